// What a killed service left for the next: any bytes as its file, and any numbers behind a sound checksum.
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "services/fusion/fusion.h"
#include "services/vio/memory.h"
#include "tests/fuzz/scratch_file.h"

namespace {

using namespace orthonav;

// The numbers of the input, in turn; zeros at its end.
class Numbers {
 public:
  Numbers(const uint8_t* data, size_t size) : data_(data), size_(size) {}
  template <class Number>
  void take(Number& number) {
    const size_t length = std::min(sizeof(number), size_);
    if (length > 0) std::memcpy(&number, data_, length);
    data_ += length;
    size_ -= length;
  }

 private:
  const uint8_t* data_;
  size_t size_;
};

void go_on(const fusion::Memory& memory) {
  fusion::Fusion fusion{fusion::FusionOptions{}};
  if (!fusion.resume(memory)) return;
  fusion::OdometryState state;
  state.utime = memory.keyframe.utime < INT64_MAX - 1'000'000 ? memory.keyframe.utime + 1'000'000 : 0;
  state.session = memory.keyframe.session;
  state.has_pose = true;
  const fusion::Solution solution = fusion.propagate(state).solution;
  // Whatever is gone on with, a position is a number or says that it is none.
  if (std::isinf(solution.position.latitude_deg) || std::abs(solution.position.latitude_deg) > 90) std::abort();
  fusion::Keyframe keyframe = memory.keyframe;
  keyframe.utime = state.utime;
  ++keyframe.id;
  fusion.add_keyframe(keyframe);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto file = fuzz::scratch_file("memory", data, size);
  vio::read_memory(file);
  if (const auto memory = fusion::read_memory(file)) go_on(*memory);

  Numbers numbers(data, size);
  fusion::Memory memory;
  numbers.take(memory.keyframe.utime);
  numbers.take(memory.session_utime);
  numbers.take(memory.newest_fix_utime);
  for (int* number : {&memory.keyframe.session, &memory.keyframe.id, &memory.believed, &memory.reset_counter}) {
    numbers.take(*number);
  }
  for (double* number : {&memory.anchor.latitude_deg, &memory.anchor.longitude_deg, &memory.anchor.height,
                         &memory.keyframe.height_above_ground}) {
    numbers.take(*number);
  }
  for (double& number : memory.keyframe.p_W_B) numbers.take(number);
  for (double& number : memory.keyframe.q_W_B.coeffs()) numbers.take(number);
  for (double& number : memory.estimate.state.x) numbers.take(number);
  for (double& number : memory.estimate.covariance.reshaped()) numbers.take(number);
  fusion::write_memory(file, memory);
  const auto read = fusion::read_memory(file);
  if (!read) std::abort();
  go_on(*read);
  return 0;
}
