// Residual of a landmark's reprojection from its anchor into another frame (equation 2), with analytic Jacobians.
#pragma once

#include <Eigen/Core>
#include <ceres/manifold.h>
#include <ceres/sized_cost_function.h>

#include "common/camera/camera_model.h"
#include "services/vio/state.h"

namespace orthonav::vio {

// The tangent space of a pose block (p, q as x y z w): p + d, q Exp(e). Cost functions of this library give their
// Jacobians of the tangent directions directly, in the first six columns, and this manifold's Jacobian passes them
// through: one 7x6 product less per residual.
class PoseManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 7; }
  int TangentSize() const override { return 6; }
  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override;
  bool PlusJacobian(const double* x, double* jacobian) const override;
  bool Minus(const double* y, const double* x, double* y_minus_x) const override;
  bool MinusJacobian(const double* x, double* jacobian) const override;
};

// Residual (2): projection onto the plane z = 1 minus the observed ray, times `weight` (focal length over the standard
// deviation of a pixel). Parameters: pose of the anchor frame (7), pose of the other frame (7), inverse depth (1).
class ProjectionFactor final : public ceres::SizedCostFunction<2, 7, 7, 1> {
 public:
  struct Jacobians {
    Eigen::Matrix<double, 2, 6> pose_i, pose_j;
    Eigen::Vector2d inverse_depth;
  };

  // The frames and the extrinsics outlive the factor.
  ProjectionFactor(const Eigen::Vector3d& ray_i, const Eigen::Vector3d& ray_j, const Extrinsics& extrinsics,
                   double weight, const Frame& i, const Frame& j);

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

  // Weighted residual and, where not null, Jacobians; false when the point lies behind the other camera.
  static bool evaluate(const Eigen::Vector3d& ray_i, const Eigen::Vector3d& ray_j, const Extrinsics& extrinsics,
                       double weight, const double* pose_i, const double* pose_j, double inverse_depth,
                       Eigen::Vector2d* residual, Jacobians* jacobians);

 private:
  Eigen::Vector3d ray_i_, ray_j_;
  const Extrinsics& extrinsics_;
  double weight_;
  const Frame& i_;
  const Frame& j_;
};

}  // namespace orthonav::vio
