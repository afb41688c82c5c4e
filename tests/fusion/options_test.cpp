// The shipped configuration is read whole, and errors in one are found.
#include "services/fusion/options.h"

#include <cmath>
#include <filesystem>
#include <fstream>

#include <gtest/gtest.h>

#include "common/config/config.h"

namespace orthonav::fusion {
namespace {

std::filesystem::path written(const std::string& text) {
  const auto file = std::filesystem::path(::testing::TempDir()) / "fusion.yaml";
  std::ofstream(file) << text;
  return file;
}

TEST(FusionOptions, EveryShippedScenarioIsRead) {
  int found = 0;
  for (const auto& folder : std::filesystem::directory_iterator(std::filesystem::path(ORTHONAV_SOURCE) / "config")) {
    const auto file = folder.path() / "fusion.yaml";
    if (!std::filesystem::exists(file)) continue;
    EXPECT_NO_THROW(FusionOptions::load(file)) << file;
    ++found;
  }
  EXPECT_GE(found, 4);
}

TEST(FusionOptions, AnglesAreInDegreesInTheFile) {
  const FusionOptions options = FusionOptions::load(written("edge: {tilt_stddev_deg: 90}"));
  EXPECT_NEAR(options.edge.tilt_stddev, M_PI_2, 1e-12);
}

TEST(FusionOptions, AMisspeltKeyIsAnErrorWithItsLine) {
  try {
    FusionOptions::load(written("window_keyframes: 50\ngate:\n  lock_fixs: 2\n"));
    FAIL() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("lock_fixs"), std::string::npos) << error.what();
    EXPECT_NE(std::string(error.what()).find(":3"), std::string::npos) << error.what();
  }
}

TEST(FusionOptions, ValuesOutOfRangeAreRefused) {
  EXPECT_THROW(FusionOptions::load(written("window_keyframes: 1")), ConfigError);
  EXPECT_THROW(FusionOptions::load(written("fix: {huber: -1}")), ConfigError);
  EXPECT_THROW(FusionOptions::load(written("edge: {position_stddev: 0}")), ConfigError);
}

}  // namespace
}  // namespace orthonav::fusion
