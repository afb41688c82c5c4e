// Runs the odometry over recorded flights and prints how well it did. Not a test: a tool to tune by.
//
//   vio_bench --config config/rural flight1.lcm flight2.lcm      flight logs with TRUTH
//   vio_bench --config config/default --asl DIR                  EuRoC/ASL folders; calibration from its sensor.yaml
//   vio_bench --config config/rural --starts 20 flight.lcm       starts at random moments: time, scale
//   vio_bench --config config/rural --loops 8 flight.lcm         an hour: memory and time per frame, loop by loop
//
// One line per flight: position RMSE after alignment in yaw and translation (4-DoF) and by a similarity (Umeyama), the
// scale of the latter, drift over 100 m of flight, sessions and why they ended, time to start, normalised error squared
// (per dimension) of the motion between keyframes, time per frame.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <random>
#include <sstream>

#include <CLI/CLI.hpp>
#include <opencv2/imgcodecs.hpp>

#include "common/bus/channels.h"
#include "common/camera/image_decode.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "common/math/align.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "orthonav/altitude_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/truth_t.hpp"
#include "services/vio/asl_setup.h"
#include "services/vio/vio.h"

namespace orthonav::vio {
namespace {

struct Pose {
  Eigen::Vector3d p;
  Eigen::Quaterniond q;
};

struct Result {
  std::vector<VioOutput> outputs;
  std::vector<double> ms;
  std::map<int64_t, Pose> truth;
  std::map<int64_t, double> height;  // m above the surface
  std::map<std::string, double> counters;
};

void run_pending(Vio& vio, Result& result, bool verbose) {
  while (true) {
    const auto start = std::chrono::steady_clock::now();
    auto output = vio.next();
    const double ms = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
    if (!output) break;
    if (verbose && (output->keyframe || output->status != Estimator::Status::kTracking)) {
      const auto& s = output->state;
      std::printf(
          "%.2f session %d status %d tracked %d features %zu h %.2f v %.2f %.2f %.2f ba %.3f %.3f %.3f bg %.4f %.4f "
          "%.4f %.1f ms %s\n",
          1e-6 * static_cast<double>(output->utime), output->session, static_cast<int>(output->status),
          output->num_tracked, output->keyframe ? output->keyframe->features.size() : 0, output->height_above_ground,
          s.v().x(), s.v().y(), s.v().z(), s.ba().x(), s.ba().y(), s.ba().z(), s.bg().x(), s.bg().y(), s.bg().z(), ms,
          output->reason.c_str());
    }
    result.outputs.push_back(*output);
    result.ms.push_back(ms);
  }
}

// Feeds a log to the odometry, all time stamps later by `later` (microseconds); returns the last of them.
int64_t feed_log(const std::filesystem::path& file, Vio& vio, Result& result, double duration, bool verbose,
                 double begin, int64_t later) {
  LogReader reader(file);
  std::optional<EnuFrame> frame;
  int64_t first = 0, last = 0;
  while (const auto event = reader.next()) {
    if (first == 0) first = event->utime;
    const double age = 1e-6 * static_cast<double>(event->utime - first) - begin;
    if (age > duration) break;
    if (age < 0) continue;
    last = std::max(last, event->utime + later);
    if (event->channel == channel::kImu) {
      if (const auto imu = event->decode<imu_t>()) {
        ImuSample sample;
        sample.utime = imu->utime + later;
        sample.gyro = Eigen::Map<const Eigen::Vector3d>(imu->angular_rate);
        sample.accel = Eigen::Map<const Eigen::Vector3d>(imu->specific_force);
        vio.feed_imu(sample);
      }
    } else if (event->channel == channel::kCamera) {
      if (const auto image = event->decode<image_t>()) {
        const DecodedImage decoded = decode_image(*image);
        if (decoded.ok()) vio.feed_image(image->utime + later, decoded.grey);
      }
    } else if (event->channel == channel::kAltitude) {
      if (const auto altitude = event->decode<altitude_t>()) {
        vio.feed_altitude(altitude->utime + later, altitude->height_above_ground, altitude->stddev);
      }
    } else if (event->channel == channel::kTruth) {
      if (const auto truth = event->decode<truth_t>()) {
        const Geodetic position{truth->latitude_deg, truth->longitude_deg, truth->ellipsoidal_height};
        if (!frame) frame.emplace(position);
        const double* q = truth->q_ENU_B;
        result.truth[truth->utime + later] = {frame->to_enu(position), {q[0], q[1], q[2], q[3]}};
        result.height[truth->utime + later] = truth->height_above_ground;
      }
    }
    run_pending(vio, result, verbose);
  }
  result.counters = vio.counters();
  return last;
}

Result run_log(const std::filesystem::path& file, const VioSetup& setup, double duration, bool verbose,
               double begin = 0) {
  Vio vio(setup.options, setup.camera, setup.extrinsics);
  Result result;
  feed_log(file, vio, result, duration, verbose, begin, 0);
  return result;
}

std::vector<std::vector<std::string>> read_csv(const std::filesystem::path& file) {
  std::ifstream in(file);
  std::vector<std::vector<std::string>> rows;
  for (std::string line; std::getline(in, line);) {
    if (line.empty() || line[0] == '#') continue;
    while (!line.empty() && (line.back() == '\r' || line.back() == '\n')) line.pop_back();
    std::vector<std::string> cells;
    std::stringstream stream(line);
    for (std::string cell; std::getline(stream, cell, ',');) cells.push_back(cell);
    rows.push_back(cells);
  }
  return rows;
}

Result run_asl(const std::filesystem::path& folder, const VioOptions& base, double duration, bool verbose) {
  const auto mav = folder / "mav0";
  const VioSetup setup = load_asl_setup(folder, base);
  Vio vio(setup.options, setup.camera, setup.extrinsics);
  Result result;
  const auto images = read_csv(mav / "cam0/data.csv"), samples = read_csv(mav / "imu0/data.csv");
  for (const auto& row : read_csv(mav / "state_groundtruth_estimate0/data.csv")) {
    result.truth[std::stoll(row[0]) / 1000] = {
        {std::stod(row[1]), std::stod(row[2]), std::stod(row[3])},
        {std::stod(row[4]), std::stod(row[5]), std::stod(row[6]), std::stod(row[7])}};
  }
  size_t next_image = 0;
  const int64_t first = std::stoll(images.front()[0]) / 1000;
  for (const auto& row : samples) {
    ImuSample sample;
    sample.utime = std::stoll(row[0]) / 1000;
    if (1e-6 * static_cast<double>(sample.utime - first) > duration) break;
    for (int k = 0; k < 3; ++k) {
      sample.gyro[k] = std::stod(row[static_cast<size_t>(1 + k)]);
      sample.accel[k] = std::stod(row[static_cast<size_t>(4 + k)]);
    }
    vio.feed_imu(sample);
    while (next_image < images.size() && std::stoll(images[next_image][0]) / 1000 <= sample.utime) {
      vio.feed_image(std::stoll(images[next_image][0]) / 1000,
                     cv::imread((mav / "cam0/data" / images[next_image][1]).string(), cv::IMREAD_GRAYSCALE));
      ++next_image;
      run_pending(vio, result, verbose);
    }
    run_pending(vio, result, verbose);
  }
  result.counters = vio.counters();
  return result;
}

// Truth at a time, between its samples.
std::optional<Pose> truth_at(const std::map<int64_t, Pose>& truth, int64_t utime) {
  auto after = truth.lower_bound(utime);
  if (after == truth.end()) return std::nullopt;
  if (after->first == utime) return after->second;
  if (after == truth.begin()) return std::nullopt;
  const auto before = std::prev(after);
  if (after->first - before->first > 200000) return std::nullopt;
  const double s = static_cast<double>(utime - before->first) / static_cast<double>(after->first - before->first);
  return Pose{(1 - s) * before->second.p + s * after->second.p, before->second.q.slerp(s, after->second.q)};
}

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
  std::vector<double> ms, drift, nees;
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
      nees.push_back(error.dot(keyframe.relative_covariance.ldlt().solve(error)) / 6);
    }
    last_keyframe = keyframe;
    last_keyframe_truth = *truth;
  }
  if (sessions.empty() || result.outputs.empty()) {
    std::printf("%-28s never started (%s)\n", name.c_str(),
                result.outputs.empty() ? "no images" : result.outputs.back().reason.c_str());
    return;
  }
  size_t total = 0;
  std::string per_session;
  double first_scale = 0;
  for (const auto& [session, tracks] : sessions) {
    const auto& [from, to] = tracks;
    total += from.size();
    if (from.size() < 20) continue;
    const Similarity rigid = align_yaw_translation(from, to), similar = align_umeyama(from, to, true);
    // Scale of the first ten seconds, for the start's quality.
    const size_t head = std::min<size_t>(from.size(), 100);
    const std::vector<Eigen::Vector3d> from_head(from.begin(), from.begin() + static_cast<long>(head)),
        to_head(to.begin(), to.begin() + static_cast<long>(head));
    first_scale = align_umeyama(from_head, to_head, true).scale;
    double worst = 0;
    for (size_t i = 0; i < from.size(); ++i) worst = std::max(worst, (rigid * from[i] - to[i]).norm());
    char text[200];
    std::snprintf(text, sizeof text, " [4dof %.3f m  max %.3f  umeyama %.3f m  scale %.4f  first %.3f  n %zu]",
                  rmse(rigid, from, to), worst, rmse(similar, from, to), similar.scale, first_scale, from.size());
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
      "%-28s sessions %zu  start %.1f s%s  drift/100m %.2f %%  NEES of a keyframe's motion median %.2f mean %.2f  ms "
      "median %.1f p99 %.1f  time offset %.2f ms%s\n",
      name.c_str(), sessions.size(), 1e-6 * static_cast<double>(start - result.outputs.front().utime),
      per_session.c_str(), 100 * median(drift), median(nees), mean(nees), quantile(ms, 0.5), quantile(ms, 0.99),
      1e3 * result.outputs.back().time_offset, restarts(result).c_str());
  if (!dump.empty()) {
    std::ofstream out(dump);
    for (const VioOutput& output : result.outputs) {
      const auto truth = truth_at(result.truth, output.utime);
      if (!truth || output.status == Estimator::Status::kInitialising) continue;
      out << output.utime << ' ' << output.state.p().transpose() << ' ' << truth->p.transpose() << ' '
          << output.state.v().transpose() << ' ' << output.state.ba().transpose() << ' '
          << output.state.bg().transpose() << ' ' << output.height_above_ground << ' ' << output.num_tracked << ' '
          << output.pose_covariance.topLeftCorner<3, 3>().trace() << '\n';
    }
  }
}

// The log again and again, as one long flight: what a frame costs and what the process holds, each time. Where the log
// begins anew the camera and the IMU jump, and the odometry has to find out and restart.
void report_loops(const std::filesystem::path& file, const VioSetup& setup, int loops, double duration) {
  Vio vio(setup.options, setup.camera, setup.extrinsics);
  int64_t later = 0;
  for (int n = 0; n < loops; ++n) {
    Result result;
    const int64_t first = later;
    const int64_t last = feed_log(file, vio, result, duration, false, 0, later);
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

// How a session starts at many moments of a flight: time to the first state, and how far its height (that is, its
// scale) is from the truth, then and five seconds later.
void report_starts(const std::filesystem::path& file, const VioSetup& setup, int starts, double last) {
  std::vector<double> times, errors, later;
  int failed = 0;
  std::mt19937 generator(1);
  for (int n = 0; n < starts; ++n) {
    const double begin = std::uniform_real_distribution<double>(0, last)(generator);
    const Result result = run_log(file, setup, 20, false, begin);
    double time = -1, error = 0, after = 0;
    int64_t start = 0;
    for (const VioOutput& output : result.outputs) {
      if (output.status == Estimator::Status::kInitialising) continue;
      const auto height = result.height.lower_bound(output.utime);
      if (height == result.height.end()) break;
      const double off = output.height_above_ground / height->second - 1;
      if (start == 0) {
        start = output.utime;
        time = 1e-6 * static_cast<double>(start - result.outputs.front().utime);
        error = off;
      }
      after = off;
      if (output.utime > start + 5000000) break;
    }
    std::printf("start at %.1f s: took %.1f s, height off by %.1f %%, five seconds later %.1f %%, sessions %d%s\n",
                begin, time, 100 * error, 100 * after, result.outputs.back().session,
                time < 0 ? ("  " + result.outputs.back().reason).c_str() : "");
    if (time < 0) {
      ++failed;
      continue;
    }
    times.push_back(time);
    errors.push_back(std::abs(error));
    later.push_back(std::abs(after));
  }
  std::printf(
      "%d starts, %d failed; time median %.1f p90 %.1f s; scale error median %.1f %% p90 %.1f %%, later median %.1f %% "
      "p90 %.1f %%\n",
      starts, failed, median(times), quantile(times, 0.9), 100 * median(errors), 100 * quantile(errors, 0.9),
      100 * median(later), 100 * quantile(later, 0.9));
}

}  // namespace
}  // namespace orthonav::vio

int main(int argc, char** argv) {
  using namespace orthonav;
  CLI::App app{"Runs the odometry over recorded flights and prints its accuracy"};
  std::filesystem::path config, dump;
  std::vector<std::filesystem::path> inputs;
  bool asl = false, verbose = false;
  double duration = 1e9, starts_until = 90;
  int starts = 0;
  int loops = 0;
  app.add_option("--loops", loops, "instead, run each flight log so many times as one long flight");
  app.add_option("--starts", starts, "instead, start at this many random moments of a flight log");
  app.add_option("--starts-until", starts_until, "the last of these moments, s");
  app.add_option("--config", config, "configuration folder")->required();
  app.add_flag("--asl", asl, "the inputs are EuRoC/ASL folders");
  app.add_flag("-v,--verbose", verbose, "a line per keyframe");
  app.add_option("--duration", duration, "seconds of each input to run");
  app.add_option("--dump", dump, "estimate and truth of the last input, as text");
  app.add_option("inputs", inputs, "flight logs or ASL folders")->required();
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);
  try {
    const vio::VioSetup setup = vio::load_setup(config);
    for (const auto& input : inputs) {
      if (loops > 0) {
        vio::report_loops(input, setup, loops, duration);
        continue;
      }
      if (starts > 0) {
        vio::report_starts(input, setup, starts, starts_until);
        continue;
      }
      const vio::Result result =
          asl ? vio::run_asl(input, setup.options, duration, verbose) : vio::run_log(input, setup, duration, verbose);
      vio::report(input.filename().string(), result, dump);
    }
  } catch (const std::exception& error) {
    std::fprintf(stderr, "vio_bench: %s\n", error.what());
    return 1;
  }
  return 0;
}
