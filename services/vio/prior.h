// What the window remembers of the frames and landmarks that left it: a quadratic cost on those that stay.
//
// It was linearised where the frames stood when it was made, and they move on. Pictures alone tell nothing of where the
// window lies, how it is turned and how large it is; the tangent directions of a turn and of a scale are other ones at
// another place, and a prior that stays behind has sharp knowledge along them that nobody measured: once the scale had
// moved by a percent, it was "known" to a tenth of one. So the prior goes along with the estimate (follow), and what it
// knows along those directions, which is what gravity and accelerations told, stays what it was. All other terms of the
// window are linearised where the estimate is. An observability constraint as of Hesch et al. (TRO 2014), put on the
// prior alone. Squared error of the scale over its variance, 2, 5 and 20 s after the start (vio_monte_carlo, solved to
// convergence): first-estimate Jacobians for what is in the prior and current ones for the rest 204, 205 and 46
// (`cruise15`); current ones everywhere 7, 13 and 36, so 5, 3 and 2 (`consumer`).
//
// Not thread-safe.
#pragma once

#include <array>
#include <vector>

#include <Eigen/Core>
#include <ceres/cost_function.h>

#include "services/vio/state.h"

namespace orthonav::vio {

// A quadratic cost |r0 + J (x - x0)|^2 / 2 on some of the window's blocks.
struct Prior {
  struct Block {
    enum class Kind { kPose, kSpeedBias, kCamera, kTimeOffset, kHeightBias };
    Kind kind = Kind::kPose;
    Frame* frame = nullptr;      // of a pose or speed and bias
    Shared* shared = nullptr;    // of the others
    std::array<double, 9> x0{};  // the linearisation point, as in the parameter block

    bool pose() const { return kind == Kind::kPose || kind == Kind::kCamera; }
    int size() const;          // of its tangent space
    int ambient_size() const;  // of its parameter block
    double* value() const;
    // Makes the current value the linearisation point.
    void linearise();
  };
  std::vector<Block> blocks;
  Eigen::MatrixXd J;  // columns in the order of the blocks, in tangent space
  Eigen::VectorXd r0;
  Eigen::VectorXd made;  // the residual where it was made

  bool empty() const { return blocks.empty(); }
  // Residual at the blocks' current values.
  Eigen::VectorXd residual() const;
  // Squared standard deviations, per dimension, by which the blocks have moved from where it was made.
  double departure() const;
  bool holds(const Frame& frame) const;
  bool holds(Block::Kind kind) const;
  // Linearises at the current values. What is known of the window's turn and scale stays what it was.
  void follow();
};

// Standard deviations of what is known of a session's first frame.
struct InitialUncertainty {
  double position = 1e-3;   // m: the origin of W is arbitrary, so nearly nothing
  double yaw = 1e-4;        // rad: likewise
  double accel_bias = 0.1;  // m/s^2
  double gyro_bias = 0.02;  // rad/s
};

// The prior of a session: fixes position and yaw of `frame` where they are and holds its biases near
// `accel_bias` and `gyro_bias`.
Prior make_initial_prior(Frame& frame, const InitialUncertainty& sigma, const Eigen::Vector3d& accel_bias,
                         const Eigen::Vector3d& gyro_bias);

// Standard deviations of what is known of the shared parameters beforehand.
struct SharedUncertainty {
  double camera_rotation = 0.02;  // rad
  double camera_position = 0.02;  // m
  double time_offset = 0.005;     // s
  double height_bias = 2;         // m
};

// Holds those of the shared parameters near their current values that are free and not in the prior yet.
void add_shared_prior(Prior& prior, Shared& shared, const SharedUncertainty& sigma);

// The prior as a cost of a Ceres problem, of Prior::blocks in their order. The prior outlives it.
class PriorFactor final : public ceres::CostFunction {
 public:
  explicit PriorFactor(const Prior& prior);
  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

 private:
  const Prior& prior_;
};

}  // namespace orthonav::vio
