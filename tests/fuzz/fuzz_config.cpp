// Configuration files, by the first byte: an aircraft's, Kalibr's chain and IMU, a compass's, a board's sensors, the
// boards.
#include "common/camera/aircraft.h"
#include "common/camera/camera_model.h"
#include "common/compass/magnetic_calibration.h"
#include "common/config/config.h"
#include "services/ingest/sensor_options.h"
#include "tests/fuzz/scratch_file.h"
#include "tools/boards/boards.h"

namespace {

using namespace orthonav;

void read(int kind, const char* text, size_t size) {
  const auto folder = fuzz::scratch_folder();
  switch (kind) {
    case 0: {
      fuzz::scratch_file("aircraft.yaml", text, size);
      ConfigNode node = load_aircraft(folder);
      ConfigNode camera = node.child("camera");
      CameraModel::from_config(camera);
      break;
    }
    case 1:
    case 2: {
      const std::string aircraft =
          kind == 1 ? "kalibr:\n  camchain: chain.yaml\n" : "kalibr:\n  camchain: sound.yaml\n  imu: imu.yaml\n";
      fuzz::scratch_file("aircraft.yaml", aircraft.data(), aircraft.size());
      const std::string sound =
          "cam0:\n  camera_model: pinhole\n  intrinsics: [400, 400, 320, 240]\n  distortion_model: radtan\n"
          "  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [640, 480]\n  T_cam_imu:\n  - [1, 0, 0, 0]\n  - [0, 1, 0, "
          "0]\n"
          "  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n";
      fuzz::scratch_file("sound.yaml", sound.data(), sound.size());
      fuzz::scratch_file(kind == 1 ? "chain.yaml" : "imu.yaml", text, size);
      load_aircraft(folder);
      break;
    }
    case 3:
      MagneticCalibration::load(fuzz::scratch_file("compass.yaml", text, size));
      break;
    case 4:
      fuzz::scratch_file("ingest.yaml", text, size);
      ingest::SensorOptions::load(folder);
      break;
    default:
      boards::load(fuzz::scratch_file("boards.yaml", text, size));
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  if (size == 0) return 0;
  try {
    read(data[0] % 6, reinterpret_cast<const char*>(data) + 1, size - 1);
  } catch (const orthonav::ConfigError&) {
    // The only thing that a file may do.
  }
  return 0;
}
