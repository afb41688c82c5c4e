#include "tools/evaluate/metrics.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>

#include <Eigen/LU>
#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "tools/evaluate/error_regression.h"
#include "tools/evaluate/figures.h"
#include "tools/evaluate/fusion_metrics.h"

namespace orthonav::evaluate {
namespace {

constexpr double kTrueMatchDistance = 30.0;  // m, the design's definition of a true match
constexpr int kTrueMatchInliers = 8;
constexpr double kDriftStretch = 100.0;  // m

struct OdometrySession {
  std::vector<const vio_state_t*> states;     // with a pose
  std::vector<Eigen::Vector3d> p_W_B, p_G_B;  // odometry and reference, one by one
};

OdometrySession with_reference(const std::vector<const vio_state_t*>& states, const Reference& reference) {
  OdometrySession session;
  for (const vio_state_t* state : states) {
    const auto sample = reference.at(state->utime);
    if (!sample) continue;
    session.states.push_back(state);
    session.p_W_B.push_back(vector_of(state->p_W_B));
    session.p_G_B.push_back(sample->p_G_B);
  }
  return session;
}

bool can_be_aligned(const OdometrySession& session) {
  return session.states.size() >= 10;
}

std::vector<Eigen::Vector3d> errors_after(const Similarity& T, const OdometrySession& session) {
  std::vector<Eigen::Vector3d> errors;
  for (size_t k = 0; k < session.p_W_B.size(); ++k) errors.push_back(T * session.p_W_B[k] - session.p_G_B[k]);
  return errors;
}

void append(std::vector<Eigen::Vector3d>& all, const std::vector<Eigen::Vector3d>& some) {
  all.insert(all.end(), some.begin(), some.end());
}

// Error of the odometry's displacement over each stretch of 100 m, turned by the true attitude at its start.
void add_drifts(const OdometrySession& session, const Reference& reference, std::vector<double>& drifts) {
  std::vector<double> path(session.p_G_B.size(), 0.0);
  for (size_t k = 1; k < path.size(); ++k) path[k] = path[k - 1] + (session.p_G_B[k] - session.p_G_B[k - 1]).norm();
  size_t end = 0;
  for (size_t start = 0; start < path.size(); start += 5) {
    while (end < path.size() && path[end] < path[start] + kDriftStretch) ++end;
    if (end == path.size()) return;
    const auto sample = reference.at(session.states[start]->utime);
    const double turn = heading_of(quaternion_of(session.states[start]->q_W_B)) - heading_of(sample->q_G_B);
    const Eigen::Vector3d moved =
        Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()) * (session.p_W_B[end] - session.p_W_B[start]);
    drifts.push_back((moved - (session.p_G_B[end] - session.p_G_B[start])).norm());
  }
}

VioMetrics evaluate_vio(const FlightRecord& record, const OdometryScale& scale) {
  VioMetrics vio;
  std::map<int, std::vector<const vio_state_t*>> sessions;
  std::vector<double> times;
  int64_t first_tracked = 0;
  std::set<int64_t> tracked;
  for (const auto& [logged_at, state] : record.vio) {
    if (state.processing_ms > 0) times.push_back(state.processing_ms);
    if (state.status == vio_state_t::INITIALISING || !vector_of(state.p_W_B).allFinite()) continue;
    if (first_tracked == 0) first_tracked = state.utime;
    tracked.insert(state.utime);
    sessions[state.session].push_back(&state);
  }
  vio.time = Times::of(times);
  vio.restarts = std::max(0, static_cast<int>(sessions.size()) - 1);
  int images = 0;
  for (const auto& [utime, logged_at] : record.images) images += utime >= first_tracked ? 1 : 0;
  vio.tracking_share = tracked.empty() ? kNan : share(static_cast<int>(tracked.size()), images);

  const Reference& reference = best_reference(record);
  std::vector<Eigen::Vector3d> scaled, rigid, gnss;
  std::vector<double> headings, drifts;
  size_t longest = 0;
  vio.scale = kNan;
  for (const auto& [id, states] : sessions) {
    if (const auto session = with_reference(states, record.gnss); can_be_aligned(session)) {
      append(gnss, errors_after(align_umeyama(session.p_W_B, session.p_G_B, true), session));
    }
    const OdometrySession session = with_reference(states, reference);
    if (!can_be_aligned(session)) continue;
    const Similarity T = align_umeyama(session.p_W_B, session.p_G_B, true);
    const Similarity T_yaw = align_yaw_translation(session.p_W_B, session.p_G_B);
    const std::vector<Eigen::Vector3d> errors = errors_after(T, session);
    append(scaled, errors);
    append(rigid, errors_after(T_yaw, session));
    if (session.states.size() > longest) {
      longest = session.states.size();
      vio.scale = T.scale;
    }
    for (size_t k = 0; k < session.states.size(); ++k) {
      ErrorSample sample;
      sample.utime = session.states[k]->utime;
      sample.p_G_B = T * session.p_W_B[k];
      sample.error = errors[k];
      sample.stddev.setConstant(kNan);
      sample.heading_error = sample.heading_stddev = kNan;
      if (!record.truth.empty()) {
        const Eigen::Quaterniond q = Eigen::Quaterniond(T_yaw.R) * quaternion_of(session.states[k]->q_W_B);
        sample.heading_error = wrap_angle(heading_of(q) - heading_of(reference.at(sample.utime)->q_G_B));
        headings.push_back(sample.heading_error);
      }
      vio.track.push_back(sample);
    }
    if (!record.truth.empty()) add_drifts(session, reference, drifts);
  }
  const PositionErrors against = PositionErrors::of(scaled);
  (record.truth.empty() ? vio.gnss : vio.truth) = against;
  if (!record.truth.empty()) vio.gnss = PositionErrors::of(gnss);
  if (record.truth.empty()) vio.truth = PositionErrors::of({});
  vio.yaw_only = PositionErrors::of(rigid);
  vio.scale_at_start = scale.beginning_at(scale.begin());
  vio.scale_after_30s = scale.beginning_at(scale.begin() + 30'000'000);
  vio.scale_at_end = scale.ending_at(scale.end());
  vio.heading_rmse = root_mean_square(headings);
  vio.drift_per_100m = median(drifts);
  return vio;
}

RegistrationMetrics evaluate_registration(const FlightRecord& record) {
  RegistrationMetrics result;
  std::map<std::pair<int, int>, const vio_keyframe_t*> keyframes;
  for (const vio_keyframe_t& keyframe : record.keyframes) keyframes[{keyframe.session, keyframe.id}] = &keyframe;
  const Reference& reference = best_reference(record);
  std::vector<Eigen::Vector3d> truth, correct, gnss, to_map;
  std::vector<double> headings, inliers, total, describe, match, solve;
  int judged = 0;
  for (const map_fix_t& fix : record.fixes) {
    JudgedFix judgement;
    judgement.fix = &fix;
    judgement.reference = reference.at(fix.utime);
    if (record.frame) judgement.p_G_B = position_of(*record.frame, fix);
    const auto keyframe = keyframes.find({fix.session, fix.keyframe_id});
    if (keyframe != keyframes.end()) judgement.implied_en = implied_position(fix, *keyframe->second);
    ++result.tried;
    if (fix.valid) ++result.valid;
    if (fix.total_ms > 0) {
      total.push_back(fix.total_ms);
      describe.push_back(fix.describe_ms);
      match.push_back(fix.match_ms);
      solve.push_back(fix.solve_ms);
    }
    if (judgement.reference) {
      ++judged;
      const Eigen::Vector3d p = judgement.reference->p_G_B;
      judgement.true_match = fix.num_inliers >= kTrueMatchInliers && judgement.implied_en &&
                             (*judgement.implied_en - p.head<2>()).norm() <= kTrueMatchDistance;
      if (judgement.true_match) inliers.push_back(fix.num_inliers);
      if (judgement.p_G_B) {
        const Eigen::Vector3d error = *judgement.p_G_B - p;
        judgement.false_fix = error.norm() > kTrueMatchDistance;
        if (!record.truth.empty()) {
          truth.push_back(error);
          const Eigen::Vector2d offset = judgement.reference->map_offset_en;
          if (offset.allFinite()) to_map.push_back(error - Eigen::Vector3d(offset.x(), offset.y(), 0.0));
          if (!judgement.false_fix) {
            correct.push_back(error);
            const Eigen::Quaterniond q = quaternion_of(fix.q_G_B);
            if (q.coeffs().allFinite()) {
              headings.push_back(wrap_angle(heading_of(q) - heading_of(judgement.reference->q_G_B)));
            }
          }
        }
      }
    }
    if (const auto sample = record.gnss.at(fix.utime); sample && judgement.p_G_B) {
      gnss.push_back(*judgement.p_G_B - sample->p_G_B);
    }
    result.true_matches += judgement.true_match ? 1 : 0;
    result.false_fixes += judgement.false_fix ? 1 : 0;
    result.fixes.push_back(judgement);
  }
  result.truth = PositionErrors::of(truth);
  result.truth_correct = PositionErrors::of(correct);
  result.gnss = PositionErrors::of(gnss);
  result.to_map = PositionErrors::of(to_map);
  result.heading_rmse = root_mean_square(headings);
  result.true_match_rate = share(result.true_matches, judged);
  result.inliers_median = median(inliers);
  result.time = Times::of(total);
  result.describe = Times::of(describe);
  result.match = Times::of(match);
  result.solve = Times::of(solve);
  return result;
}

TransportMetrics evaluate_transport(const FlightRecord& record) {
  TransportMetrics transport;
  std::set<int64_t> vio, nav, fixed;
  for (const auto& [logged_at, state] : record.vio) vio.insert(state.utime);
  std::vector<double> latencies;
  // A replay is recorded with the time of the data itself.
  const bool live = std::any_of(record.images.begin(), record.images.end(),
                                [](const auto& image) { return image.first != image.second; });
  for (const auto& [logged_at, state] : record.nav) {
    nav.insert(state.utime);
    const auto image = record.images.find(state.utime);
    if (image == record.images.end()) continue;
    latencies.push_back(1e3 * seconds_between(image->second, logged_at));
  }
  if (live) transport.latency = Times::of(latencies);
  if (!vio.empty()) {
    for (const auto& [utime, logged_at] : record.images) {
      const bool between = utime > *vio.begin() && utime < *vio.rbegin();
      transport.images_without_vio += between && vio.count(utime) == 0 ? 1 : 0;
    }
  }
  if (!nav.empty()) {
    for (const int64_t utime : vio) {
      const bool between = utime > *nav.begin() && utime < *nav.rbegin();
      transport.vio_without_nav += between && nav.count(utime) == 0 ? 1 : 0;
    }
  }
  for (const map_fix_t& fix : record.fixes) fixed.insert(fix.utime);
  std::map<int, int> last_id;
  for (const vio_keyframe_t& keyframe : record.keyframes) {
    const auto last = last_id.find(keyframe.session);
    if (last != last_id.end() && keyframe.id > last->second + 1) {
      transport.keyframe_gaps += keyframe.id - last->second - 1;
    }
    last_id[keyframe.session] = keyframe.id;
    const bool between = !fixed.empty() && keyframe.utime > *fixed.begin() && keyframe.utime < *fixed.rbegin();
    transport.keyframes_without_fix_message += between && fixed.count(keyframe.utime) == 0 ? 1 : 0;
  }
  for (const auto& [channel, count] : record.channels) transport.undecodable += count.undecodable;
  return transport;
}

void describe_flight(const FlightRecord& record, Metrics& metrics) {
  metrics.duration = seconds_between(record.begin, record.end);
  const Reference& reference = best_reference(record);
  std::vector<double> tilts;
  std::optional<ReferenceSample> last;
  // A step of a second: shorter ones would add a noisy reference's noise to the distance.
  for (int64_t utime = record.begin; utime <= record.end; utime += 1'000'000) {
    const auto sample = reference.at(utime);
    if (!sample) continue;
    if (last) metrics.distance += (sample->p_G_B - last->p_G_B).norm();
    last = sample;
    tilts.push_back(std::acos(std::clamp((sample->q_G_B * Eigen::Vector3d::UnitZ()).z(), -1.0, 1.0)));
  }
  metrics.mean_tilt = record.truth.empty() ? kNan : mean(tilts);
}

void note_what_is_missing(const FlightRecord& record, const Metrics& metrics, std::vector<std::string>& notes) {
  if (!metrics.has_truth && metrics.has_gnss) {
    notes.push_back(
        "The log has no TRUTH: errors are against the GNSS reference alone, true matches and false fixes are judged by "
        "it, and attitude cannot be judged.");
  }
  if (!metrics.has_truth && !metrics.has_gnss)
    notes.push_back("The log has no TRUTH and no GNSS_REFERENCE: no errors can be given.");
  if (record.vio.empty())
    notes.push_back("The log has no VIO_STATE: the odometry did not run, or its channel was not recorded.");
  if (record.fixes.empty()) notes.push_back("The log has no MAP_FIX: registration did not run, or saw no keyframe.");
  if (!record.fixes.empty() && metrics.registration.valid == 0) {
    notes.push_back("No keyframe was found on the map: there is no position.");
  }
  if (record.nav.empty())
    notes.push_back("The log has no NAV_STATE: fusion did not run, or its channel was not recorded.");
  if (record.images.empty()) notes.push_back("The log has no CAMERA images: latency and tracking share are unknown.");
  if (record.skipped_bytes > 0) {
    notes.push_back(fmt::format("{} bytes of the log are damaged or cut off and were skipped.", record.skipped_bytes));
  }
  for (const auto& [channel, count] : record.channels) {
    if (count.undecodable > 0) {
      notes.push_back(fmt::format("{} of {} messages on {} could not be decoded: they are of another version.",
                                  count.undecodable, count.messages, channel));
    }
  }
}

}  // namespace

PositionErrors PositionErrors::of(const std::vector<Eigen::Vector3d>& errors) {
  std::vector<double> norm, horizontal, vertical;
  for (const Eigen::Vector3d& error : errors) {
    norm.push_back(error.norm());
    horizontal.push_back(error.head<2>().norm());
    vertical.push_back(error.z());
  }
  PositionErrors result;
  result.samples = static_cast<int>(errors.size());
  result.rmse = root_mean_square(norm);
  result.horizontal_rmse = root_mean_square(horizontal);
  result.vertical_rmse = root_mean_square(vertical);
  result.median = quantile(norm, 0.5);
  result.p95 = quantile(norm, 0.95);
  result.largest = quantile(norm, 1.0);
  return result;
}

Times Times::of(const std::vector<double>& ms) {
  return {static_cast<int>(ms.size()), quantile(ms, 0.5), quantile(ms, 0.99)};
}

std::optional<Eigen::Vector2d> implied_position(const map_fix_t& fix, const vio_keyframe_t& keyframe) {
  const Eigen::Vector2d translation(fix.translation[0], fix.translation[1]);
  const Eigen::Quaterniond q_W_B = quaternion_of(keyframe.q_W_B);
  const Eigen::Vector3d p_W_B = vector_of(keyframe.p_W_B);
  if (!translation.allFinite() || !std::isfinite(fix.heading) || !p_W_B.allFinite() || fix.num_inliers <= 0) {
    return std::nullopt;
  }
  // Equation (7): the rotation about z that gives the body this heading. Headings grow clockwise.
  const Eigen::Matrix3d R_G_W =
      Eigen::AngleAxisd(heading_of(q_W_B) - fix.heading, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  if (fix.method == "submap" || fix.method == "paper") return Eigen::Vector2d((R_G_W * p_W_B).head<2>() + translation);
  const Eigen::Matrix3d R_G_B = R_G_W * q_W_B.toRotationMatrix();
  const Eigen::Vector3d axis = R_G_B * (quaternion_of(keyframe.q_B_C) * Eigen::Vector3d::UnitZ());
  if (!(axis.z() < -0.1) || !std::isfinite(keyframe.height_above_ground)) return std::nullopt;
  const Eigen::Vector3d back = keyframe.height_above_ground / axis.z() * axis - R_G_B * vector_of(keyframe.p_B_C);
  return Eigen::Vector2d(translation + back.head<2>());
}

Metrics evaluate(const FlightRecord& record) {
  Metrics metrics;
  metrics.has_truth = !record.truth.empty();
  metrics.has_gnss = !record.gnss.empty();
  describe_flight(record, metrics);
  const OdometryScale scale(record);
  metrics.vio = evaluate_vio(record, scale);
  metrics.registration = evaluate_registration(record);
  metrics.registration.regression = regress_errors(record, metrics.registration, scale);
  metrics.fusion = evaluate_fusion(record);
  metrics.transport = evaluate_transport(record);
  note_what_is_missing(record, metrics, metrics.notes);
  return metrics;
}

}  // namespace orthonav::evaluate
