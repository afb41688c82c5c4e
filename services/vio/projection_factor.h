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

// Inverse depths moved as the depths they stand for: a step along which positions and depths grow alike leaves every
// projection as it is, however long it is. A start needs that: its scale is far off and lies along a valley which is
// curved for inverse depths, where a solver takes a hundred small steps and stops half way.
class DepthManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 1; }
  int TangentSize() const override { return 1; }
  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override;
  bool PlusJacobian(const double* x, double* jacobian) const override;
  bool Minus(const double* y, const double* x, double* y_minus_x) const override;
  bool MinusJacobian(const double* x, double* jacobian) const override;
};

// Two bearings of one landmark. A bearing belongs to its image's time; the frame's state belongs to image time plus the
// time offset that its IMU samples were cut at. Where the offset is off by d, the bearing at the state's time is
// ray - rate d.
struct Bearings {
  Eigen::Vector3d ray_i = Eigen::Vector3d::UnitZ(), ray_j = Eigen::Vector3d::UnitZ();  // z = 1
  Eigen::Vector2d rate_i = Eigen::Vector2d::Zero(), rate_j = Eigen::Vector2d::Zero();  // 1/s
  double shift_i = 0, shift_j = 0;                                                     // s, Frame::time_shift
};

Bearings bearings_of(const Observation& anchor, const Observation& other);

// Residual (2): projection onto the plane z = 1 minus the observed ray, times `weight` (focal length over the standard
// deviation of a pixel). Parameters: pose of the anchor frame (7), pose of the other frame (7), inverse depth (1),
// T_B_C (7), time offset (1).
class ProjectionFactor final : public ceres::SizedCostFunction<2, 7, 7, 1, 7, 1> {
 public:
  struct Jacobians {
    Eigen::Matrix<double, 2, 6> pose_i, pose_j, camera;
    Eigen::Vector2d inverse_depth, time_offset;
  };

  // What the frames share outlives the factor.
  ProjectionFactor(const Bearings& bearings, const Shared& shared, const Extrinsics& extrinsics, double weight);

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

  // Weighted residual and, where not null, Jacobians; false when the point lies behind the other camera.
  static bool evaluate(const Bearings& bearings, double time_offset, const Extrinsics& extrinsics, double weight,
                       const double* pose_i, const double* pose_j, double inverse_depth, Eigen::Vector2d* residual,
                       Jacobians* jacobians);

 private:
  Bearings bearings_;
  const Shared& shared_;
  const Extrinsics& extrinsics_;  // of shared_, while the camera's pose is frozen
  double weight_;
};

}  // namespace orthonav::vio
