// What fixes are wrong by, each effect once: docs/fusion.md has the table.
#pragma once

#include <Eigen/Core>

#include "services/fusion/factors.h"
#include "services/fusion/options.h"

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

// Of all that neighbouring fixes are off by, of one by itself.
inline Eigen::Matrix3d shared_covariance(const FusionOptions& options, const Lever& lever) {
  Eigen::Matrix3d covariance = shared_stddev(options.fix).cwiseAbs2().asDiagonal();
  return covariance + options.edge.lean_stddev * options.edge.lean_stddev * lever * lever.transpose();
}

}  // namespace orthonav::fusion
