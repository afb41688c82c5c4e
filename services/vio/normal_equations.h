// The window's Gauss-Newton system in the frames alone, each landmark eliminated as it is added (a Schur complement).
// From it come the prior (marginalise) and covariances. Jacobians and residuals are taken at the current values. Not
// thread-safe.
#pragma once

#include <optional>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <ceres/cost_function.h>

#include "common/camera/camera_model.h"
#include "services/vio/prior.h"
#include "services/vio/state.h"

namespace orthonav::vio {

class NormalEquations {
 public:
  // Unknowns: the pose of each frame (6), then speed and biases of each frame (9), in the order of `frames`, then those
  // of the shared parameters that are free.
  NormalEquations(std::vector<Frame*> frames, Shared& shared);

  void add_imu(const Frame& i, const Frame& j, double gravity);  // of j.imu
  // Adds a landmark's projections under a Huber loss of `robust_width`, and the heights that were measured above it,
  // and eliminates it.
  void add_landmark(const Landmark& landmark, double weight, double robust_width);
  void add_prior(const Prior& prior);
  // Adds a cost without a loss, at the current values of its blocks.
  void add_cost(const ceres::CostFunction& cost, const std::vector<Prior::Block>& blocks);

  const Eigen::MatrixXd& H() const { return H_; }  // upper and lower half
  const Eigen::VectorXd& b() const { return b_; }  // H dx = b
  int pose_offset(const Frame& frame) const;
  int speed_bias_offset(const Frame& frame) const;

  // The prior on all that was connected to `frame` (which must be among the frames) when it is eliminated, linearised
  // at the current values.
  Prior marginalise(const Frame& frame) const;

  // Covariance of the unknowns at `offsets` (each begins six of a pose), stacked; empty when H is singular.
  Eigen::MatrixXd pose_covariance(const std::vector<int>& offsets) const;
  // Covariance of the unknowns `rows`, in their order; empty when H is singular.
  Eigen::MatrixXd covariance(const std::vector<int>& rows) const;
  int offset(const Prior::Block& block) const;

 private:
  struct Factor {
    Eigen::VectorXd scale;  // to unit diagonals
    Eigen::LLT<Eigen::MatrixXd> llt;
  };
  const Factor& factor() const;
  size_t index_of(const Frame& frame) const;

  std::vector<Frame*> frames_;
  Shared& shared_;
  Extrinsics extrinsics_;
  Eigen::MatrixXd H_;
  Eigen::VectorXd b_;
  mutable std::optional<Factor> factor_;  // of H_ as it is: covariances of several parts are asked for
};

// Huber's weight of a residual with squared norm `s`: 1 up to `width` standard deviations, then width / |r|.
double huber_weight(double s, double width);

}  // namespace orthonav::vio
