// Residual of the preintegrated IMU between two frames, whitened, with analytic Jacobians.
#pragma once

#include <Eigen/Core>
#include <ceres/sized_cost_function.h>

#include "services/vio/preintegration.h"
#include "services/vio/state.h"

namespace orthonav::vio {

// Residual (15): position, rotation, velocity, accelerometer bias, gyroscope bias of `preintegration`'s error state.
// Parameters: pose i (7), speed and bias i (9), pose j (7), speed and bias j (9), laid out as in StateValues.
// Jacobians with respect to a pose are of its six tangent directions, in the first six of seven columns (see
// PoseManifold).
class ImuFactor final : public ceres::SizedCostFunction<15, 7, 9, 7, 9> {
 public:
  using Vector15 = Eigen::Matrix<double, 15, 1>;
  struct Jacobians {
    Eigen::Matrix<double, 15, 6> pose_i, pose_j;
    Eigen::Matrix<double, 15, 9> speed_bias_i, speed_bias_j;
  };

  // `gravity` is its magnitude, m/s^2. The preintegration outlives the factor.
  ImuFactor(const Preintegration& preintegration, double gravity);

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override;

  // Whitened residual and, where not null, Jacobians at the given values.
  static void evaluate(const Preintegration& preintegration, const StateValues& i, const StateValues& j, double gravity,
                       Vector15* residual, Jacobians* jacobians);

 private:
  const Preintegration& preintegration_;
  double gravity_;
};

}  // namespace orthonav::vio
