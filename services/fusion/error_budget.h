// What fixes are wrong by, each effect once: docs/fusion.md has the table.
#pragma once

#include <algorithm>

#include <Eigen/Core>

#include "services/fusion/factors.h"
#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// How a fix from `height` m above the ground leans with the vertical that it was found under, where it does not say
// itself: the points stay where they are, and the body is upright over them.
inline Lever lever_of_height(double height) {
  Lever lever;
  lever << 0.0, -height, height, 0.0, 0.0, 0.0;
  return lever;
}

// 1 sigma of what neighbouring fixes are all off by, m in G, beside their lean.
inline Eigen::Vector3d shared_stddev(const FixOptions& fix) {
  return {fix.shared_horizontal_stddev, fix.shared_horizontal_stddev, fix.shared_vertical_stddev};
}

// How well the odometry knows its vertical at a keyframe, rad per axis: by its own word, at best as well as configured.
inline double stddev_of_lean(const EdgeOptions& edge, const Keyframe& keyframe) {
  constexpr double kNothing = 1.0;  // rad: who knows less knows nothing
  const double word =
      keyframe.lean_stddev > edge.lean_stddev ? keyframe.lean_stddev : edge.lean_stddev;  // NaN: unknown
  return std::min(word, kNothing);
}

// Of all that neighbouring fixes are off by, of one by itself that moves with the vertical of its keyframe by `lever`.
inline Eigen::Matrix3d shared_covariance(const FusionOptions& options, const Keyframe& keyframe, const Lever& lever) {
  const double lean_stddev = stddev_of_lean(options.edge, keyframe);
  Eigen::Matrix3d covariance = shared_stddev(options.fix).cwiseAbs2().asDiagonal();
  return covariance + lean_stddev * lean_stddev * lever * lever.transpose();
}

}  // namespace orthonav::fusion
