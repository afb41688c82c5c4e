#include "services/vio/preintegration.h"

#include <random>

#include <gtest/gtest.h>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

ImuSample at(double t, const Vector3d& gyro, const Vector3d& accel) {
  return {static_cast<int64_t>(std::llround(1e6 * t)), gyro, accel};
}

TEST(Preintegration, ConstantForceWithoutRotationIsAParabola) {
  const Vector3d force(0.3, -0.2, 9.9), bias(0.1, 0.05, -0.02);
  Preintegration pre(bias, Vector3d::Zero(), {});
  for (int k = 0; k <= 400; ++k) pre.add(at(0.005 * k, Vector3d::Zero(), force));
  const Vector3d a = force - bias;
  EXPECT_NEAR(pre.duration(), 2.0, 1e-9);
  EXPECT_LT((pre.alpha() - 0.5 * 4.0 * a).norm(), 1e-9);
  EXPECT_LT((pre.beta() - 2.0 * a).norm(), 1e-9);
}

TEST(Preintegration, ConstantRateIsTheExponential) {
  const Vector3d rate(0.4, -0.3, 0.8), bias(0.01, 0.02, -0.03);
  Preintegration pre(Vector3d::Zero(), bias, {});
  for (int k = 0; k <= 300; ++k) pre.add(at(0.005 * k, rate, Vector3d::Zero()));
  EXPECT_LT(so3_log(so3_exp(1.5 * (rate - bias)).conjugate() * pre.gamma()).norm(), 1e-9);
}

TEST(Preintegration, CircularMotionMatchesItsClosedForm) {
  // A body on a circle, x forward and y to the centre, feels a constant force and turns at a constant rate.
  const double rate = 0.7, radius = 3.0, T = 2.0;
  Preintegration pre(Vector3d::Zero(), Vector3d::Zero(), {});
  const int n = 400;
  for (int k = 0; k <= n; ++k) {
    pre.add(at(T * k / n, {0, 0, rate}, {0, rate * rate * radius, 0}));
  }
  const Vector3d velocity(rate * radius, 0, 0);
  const Vector3d expected = Vector3d(radius * std::sin(rate * T), radius * (1 - std::cos(rate * T)), 0) - velocity * T;
  EXPECT_LT((pre.alpha() - expected).norm(), 5e-5);
  const Vector3d change = so3_exp({0, 0, rate * T}) * velocity - velocity;
  EXPECT_LT((pre.beta() - change).norm(), 5e-5);
}

// Samples of an arbitrary rough motion.
std::vector<ImuSample> rough_motion(int n) {
  std::vector<ImuSample> samples;
  for (int k = 0; k <= n; ++k) {
    const double t = 0.005 * k;
    samples.push_back(at(t, {0.5 * std::sin(3 * t), 0.4 * std::cos(2 * t), 0.3 + 0.2 * std::sin(t)},
                         {std::cos(4 * t), 2 * std::sin(t), 9.8 + std::sin(5 * t)}));
  }
  return samples;
}

TEST(Preintegration, BiasJacobiansMatchFiniteDifferences) {
  const auto samples = rough_motion(200);
  const Vector3d ba(0.05, -0.1, 0.02), bg(0.01, -0.02, 0.005);
  Preintegration pre(ba, bg, {});
  for (const auto& sample : samples) pre.add(sample);
  const double step = 1e-6;
  for (int axis = 0; axis < 3; ++axis) {
    const Vector3d d = step * Vector3d::Unit(axis);
    Preintegration other = pre;
    other.repropagate(ba + d, bg);
    EXPECT_LT(((other.alpha() - pre.alpha()) / step - pre.jacobian().block<3, 1>(0, 9 + axis)).norm(), 1e-5);
    EXPECT_LT(((other.beta() - pre.beta()) / step - pre.jacobian().block<3, 1>(6, 9 + axis)).norm(), 1e-5);
    other.repropagate(ba, bg + d);
    EXPECT_LT(((other.alpha() - pre.alpha()) / step - pre.jacobian().block<3, 1>(0, 12 + axis)).norm(), 1e-4);
    EXPECT_LT(((other.beta() - pre.beta()) / step - pre.jacobian().block<3, 1>(6, 12 + axis)).norm(), 1e-4);
    const Vector3d turned = so3_log(pre.gamma().conjugate() * other.gamma()) / step;
    EXPECT_LT((turned - pre.jacobian().block<3, 1>(3, 12 + axis)).norm(), 1e-5);
  }
}

TEST(Preintegration, AppendingEqualsIntegratingThrough) {
  const auto samples = rough_motion(200);
  Preintegration whole(Vector3d::Zero(), Vector3d::Zero(), {}), first = whole, second = whole;
  for (const auto& sample : samples) whole.add(sample);
  for (size_t k = 0; k <= 120; ++k) first.add(samples[k]);
  for (size_t k = 120; k < samples.size(); ++k) second.add(samples[k]);
  first.append(second);
  EXPECT_LT((first.alpha() - whole.alpha()).norm(), 1e-12);
  EXPECT_LT((first.beta() - whole.beta()).norm(), 1e-12);
  EXPECT_LT((first.covariance() - whole.covariance()).norm(), 1e-12);
}

TEST(Preintegration, CovarianceMatchesTheScatterOfNoisySamples) {
  const ImuNoise noise{1e-3, 1e-4, 1e-2, 1e-3};
  const auto clean = rough_motion(100);
  const double dt = 0.005, root = std::sqrt(dt);
  Preintegration reference(Vector3d::Zero(), Vector3d::Zero(), noise);
  for (const auto& sample : clean) reference.add(sample);
  std::mt19937 generator(7);
  std::normal_distribution<double> normal;
  const auto draw = [&] { return Vector3d(normal(generator), normal(generator), normal(generator)); };
  constexpr int kRuns = 2000;
  Eigen::Matrix<double, 9, 9> scatter = Eigen::Matrix<double, 9, 9>::Zero();
  for (int run = 0; run < kRuns; ++run) {
    Preintegration pre(Vector3d::Zero(), Vector3d::Zero(), noise);
    Vector3d ba = Vector3d::Zero(), bg = Vector3d::Zero();
    for (const auto& sample : clean) {
      ImuSample noisy = sample;
      noisy.gyro += bg + noise.gyro_noise / root * draw();
      noisy.accel += ba + noise.accel_noise / root * draw();
      ba += noise.accel_walk * root * draw();
      bg += noise.gyro_walk * root * draw();
      pre.add(noisy);
    }
    Eigen::Matrix<double, 9, 1> error;
    error << pre.alpha() - reference.alpha(), so3_log(reference.gamma().conjugate() * pre.gamma()),
        pre.beta() - reference.beta();
    scatter += error * error.transpose() / kRuns;
  }
  for (int k = 0; k < 9; ++k) {
    const double ratio = scatter(k, k) / reference.covariance()(k, k);
    EXPECT_GT(ratio, 0.85) << k;
    EXPECT_LT(ratio, 1.15) << k;
  }
}

TEST(Preintegration, RootOfInformationInvertsTheCovariance) {
  Preintegration pre(Vector3d::Zero(), Vector3d::Zero(), {});
  for (const auto& sample : rough_motion(100)) pre.add(sample);
  const auto& L = pre.sqrt_information();
  const Preintegration::Matrix15 product = L * pre.covariance() * L.transpose();
  EXPECT_LT((product - Preintegration::Matrix15::Identity()).cwiseAbs().maxCoeff(), 1e-3);
}

}  // namespace
}  // namespace orthonav::vio
