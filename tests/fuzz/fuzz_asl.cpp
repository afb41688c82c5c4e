// A EuRoC/ASL folder: the tables of the IMU, the images and the ground truth, one after the other in the input.
#include <algorithm>
#include <filesystem>
#include <stdexcept>

#include "services/ingest/asl_source.h"
#include "tests/fuzz/scratch_file.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace orthonav;
  const uint8_t* const end = data + size;
  for (const char* table : {"imu0", "cam0", "state_groundtruth_estimate0"}) {
    // The tables are parted by a zero byte.
    const uint8_t* const stop = std::find(data, end, uint8_t{0});
    std::filesystem::create_directories(fuzz::scratch_folder() / "mav0" / table / "data");
    fuzz::scratch_file(std::filesystem::path("mav0") / table / "data.csv", data, static_cast<size_t>(stop - data));
    data = stop == end ? end : stop + 1;
  }
  try {
    ingest::AslSource source(fuzz::scratch_folder());
    while (source.next()) source.progress();
  } catch (const std::runtime_error&) {
  }
  return 0;
}
