#include "tools/evaluate/fusion_metrics.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "tools/evaluate/figures.h"

namespace orthonav::evaluate {
namespace {

using RowMajor6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;
using RowMajor3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

// The truth's velocity over a fifth of a second.
std::optional<Eigen::Vector3d> velocity_at(const Reference& reference, int64_t utime) {
  const auto before = reference.at(utime - 100'000);
  const auto after = reference.at(utime + 100'000);
  if (!before || !after) return std::nullopt;
  return Eigen::Vector3d((after->p_G_B - before->p_G_B) / 0.2);
}

// Squared error weighted by the inverse of its covariance, per degree of freedom.
template <class Matrix, class Vector>
double normalised(const Matrix& covariance, const Vector& error) {
  return error.dot(covariance.ldlt().solve(error)) / static_cast<double>(error.size());
}

struct Normalised {
  std::vector<double> position, horizontal, velocity, attitude, pose;

  Consistency mean_values() const {
    return {mean(position), mean(horizontal), mean(velocity), mean(attitude), mean(pose)};
  }
};

// Errors of a state with the truth, and what the state says of them.
void judge_consistency(const nav_state_t& nav, const Eigen::Vector3d& position, const Eigen::Vector3d& rotation,
                       const std::optional<Eigen::Vector3d>& velocity, Normalised& normalised_errors) {
  const Eigen::Matrix<double, 6, 6> covariance = Eigen::Map<const RowMajor6>(nav.covariance);
  if (!covariance.allFinite()) return;
  Eigen::Matrix<double, 6, 1> pose;
  pose << position, rotation;
  const Eigen::Matrix3d P = covariance.topLeftCorner<3, 3>();
  const Eigen::Matrix3d P_rotation = covariance.bottomRightCorner<3, 3>();
  const Eigen::Matrix2d P_en = covariance.topLeftCorner<2, 2>();
  const Eigen::Vector2d e_en = position.head<2>();
  normalised_errors.position.push_back(normalised(P, position));
  normalised_errors.horizontal.push_back(normalised(P_en, e_en));
  normalised_errors.attitude.push_back(normalised(P_rotation, rotation));
  normalised_errors.pose.push_back(normalised(covariance, pose));
  const Eigen::Matrix3d P_velocity = Eigen::Map<const RowMajor3>(nav.velocity_covariance);
  if (velocity && P_velocity.allFinite()) normalised_errors.velocity.push_back(normalised(P_velocity, *velocity));
}

bool is_bounded(const nav_state_t& nav) {
  return std::isfinite(nav.horizontal_protection_level) && std::isfinite(nav.vertical_protection_level);
}

struct Protected {
  std::vector<double> horizontal, vertical;  // levels
  ProtectionStatistics statistics;

  void add(const nav_state_t& nav, const Eigen::Vector3d& error) {
    ++statistics.epochs;
    if (!is_bounded(nav)) return;
    ++statistics.bounded;
    horizontal.push_back(nav.horizontal_protection_level);
    vertical.push_back(nav.vertical_protection_level);
    const double horizontal_part = error.head<2>().norm() / nav.horizontal_protection_level;
    const double vertical_part = std::abs(error.z()) / nav.vertical_protection_level;
    statistics.largest_horizontal_part = std::max(statistics.largest_horizontal_part, horizontal_part);
    statistics.largest_vertical_part = std::max(statistics.largest_vertical_part, vertical_part);
    statistics.misleading_horizontal += horizontal_part > 1.0 ? 1 : 0;
    statistics.misleading_vertical += vertical_part > 1.0 ? 1 : 0;
  }
  ProtectionStatistics finished() {
    statistics.horizontal_median = median(horizontal);
    statistics.vertical_median = median(vertical);
    return statistics;
  }
};

bool is_aided(const nav_state_t& nav) {
  return nav.mode == nav_state_t::MAP_AIDED || nav.mode == nav_state_t::REACQUIRED;
}

// The stretches, after the first position, in which the map did not aid the solution.
std::vector<Outage> find_outages(const FlightRecord& record, const Reference& reference) {
  std::vector<Outage> outages;
  bool begun = false, open = false;
  int64_t last_utime = 0;
  for (const auto& [logged_at, nav] : record.nav) {
    const bool aided = is_aided(nav);
    if (!begun) {
      begun = aided;
      continue;
    }
    if (!aided && !open) {
      Outage outage;
      outage.begin = record.seconds(nav.utime);
      outages.push_back(outage);
      open = true;
      last_utime = nav.utime;
    }
    if (!open) continue;
    Outage& outage = outages.back();
    outage.duration = record.seconds(nav.utime) - outage.begin;
    const auto p_G_B = record.frame ? position_of(*record.frame, nav) : std::nullopt;
    if (!p_G_B) outage.without_position += seconds_between(last_utime, nav.utime);
    last_utime = nav.utime;
    // The state that ends the outage counts too: it shows where the aircraft was when it came back.
    const auto sample = reference.at(nav.utime);
    if (p_G_B && sample) {
      outage.largest_error = std::max(outage.largest_error, (*p_G_B - sample->p_G_B).head<2>().norm());
    }
    if (aided) {
      outage.ended = true;
      open = false;
    }
  }
  return outages;
}

InertialRate evaluate_inertial(const FlightRecord& record) {
  InertialRate result;
  const Reference& reference = best_reference(record);
  std::vector<Eigen::Vector3d> errors;
  std::vector<double> steps;
  for (size_t k = 0; k < record.nav_inertial.size(); ++k) {
    const nav_state_t& nav = record.nav_inertial[k].message;
    if (k > 0) steps.push_back(seconds_between(record.nav_inertial[k - 1].message.utime, nav.utime));
    const auto p_G_B = record.frame ? position_of(*record.frame, nav) : std::nullopt;
    const auto sample = reference.at(nav.utime);
    if (p_G_B && sample && !record.truth.empty()) errors.push_back(*p_G_B - sample->p_G_B);
  }
  result.errors = PositionErrors::of(errors);
  result.rate_hz = steps.empty() ? kNan : 1.0 / median(steps);
  return result;
}

}  // namespace

FusionMetrics evaluate_fusion(const FlightRecord& record) {
  FusionMetrics fusion;
  const Reference& reference = best_reference(record);
  std::vector<Eigen::Vector3d> truth, gnss, to_map;
  std::vector<double> headings, velocities, times;
  Normalised normalised_errors;
  Protected protection;
  int located = 0, coasting = 0, judged = 0, inside = 0, images_located = 0, images_bounded = 0;
  double last_ms = 0;
  int64_t first_located = 0;
  for (const auto& [logged_at, nav] : record.nav) {
    fusion.resets = std::max(fusion.resets, nav.reset_counter);
    // The message repeats the newest solution's time until there is another.
    if (nav.processing_ms > 0 && nav.processing_ms != last_ms) times.push_back(nav.processing_ms);
    last_ms = nav.processing_ms;
    const auto p_G_B = record.frame ? position_of(*record.frame, nav) : std::nullopt;
    if (!p_G_B) continue;
    if (first_located == 0) first_located = nav.utime;
    ++located;
    coasting += nav.mode == nav_state_t::COASTING ? 1 : 0;
    if (record.images.count(nav.utime) > 0) {
      ++images_located;
      images_bounded += is_bounded(nav) ? 1 : 0;
    }
    if (const auto sample = record.gnss.at(nav.utime)) gnss.push_back(*p_G_B - sample->p_G_B);
    const auto sample = reference.at(nav.utime);
    if (!sample) continue;
    ErrorSample error;
    error.utime = nav.utime;
    error.p_G_B = *p_G_B;
    error.error = *p_G_B - sample->p_G_B;
    const RowMajor6 covariance = Eigen::Map<const RowMajor6>(nav.covariance);
    error.stddev = covariance.diagonal().head<3>().cwiseSqrt();
    error.heading_stddev = std::sqrt(covariance(5, 5));
    error.heading_error = kNan;
    if (!record.truth.empty()) {
      truth.push_back(error.error);
      if (sample->map_offset_en.allFinite()) {
        to_map.push_back(error.error - Eigen::Vector3d(sample->map_offset_en.x(), sample->map_offset_en.y(), 0.0));
      }
      const Eigen::Quaterniond q_G_B = quaternion_of(nav.q_G_B);
      error.heading_error = wrap_angle(heading_of(q_G_B) - heading_of(sample->q_G_B));
      headings.push_back(error.heading_error);
      auto velocity = velocity_at(reference, nav.utime);
      if (velocity) *velocity = vector_of(nav.v_G_B) - *velocity;
      if (velocity && velocity->allFinite()) {
        velocities.push_back(velocity->norm());
      } else {
        velocity.reset();
      }
      const Eigen::Vector3d rotation = so3_log(q_G_B * sample->q_G_B.conjugate());
      judge_consistency(nav, error.error, rotation, velocity, normalised_errors);
      protection.add(nav, error.error);
      if (covariance.allFinite()) {
        ++judged;
        inside += error.error.head<2>().norm() <= 3.0 * std::sqrt(covariance(0, 0) + covariance(1, 1)) ? 1 : 0;
      }
    }
    fusion.track.push_back(error);
  }
  fusion.truth = PositionErrors::of(truth);
  fusion.gnss = PositionErrors::of(gnss);
  fusion.to_map = PositionErrors::of(to_map);
  fusion.heading_rmse = root_mean_square(headings);
  fusion.velocity_rmse = root_mean_square(velocities);
  fusion.nees = normalised_errors.mean_values();
  fusion.within_3_sigma = share(inside, judged);
  fusion.protection = protection.finished();
  fusion.outages = find_outages(record, reference);
  fusion.inertial = evaluate_inertial(record);
  fusion.coasting_share = share(coasting, located);
  fusion.located_share = share(images_located, static_cast<int>(record.images.size()));
  fusion.protection.bounded_share = share(images_bounded, static_cast<int>(record.images.size()));
  fusion.time = Times::of(times);
  fusion.time_to_first_fix = fusion.time_to_first_fix_from_start = kNan;
  if (first_located != 0) {
    fusion.time_to_first_fix_from_start = record.seconds(first_located);
    for (const auto& [logged_at, state] : record.vio) {
      if (state.status == vio_state_t::INITIALISING) continue;
      fusion.time_to_first_fix = seconds_between(state.utime, first_located);
      break;
    }
  }
  return fusion;
}

}  // namespace orthonav::evaluate
