#include "services/fusion/consensus.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include <Eigen/Cholesky>

#include "common/math/so3.h"
#include "services/fusion/error_budget.h"
#include "services/fusion/pose_graph.h"

namespace orthonav::fusion {
namespace {

// Mahalanobis distance below which two fixes agree about the motion between them.
constexpr double kAgreement = 3.0;

Eigen::Vector3d turn(double yaw, const Eigen::Vector3d& v) {
  return Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) * v;
}

// Both headings come from one compass: the difference between them is no evidence, their mean is the estimate.
double mean_yaw(const Sighting& a, const Sighting& b) {
  return a.yaw_G_W + 0.5 * wrap_angle(b.yaw_G_W - a.yaw_G_W);
}

bool are_apart(const Sighting& a, const Sighting& b) {
  const Eigen::Vector3d moved = turn(mean_yaw(a, b), b.keyframe.p_W_B - a.keyframe.p_W_B);
  return (b.p_G_B - a.p_G_B - moved).head<2>().norm() > kPlaceSize;
}

}  // namespace

void Sighting::place_in(const EnuFrame& frame) {
  p_G_B = frame.to_enu(fix.position);
  if (fix.upright) p_G_B += fix.upright->p_G_B;
}

double disagreement(const Sighting& a, const Sighting& b, const FusionOptions& options) {
  const double yaw = mean_yaw(a, b);
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

double Consensus::log_odds(const FusionOptions& options) const {
  const double here = agreement.place_log_odds(agreement.newest_utime(), options.lock);
  return here - std::log1p(std::exp(rival_log_odds));
}

std::optional<Consensus> find_consensus(const std::vector<Sighting>& sightings, double at_least,
                                        const FusionOptions& options) {
  if (sightings.empty()) return std::nullopt;
  const int64_t now = sightings.back().keyframe.utime;
  const auto agree = [&](size_t a, size_t b) {
    return a == b || disagreement(sightings[a], sightings[b], options) < kAgreement * kAgreement;
  };
  // Those of `all` that agree with one of them.
  const auto around = [&](size_t centre, const std::vector<size_t>& all) {
    Consensus consensus;
    for (const size_t other : all) {
      if (!agree(centre, other)) continue;
      consensus.members.push_back(other);
      const Keyframe& keyframe = sightings[other].keyframe;
      consensus.agreement.add(keyframe, sightings[other].fix, working_height(options.edge, keyframe), options.lock);
    }
    return consensus;
  };
  const auto log_odds = [&](const Consensus& set) { return set.agreement.place_log_odds(now, options.lock); };
  std::vector<size_t> all(sightings.size());
  std::iota(all.begin(), all.end(), size_t{0});
  // Mostly they are too few, and the search ends here.
  const Consensus near = around(sightings.size() - 1, all);
  if (log_odds(near) < at_least) return std::nullopt;
  Consensus best;
  // From the newest on: it wins a draw, because less odometry lies between it and now.
  for (size_t k = near.members.size(); k-- > 0;) {
    const Consensus consensus = around(near.members[k], near.members);
    if (best.members.empty() || log_odds(consensus) > log_odds(best)) best = consensus;
  }
  std::vector<size_t> others;
  for (const size_t i : all) {
    if (!std::binary_search(best.members.begin(), best.members.end(), i)) others.push_back(i);
  }
  for (const size_t centre : others) {
    if (!are_apart(sightings[centre], sightings.back())) continue;
    best.rival_log_odds = std::max(best.rival_log_odds, log_odds(around(centre, others)));
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
