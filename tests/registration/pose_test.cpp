#include "services/registration/paper/pose.h"

#include <random>

#include <gtest/gtest.h>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

struct Scene {
  CameraPose truth;
  std::vector<Eigen::Vector2d> rays;
  std::vector<Eigen::Vector3d> points;
};

// Points on ground with 3 m of relief, far from the origin, seen from 110 m with a tilt.
Scene scene(std::mt19937& random, int count) {
  Scene scene;
  Eigen::Matrix3d down;
  down << 0, -1, 0, -1, 0, 0, 0, 0, -1;
  scene.truth.R_G_C = so3_exp({0.08, -0.05, 1.1}).toRotationMatrix() * down;
  scene.truth.p_G_C = {812, -640, 131};
  std::uniform_real_distribution<double> across(-0.35, 0.35);
  std::uniform_real_distribution<double> relief(-1.5, 1.5);
  for (int i = 0; i < count; ++i) {
    const Eigen::Vector3d ray = scene.truth.R_G_C * Eigen::Vector3d(across(random), across(random), 1);
    const double z = 20 + relief(random);
    scene.points.push_back(scene.truth.p_G_C + (z - scene.truth.p_G_C.z()) / ray.z() * ray);
    const Eigen::Vector3d p_C = scene.truth.R_G_C.transpose() * (scene.points.back() - scene.truth.p_G_C);
    scene.rays.emplace_back(p_C.hnormalized());
  }
  return scene;
}

TEST(Pnp, RecoversThePoseFromAGuessThatIsOff) {
  std::mt19937 random(2);
  const Scene s = scene(random, 20);
  CameraPose guess = s.truth;
  guess.p_G_C += Eigen::Vector3d(6, -5, 4);
  guess.R_G_C = so3_exp({0.03, 0.02, 0.06}).toRotationMatrix() * guess.R_G_C;
  const auto result = solve_pnp(s.rays, s.points, 850, guess);
  ASSERT_TRUE(result);
  EXPECT_LT((result->pose.p_G_C - s.truth.p_G_C).norm(), 1e-3);
  EXPECT_LT((result->pose.R_G_C - s.truth.R_G_C).norm(), 1e-5);
  EXPECT_LT(result->rms, 1e-3);
}

TEST(Pnp, SaysHowUncertainItIs) {
  std::mt19937 random(3);
  constexpr double kFocal = 850;
  std::normal_distribution<double> noise(0, 1.0 / kFocal);
  double chi_square = 0;
  constexpr int kRounds = 300;
  for (int round = 0; round < kRounds; ++round) {
    Scene s = scene(random, 40);
    for (Eigen::Vector2d& ray : s.rays) ray += Eigen::Vector2d(noise(random), noise(random));
    const auto result = solve_pnp(s.rays, s.points, kFocal, s.truth);
    ASSERT_TRUE(result);
    const Eigen::Vector3d error = result->pose.p_G_C - s.truth.p_G_C;
    chi_square += error.dot(result->position_covariance.ldlt().solve(error)) / kRounds;
  }
  EXPECT_NEAR(chi_square, 3.0, 0.45);
}

TEST(Pnp, RefusesTooFewPointsAndPointsBehindTheCamera) {
  std::mt19937 random(4);
  Scene s = scene(random, 12);
  EXPECT_FALSE(solve_pnp({s.rays.begin(), s.rays.begin() + 5}, {s.points.begin(), s.points.begin() + 5}, 850, s.truth));
  CameraPose above = s.truth;
  above.R_G_C = above.R_G_C * so3_exp({M_PI, 0, 0}).toRotationMatrix();
  const auto result = solve_pnp(s.rays, s.points, 850, above);
  if (result) {
    EXPECT_LT((result->pose.p_G_C - s.truth.p_G_C).norm(), 1);
  }
}

TEST(TiltDifference, DoesNotSeeTheHeading) {
  const Eigen::Matrix3d R = so3_exp({0.1, 3.0, 0.2}).toRotationMatrix();
  EXPECT_NEAR(tilt_difference(so3_exp({0, 0, 1.3}).toRotationMatrix() * R, R), 0, 1e-7);
  EXPECT_NEAR(tilt_difference(so3_exp({0.2, 0, 0}).toRotationMatrix(), Eigen::Matrix3d::Identity()), 0.2, 1e-9);
}

}  // namespace
}  // namespace orthonav::registration
