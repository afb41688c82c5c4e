// Protection levels: bounds of the horizontal and the vertical error that hold though fixes may be wrong.
//
// Probability: at any one epoch the error exceeds its level with a probability of at most 10^-3. A tenth of that is
// spent on a solution without faults, and the same on each of the two faults considered, whose own rarity is not
// counted on:
//   - all fixes of the newest `exposure` seconds are wrong at once. The solution without them errs by its own
//     covariance, and differs from the one given out by what can be seen (solution separation);
//   - the place is wrong and fixes that were not believed are right: the level reaches to where they say.
// A fault that began earlier and was believed ever since, and a lock on a wrong place that nothing contradicts, are
// left to the odds that a lock and its confirmation need (agreement.h).
//
// Pure functions, thread-safe.
#pragma once

#include <optional>

#include <Eigen/Core>

#include "services/fusion/types.h"

namespace orthonav::fusion {

// Standard deviations that a Gaussian error exceeds with a probability of 10^-4: the length of a horizontal one in
// units of its larger axis, and a vertical one to either side.
inline constexpr double kHorizontalQuantile = 4.292;
inline constexpr double kVerticalQuantile = 3.891;

// What a level has left for each fault.
inline constexpr double kFaultProbability = 1e-4;

struct Protection {
  double horizontal = kUnknown;  // m
  double vertical = kUnknown;    // m
};

// A position with its covariance, m and m^2.
struct Located {
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();
};

// Larger standard deviation of the horizontal error, m.
double horizontal_stddev(const Eigen::Matrix3d& covariance);

// `given`: what is given out; `without_newest`: without the fixes of the exposure; `rival`: where fixes that are not
// believed agree to be.
Protection protect(const Located& given, const Located& without_newest, const std::optional<Located>& rival);

// The level a little later, when the covariance has grown from `then` to `now`.
Protection carried_on(const Protection& level, const Eigen::Matrix3d& then, const Eigen::Matrix3d& now);

}  // namespace orthonav::fusion
