// The shipped configuration is read whole, and errors in one are found.
#include "services/fusion/options.h"

#include <cmath>
#include <filesystem>
#include <fstream>

#include <gtest/gtest.h>

#include "common/config/config.h"

namespace orthonav::fusion {
namespace {

constexpr const char* kAircraft = "magnetic_declination_deg: -90\nimu: {gravity: 9.79}\n";

// A configuration folder with this fusion.yaml.
std::filesystem::path written(const std::string& text) {
  const auto folder = std::filesystem::path(::testing::TempDir()) / "fusion_options";
  std::filesystem::create_directories(folder);
  std::ofstream(folder / "fusion.yaml") << text;
  std::ofstream(folder / "aircraft.yaml") << kAircraft;
  return folder;
}

TEST(FusionOptions, EveryShippedScenarioIsRead) {
  int found = 0;
  for (const auto& folder : std::filesystem::directory_iterator(std::filesystem::path(ORTHONAV_SOURCE) / "config")) {
    const auto file = folder.path() / "fusion.yaml";
    if (!std::filesystem::exists(file)) continue;
    EXPECT_NO_THROW(FusionOptions::load(folder.path())) << file;
    ++found;
  }
  EXPECT_GE(found, 4);
}

TEST(FusionOptions, AnglesAreInDegreesInTheFile) {
  const FusionOptions options = FusionOptions::load(written("compass: {noise_stddev_deg: 90}"));
  EXPECT_NEAR(options.compass.noise_stddev, M_PI_2, 1e-12);
}

TEST(FusionOptions, DeclinationAndGravityAreTheAircrafts) {
  const FusionOptions options = FusionOptions::load(written("{}"));
  EXPECT_NEAR(options.declination, -M_PI_2, 1e-12);
  EXPECT_EQ(options.inertial.gravity, 9.79);
}

TEST(FusionOptions, AMisspeltKeyIsAnErrorWithItsLine) {
  try {
    FusionOptions::load(written("window_keyframes: 50\nlock:\n  probabilty: 0.9\n"));
    FAIL() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("probabilty"), std::string::npos) << error.what();
    EXPECT_NE(std::string(error.what()).find(":3"), std::string::npos) << error.what();
  }
}

TEST(FusionOptions, ValuesOutOfRangeAreRefused) {
  EXPECT_THROW(FusionOptions::load(written("window_keyframes: 1")), ConfigError);
  EXPECT_THROW(FusionOptions::load(written("fix: {huber: -1}")), ConfigError);
  EXPECT_THROW(FusionOptions::load(written("edge: {position_walk: 0}")), ConfigError);
}

}  // namespace
}  // namespace orthonav::fusion
