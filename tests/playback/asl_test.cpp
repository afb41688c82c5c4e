// Datasets in EuRoC/ASL layout through the same program as flights.
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "orthonav/vio_state_t.hpp"
#include "tests/support/temporary_folder.h"
#include "tools/replay/replay.h"

namespace orthonav {
namespace {

namespace fs = std::filesystem;

fs::path sequence(const std::string& name) {
  const char* variable = std::getenv("ORTHONAV_DATA");
  const fs::path data = variable ? fs::path(variable) : fs::path(ORTHONAV_SOURCE).parent_path() / "shared/data";
  return data / "vio" / name;
}

std::vector<std::vector<double>> numbers(const fs::path& file, char separator) {
  std::vector<std::vector<double>> rows;
  std::ifstream stream(file);
  for (std::string line; std::getline(stream, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::stringstream cells(line);
    rows.emplace_back();
    for (std::string cell; std::getline(cells, cell, separator);) rows.back().push_back(std::stod(cell));
  }
  return rows;
}

TEST(ReplayAsl, FliesTheRealFragmentAndWritesItsTrajectory) {
  const fs::path folder = sequence("real_V1_01_fragment");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is not there (set ORTHONAV_DATA)";
  const test::TemporaryFolder out;
  replay::ReplayOptions options;
  options.asl = folder;
  options.trajectory = out / "vio.tum";
  options.times = out / "times.csv";
  replay::replay(options);
  const auto times = numbers(options.times, ',');
  ASSERT_EQ(times.size(), 90u);  // one for each image
  // Once it tracks it goes on tracking. A start whose scale turns out wrong may be published anew, as a new session.
  bool started = false;
  for (const auto& row : times) {
    ASSERT_EQ(row.size(), 5u);
    EXPECT_FALSE(started && row[2] == vio_state_t::INITIALISING) << "lost at " << row[0];
    started = started || row[2] != vio_state_t::INITIALISING;
  }
  EXPECT_TRUE(started);
  const auto states = numbers(options.trajectory, ' ');
  double previous = 0;
  for (const auto& state : states) {
    ASSERT_EQ(state.size(), 8u);
    EXPECT_GT(state[0], previous);
    previous = state[0];
    EXPECT_NEAR(std::hypot(std::hypot(state[4], state[5]), std::hypot(state[6], state[7])), 1, 1e-6);
    EXPECT_LT(std::hypot(state[1], state[2], state[3]), 3.0);  // of 1.3 m
  }
}

TEST(ReplayAsl, NamesAFolderThatHasNoCalibration) {
  const test::TemporaryFolder folder;
  fs::create_directories(folder / "mav0/cam0/data");
  fs::create_directories(folder / "mav0/imu0");
  std::ofstream(folder / "mav0/cam0/data.csv") << "#timestamp [ns],filename\n";
  std::ofstream(folder / "mav0/imu0/data.csv") << "#timestamp [ns]\n";
  replay::ReplayOptions options;
  options.asl = folder.path();
  try {
    replay::replay(options);
    FAIL() << "a folder without calibration passed";
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("cam0/sensor.yaml"), std::string::npos) << error.what();
  }
}

}  // namespace
}  // namespace orthonav
