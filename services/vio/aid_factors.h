// Residuals of what is known besides images and IMU: standstill, a measured height, a scale. Whitened, with analytic
// Jacobians; those of a pose are of its six tangent directions (see PoseManifold).
#pragma once

#include <Eigen/Core>
#include <ceres/sized_cost_function.h>

#include "services/vio/projection_factor.h"
#include "services/vio/state.h"

namespace orthonav::vio {

// A frame does not move: v_W_B over sigma. Parameter: speed and bias (9).
class StandstillFactor final : public ceres::SizedCostFunction<3, 9> {
 public:
  explicit StandstillFactor(double sigma) : sigma_(sigma) {}  // m/s
  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

 private:
  double sigma_;
};

// A height above ground: frame j's height over a landmark, plus the sensor's bias, minus the measurement. It holds the
// scale because the landmark's depth takes part. Parameters: pose of the anchor (7), pose of frame j (7), inverse
// depth (1), height bias (1).
class HeightFactor final : public ceres::SizedCostFunction<1, 7, 7, 1, 1> {
 public:
  struct Jacobians {
    Eigen::Matrix<double, 1, 6> pose_i, pose_j;
    double inverse_depth = 0, bias = 0;
  };

  // The extrinsics outlive the factor.
  HeightFactor(const HeightMeasurement& measured, const Eigen::Vector3d& ray_i, const Extrinsics& extrinsics);

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

  static double evaluate(const HeightMeasurement& measured, const Eigen::Vector3d& ray_i, const Extrinsics& extrinsics,
                         const double* pose_i, const double* pose_j, double inverse_depth, double bias,
                         Jacobians* jacobians);

 private:
  HeightMeasurement measured_;
  Eigen::Vector3d ray_i_;
  const Extrinsics& extrinsics_;
};

// The distance between two frames is `distance` to `sigma`, m: a scale hint, made at the window's shape of its time.
// Parameters: their poses (7, 7).
class DistanceFactor final : public ceres::SizedCostFunction<1, 7, 7> {
 public:
  DistanceFactor(double distance, double sigma);
  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

 private:
  double distance_, sigma_;
};

}  // namespace orthonav::vio
