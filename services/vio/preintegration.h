// Inertial preintegration between two frames, after Forster et al. (TRO 2017) with mid-point integration.
//
// Summarises the IMU samples between frames i and j as a motion relative to frame i that does not depend on its
// pose and velocity, so that the estimator may move them without integrating again; the dependence on the biases is
// kept to first order. With b the accelerometer and w the gyroscope bias at the start, T the duration, g gravity:
//   p_j = p_i + v_i T + g T^2 / 2 + R_i alpha,   v_j = v_i + g T + R_i beta,   R_j = R_i gamma.
// Error state, in this order: alpha (0), rotation vector at the right of gamma (3), beta (6), accelerometer bias (9),
// gyroscope bias (12). Where samples are missing or saturated the covariance grows by what may have happened meanwhile,
// so that the other measurements decide. Not thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace orthonav::vio {

struct ImuSample {
  int64_t utime = 0;                                // microseconds since the Unix epoch
  Eigen::Vector3d gyro = Eigen::Vector3d::Zero();   // rad/s in B
  Eigen::Vector3d accel = Eigen::Vector3d::Zero();  // m/s^2 in B, specific force
  bool saturated = false;                           // at the end of the sensor's range: the truth may be beyond
};

struct ImuNoise {
  double gyro_noise = 1.7e-4;   // rad/s/sqrt(Hz)
  double gyro_walk = 1.9e-5;    // rad/s^2/sqrt(Hz)
  double accel_noise = 2.0e-3;  // m/s^2/sqrt(Hz)
  double accel_walk = 3.0e-3;   // m/s^3/sqrt(Hz)
};

class Preintegration {
 public:
  using Matrix15 = Eigen::Matrix<double, 15, 15>;

  Preintegration(const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias, const ImuNoise& noise);

  // Appends a sample; the first one only starts the interval. Samples must be in time order.
  void add(const ImuSample& sample);

  // Appends the interval that begins where this one ends: what is left of two when the frame between is dropped.
  void append(const Preintegration& next);

  // Integrates again from the kept samples about other biases.
  void repropagate(const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias);

  // The same as a sensor of another noise.
  void reweigh(const ImuNoise& noise);

  double duration() const { return duration_; }  // s
  const Eigen::Vector3d& alpha() const { return alpha_; }
  const Eigen::Quaterniond& gamma() const { return gamma_; }
  const Eigen::Vector3d& beta() const { return beta_; }
  const Eigen::Vector3d& accel_bias() const { return accel_bias_; }
  const Eigen::Vector3d& gyro_bias() const { return gyro_bias_; }
  // Derivative of the error state at the end with respect to that at the start: its last six columns are the bias
  // Jacobians.
  const Matrix15& jacobian() const { return jacobian_; }
  const Matrix15& covariance() const { return covariance_; }
  // Upper triangular L with L^T L = covariance^-1. Computed on first use after a change.
  const Matrix15& sqrt_information() const;
  const std::vector<ImuSample>& samples() const { return samples_; }

  // Corrected to first order for other biases.
  Eigen::Vector3d corrected_alpha(const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias) const;
  Eigen::Vector3d corrected_beta(const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias) const;
  Eigen::Quaterniond corrected_gamma(const Eigen::Vector3d& gyro_bias) const;

 private:
  void reset();
  void step(const ImuSample& from, const ImuSample& to);

  Eigen::Vector3d accel_bias_, gyro_bias_;
  ImuNoise noise_;
  std::vector<ImuSample> samples_;
  double duration_ = 0;
  Eigen::Vector3d alpha_, beta_;
  Eigen::Quaterniond gamma_;
  Matrix15 jacobian_, covariance_;
  mutable Matrix15 sqrt_information_;
  mutable bool sqrt_information_valid_ = false;
};

}  // namespace orthonav::vio
