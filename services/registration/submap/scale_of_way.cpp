#include "services/registration/submap/scale_of_way.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

namespace orthonav::registration {
namespace {

// What the odometry's changes of scale and heading make of the way to a keyframe, relative.
constexpr double kWayStddev = 0.01;
// Neighbours err together: so many count as one.
constexpr double kTogether = 3;
// Standard deviations within which a keyframe has to be found, for a scale that changed bends the way slowly, and how
// many in a row may not be.
constexpr double kGate = 2;
constexpr int kMostMissing = 1;
constexpr double kNews = 1.25;  // of the information that there was before

}  // namespace

std::optional<ScaleBelief> scale_of_way(const std::vector<const View*>& views, size_t fitted, const PlaceFit& fit,
                                        const MapIndex& index, const EvidenceOptions& evidence,
                                        const FitOptions& options) {
  const ScaleBelief& scale = fit.scale;
  const View& newest = *views.front();
  // Of one keyframe, each of east and north: the map's own error and the odometry's vertical times the height.
  const double of_place = std::hypot(options.map_stddev, options.tilt_stddev * newest.keyframe.height_above_ground);
  // Corrections of place, turn and log scale, and their covariance.
  Eigen::Vector4d state(0, 0, 0, scale.log_scale - std::log(fit.alignment.scale));
  Eigen::Matrix4d covariance =
      Eigen::Vector4d(of_place, of_place, fit.turn_stddev, scale.stddev).array().square().matrix().asDiagonal();
  int missing = 0;
  for (size_t k = fitted; k < views.size() && missing <= kMostMissing; ++k) {
    const View& view = *views[k];
    const Eigen::Vector2d way =
        fit.alignment.from_W(newest.yaw) * (view.keyframe.p_W_B - newest.keyframe.p_W_B).head<2>();
    Eigen::Matrix<double, 2, 4> jacobian;
    jacobian << 1, 0, -way.y(), way.x(),  //
        0, 1, way.x(), way.y();
    const double variance = of_place * of_place + kWayStddev * kWayStddev * way.squaredNorm();
    const Eigen::Matrix2d spread =
        jacobian * covariance * jacobian.transpose() + variance * Eigen::Matrix2d::Identity();
    const Alignment alignment{fit.alignment.turn + newest.yaw - view.yaw + state(2),
                              fit.alignment.scale * std::exp(state(3))};
    const Eigen::Vector2d expected = fit.en + way + jacobian * state;
    const double radius = kGate * std::sqrt(spread.diagonal().maxCoeff());
    const std::optional<Eigen::Vector2d> place = peak_near({&view}, index, alignment, expected, radius, evidence);
    const Eigen::Vector2d off = place ? Eigen::Vector2d(*place - expected) : Eigen::Vector2d::Zero();
    const Eigen::LDLT<Eigen::Matrix2d> solver(spread);
    if (!place || off.dot(solver.solve(off)) > kGate * kGate) {
      ++missing;
      continue;
    }
    missing = 0;
    const Eigen::Matrix2d weighed = spread + (kTogether - 1) * variance * Eigen::Matrix2d::Identity();
    const Eigen::Matrix<double, 4, 2> gain = weighed.ldlt().solve(jacobian * covariance).transpose();
    state += gain * off;
    covariance -= gain * jacobian * covariance;
  }
  // Less what was known before.
  const double before = 1 / (scale.stddev * scale.stddev), after = 1 / covariance(3, 3);
  if (!(after > kNews * before)) return std::nullopt;
  const double log_scale = std::log(fit.alignment.scale) + state(3);
  const ScaleBelief way{(after * log_scale - before * scale.log_scale) / (after - before),
                        1 / std::sqrt(after - before)};
  return agree(way, scale) ? std::optional(way) : std::nullopt;
}

}  // namespace orthonav::registration
