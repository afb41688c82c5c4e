// Fault injection: short flights in which something goes wrong, and whether the error ever exceeds its protection
// level (a hazardously misleading epoch).
//   bench_integrity [--seeds N] [--config FOLDER]
#include <cstdio>
#include <filesystem>
#include <functional>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "tests/fusion/faults.h"
#include "tests/fusion/fly.h"

using namespace orthonav;
using namespace orthonav::fusion;

namespace {

using Fault = std::function<void(SyntheticFlight&)>;

std::vector<std::pair<std::string, Fault>> all_faults() {
  using Eigen::Vector3d;
  namespace f = orthonav::fusion::faults;
  return {
      {"none", [](SyntheticFlight&) {}},
      {"10 s of fixes 5 m off", [](auto& x) { f::shift_fixes(x, 90, 100, Vector3d(4, 3, 0)); }},
      {"20 s of fixes 8 m off", [](auto& x) { f::shift_fixes(x, 90, 110, Vector3d(-5, 6, 0)); }},
      {"25 s of fixes 12 m off", [](auto& x) { f::shift_fixes(x, 90, 115, Vector3d(0, -12, 0)); }},
      {"25 s of fixes 20 m off", [](auto& x) { f::shift_fixes(x, 90, 115, Vector3d(16, 12, 0)); }},
      {"25 s of fixes 60 m off", [](auto& x) { f::shift_fixes(x, 90, 115, Vector3d(50, 33, 2)); }},
      {"40 s of fixes 150 m off", [](auto& x) { f::shift_fixes(x, 90, 130, Vector3d(-120, 90, 5)); }},
      {"25 s of heights 6 m off", [](auto& x) { f::shift_fixes(x, 90, 115, Vector3d(0, 0, 6)); }},
      {"25 s of heights 15 m off", [](auto& x) { f::shift_fixes(x, 90, 115, Vector3d(0, 0, -15)); }},
      {"fixes drift 0.3 m/s for 25 s",
       [](auto& x) { f::shift_fixes(x, 90, 115, Vector3d::Zero(), Vector3d(0.3, 0, 0)); }},
      {"first 4 s of fixes 100 m off", [](auto& x) { f::shift_fixes(x, 0, 4, Vector3d(80, 60, 0)); }},
      {"first 8 s of fixes 100 m off", [](auto& x) { f::shift_fixes(x, 0, 8, Vector3d(80, 60, 0)); }},
      {"no fixes for 60 s", [](auto& x) { f::silence_fixes(x, 80, 140); }},
      {"no fixes, then 10 wrong",
       [](auto& x) {
         f::silence_fixes(x, 70, 120);
         f::shift_fixes(x, 120, 124, Vector3d(-30, 20, 0));
       }},
      {"compass 20 degrees off", [](auto& x) { f::turn_compass(x, 0, 1e9, 0.349); }},
      {"compass turns 40 degrees", [](auto& x) { f::turn_compass(x, 90, 1e9, 0.7); }},
      {"compass dies", [](auto& x) { f::silence_compass(x, 60, 1e9); }},
      {"compass freezes", [](auto& x) { f::freeze_compass(x, 60); }},
      {"odometry restarts", [](auto& x) { f::restart_odometry(x, 90, 3.0); }},
      {"odometry gone for 15 s", [](auto& x) { f::restart_odometry(x, 90, 15.0); }},
      {"no sensors for 1.2 s, odometry gone for 4",
       [](auto& x) {
         f::restart_odometry(x, 90, 4.0);
         f::silence_imu(x, 90, 91.2);
       }},
      {"the same, then 5 s of fixes 30 m off",
       [](auto& x) {
         f::restart_odometry(x, 90, 4.0);
         f::silence_imu(x, 90, 91.2);
         f::shift_fixes(x, 94, 99, Vector3d(24, 18, 0));
       }},
      {"fusion is killed", [](auto& x) { x.fusion_killed = 90; }},
      {"fusion is killed among wrong fixes",
       [](auto& x) {
         x.fusion_killed = 100;
         f::shift_fixes(x, 90, 115, Vector3d(16, 12, 0));
       }},
      {"odometry's scale 5 % off", [](auto& x) { f::bend_odometry(x, 90, 0.95, 0.0); }},
      {"odometry turns 1 degree", [](auto& x) { f::bend_odometry(x, 90, 1.0, 0.0175); }},
      {"odometry jumps 3 m", [](auto& x) { f::bend_odometry(x, 90, 1.0, 0.0, Vector3d(2.4, 1.8, 0)); }},
  };
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Errors against protection levels in short flights with faults."};
  int seeds = 3;
  std::filesystem::path config;
  app.add_option("--seeds", seeds, "flights of each fault");
  app.add_option("--config", config, "folder with fusion.yaml and aircraft.yaml (default: the defaults in the code)");
  CLI11_PARSE(app, argc, argv);
  FusionOptions options;
  if (!config.empty()) options = FusionOptions::load(config);
  options.declination = 0.0;

  SyntheticOptions synthetic;
  synthetic.duration = 180.0;
  synthetic.keyframe_interval = 0.5;
  synthetic.imu = true;
  int flights = 0, epochs = 0, bounded = 0, misleading = 0;
  std::printf("%-30s %7s %8s %7s %8s %8s %7s %7s\n", "fault", "epochs", "bounded", "level", "largest", "rmse h",
              "misl. h", "misl. v");
  for (const auto& [name, fault] : all_faults()) {
    int epochs_of = 0, bounded_of = 0, horizontal_of = 0, vertical_of = 0;
    std::vector<double> largest, levels, rmse;
    for (int seed = 1; seed <= seeds; ++seed) {
      SyntheticFlight flight = make_flight(synthetic, 100 + static_cast<uint64_t>(seed));
      fault(flight);
      const Flown flown = fly(flight, options);
      ++flights;
      epochs_of += flown.located;
      bounded_of += flown.bounded;
      horizontal_of += flown.misleading_horizontal;
      vertical_of += flown.misleading_vertical;
      largest.push_back(flown.largest);
      levels.push_back(flown.horizontal_level);
      rmse.push_back(flown.horizontal_rmse);
    }
    std::printf("%-30s %7d %7.1f%% %7.1f %8.1f %8.2f %7d %7d\n", name.c_str(), epochs_of,
                100.0 * bounded_of / std::max(1, epochs_of), median(levels), quantile(largest, 1.0), median(rmse),
                horizontal_of, vertical_of);
    epochs += epochs_of;
    bounded += bounded_of;
    misleading += horizontal_of + vertical_of;
  }
  std::printf("%d flights, %d epochs with a position, %d of them bounded, %d hazardously misleading\n", flights, epochs,
              bounded, misleading);
  return misleading == 0 ? 0 : 1;
}
