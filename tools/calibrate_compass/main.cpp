// Fits hard and soft iron to a recorded turn and writes the aircraft's compass.yaml.
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <numbers>
#include <stdexcept>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/compass/level.h"
#include "common/compass/magnetic_calibration.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/imu_t.hpp"
#include "orthonav/magnetometer_t.hpp"

namespace {

namespace fs = std::filesystem;
using namespace orthonav;

struct Recording {
  std::vector<Eigen::Vector3d> readings, ups;
  int unusable = 0;  // before the first IMU sample, or not finite
};

Recording read(const fs::path& log) {
  Recording recording;
  Level level;
  LogReader reader(log);
  while (const auto event = reader.next()) {
    if (event->channel == channel::kImu) {
      if (const auto imu = event->decode<imu_t>()) {
        level.feed(imu->utime, Eigen::Map<const Eigen::Vector3d>(imu->angular_rate),
                   Eigen::Map<const Eigen::Vector3d>(imu->specific_force));
      }
    } else if (event->channel == channel::kMagnetometer) {
      const auto sample = event->decode<magnetometer_t>();
      const bool usable = sample && level.up_B() && Eigen::Map<const Eigen::Vector3d>(sample->field).allFinite();
      if (!usable) {
        ++recording.unusable;
        continue;
      }
      recording.readings.emplace_back(Eigen::Map<const Eigen::Vector3d>(sample->field));
      recording.ups.push_back(*level.up_B());
    }
  }
  return recording;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Fits the compass's hard and soft iron to a recorded turn (channels MAGNETOMETER and IMU) and writes "
      "compass.yaml."};
  fs::path log, out;
  app.add_option("log", log, "LCM log of at least one whole turn, level or tumbling")
      ->required()
      ->check(CLI::ExistingFile);
  app.add_option("--out", out, "compass.yaml of the aircraft's configuration folder")->required();
  CLI11_PARSE(app, argc, argv);
  try {
    const Recording recording = read(log);
    const CalibrationFit fit = fit_calibration(recording.readings, recording.ups);
    constexpr double kDegrees = 180 / std::numbers::pi;
    const std::string summary =
        fmt::format("{}, {} readings over {:.0f} degrees, field even to {:.2f} % (uncorrected {:.1f} %)",
                    fit.full ? "all axes" : "level turn: horizontal axes only", recording.readings.size(),
                    fit.coverage * kDegrees, 100 * fit.residual, 100 * fit.raw_residual);
    std::ofstream file(out);
    file << fit.calibration.to_yaml("orthonav-calibrate-compass: " + log.filename().string() + ", " + summary);
    file.close();
    if (!file) throw std::runtime_error(out.string() + ": cannot write");
    fmt::print("{}\n", summary);
    if (recording.unusable > 0) fmt::print("{} readings could not be used\n", recording.unusable);
    return 0;
  } catch (const std::exception& error) {
    fmt::print(stderr, "orthonav-calibrate-compass: {}: {}\n", log.string(), error.what());
    return 1;
  }
}
