// The inertial sensor's noise, told from what it does.
//
// A data sheet says nothing of the airframe, and may be wrong by ten. Each motion between two frames leaves a residual
// of the preintegrated IMU. Its square, and what the solution does not know of it, are in the mean the noise's variance
// (expectation maximisation): a solution that follows the sensor for want of anything better makes it no better, and
// one that knows better shows what it is like, in units of the data sheet's and never below it. The walk of a bias
// shows only after minutes; a part that is noisier than its sheet is another part, and its walk is taken to be so, too.
// Not thread-safe; a value.
#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>

#include "services/vio/preintegration.h"

namespace orthonav::vio {

// Variances over those of the data sheet, of white noise and walk alike.
struct ImuVariances {
  double gyro = 1, accel = 1;

  ImuNoise applied_to(ImuNoise sheet) const;
  bool operator==(const ImuVariances&) const = default;
};

// What a pilot should know of them; empty while the sensor is about what its data sheet says.
std::string notice_of(const ImuVariances& variances);

class ImuNoiseMeter {
 public:
  using Vector15 = Eigen::Matrix<double, 15, 1>;

  // What one motion says. `residual` and the variances `unknown` of its parts after the solution are whitened (error
  // state of Preintegration, which was made with `integrated_with`).
  static ImuVariances heard(const Vector15& residual, const Vector15& unknown, const ImuVariances& integrated_with);

  // Samples between two frames; those at both ends may be interpolated and do not count.
  void see(const std::vector<ImuSample>& samples, const ImuNoise& sheet);

  // Takes over `share` (0 ... 1) of it.
  void learn(const ImuVariances& heard, double share);

  const ImuVariances& variances() const { return variances_; }

 private:
  ImuVariances variances_;
  ImuVariances scatter_{0, 0};  // means of so many differences
  double seen_ = 0;
};

}  // namespace orthonav::vio
