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

// A quadratic cost |r0 + J (x - x0)|^2 / 2 on some of the window's blocks; x0 are their first estimates.
struct Prior {
  struct Block {
    enum class Kind { kPose, kSpeedBias, kCamera, kTimeOffset, kHeightBias };
    Kind kind = Kind::kPose;
    Frame* frame = nullptr;    // of a pose or speed and bias
    Shared* shared = nullptr;  // of the others

    bool pose() const { return kind == Kind::kPose || kind == Kind::kCamera; }
    int size() const;          // of its tangent space
    int ambient_size() const;  // of its parameter block
    double* value() const;
    double* first_estimate() const;
    bool& fixed() const;  // whether its linearisation point is its first estimate
  };
  std::vector<Block> blocks;
  Eigen::MatrixXd J;  // columns in the order of the blocks, in tangent space
  Eigen::VectorXd r0;

  bool empty() const { return blocks.empty(); }
  // Residual at the blocks' current values.
  Eigen::VectorXd residual() const;
  bool holds(const Frame& frame) const;
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

// Standard deviations of what is known of the shared parameters beforehand.
struct SharedUncertainty {
  double camera_rotation = 0.02;  // rad
  double camera_position = 0.02;  // m
  double time_offset = 0.005;     // s
  double height_bias = 2;         // m
};

// Holds those of the shared parameters near their current values that are free and not in a prior yet. Fixes their
// first estimates.
void add_shared_prior(Prior& prior, Shared& shared, const SharedUncertainty& sigma);

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

  // The prior on all that was connected to `frame` (which must be among the frames) when it is eliminated. Fixes the
  // first estimates of the frames in it at their current states where they were free.
  Prior marginalise(const Frame& frame) const;

  // Covariance of the unknowns at `offsets` (each begins six of a pose), stacked; empty when H is singular.
  Eigen::MatrixXd pose_covariance(const std::vector<int>& offsets) const;
  // Covariance of the unknowns `rows`, in their order; empty when H is singular.
  Eigen::MatrixXd covariance(const std::vector<int>& rows) const;
  int offset(const Prior::Block& block) const;

 private:
  size_t index_of(const Frame& frame) const;

  std::vector<Frame*> frames_;
  Shared& shared_;
  Extrinsics extrinsics_;
  Eigen::MatrixXd H_;
  Eigen::VectorXd b_;
};

// Huber's weight of a residual with squared norm `s`: 1 up to `width` standard deviations, then width / |r|.
double huber_weight(double s, double width);

}  // namespace orthonav::vio
