// What the window remembers of the frames and landmarks that left it, and the linear algebra that makes it.
//
// NormalEquations assembles the window's Gauss-Newton system in the frames alone, each landmark eliminated as it is
// added (a Schur complement). From it come the prior (marginalise) and covariances. Jacobians are taken at the
// frames' first estimates (see Frame), residuals at their current values. Not thread-safe.
#pragma once

#include <vector>

#include <Eigen/Core>
#include <ceres/cost_function.h>

#include "common/camera/camera_model.h"
#include "services/vio/state.h"

namespace orthonav::vio {

// A quadratic cost |r0 + J (x - x0)|^2 / 2 on some of the window's blocks; x0 are the frames' first estimates.
struct Prior {
  struct Block {
    Frame* frame = nullptr;
    bool speed_bias = false;  // else the pose

    int size() const { return speed_bias ? 9 : 6; }
  };
  std::vector<Block> blocks;
  Eigen::MatrixXd J;  // columns in the order of the blocks, in tangent space
  Eigen::VectorXd r0;

  bool empty() const { return blocks.empty(); }
  // Residual at the frames' current states.
  Eigen::VectorXd residual() const;
};

// Standard deviations of what is known of a session's first frame.
struct InitialUncertainty {
  double position = 1e-3;   // m: the origin of W is arbitrary, so nearly nothing
  double yaw = 1e-4;        // rad: likewise
  double accel_bias = 0.1;  // m/s^2
  double gyro_bias = 0.02;  // rad/s
};

// The prior of a session: fixes position and yaw of `frame` where they are and holds its biases near
// `accel_bias` and `gyro_bias`. Fixes the frame's first estimate.
Prior make_initial_prior(Frame& frame, const InitialUncertainty& sigma, const Eigen::Vector3d& accel_bias,
                         const Eigen::Vector3d& gyro_bias);

// The prior as a cost of a Ceres problem, of Prior::blocks in their order. The prior outlives it.
class PriorFactor final : public ceres::CostFunction {
 public:
  explicit PriorFactor(const Prior& prior);
  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

 private:
  const Prior& prior_;
};

class NormalEquations {
 public:
  // Unknowns: the pose of each frame (6), then speed and biases of each frame (9), in the order of `frames`.
  explicit NormalEquations(std::vector<Frame*> frames);

  void add_imu(const Frame& i, const Frame& j, double gravity);  // of j.imu
  // Adds a landmark's projections under a Huber loss of `robust_width` and eliminates it.
  void add_landmark(const Landmark& landmark, const Extrinsics& extrinsics, double weight, double robust_width);
  void add_prior(const Prior& prior);

  const Eigen::MatrixXd& H() const { return H_; }  // upper and lower half
  const Eigen::VectorXd& b() const { return b_; }  // H dx = b
  int pose_offset(const Frame& frame) const;
  int speed_bias_offset(const Frame& frame) const;

  // The prior on all that was connected to `frame` (which must be among the frames) when it is eliminated. Fixes the
  // first estimates of the frames in it at their current states where they were free.
  Prior marginalise(const Frame& frame) const;

  // Covariance of the unknowns at `offsets` (each begins six of a pose), stacked; empty when H is singular.
  Eigen::MatrixXd pose_covariance(const std::vector<int>& offsets) const;

 private:
  size_t index_of(const Frame& frame) const;

  std::vector<Frame*> frames_;
  Eigen::MatrixXd H_;
  Eigen::VectorXd b_;
};

// Huber's weight of a residual with squared norm `s`: 1 up to `width` standard deviations, then width / |r|.
double huber_weight(double s, double width);

}  // namespace orthonav::vio
