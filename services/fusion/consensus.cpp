#include "services/fusion/consensus.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

#include "common/math/so3.h"
#include "services/fusion/error_budget.h"

namespace orthonav::fusion {
namespace {

Eigen::Vector3d turn(double yaw, const Eigen::Vector3d& v) {
  return Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) * v;
}

}  // namespace

void Sighting::place_in(const EnuFrame& frame) {
  p_G_B = frame.to_enu(fix.position);
  if (fix.upright) p_G_B += fix.upright->p_G_B;
}

double disagreement(const Sighting& a, const Sighting& b, const FusionOptions& options) {
  // Both headings come from one compass: the difference between them is no evidence, their mean is the estimate.
  const double yaw = a.yaw_G_W + 0.5 * wrap_angle(b.yaw_G_W - a.yaw_G_W);
  const double yaw_stddev = std::max(a.yaw_stddev, b.yaw_stddev);
  const Eigen::Vector3d moved = turn(yaw, b.keyframe.p_W_B - a.keyframe.p_W_B);
  const Eigen::Vector3d sideways = Eigen::Vector3d::UnitZ().cross(moved);
  // What neighbours share drops out of the difference, the less the further they are apart.
  const double way = moved.head<2>().norm();
  const auto forgotten = [&](double distance) { return 2.0 * -std::expm1(-way / distance); };
  Eigen::Vector3d shared = shared_stddev(options.fix).cwiseAbs2();
  shared.head<2>() *= forgotten(options.fix.shared_distance);
  shared.z() *= forgotten(options.fix.shared_vertical_distance);
  // So does the lean, but for the way, which it tilts, and for what the odometry has levelled between the two: the one
  // that leans more has been found further off.
  const Lever tilts_way = -skew(moved).leftCols<2>();
  const double lean_stddev =
      std::max(stddev_of_lean(options.edge, a.keyframe), stddev_of_lean(options.edge, b.keyframe));
  const Lever lean = lean_stddev * (b.lever - a.lever - tilts_way);
  const Eigen::Vector2d more = Eigen::Rotation2Dd(yaw) * (a.keyframe.levelled - b.keyframe.levelled);
  const double scale_stddev = std::max(a.scale_stddev, b.scale_stddev);
  Eigen::Matrix3d covariance = a.covariance + b.covariance + yaw_stddev * yaw_stddev * sideways * sideways.transpose() +
                               scale_stddev * scale_stddev * moved * moved.transpose();
  covariance.diagonal() += shared;
  covariance += lean * lean.transpose();
  const Eigen::Vector3d error = (b.p_G_B - a.p_G_B) - moved - b.lever * more;
  return error.dot(covariance.llt().solve(error));
}

std::optional<Consensus> find_consensus(const std::vector<Sighting>& sightings, size_t needed,
                                        const FusionOptions& options) {
  if (sightings.empty()) return std::nullopt;
  const double limit = options.gate.agreement * options.gate.agreement;
  auto agree = [&](size_t a, size_t b) { return a == b || disagreement(sightings[a], sightings[b], options) < limit; };
  // Those that agree with the newest; mostly too few, and the search ends here.
  std::vector<size_t> near;
  for (size_t i = 0; i < sightings.size(); ++i) {
    if (agree(i, sightings.size() - 1)) near.push_back(i);
  }
  Consensus best;
  for (size_t k = near.size(); k-- > 0 && near.size() >= needed;) {
    Consensus consensus;
    for (const size_t other : near) {
      if (agree(near[k], other)) consensus.members.push_back(other);
    }
    // From the newest on: it wins a draw, because less odometry lies between it and now.
    if (consensus.members.size() > best.members.size()) best = consensus;
  }
  if (best.members.size() < needed) return std::nullopt;

  const Eigen::Vector3d from = sightings[best.members.front()].keyframe.p_W_B;
  for (const size_t member : best.members) {
    best.span = std::max(best.span, (sightings[member].keyframe.p_W_B - from).head<2>().norm());
  }
  std::vector<size_t> others;
  for (size_t i = 0; i < sightings.size(); ++i) {
    if (!std::binary_search(best.members.begin(), best.members.end(), i)) others.push_back(i);
  }
  for (const size_t centre : others) {
    const auto count = std::count_if(others.begin(), others.end(), [&](size_t i) { return agree(centre, i); });
    best.rivals = std::max(best.rivals, static_cast<size_t>(count));
  }
  return best;
}

Placement place(const std::vector<Sighting>& members) {
  Placement result;
  if (members.empty()) return result;
  double offset = 0.0;
  for (const Sighting& member : members) offset += wrap_angle(member.yaw_G_W - members.back().yaw_G_W);
  const auto n = static_cast<double>(members.size());
  result.yaw_G_W = wrap_angle(members.back().yaw_G_W + offset / n);
  for (const Sighting& member : members) {
    result.p_G_W += (member.p_G_B - turn(result.yaw_G_W, member.keyframe.p_W_B)) / n;
  }
  return result;
}

}  // namespace orthonav::fusion
