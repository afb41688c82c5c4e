// Carries a fused state on by the inertial sensor: to the sensor's rate between odometry states, and through the
// seconds in which the odometry restarts.
//
// Strapdown integration in G (midpoint rule, constant gravity) from the newest odometry state; samples that came
// before that state are integrated again, so a late state costs nothing. The covariance grows by the sensor's noise and
// by what is unknown of its biases.
//
// Deterministic; not thread-safe.
#pragma once

#include <deque>
#include <optional>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

using Matrix9d = Eigen::Matrix<double, 9, 9>;

struct InertialState {
  int64_t utime = 0;
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();
  Eigen::Vector3d v_G_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_G_B = Eigen::Quaterniond::Identity();
  Matrix9d covariance = Matrix9d::Zero();  // (position, velocity, rotation vector in G)
};

class Inertial {
 public:
  explicit Inertial(const InertialOptions& options) : options_(options) {}

  // Starts from an odometry state; biases in B.
  void rebase(const InertialState& state, const Eigen::Vector3d& gyro_bias, const Eigen::Vector3d& accel_bias);
  // Nothing is known until the next rebase(); samples are kept.
  void invalidate() { base_.reset(); }

  // kUsed, kBadNumber, or kOutOfOrder for a sample that is not newer than the last. One of another time (stamps.h) is
  // the first of a new sequence.
  Outcome add(const ImuSample& sample);

  // The state at the newest sample, with the whole covariance; nullopt before rebase(), beyond `max_time` after it,
  // and after a gap in the samples that is too long to be bridged.
  std::optional<InertialState> newest() const;
  // Whether there is a bridged gap since the base.
  bool guessed() const { return guessed_; }
  // The same at a time since the base, however late it is asked for, or up to 0.1 s after the newest sample.
  std::optional<InertialState> at(int64_t utime) const;

 private:
  void integrate(const ImuSample& from, const ImuSample& to);
  void step(const ImuSample& from, const ImuSample& to, InertialState& state) const;
  Matrix9d of_a_guess(double dt) const;
  InertialState with_biases(InertialState state) const;

  InertialOptions options_;
  std::deque<ImuSample> samples_;      // from just before the base on
  std::optional<InertialState> base_;  // as given
  InertialState state_;                // at the newest sample; covariance without the biases' part
  bool guessed_ = false;               // since the base
  bool gap_ = false;                   // between the base and the newest sample
  Eigen::Vector3d gyro_bias_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d accel_bias_ = Eigen::Vector3d::Zero();
};

}  // namespace orthonav::fusion
