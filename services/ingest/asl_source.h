// A dataset in EuRoC/ASL layout: mav0/cam0 (images), mav0/imu0, and mav0/state_groundtruth_estimate0 as TRUTH.
//
// The dataset's local frame has no place on Earth: the truth is put on a frame anchored at latitude and longitude 0,
// its x axis to the east, which is enough for trajectory errors after alignment.
#pragma once

#include <filesystem>
#include <fstream>

#include "common/geo/enu_frame.h"
#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class AslSource : public SensorSource {
 public:
  // `folder` holds mav0/, or is it. Throws std::runtime_error naming the file that is missing: cam0/data.csv and
  // imu0/data.csv are needed, the ground truth is not.
  explicit AslSource(const std::filesystem::path& folder);

  std::optional<SensorEvent> next() override;
  double progress() const override;

 private:
  // One csv file, read ahead by a line.
  struct Table {
    std::filesystem::path file;
    std::ifstream stream;
    std::string row;
    int line = 0;
    int64_t time_ns = -1;  // of `row`; -1 at the end

    bool open(const std::filesystem::path& csv);
    void advance();
  };

  SensorEvent read_imu();
  SensorEvent read_image();
  SensorEvent read_truth();

  std::filesystem::path images_;
  Table imu_, camera_, truth_;
  EnuFrame frame_{Geodetic{}};
  uintmax_t imu_bytes_ = 1;
};

}  // namespace orthonav::ingest
