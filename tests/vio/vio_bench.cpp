// Runs the odometry over recorded flights and prints how well it did. Not a test: a tool to tune by.
//
//   vio_bench --config config/rural flight1.lcm flight2.lcm      flight logs with TRUTH
//   vio_bench --config config/default --asl DIR                  EuRoC/ASL folders; calibration from its sensor.yaml
//   vio_bench --config config/rural --starts 20 flight.lcm       starts at random moments: time, scale
//   vio_bench --config config/rural --resets 15 flight.lcm       a reset every 15 s: time to the next session, scale
//   vio_bench --config config/rural --loops 8 flight.lcm         an hour: memory and time per frame, loop by loop
//
// One line per flight: position RMSE after alignment in yaw and translation (4-DoF) and by a similarity (Umeyama), the
// scale of the latter, error of the vertical (root mean square), drift over 100 m of flight, sessions and why they
// ended, time to start, normalised error squared (per dimension) of the motion between keyframes, CPU time per frame.
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>

#include <CLI/CLI.hpp>
#include <opencv2/core.hpp>

#include "common/math/align.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "tests/vio/bench_run.h"
#include "tests/vio/bench_starts.h"

namespace orthonav::vio {
namespace {

double rmse(const Similarity& fit, const std::vector<Eigen::Vector3d>& from, const std::vector<Eigen::Vector3d>& to) {
  std::vector<double> errors;
  for (size_t i = 0; i < from.size(); ++i) errors.push_back((fit * from[i] - to[i]).norm());
  return root_mean_square(errors);
}

// When sessions ended, and why.
std::string restarts(const Result& result) {
  std::string text;
  int session = 0;
  for (const VioOutput& output : result.outputs) {
    if (session != 0 && output.session != session) {
      char line[300];
      std::snprintf(line, sizeof line, "\n    at %.1f s: %s",
                    1e-6 * static_cast<double>(output.utime - result.outputs.front().utime),
                    output.reason.empty() ? "published anew" : output.reason.c_str());
      text += line;
    }
    session = output.session;
  }
  return text;
}

// Angle between the vertical of an attitude and the true one, degrees.
double tilt_error_deg(const Eigen::Quaterniond& q, const Eigen::Quaterniond& truth) {
  const Eigen::Vector3d up = q.conjugate() * Eigen::Vector3d::UnitZ(),
                        true_up = truth.conjugate() * Eigen::Vector3d::UnitZ();
  return std::atan2(up.cross(true_up).norm(), up.dot(true_up)) * 180 / M_PI;
}

double mean(const std::vector<double>& values) {
  double sum = 0;
  for (const double value : values) sum += value;
  return values.empty() ? std::numeric_limits<double>::quiet_NaN() : sum / static_cast<double>(values.size());
}

void report(const std::string& name, const Result& result, const std::filesystem::path& dump) {
  std::map<int, std::pair<std::vector<Eigen::Vector3d>, std::vector<Eigen::Vector3d>>> sessions;
  std::map<int, std::vector<Eigen::Quaterniond>> attitudes, true_attitudes;
  std::optional<Keyframe> last_keyframe;
  Pose last_keyframe_truth{Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity()};
  std::vector<double> ms, drift, nees, nees_position, nees_rotation;
  int64_t start = 0;
  for (size_t i = 0; i < result.outputs.size(); ++i) {
    const VioOutput& output = result.outputs[i];
    if (output.status == Estimator::Status::kInitialising) continue;
    if (start == 0) start = output.utime;
    ms.push_back(result.ms[i]);
    const auto truth = truth_at(result.truth, output.utime);
    if (!truth) continue;
    sessions[output.session].first.emplace_back(output.state.p());
    sessions[output.session].second.push_back(truth->p);
    attitudes[output.session].emplace_back(output.state.q());
    true_attitudes[output.session].push_back(truth->q);
    if (!output.keyframe) continue;
    const Keyframe& keyframe = *output.keyframe;
    if (last_keyframe && keyframe.relative_covariance.allFinite()) {
      const StateValues &a = last_keyframe->state, &b = keyframe.state;
      const Pose& true_a = last_keyframe_truth;
      Eigen::Matrix<double, 6, 1> error;
      error << a.q().conjugate() * (b.p() - a.p()) - true_a.q.conjugate() * (truth->p - true_a.p),
          so3_log((true_a.q.conjugate() * truth->q).conjugate() * (a.q().conjugate() * b.q()));
      const auto& covariance = keyframe.relative_covariance;
      nees.push_back(error.dot(covariance.ldlt().solve(error)) / 6);
      nees_position.push_back(error.head<3>().dot(covariance.topLeftCorner<3, 3>().ldlt().solve(error.head<3>())) / 3);
      nees_rotation.push_back(error.tail<3>().dot(covariance.bottomRightCorner<3, 3>().ldlt().solve(error.tail<3>())) /
                              3);
    }
    last_keyframe = keyframe;
    last_keyframe_truth = *truth;
  }
  if (sessions.empty() || result.outputs.empty()) {
    std::printf("%-28s never started (%s)\n", name.c_str(),
                result.outputs.empty() ? "no images" : result.outputs.back().reason.c_str());
    return;
  }
  std::string per_session;
  double first_scale = 0;
  for (const auto& [session, tracks] : sessions) {
    const auto& [from, to] = tracks;
    if (from.size() < 20) continue;
    const Similarity rigid = align_yaw_translation(from, to), similar = align_umeyama(from, to, true);
    // Scale of the first ten seconds, for the start's quality.
    const size_t head = std::min<size_t>(from.size(), 100);
    const std::vector<Eigen::Vector3d> from_head(from.begin(), from.begin() + static_cast<long>(head)),
        to_head(to.begin(), to.begin() + static_cast<long>(head));
    first_scale = align_umeyama(from_head, to_head, true).scale;
    double worst = 0;
    std::vector<double> tilts;
    for (size_t i = 0; i < from.size(); ++i) {
      worst = std::max(worst, (rigid * from[i] - to[i]).norm());
      tilts.push_back(tilt_error_deg(attitudes[session][i], true_attitudes[session][i]));
    }
    char text[200];
    std::snprintf(text, sizeof text,
                  " [4dof %.3f m  max %.3f  umeyama %.3f m  scale %.4f  first %.3f  tilt %.2f deg  n %zu]",
                  rmse(rigid, from, to), worst, rmse(similar, from, to), similar.scale, first_scale,
                  root_mean_square(tilts), from.size());
    per_session += text;
    std::vector<double> path(to.size(), 0.0);
    for (size_t i = 1; i < to.size(); ++i) path[i] = path[i - 1] + (to[i] - to[i - 1]).norm();
    // What 100 m of flight add to the error of position, begun with the true position and yaw.
    for (size_t i = 0, j = 0; i < to.size(); i += 10) {
      while (j < to.size() && path[j] - path[i] < 100) ++j;
      if (j >= to.size()) break;
      const double turn = yaw_of(true_attitudes[session][i]) - yaw_of(attitudes[session][i]);
      const Eigen::Vector3d way = Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()) * (from[j] - from[i]);
      drift.push_back((way - (to[j] - to[i])).norm() / (path[j] - path[i]));
    }
  }
  std::printf(
      "%-28s sessions %zu  start %.1f s%s  drift/100m %.2f %%  NEES of a keyframe's motion median %.2f mean %.2f "
      "(position %.2f, rotation %.2f)  ms "
      "median %.1f p99 %.1f  time offset %.2f ms%s\n",
      name.c_str(), sessions.size(), 1e-6 * static_cast<double>(start - result.outputs.front().utime),
      per_session.c_str(), 100 * median(drift), median(nees), mean(nees), median(nees_position), median(nees_rotation),
      quantile(ms, 0.5), quantile(ms, 0.99), 1e3 * result.outputs.back().time_offset, restarts(result).c_str());
  if (!dump.empty()) {
    std::ofstream out(dump);
    for (const VioOutput& output : result.outputs) {
      const auto truth = truth_at(result.truth, output.utime);
      if (!truth || output.status == Estimator::Status::kInitialising) continue;
      out << output.utime << ' ' << output.state.p().transpose() << ' ' << truth->p.transpose() << ' '
          << output.state.v().transpose() << ' ' << output.state.ba().transpose() << ' '
          << output.state.bg().transpose() << ' ' << output.height_above_ground << ' ' << output.num_tracked << ' '
          << output.pose_covariance.topLeftCorner<3, 3>().trace() << ' ' << tilt_error_deg(output.state.q(), truth->q)
          << '\n';
    }
  }
}

// The log again and again, as one long flight: what a frame costs and what the process holds, each time. Where the log
// begins anew the camera and the IMU jump, and the odometry has to find out and restart.
void report_loops(const BenchInput& input, const BenchRun& run, int loops) {
  const VioSetup& setup = input.setup;
  Vio vio(setup.options, setup.camera, setup.extrinsics);
  int64_t later = 0;
  for (int n = 0; n < loops; ++n) {
    Result result;
    const int64_t first = later;
    const int64_t last = feed_log(input.path, run, later, vio, result);
    const int64_t begun = result.outputs.empty() ? last : result.outputs.front().utime;
    later = first + (last - begun) + 100'000;
    long pages = 0, resident = 0;
    std::ifstream("/proc/self/statm") >> pages >> resident;
    std::printf("loop %d: %.0f s, ms median %.1f p99 %.1f, resident %.1f MB, restarts so far %.0f\n", n + 1,
                1e-6 * static_cast<double>(last - begun), quantile(result.ms, 0.5), quantile(result.ms, 0.99),
                static_cast<double>(resident) * 4096 / 1e6,
                vio.counters().count("restarts") ? vio.counters().at("restarts") : 0.0);
    std::fflush(stdout);
  }
}

}  // namespace
}  // namespace orthonav::vio

int main(int argc, char** argv) {
  using namespace orthonav;
  CLI::App app{"Runs the odometry over recorded flights and prints its accuracy"};
  std::filesystem::path config, dump;
  std::vector<std::filesystem::path> inputs;
  bool asl = false;
  vio::BenchRun run;
  vio::StartOptions start;
  int loops = 0;
  double resets = 0;
  start.count = 0;
  app.add_option("--loops", loops, "instead, run each flight log so many times as one long flight");
  app.add_option("--starts", start.count, "instead, start at this many random moments of each input");
  app.add_option("--resets", resets, "instead, end the session every so many seconds of each flight log");
  app.add_option("--starts-until", start.until, "the last of these moments, s");
  app.add_option("--starts-seed", start.seed, "of these moments");
  app.add_option("--config", config, "configuration folder")->required();
  app.add_flag("--asl", asl, "the inputs are EuRoC/ASL folders");
  app.add_flag("-v,--verbose", run.verbose, "a line per keyframe");
  app.add_option("--begin", run.begin, "seconds of each input to pass over");
  app.add_option("--duration", run.duration, "seconds of each input to run");
  app.add_option("--image-noise", run.image_noise, "noise added to the images, grey levels, 1 sigma");
  app.add_option("--dump", dump, "estimate and truth of the last input, as text");
  app.add_option("inputs", inputs, "flight logs or ASL folders")->required();
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);
  start.image_noise = run.image_noise;
  try {
    const vio::VioSetup setup = vio::load_setup(config);
    std::vector<vio::Start> starts;
    for (const auto& path : inputs) {
      const vio::BenchInput input{path, asl, setup};
      if (loops > 0) {
        vio::report_loops(input, run, loops);
      } else if (resets > 0) {
        vio::run_resets(input, resets, starts);
      } else if (start.count > 0) {
        vio::run_starts(input, start, starts);
      } else {
        vio::report(path.filename().string(), vio::run_input(input, run), dump);
      }
    }
    vio::print_summary(starts);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "vio_bench: %s\n", error.what());
    return 1;
  }
  return 0;
}
