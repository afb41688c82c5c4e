#include "tests/vio/bench_starts.h"

#include <cmath>
#include <cstdio>
#include <random>

#include <Eigen/QR>

#include "common/math/align.h"
#include "common/math/statistics.h"

namespace orthonav::vio {
namespace {

constexpr double kAfter = 5;           // s, after which the scale is looked at again
constexpr double kDeparture = 1e-3;    // rad
constexpr double kRoomDistance = 2.0;  // m, where the input knows no height

// Root mean square of how far the true way from `begin` to `end` lies from the best uniformly accelerated one, m.
double departure(const std::map<int64_t, Pose>& truth, int64_t begin, int64_t end) {
  std::vector<std::pair<double, Eigen::Vector3d>> way;
  for (auto it = truth.lower_bound(begin); it != truth.end() && it->first <= end; ++it) {
    way.emplace_back(1e-6 * static_cast<double>(it->first - begin), it->second.p);
  }
  if (way.size() < 5) return 0;
  const auto n = static_cast<Eigen::Index>(way.size());
  Eigen::MatrixXd A(n, 3), b(n, 3);
  for (Eigen::Index k = 0; k < n; ++k) {
    const auto& [t, p] = way[static_cast<size_t>(k)];
    A.row(k) << 1, t, t * t;
    b.row(k) = p.transpose();
  }
  return (A * A.householderQr().solve(b) - b).norm() / std::sqrt(static_cast<double>(n));
}

double observable_after(const Result& result) {
  if (result.outputs.empty()) return -1;
  const int64_t begin = result.outputs.front().utime;
  for (const VioOutput& output : result.outputs) {
    const auto height = result.height.lower_bound(output.utime);
    const double distance = height == result.height.end() ? kRoomDistance : height->second;
    if (departure(result.truth, begin, output.utime) > kDeparture * distance) {
      return 1e-6 * static_cast<double>(output.utime - begin);
    }
  }
  return -1;
}

// Relative error of the way between two times.
std::optional<double> way_error(const Result& result, int64_t from, int64_t to) {
  std::vector<Eigen::Vector3d> estimate, truth;
  for (const VioOutput& output : result.outputs) {
    if (output.status == Estimator::Status::kInitialising || output.utime < from || output.utime > to) continue;
    const auto at = truth_at(result.truth, output.utime);
    if (!at) continue;
    estimate.emplace_back(output.state.p());
    truth.push_back(at->p);
  }
  if (estimate.size() < 5) return std::nullopt;
  return 1 / align_umeyama(estimate, truth, true).scale - 1;
}

Start judge(const Result& result) {
  Start start;
  start.observable = observable_after(result);
  const auto at = result.started();
  if (!at) {
    start.reason = result.outputs.empty() ? "no images" : result.outputs.back().reason;
    return start;
  }
  start.took = 1e-6 * static_cast<double>(*at - result.outputs.front().utime);
  int session = 0;
  bool first = true;
  for (const VioOutput& output : result.outputs) {
    if (output.utime < *at) continue;
    if (first) session = output.session;
    start.restarted = start.restarted || output.session != session;
    const auto height = result.height.lower_bound(output.utime);
    if (height != result.height.end() && output.status != Estimator::Status::kInitialising) {
      start.scale_later = output.height_above_ground / height->second - 1;
      if (first) start.scale_error = start.scale_later;
    }
    first = false;
  }
  if (result.height.empty()) {
    start.scale_error = way_error(result, *at, *at + 2'000'000).value_or(NAN);
    start.scale_later = way_error(result, *at + 4'000'000, *at + 6'000'000).value_or(NAN);
  }
  return start;
}

void print(const BenchInput& input, const Start& start) {
  std::printf("%-16s at %5.1f s: took %.1f s, observable after %.1f s, scale off by %.1f %%, later %.1f %%%s %s\n",
              input.path.filename().c_str(), start.begin, start.took, start.observable, 100 * start.scale_error,
              100 * start.scale_later, start.restarted ? ", restarted" : "", start.reason.c_str());
  std::fflush(stdout);
}

}  // namespace

void run_starts(const BenchInput& input, const StartOptions& options, std::vector<Start>& starts) {
  std::mt19937 generator(options.seed);
  std::uniform_real_distribution<double> uniform(0, options.until);
  for (int n = 0; n < options.count; ++n) {
    BenchRun run;
    run.begin = uniform(generator);
    run.duration = 25;
    run.after_start = input.asl ? kAfter + 1 : kAfter;
    run.image_noise = options.image_noise;
    Start start = judge(run_input(input, run));
    start.begin = run.begin;
    print(input, start);
    starts.push_back(start);
  }
}

void run_resets(const BenchInput& input, double every, std::vector<Start>& starts) {
  BenchRun run;
  run.reset_every = every;
  const Result whole = run_input(input, run);
  // Each stretch from a reset on is judged as a flight of its own.
  Result stretch;
  stretch.truth = whole.truth;
  stretch.height = whole.height;
  const auto judged = [&] {
    if (stretch.outputs.size() < 10 * kAfter) return;
    Start start = judge(stretch);
    start.begin = 1e-6 * static_cast<double>(stretch.outputs.front().utime - whole.outputs.front().utime);
    print(input, start);
    starts.push_back(start);
  };
  for (const VioOutput& output : whole.outputs) {
    const bool ended = !stretch.outputs.empty() && stretch.outputs.back().status != Estimator::Status::kInitialising &&
                       output.status == Estimator::Status::kInitialising;
    if (ended) {
      // The first one began with nothing known, as run_starts has it.
      if (stretch.outputs.front().utime != whole.outputs.front().utime) judged();
      stretch.outputs.clear();
    }
    stretch.outputs.push_back(output);
  }
  judged();
}

void print_summary(const std::vector<Start>& starts) {
  std::vector<double> took, waited, errors, later;
  int failed = 0, restarted = 0, in_time = 0;
  for (const Start& start : starts) {
    if (start.took < 0) {
      ++failed;
      continue;
    }
    restarted += start.restarted ? 1 : 0;
    took.push_back(start.took);
    const double wait = start.observable < 0 ? 0.0 : start.took - start.observable;
    in_time += wait <= 3 ? 1 : 0;
    waited.push_back(wait);
    if (std::isfinite(start.scale_error)) errors.push_back(std::abs(start.scale_error));
    if (std::isfinite(start.scale_later)) later.push_back(std::abs(start.scale_later));
  }
  if (took.empty()) return;
  std::printf(
      "%zu starts: %d failed, %d restarted or published anew; took median %.1f p90 %.1f max %.1f s; after motion made "
      "it "
      "observable median %.1f p90 %.1f max %.1f s, %d within 3 s; scale off by median %.1f %% p90 %.1f %%, later "
      "median "
      "%.1f %% p90 %.1f %%\n",
      starts.size(), failed, restarted, median(took), quantile(took, 0.9), quantile(took, 1.0), median(waited),
      quantile(waited, 0.9), quantile(waited, 1.0), in_time, 100 * median(errors), 100 * quantile(errors, 0.9),
      100 * median(later), 100 * quantile(later, 0.9));
}

}  // namespace orthonav::vio
