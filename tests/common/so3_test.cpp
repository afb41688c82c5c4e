#include "common/math/so3.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

namespace orthonav {
namespace {

Eigen::Vector3d random_vector(std::mt19937& generator, double length) {
  std::normal_distribution<double> normal;
  return length * Eigen::Vector3d(normal(generator), normal(generator), normal(generator)).normalized();
}

TEST(So3, LogInvertsExpFromTinyToPi) {
  std::mt19937 generator(1);
  for (const double angle : {0.0, 1e-12, 1e-7, 9e-6, 1.1e-5, 1e-3, 1.0, 3.0, M_PI - 1e-6}) {
    const Eigen::Vector3d phi = random_vector(generator, angle);
    EXPECT_LT((so3_log(so3_exp(phi)) - phi).norm(), 1e-9) << angle;
  }
}

TEST(So3, ExpIsTheMatrixExponential) {
  const Eigen::Vector3d phi(0.3, -0.2, 0.5);
  Eigen::Matrix3d sum = Eigen::Matrix3d::Identity(), term = Eigen::Matrix3d::Identity();
  for (int k = 1; k < 25; ++k) {
    term = term * skew(phi) / k;
    sum += term;
  }
  EXPECT_LT((so3_exp(phi).toRotationMatrix() - sum).norm(), 1e-14);
}

TEST(So3, RightJacobianAgreesWithFiniteDifferences) {
  std::mt19937 generator(2);
  for (const double angle : {1e-7, 1e-3, 0.7, 2.5}) {
    const Eigen::Vector3d phi = random_vector(generator, angle);
    Eigen::Matrix3d numeric;
    constexpr double kStep = 1e-6;
    for (int i = 0; i < 3; ++i) {
      const Eigen::Vector3d d = kStep * Eigen::Vector3d::Unit(i);
      numeric.col(i) = (so3_log(so3_exp(phi).conjugate() * so3_exp(phi + d)) -
                        so3_log(so3_exp(phi).conjugate() * so3_exp(phi - d))) /
                       (2 * kStep);
    }
    EXPECT_LT((so3_right_jacobian(phi) - numeric).norm(), 1e-8) << angle;
    EXPECT_LT((so3_right_jacobian_inverse(phi) * so3_right_jacobian(phi) - Eigen::Matrix3d::Identity()).norm(), 1e-10);
  }
}

TEST(So3, HeadingIsClockwiseFromNorth) {
  const auto body_facing = [](double yaw) { return so3_exp(Eigen::Vector3d(0, 0, yaw)); };
  EXPECT_NEAR(heading_of(body_facing(M_PI_2)), 0.0, 1e-12);       // x axis to the north
  EXPECT_NEAR(heading_of(body_facing(0.0)), M_PI_2, 1e-12);       // to the east
  EXPECT_NEAR(heading_of(body_facing(-M_PI_2)), M_PI, 1e-12);     // to the south
  EXPECT_NEAR(heading_of(body_facing(M_PI)), 1.5 * M_PI, 1e-12);  // to the west
}

TEST(So3, AnglesWrapToTheHalfOpenInterval) {
  EXPECT_DOUBLE_EQ(wrap_angle(-M_PI), M_PI);
  EXPECT_NEAR(wrap_angle(7.0), 7.0 - 2 * M_PI, 1e-15);
}

}  // namespace
}  // namespace orthonav
