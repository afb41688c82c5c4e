#include "services/vio/vio.h"

#include <cmath>
#include <functional>
#include <limits>
#include <random>

#include <gtest/gtest.h>

#include "common/math/align.h"
#include "common/math/so3.h"
#include "services/vio/two_point.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

using Eigen::Vector3d;

constexpr int kFirstSession = 1000;  // the second of the first image

int64_t to_utime(double t) {
  return 1'000'000'000 + static_cast<int64_t>(std::llround(1e6 * t));
}

const TexturedGround& ground() {
  static const TexturedGround instance(60, 0.06, 1);
  return instance;
}

const Trajectory& flight() {
  static const Trajectory instance = survey_flight(40, 2.0);
  return instance;
}

Vio make_vio() {
  return Vio({}, test_camera(), downward_camera());
}

// Feeds a stretch of the flight; `change_image` and `change_imu` break the input.
struct Feeder {
  std::function<cv::Mat(double, cv::Mat)> change_image = [](double, cv::Mat image) { return image; };
  std::function<bool(double, ImuSample&)> change_imu = [](double, ImuSample&) { return true; };
  std::vector<VioOutput> outputs = {};

  void run(Vio& vio, double from, double to) {
    for (int k = static_cast<int>(std::lround(from * 200)); k <= std::lround(to * 200); ++k) {
      const double t = 0.005 * k;
      if (k % 20 == 0) vio.feed_image(to_utime(t), change_image(t, ground().picture(flight(), t)));
      ImuSample sample = flight().imu(t, 9.81);
      if (change_imu(t, sample)) vio.feed_imu(sample);
      while (auto output = vio.next()) outputs.push_back(*output);
    }
  }
};

TEST(Vio, FliesOnPicturesOfAPlane) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.run(vio, 0, 25);
  // The last image may still wait for the IMU, by the time offset.
  ASSERT_GE(feeder.outputs.size(), 250u);
  std::vector<Vector3d> estimate, truth;
  for (const VioOutput& output : feeder.outputs) {
    if (output.status != Estimator::Status::kTracking) continue;
    estimate.emplace_back(output.state.p());
    truth.push_back(flight().position(1e-6 * static_cast<double>(output.utime - 1'000'000'000)));
  }
  ASSERT_GT(estimate.size(), 150u);
  const Similarity fit = align_yaw_translation(estimate, truth);
  for (size_t i = 0; i < truth.size(); ++i) EXPECT_LT((fit * estimate[i] - truth[i]).norm(), 1.0) << i;
  EXPECT_EQ(vio.session(), kFirstSession);
}

TEST(Vio, KeyframeFeaturesLieWhereTheirPixelsAre) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.run(vio, 0, 20);
  const CameraModel camera = test_camera();
  const Extrinsics extrinsics = downward_camera();
  int keyframes = 0;
  for (const VioOutput& output : feeder.outputs) {
    if (!output.keyframe) continue;
    ++keyframes;
    EXPECT_EQ(output.keyframe->utime, output.utime);
    EXPECT_GT(output.keyframe->features.size(), 20u);
    const StateValues& state = output.keyframe->state;
    for (const KeyframeFeature& feature : output.keyframe->features) {
      const Vector3d p_C =
          extrinsics.R_B_C.transpose() * (state.q().conjugate() * (feature.p_W - state.p()) - extrinsics.p_B_C);
      const auto pixel = camera.project(p_C);
      ASSERT_TRUE(pixel);
      EXPECT_LT((*pixel - feature.pixel).norm(), 8.0);
    }
  }
  EXPECT_GT(keyframes, 5);
}

TEST(Vio, RepeatsBitForBit) {
  Vio a = make_vio(), b = make_vio();
  Feeder first, second;
  first.run(a, 0, 12);
  second.run(b, 0, 12);
  ASSERT_EQ(first.outputs.size(), second.outputs.size());
  for (size_t i = 0; i < first.outputs.size(); ++i) {
    EXPECT_EQ(first.outputs[i].state.pose, second.outputs[i].state.pose);
    EXPECT_EQ(first.outputs[i].state.speed_bias, second.outputs[i].state.speed_bias);
  }
}

TEST(Vio, BeginsANewSessionWhenAskedAndNotTwiceAtOnce) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.run(vio, 0, 12);
  ASSERT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
  const size_t before = feeder.outputs.size();
  EXPECT_TRUE(vio.reset("a test"));
  EXPECT_FALSE(vio.reset("a test"));
  EXPECT_EQ(vio.counters().at("reset.rejected.too_soon"), 1);
  feeder.run(vio, 12, 25);
  const VioOutput& next = feeder.outputs[before];
  EXPECT_EQ(next.status, Estimator::Status::kInitialising);
  EXPECT_EQ(next.session, kFirstSession + 1);
  EXPECT_NE(next.reason.find("a test"), std::string::npos) << next.reason;
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
  EXPECT_EQ(feeder.outputs.back().session, kFirstSession + 1);
  EXPECT_TRUE(vio.reset("a test, later"));
}

TEST(Vio, CountsAndSurvivesBadImu) {
  Vio vio = make_vio();
  Feeder feeder;
  int k = 0;
  feeder.change_imu = [&](double, ImuSample& sample) {
    ++k;
    if (k % 50 == 10) sample.gyro.x() = std::numeric_limits<double>::quiet_NaN();
    if (k % 50 == 20) sample.utime -= 40000;
    if (k % 50 == 30) sample.accel.z() = 1e6;
    return true;
  };
  feeder.run(vio, 0, 15);
  EXPECT_GT(vio.counters().at("imu.rejected.not_finite"), 40);
  EXPECT_GT(vio.counters().at("imu.rejected.order"), 40);
  EXPECT_GT(vio.counters().at("imu.rejected.implausible"), 40);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
  EXPECT_EQ(vio.session(), kFirstSession);
}

TEST(Vio, CountsAndSurvivesBadImages) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.run(vio, 0, 10);
  vio.feed_image(to_utime(10.0), ground().picture(flight(), 10.0));          // the time of the last one
  vio.feed_image(to_utime(10.05), cv::Mat(100, 100, CV_8U, cv::Scalar(3)));  // another size
  vio.feed_image(to_utime(10.05), cv::Mat());
  feeder.run(vio, 10.1, 12);
  EXPECT_EQ(vio.counters().at("camera.rejected.order"), 1);
  EXPECT_EQ(vio.counters().at("camera.rejected.size"), 2);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
}

TEST(Vio, RestartsWithANewSessionAfterBlindness) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.change_image = [](double t, cv::Mat image) {
    return t > 10 && t < 13.5 ? cv::Mat(480, 640, CV_8U, cv::Scalar(40)) : image;
  };
  feeder.run(vio, 0, 28);
  EXPECT_EQ(vio.session(), kFirstSession + 1);
  EXPECT_EQ(vio.counters().at("restarts"), 1);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
  EXPECT_EQ(feeder.outputs.back().session, kFirstSession + 1);
  bool said_why = false;
  for (const VioOutput& output : feeder.outputs) {
    if (output.session == kFirstSession + 1 && output.status == Estimator::Status::kInitialising) {
      said_why = said_why || output.reason.find("landmarks in view") != std::string::npos;
      EXPECT_EQ(output.last_keyframe_id, -1);
    }
  }
  EXPECT_TRUE(said_why);
}

TEST(Vio, BridgesAShortImuGapAndRestartsAfterALongOne) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.change_imu = [](double t, ImuSample&) { return !(t > 10.02 && t < 10.1); };
  feeder.run(vio, 0, 12);
  EXPECT_EQ(vio.session(), kFirstSession);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
  feeder.change_imu = [](double t, ImuSample&) { return !(t > 12.5 && t < 13.5); };
  feeder.run(vio, 12.1, 24);
  EXPECT_EQ(vio.session(), kFirstSession + 1);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
}

// Three samples from the future, of the IMU or of the camera, as a glitch of a clock makes them.
TEST(Vio, StampsInTheFutureCostNeitherTheSessionNorASecond) {
  for (const double ahead : {0.3, 5.0, 3600.0}) {
    Vio vio = make_vio();
    Feeder feeder;
    feeder.run(vio, 0, 10);
    ASSERT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
    for (int k = 1; k <= 3; ++k) {
      ImuSample sample = flight().imu(10, 9.81);
      sample.utime += static_cast<int64_t>(1e6 * ahead) + 5000 * k;
      vio.feed_imu(sample);
      vio.feed_image(sample.utime, ground().picture(flight(), 10));
    }
    const size_t before = feeder.outputs.size();
    feeder.run(vio, 10.005, 13);
    ASSERT_GE(feeder.outputs.size(), before + 29) << ahead;
    EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking) << ahead;
    EXPECT_EQ(vio.session(), kFirstSession) << ahead;
    EXPECT_LT(feeder.outputs[before].utime, to_utime(10.2)) << ahead;
    if (ahead > 1) {
      EXPECT_EQ(vio.counters().at("imu.rejected.future"), 3) << ahead;
      EXPECT_EQ(vio.counters().at("camera.rejected.future"), 3) << ahead;
    }
  }
}

TEST(Vio, StartsAlthoughTheFirstStampsWereInTheFuture) {
  Vio vio = make_vio();
  ImuSample sample = flight().imu(0, 9.81);
  for (int k = 1; k <= 3; ++k) {
    sample.utime = to_utime(500 + 0.005 * k);
    vio.feed_imu(sample);
  }
  Feeder feeder;
  feeder.run(vio, 0, 12);
  ASSERT_FALSE(feeder.outputs.empty());
  EXPECT_LT(feeder.outputs.front().utime, to_utime(1.0));
  EXPECT_EQ(vio.counters().at("imu.stepped_back"), 1);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
}

TEST(Vio, StartsANewSessionWhenAllClocksAreSetBack) {
  Vio vio = make_vio();
  Feeder feeder;
  feeder.run(vio, 20, 30);
  ASSERT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
  const int session = vio.session();
  const size_t before = feeder.outputs.size();
  feeder.run(vio, 0, 12);
  ASSERT_GT(feeder.outputs.size(), before + 110);
  EXPECT_NE(feeder.outputs[before].reason.find("set back"), std::string::npos) << feeder.outputs[before].reason;
  EXPECT_EQ(vio.session(), session + 1);
  EXPECT_EQ(feeder.outputs.back().status, Estimator::Status::kTracking);
}

TEST(TwoPoint, FindsOutliersOnAPlaneAndKeepsEverythingAtRest) {
  std::mt19937 generator(1);
  std::uniform_real_distribution<double> uniform(-1, 1);
  std::vector<Vector3d> rays_1, rays_2, rays_still;
  const Eigen::Matrix3d R = so3_exp({0.02, -0.01, 0.03}).toRotationMatrix();
  for (int i = 0; i < 60; ++i) {
    const Vector3d point(40 * uniform(generator), 30 * uniform(generator), 100);
    rays_1.emplace_back(point / point.z());
    Vector3d moved = R * point + Vector3d(2, 1, 0.2);
    rays_still.emplace_back((R * point) / (R * point).z());
    moved /= moved.z();
    if (i % 6 == 0) moved += Vector3d(0.03, -0.06, 0);
    rays_2.push_back(moved);
  }
  const auto inliers = two_point_inliers(rays_1, rays_2, R, 1.5 / 850);
  for (size_t i = 0; i < 60; ++i) EXPECT_EQ(inliers[i], i % 6 != 0) << i;
  for (const bool inlier : two_point_inliers(rays_1, rays_still, R, 1.5 / 850)) EXPECT_TRUE(inlier);
}

}  // namespace
}  // namespace orthonav::vio
