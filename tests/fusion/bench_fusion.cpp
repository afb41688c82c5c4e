// Accuracy, consistency and cost of the fusion on synthetic flights, over seeds:
//   bench_fusion [SEEDS] [--config FOLDER] [--whole]
//
// "in 95 %": the part of the epochs at which the mean over the seeds of the normalised estimation error squared
// (position; position and attitude) lies within its 95 % bounds, those of a chi-squared variable.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "tests/fusion/fly.h"

using namespace orthonav;
using namespace orthonav::fusion;

namespace {

// Quantile of the mean, per degree of freedom, of a chi-squared variable with n degrees (Wilson and Hilferty).
double chi_squared_quantile(double z, double n) {
  return std::pow(1.0 - 2.0 / (9.0 * n) + z * std::sqrt(2.0 / (9.0 * n)), 3);
}

// Part of the epochs, in %, at which the mean over the flights is within its 95 % bounds.
double share_within_bounds(const std::vector<std::vector<double>>& of_flights, int degrees) {
  size_t epochs = of_flights.front().size();
  for (const auto& flight : of_flights) epochs = std::min(epochs, flight.size());
  int judged = 0, inside = 0;
  for (size_t k = 0; k < epochs; ++k) {
    double sum = 0;
    for (const auto& flight : of_flights) sum += flight[k];
    const double mean = sum / static_cast<double>(of_flights.size());
    if (std::isnan(mean)) continue;  // one of them had no position yet
    const double n = degrees * static_cast<double>(of_flights.size());
    ++judged;
    inside += mean > chi_squared_quantile(-1.96, n) && mean < chi_squared_quantile(1.96, n) ? 1 : 0;
  }
  return 100.0 * inside / std::max(1, judged);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Accuracy and cost of the fusion on synthetic flights, medians over seeds."};
  int seeds = 5;
  std::filesystem::path config;
  bool whole = false;
  app.add_option("seeds", seeds, "number of flights of each kind");
  app.add_option("--config", config, "folder with fusion.yaml (default: the defaults in the code)");
  app.add_flag("--whole", whole, "solve the whole trajectory instead of the window");
  CLI11_PARSE(app, argc, argv);
  FusionOptions options;
  if (!config.empty()) options = FusionOptions::load(config);
  options.declination = 0.0;
  if (whole) options.window_keyframes = 0;

  SyntheticOptions rural;
  SyntheticOptions zone;
  zone.duration = 407.5;
  zone.speed = 6.0;
  zone.height = 285.0;
  zone.fix_stddev = 4.0;
  zone.fix_vertical_stddev = 5.0;
  zone.fix_shared_stddev = zone.fix_shared_vertical_stddev = 2.0;
  SyntheticOptions runs = rural;
  runs.wrong_run_rate = 0.02;
  SyntheticOptions wrong_start = runs;
  wrong_start.wrong_at_start = 8;
  SyntheticOptions rare = rural;
  rare.fix_rate = 0.1;
  rare.wrong_run_rate = 0.05;
  rare.wrong_run_length = 4;
  // Errors drawn from the very model that the fusion assumes: its covariance must be honest to the letter.
  SyntheticOptions model = rural;
  model.single_wrong_rate = 0.0;
  model.position_noise = options.edge.position_walk * model.height * std::sqrt(model.keyframe_interval);
  model.heading_walk = options.edge.turn_walk;
  model.heading_bias_stddev = options.compass.bias_stddev;
  model.scale_stddev = options.edge.scale_stddev;
  model.scale_time = options.edge.scale_time;
  model.scale_walk = 0.0;
  model.lean_stddev = options.edge.lean_stddev;
  model.lean_walk = options.edge.turn_walk;
  model.compass_noise = options.compass.noise_stddev;
  model.fix_shared_stddev = options.fix.shared_horizontal_stddev;
  model.fix_shared_vertical_stddev = options.fix.shared_vertical_stddev;
  model.fix_shared_distance = options.fix.shared_distance;
  model.fix_shared_vertical_distance = options.fix.shared_vertical_distance;
  const std::vector<std::pair<std::string, SyntheticOptions>> kinds{
      {"model", model},    {"rural", rural}, {"zone", zone}, {"runs", runs}, {"wrong start", wrong_start},
      {"rare fixes", rare}};
  std::printf("%-12s %7s %7s %7s %8s %8s %6s %6s %6s %6s %6s %7s %7s %6s\n", "flight", "rmse", "horiz", "vert", "worst",
              "heading", "nees", "in95", "pose95", "lock s", "wrong", "ms med", "ms p99", "resets");
  for (const auto& [name, synthetic] : kinds) {
    std::vector<std::vector<double>> position_nees, pose_nees;
    std::vector<double> rmse, horizontal, vertical, largest, heading, nees, lock, wrong, ms, resets;
    for (int seed = 1; seed <= seeds; ++seed) {
      const Flown flown = fly(make_flight(synthetic, static_cast<uint64_t>(seed)), options);
      rmse.push_back(flown.rmse);
      horizontal.push_back(flown.horizontal_rmse);
      vertical.push_back(flown.vertical_rmse);
      largest.push_back(flown.largest);
      heading.push_back(flown.heading_rmse * 57.29578);
      nees.push_back(flown.nees);
      position_nees.push_back(flown.position_nees);
      pose_nees.push_back(flown.pose_nees);
      lock.push_back(flown.lock_time);
      wrong.push_back(flown.wrong_used);
      resets.push_back(flown.solutions.back().reset_counter);
      ms.insert(ms.end(), flown.solve_ms.begin(), flown.solve_ms.end());
    }
    std::printf(
        "%-12s %7.2f %7.2f %7.2f %8.1f %8.2f %6.2f %6.1f %6.1f %6.1f %6.1f %7.2f %7.2f %6.1f   worst seed %.2f\n",
        name.c_str(), median(rmse), median(horizontal), median(vertical), median(largest), median(heading),
        median(nees), share_within_bounds(position_nees, 3), share_within_bounds(pose_nees, 6), median(lock),
        median(wrong), median(ms), quantile(ms, 0.99), median(resets), quantile(rmse, 1.0));
  }
  return 0;
}
