#include "services/vio/preintegration.h"

#include <algorithm>

#include <Eigen/Cholesky>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

// What a rate and a specific force may be off by where samples are missing (the step is longer than kGap) or saturated,
// 1 sigma, and for how long they stay so.
constexpr double kGap = 0.03;                                   // s
constexpr double kMissingRate = 0.5, kMissingForce = 3.0;       // rad/s, m/s^2
constexpr double kSaturatedRate = 3.0, kSaturatedForce = 30.0;  // rad/s, m/s^2
constexpr double kPersistence = 0.1;                            // s

}  // namespace

Preintegration::Preintegration(const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias,
                               const ImuNoise& noise)
    : accel_bias_(accel_bias), gyro_bias_(gyro_bias), noise_(noise) {
  reset();
}

void Preintegration::reset() {
  duration_ = 0;
  alpha_.setZero();
  beta_.setZero();
  gamma_.setIdentity();
  jacobian_.setIdentity();
  covariance_.setZero();
  sqrt_information_valid_ = false;
}

void Preintegration::add(const ImuSample& sample) {
  if (!samples_.empty()) step(samples_.back(), sample);
  samples_.push_back(sample);
}

void Preintegration::append(const Preintegration& next) {
  for (size_t i = samples_.empty() ? 0 : 1; i < next.samples_.size(); ++i) add(next.samples_[i]);
}

void Preintegration::repropagate(const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias) {
  accel_bias_ = accel_bias;
  gyro_bias_ = gyro_bias;
  reset();
  for (size_t i = 1; i < samples_.size(); ++i) step(samples_[i - 1], samples_[i]);
}

void Preintegration::reweigh(const ImuNoise& noise) {
  noise_ = noise;
  repropagate(Eigen::Vector3d(accel_bias_), Eigen::Vector3d(gyro_bias_));
}

void Preintegration::step(const ImuSample& from, const ImuSample& to) {
  const double dt = 1e-6 * static_cast<double>(to.utime - from.utime);
  if (dt <= 0) return;
  const Eigen::Vector3d rate = 0.5 * (from.gyro + to.gyro) - gyro_bias_;
  const Eigen::Vector3d f0 = from.accel - accel_bias_;
  const Eigen::Vector3d f1 = to.accel - accel_bias_;
  const Eigen::Quaterniond turn = so3_exp(rate * dt);
  const Eigen::Quaterniond gamma = (gamma_ * turn).normalized();
  const Eigen::Matrix3d R0 = gamma_.toRotationMatrix();
  const Eigen::Matrix3d R1 = gamma.toRotationMatrix();
  const Eigen::Vector3d acceleration = 0.5 * (R0 * f0 + R1 * f1);

  // Error propagation. The rotation error at the end is A e_theta + B e_gyro_bias.
  const Eigen::Matrix3d A = turn.toRotationMatrix().transpose();
  const Eigen::Matrix3d B = -so3_right_jacobian(rate * dt) * dt;
  const Eigen::Matrix3d R1_f1 = R1 * skew(f1);
  const Eigen::Matrix3d v_theta = -0.5 * dt * (R0 * skew(f0) + R1_f1 * A);
  const Eigen::Matrix3d v_ba = -0.5 * dt * (R0 + R1);
  const Eigen::Matrix3d v_bg = -0.5 * dt * R1_f1 * B;
  Matrix15 F = Matrix15::Identity();
  F.block<3, 3>(0, 3) = 0.5 * dt * v_theta;
  F.block<3, 3>(0, 6) = dt * Eigen::Matrix3d::Identity();
  F.block<3, 3>(0, 9) = 0.5 * dt * v_ba;
  F.block<3, 3>(0, 12) = 0.5 * dt * v_bg;
  F.block<3, 3>(3, 3) = A;
  F.block<3, 3>(3, 12) = B;
  F.block<3, 3>(6, 3) = v_theta;
  F.block<3, 3>(6, 9) = v_ba;
  F.block<3, 3>(6, 12) = v_bg;
  jacobian_ = F * jacobian_;
  covariance_ = F * covariance_ * F.transpose();
  double va = noise_.accel_noise * noise_.accel_noise * dt, vg = noise_.gyro_noise * noise_.gyro_noise * dt;
  const bool saturated = from.saturated || to.saturated;
  if (saturated || dt > kGap) {
    const double time = dt * std::max(dt, kPersistence);
    const double rate_sigma = saturated ? kSaturatedRate : kMissingRate;
    const double force_sigma = saturated ? kSaturatedForce : kMissingForce;
    vg += rate_sigma * rate_sigma * time;
    va += force_sigma * force_sigma * time;
  }
  for (int i = 0; i < 3; ++i) {
    covariance_(i, i) += 0.25 * va * dt * dt;
    covariance_(i, 6 + i) += 0.5 * va * dt;
    covariance_(6 + i, i) += 0.5 * va * dt;
    covariance_(3 + i, 3 + i) += vg;
    covariance_(6 + i, 6 + i) += va;
    covariance_(9 + i, 9 + i) += noise_.accel_walk * noise_.accel_walk * dt;
    covariance_(12 + i, 12 + i) += noise_.gyro_walk * noise_.gyro_walk * dt;
  }
  alpha_ += beta_ * dt + 0.5 * acceleration * dt * dt;
  beta_ += acceleration * dt;
  gamma_ = gamma;
  duration_ += dt;
  sqrt_information_valid_ = false;
}

const Preintegration::Matrix15& Preintegration::sqrt_information() const {
  if (!sqrt_information_valid_) {
    // Scaled to unit diagonal first: the blocks differ by ten orders of magnitude.
    const Eigen::Matrix<double, 15, 1> scale = covariance_.diagonal().cwiseMax(1e-30).cwiseSqrt().cwiseInverse();
    Matrix15 scaled = scale.asDiagonal() * covariance_ * scale.asDiagonal();
    scaled.diagonal().array() += 1e-9;
    const Matrix15 information = scale.asDiagonal() * scaled.llt().solve(Matrix15::Identity()) * scale.asDiagonal();
    sqrt_information_ = information.llt().matrixL().transpose();
    sqrt_information_valid_ = true;
  }
  return sqrt_information_;
}

Eigen::Vector3d Preintegration::corrected_alpha(const Eigen::Vector3d& accel_bias,
                                                const Eigen::Vector3d& gyro_bias) const {
  return alpha_ + jacobian_.block<3, 3>(0, 9) * (accel_bias - accel_bias_) +
         jacobian_.block<3, 3>(0, 12) * (gyro_bias - gyro_bias_);
}

Eigen::Vector3d Preintegration::corrected_beta(const Eigen::Vector3d& accel_bias,
                                               const Eigen::Vector3d& gyro_bias) const {
  return beta_ + jacobian_.block<3, 3>(6, 9) * (accel_bias - accel_bias_) +
         jacobian_.block<3, 3>(6, 12) * (gyro_bias - gyro_bias_);
}

Eigen::Quaterniond Preintegration::corrected_gamma(const Eigen::Vector3d& gyro_bias) const {
  return gamma_ * so3_exp(jacobian_.block<3, 3>(3, 12) * (gyro_bias - gyro_bias_));
}

}  // namespace orthonav::vio
