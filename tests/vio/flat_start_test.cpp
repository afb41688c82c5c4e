// The start over flat ground: from exact data the exact motion, and what it cannot do said.
#include "services/vio/flat_start.h"

#include <algorithm>
#include <memory>

#include <gtest/gtest.h>

#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

struct Window {
  std::vector<std::unique_ptr<Frame>> frames;
  std::map<int64_t, Landmark> landmarks;

  std::vector<Frame*> pointers() const {
    std::vector<Frame*> result;
    for (const auto& frame : frames) result.push_back(frame.get());
    return result;
  }
};

// A frame each 0.4 s of the first `duration` seconds.
Window window_of(const Trajectory& trajectory, double duration, double relief, double pixel_noise) {
  Window window;
  SimulatedNoise noise;
  noise.pixel = pixel_noise;
  std::vector<ImuSample> imu;
  int k = 0;
  for (const SimulatedFrame& seen : simulate_frames(trajectory, duration, relief, noise, 7)) {
    imu.insert(imu.end(), seen.imu.begin() + (imu.empty() ? 0 : 1), seen.imu.end());
    if (k++ % 4 != 0) continue;
    auto frame = std::make_unique<Frame>();
    frame->utime = seen.utime;
    if (!window.frames.empty()) {
      frame->imu = std::make_unique<Preintegration>(Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), ImuNoise{});
      for (const ImuSample& sample : imu) frame->imu->add(sample);
    }
    imu.clear();
    if (!seen.imu.empty()) imu.push_back(seen.imu.back());
    for (const TrackedFeature& feature : seen.features) {
      Landmark& landmark = window.landmarks[feature.id];
      landmark.id = feature.id;
      landmark.observations.push_back({frame.get(), feature.pixel, feature.ray, Eigen::Vector2d::Zero()});
    }
    window.frames.push_back(std::move(frame));
  }
  return window;
}

LinearStart solve(Window& window, const Extrinsics& extrinsics = downward_camera()) {
  return solve_flat_start(window.pointers(), window.landmarks, extrinsics, 9.81, Eigen::Vector3d::Zero(),
                          test_camera().focal());
}

TEST(FlatStart, FindsHeightAndVelocityOverFlatGround) {
  for (const double height : {60.0, 285.0}) {
    const Trajectory trajectory = survey_flight(height, height / 40);
    Window window = window_of(trajectory, 5, 0, 0.05);
    const LinearStart start = solve(window);
    ASSERT_TRUE(start.ok) << start.reason;
    EXPECT_LT(start.residual, 1.0);
    std::vector<double> depths;
    for (const auto& [id, landmark] : window.landmarks) {
      if (landmark.has_depth) depths.push_back(1 / landmark.inverse_depth);
    }
    ASSERT_GT(depths.size(), 80u);
    std::nth_element(depths.begin(), depths.begin() + 40, depths.end());
    // Near enough for the estimator to end where it should.
    EXPECT_NEAR(depths[40] / height, 1.0, 0.3) << height;
    EXPECT_NEAR(window.frames.back()->state.v().norm() / trajectory.velocity(5).norm(), 1.0, 0.4) << height;
  }
}

TEST(FlatStart, SaysThatACameraThatLooksAwayFromTheGroundSeesNone) {
  Window window = window_of(survey_flight(60, 1.5), 5, 0, 0.05);
  Extrinsics forward = downward_camera();
  forward.R_B_C << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  const LinearStart start = solve(window, forward);
  EXPECT_FALSE(start.ok);
  EXPECT_EQ(start.reason, "too few features on the ground");
}

TEST(FlatStart, HoveringTellsNoHeight) {
  // Nothing moves: any height fits.
  const Trajectory trajectory = survey_flight(60, 1.5, 100);
  Window window = window_of(trajectory, 5, 0, 0.05);
  const LinearStart start = solve(window);
  EXPECT_TRUE(!start.ok || window.frames.back()->state.v().norm() < 1.0);
}

}  // namespace
}  // namespace orthonav::vio
