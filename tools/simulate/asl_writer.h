// Writes a flight as an EuRoC/ASL folder, so that other estimators can be run on it.
//
//   DIR/mav0/body.yaml
//   DIR/mav0/cam0/{sensor.yaml,data.csv,data/<ns>.jpg}          (.png where the flight has raw images)
//   DIR/mav0/imu0/{sensor.yaml,data.csv}
//   DIR/mav0/state_groundtruth_estimate0/{sensor.yaml,data.csv}
//
// The reference frame R of the ground truth is G, the sensor frame S of imu0 and of the ground truth is B.
#pragma once

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <vector>

#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/truth_t.hpp"
#include "tools/simulate/scenario.h"

namespace orthonav::simulate {

class AslWriter {
 public:
  // Makes the folder. Throws std::runtime_error naming a file that cannot be written, as the other functions do.
  AslWriter(const std::filesystem::path& folder, const Scenario& scenario);

  void write_imu(const imu_t& imu);
  void write_image(const image_t& image);
  void write_truth(const truth_t& truth, const EnuFrame& frame);
  // Flushes and checks that everything arrived on the disk.
  void finish();

 private:
  std::filesystem::path root_;
  std::ofstream imu_, images_, truth_;
};

}  // namespace orthonav::simulate
