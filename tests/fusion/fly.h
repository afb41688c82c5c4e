// Flies a synthetic flight through the fusion and compares with its truth.
#pragma once

#include <chrono>
#include <cmath>
#include <memory>
#include <vector>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/fusion/fusion.h"
#include "tests/fusion/synthetic_flight.h"

namespace orthonav::fusion {

struct Flown {
  std::vector<Solution> solutions;                          // one per state
  std::vector<Outcome> outcomes;                            // of each fix, in the order of arrival
  std::vector<size_t> fix_index;                            // of each outcome
  std::vector<double> keyframe_ms;                          // wall time of each add_keyframe
  std::vector<double> solve_ms;                             // and with the fix's, where one was used
  double rmse = 0, horizontal_rmse = 0, vertical_rmse = 0;  // m, from the first geodetic position on
  double heading_rmse = 0;                                  // rad
  double largest = 0;                                       // m, error
  double nees = 0;                  // mean over the positions' 3 degrees of freedom: 1 when consistent
  double lock_time = std::nan("");  // s from the first state
  double scale = std::nan("");      // at the end
  int wrong_used = 0;               // wrong fixes that are in the graph
  int located = 0, bounded = 0;     // epochs with a position, and with protection levels
  int misleading_horizontal = 0, misleading_vertical = 0;  // of those: the error exceeds its level
  double horizontal_level = 0;                             // m, median
  std::vector<double> position_nees, pose_nees;            // per epoch and degree of freedom; NaN without a position
  std::vector<Solution> inertial;                          // of the inertial samples
};

inline Flown fly(const SyntheticFlight& flight, const FusionOptions& options) {
  Flown flown;
  auto running = std::make_unique<Fusion>(options);
  const EnuFrame frame(flight.anchor);
  double killed = flight.fusion_killed;
  std::vector<double> error, horizontal, vertical, heading, nees, levels;
  double seconds = 0;
  for (const SyntheticFlight::Step& step : flight.steps) {
    if (step.kind == SyntheticFlight::Step::Kind::kState) seconds = 0.1 * static_cast<double>(step.index);
    if (seconds >= killed) {
      if (seconds < killed + 0.5) {
        if (step.kind == SyntheticFlight::Step::Kind::kState) {
          flown.solutions.emplace_back();
          flown.position_nees.push_back(std::nan(""));
          flown.pose_nees.push_back(std::nan(""));
        }
        continue;
      }
      killed = std::nan("");
      const auto memory = running->memory();
      running = std::make_unique<Fusion>(options);
      if (memory) running->resume(*memory);
    }
    Fusion& fusion = *running;
    switch (step.kind) {
      case SyntheticFlight::Step::Kind::kState: {
        const Solution solution = fusion.propagate(flight.states[step.index]).solution;
        flown.solutions.push_back(solution);
        flown.position_nees.push_back(std::nan(""));
        flown.pose_nees.push_back(std::nan(""));
        if (std::isnan(solution.position.latitude_deg)) break;
        if (std::isnan(flown.lock_time)) flown.lock_time = 0.1 * static_cast<double>(step.index);
        const Eigen::Vector3d e = frame.to_enu(solution.position) - flight.truth[step.index];
        error.push_back(e.norm());
        horizontal.push_back(e.head<2>().norm());
        vertical.push_back(e.z());
        heading.push_back(wrap_angle(heading_of(solution.q_G_B) - heading_of(flight.truth_q[step.index])));
        const Eigen::Matrix3d covariance = solution.covariance.topLeftCorner<3, 3>();
        nees.push_back(e.dot(covariance.inverse() * e) / 3.0);
        Eigen::Matrix<double, 6, 1> pose;
        pose << e, so3_log(solution.q_G_B * flight.truth_q[step.index].conjugate());
        flown.position_nees.back() = nees.back();
        flown.pose_nees.back() = pose.dot(solution.covariance.inverse() * pose) / 6.0;
        ++flown.located;
        if (std::isfinite(solution.horizontal_protection_level)) {
          ++flown.bounded;
          levels.push_back(solution.horizontal_protection_level);
          flown.misleading_horizontal += e.head<2>().norm() > solution.horizontal_protection_level ? 1 : 0;
          flown.misleading_vertical += std::abs(e.z()) > solution.vertical_protection_level ? 1 : 0;
        }
        flown.largest = std::max(flown.largest, e.norm());
        break;
      }
      case SyntheticFlight::Step::Kind::kKeyframe: {
        const auto start = std::chrono::steady_clock::now();
        fusion.add_keyframe(flight.keyframes[step.index]);
        const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
        flown.keyframe_ms.push_back(took.count());
        break;
      }
      case SyntheticFlight::Step::Kind::kCompass:
        fusion.add_compass(flight.compass[step.index]);
        break;
      case SyntheticFlight::Step::Kind::kImu:
        if (auto carried = fusion.add_imu(flight.imu[step.index]); carried.solution) {
          flown.inertial.push_back(*carried.solution);
        }
        break;
      case SyntheticFlight::Step::Kind::kFix: {
        const auto start = std::chrono::steady_clock::now();
        const Outcome outcome = fusion.add_fix(flight.fixes[step.index]);
        const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
        // A keyframe's cost is its own and its fix's.
        if (outcome == Outcome::kUsed) flown.solve_ms.push_back(took.count() + flown.keyframe_ms.back());
        if (outcome == Outcome::kUsed && flight.wrong[step.index]) ++flown.wrong_used;
        flown.outcomes.push_back(outcome);
        flown.fix_index.push_back(step.index);
        break;
      }
    }
  }
  flown.rmse = root_mean_square(error);
  flown.horizontal_rmse = root_mean_square(horizontal);
  flown.vertical_rmse = root_mean_square(vertical);
  flown.heading_rmse = root_mean_square(heading);
  double sum = 0;
  for (const double value : nees) sum += value;
  flown.nees = sum / static_cast<double>(nees.size());
  flown.horizontal_level = median(levels);
  flown.scale = running->scale();
  return flown;
}

}  // namespace orthonav::fusion
