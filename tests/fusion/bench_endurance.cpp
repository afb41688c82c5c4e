// Time and memory over a long flight: one line an hour.
//   bench_endurance [--hours H] [--csv FILE]
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <unistd.h>

#include "common/math/statistics.h"
#include "services/fusion/fusion.h"
#include "tests/fusion/synthetic_flight.h"

using namespace orthonav;
using namespace orthonav::fusion;

namespace {

double resident_megabytes() {
  std::ifstream status("/proc/self/statm");
  long total = 0, resident = 0;
  status >> total >> resident;
  return static_cast<double>(resident) * static_cast<double>(sysconf(_SC_PAGESIZE)) / (1024.0 * 1024.0);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Time per keyframe and memory of the fusion over a long flight."};
  double hours = 10.0;
  std::filesystem::path csv;
  app.add_option("--hours", hours, "length of the flight")->check(CLI::PositiveNumber);
  app.add_option("--csv", csv, "file for the curves: minute, median and 99th percentile in ms, megabytes, error in m");
  CLI11_PARSE(app, argc, argv);

  SyntheticOptions synthetic;
  synthetic.duration = 3600.0 * hours;
  synthetic.keyframe_interval = 1.0;
  synthetic.wrong_run_rate = 0.002;
  const SyntheticFlight flight = make_flight(synthetic, 1);
  const EnuFrame frame(flight.anchor);
  std::ofstream curves;
  if (!csv.empty()) {
    curves.open(csv);
    curves << "minute,median_ms,p99_ms,megabytes,horizontal_rmse_m\n";
  }
  const double before = resident_megabytes();
  Fusion fusion{FusionOptions{}};
  std::vector<double> of_minute, of_hour, errors_of_minute, errors_of_hour;
  double pending = 0;
  int minute = 0;
  std::printf("%5s %9s %8s %8s %9s %11s %6s\n", "hour", "keyframes", "median", "p99", "memory MB", "horizontal",
              "nodes");
  const auto timed = [](const auto& work) {
    const auto start = std::chrono::steady_clock::now();
    work();
    return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
  };
  for (const SyntheticFlight::Step& step : flight.steps) {
    switch (step.kind) {
      case SyntheticFlight::Step::Kind::kState: {
        const Solution solution = fusion.propagate(flight.states[step.index]).solution;
        if (solution.located()) {
          const Eigen::Vector3d e = frame.to_enu(solution.position) - flight.truth[step.index];
          errors_of_minute.push_back(e.head<2>().norm());
          errors_of_hour.push_back(errors_of_minute.back());
        }
        if ((step.index + 1) % 600 != 0) break;
        ++minute;
        if (curves.is_open()) {
          curves << minute << "," << median(of_minute) << "," << quantile(of_minute, 0.99) << ","
                 << resident_megabytes() - before << "," << root_mean_square(errors_of_minute) << "\n";
        }
        of_minute.clear();
        errors_of_minute.clear();
        if (minute % 60 != 0) break;
        std::printf("%5d %9zu %8.2f %8.2f %9.1f %11.2f %6d\n", minute / 60, of_hour.size(), median(of_hour),
                    quantile(of_hour, 0.99), resident_megabytes() - before, root_mean_square(errors_of_hour),
                    fusion.graph_size());
        of_hour.clear();
        errors_of_hour.clear();
        break;
      }
      case SyntheticFlight::Step::Kind::kKeyframe:
        // A keyframe's cost is its own and that of the fix that comes before the next one.
        if (pending > 0) {
          of_minute.push_back(pending);
          of_hour.push_back(pending);
        }
        pending = timed([&] { fusion.add_keyframe(flight.keyframes[step.index]); });
        break;
      case SyntheticFlight::Step::Kind::kFix:
        pending += timed([&] { fusion.add_fix(flight.fixes[step.index]); });
        break;
      case SyntheticFlight::Step::Kind::kCompass:
        fusion.add_compass(flight.compass[step.index]);
        break;
      case SyntheticFlight::Step::Kind::kImu:
        break;
    }
  }
  return 0;
}
