// Many short synthetic flights of the odometry alone, each with another motion, other biases and other noise: is what
// it says of its scale, vertical, velocity and biases true, and for how long after the start? Not a test: the benchmark
// that decides about the estimator.
//
//   vio_monte_carlo                              every case, 50 flights each
//   vio_monte_carlo --cases "survey cruise" --flights 20 --json out.json
//
// A row for each case and time since the start: how many flights got so far; the error of the scale (height above flat
// ground over the truth), median and 9 of 10; and normalised errors squared per dimension, means over the flights with
// the largest twentieth left out and, in brackets, of all: 1 where the covariance is honest.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <map>
#include <random>
#include <sstream>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

using Eigen::Vector3d;

constexpr double kGravity = 9.81;
constexpr double kFlight = 60;                      // s, after the start
constexpr double kTimes[] = {0, 2, 5, 10, 20, 40};  // s after the start, at which it is judged

// 0 before 0, 1 after 1, smooth to the second derivative, and its integral.
double step(double s) {
  const double c = std::clamp(s, 0.0, 1.0);
  return c * c * c * (10 - 15 * c + 6 * c * c);
}
double step_integral(double s) {
  const double c = std::clamp(s, 0.0, 1.0);
  return c * c * c * c * (2.5 - 3 * c + c * c) + std::max(0.0, s - 1);
}

// Roll and pitch follow the acceleration, as an aircraft's do.
Trajectory banked(std::function<Vector3d(double)> position, std::function<double(double)> yaw) {
  Trajectory trajectory;
  trajectory.position = position;
  trajectory.orientation = [position, yaw](double t) {
    constexpr double h = 1e-2;
    const Vector3d a = (position(t + h) - 2 * position(t) + position(t - h)) / (h * h);
    const double psi = yaw(t), forward = a.x() * std::cos(psi) + a.y() * std::sin(psi),
                 left = -a.x() * std::sin(psi) + a.y() * std::cos(psi);
    return Vector3d(-std::atan2(left, kGravity), std::atan2(forward, kGravity), psi);
  };
  return trajectory;
}

struct Random {
  std::mt19937 generator;
  double uniform(double a, double b) { return std::uniform_real_distribution<double>(a, b)(generator); }
  Vector3d normal(double sigma) {
    std::normal_distribution<double> each(0, sigma);
    return {each(generator), each(generator), each(generator)};
  }
};

// Flies on with small sways, as a multirotor over a survey.
Trajectory survey(double height, Random& random) {
  const double speed = height / 42, w1 = random.uniform(0.5, 1.1), w2 = random.uniform(0.3, 0.7),
               sway = random.uniform(0.4, 1.0), phase = random.uniform(0, 6.28), w3 = random.uniform(0.3, 0.6);
  return banked(
      [=](double t) {
        return Vector3d(speed * t + sway * std::cos(w1 * t + phase), 1.6 * sway * std::cos(w2 * t),
                        height + 0.6 * std::sin(w3 * t + phase));
      },
      [=](double t) { return phase + 0.1 * std::sin(0.2 * t); });
}

// A fast aircraft: strong banks for some seconds, then a long leg without any acceleration, braking at its end.
Trajectory cruise(double height, double speed, Random& random) {
  const double w = random.uniform(0.5, 0.8), acceleration = random.uniform(3, 5), until = random.uniform(6, 12),
               phase = random.uniform(0, 6.28), brake = until + random.uniform(25, 35);
  const double amplitude = acceleration / (w * w);
  return banked(
      [=](double t) {
        const double fade = 1 - step((t - until) / 6);
        return Vector3d(speed * t - 0.7 * speed * 5 * step_integral((t - brake) / 5),
                        amplitude * fade * std::sin(w * t + phase), height);
      },
      [=](double) { return 0.0; });
}

// Standstill, a climb, then a survey.
Trajectory take_off(double height, Random& random) {
  const double rest = random.uniform(3, 6), climb = random.uniform(2, 4), speed = random.uniform(2, 4);
  const double top = rest + height / climb;
  const Trajectory after = survey(height, random);
  return banked(
      [=](double t) {
        const double up = 0.3 + climb * (2 * step_integral((t - rest) / 2) - 2 * step_integral((t - top) / 2));
        const double s = step((t - rest - 2) / 4);
        return Vector3d(speed * 4 * step_integral((t - top) / 4) + 0.5 * s * std::sin(0.7 * (t - rest)),
                        0.8 * s * std::sin(0.5 * (t - rest)), up + 0.4 * s * std::sin(0.4 * t));
      },
      [=](double t) { return 0.1 * std::sin(0.2 * (t - rest)) * step((t - rest) / 4); });
}

struct Case {
  std::string name;
  std::function<Trajectory(Random&)> trajectory;
  double imu_times = 1, walk_times = 1;  // the sensor's noise over its class
  bool sheet_says_so = true;             // the estimator is told
  double accel_turn_on = 0.05;           // m/s^2 per axis, 1 sigma
  SimulatedCamera camera{};
  double longest_wait = 30;  // s, for a start
};

std::vector<Case> cases() {
  const auto survey_at = [](double height) { return [height](Random& random) { return survey(height, random); }; };
  const auto cruise_at = [](double speed) { return [speed](Random& random) { return cruise(110, speed, random); }; };
  std::vector<Case> all;
  all.push_back({.name = "survey", .trajectory = survey_at(110)});
  all.push_back({.name = "high", .trajectory = survey_at(285)});
  all.push_back({.name = "cruise15", .trajectory = cruise_at(15)});
  all.push_back({.name = "cruise25", .trajectory = cruise_at(25)});
  all.push_back({.name = "take_off", .trajectory = [](Random& random) { return take_off(60, random); }});
  all.push_back({.name = "consumer", .trajectory = survey_at(110), .imu_times = 10, .walk_times = 10});
  all.push_back({.name = "consumer_untold",
                 .trajectory = survey_at(110),
                 .imu_times = 10,
                 .walk_times = 10,
                 .sheet_says_so = false});
  all.push_back({.name = "bias", .trajectory = survey_at(110), .accel_turn_on = 0.2});
  all.push_back({.name = "jitter", .trajectory = cruise_at(15)});
  all.back().camera.time_jitter = 2e-4;
  all.push_back({.name = "focal", .trajectory = survey_at(110)});
  all.back().camera.focal = 0.97;
  all.push_back({.name = "stamps", .trajectory = survey_at(110)});
  all.back().camera.time_offset = -0.03;
  return all;
}

struct Judged {
  double scale = 0;  // error, relative
  double nees_scale = 0, nees_tilt = 0, nees_velocity = 0, nees_accel = 0, nees_gyro = 0;
};

struct Flight {
  double started = -1;
  int sessions = 0;
  std::map<double, Judged> at;  // by time since the start
};

double normalised(const Eigen::VectorXd& error, const Eigen::MatrixXd& covariance) {
  return error.dot(covariance.ldlt().solve(error)) / static_cast<double>(error.size());
}

Judged judge(const Estimator& estimator, const Trajectory& trajectory, const SimulatedFrame& frame) {
  Judged result;
  const StateValues& state = estimator.newest();
  result.scale = estimator.height_above_ground() / trajectory.position(frame.t).z() - 1;
  result.nees_scale = std::pow(std::log1p(result.scale) / estimator.scale_stddev(), 2);
  const Eigen::Quaterniond q = trajectory.attitude(frame.t);
  const Vector3d up = state.q() * (q.conjugate() * Vector3d::UnitZ());
  result.nees_tilt = normalised(Eigen::Vector2d(up.y(), -up.x()), estimator.pose_covariance().block<2, 2>(3, 3));
  const Eigen::AngleAxisd turn(yaw_of(q) - yaw_of(state.q()), Vector3d::UnitZ());
  const Vector3d error = turn * state.v() - trajectory.velocity(frame.t);
  const Eigen::Matrix3d R = turn.toRotationMatrix();
  result.nees_velocity = normalised(error, R * estimator.velocity_covariance() * R.transpose());
  result.nees_accel = normalised(state.ba() - frame.accel_bias, estimator.bias_covariance().topLeftCorner<3, 3>());
  result.nees_gyro = normalised(state.bg() - frame.gyro_bias, estimator.bias_covariance().bottomRightCorner<3, 3>());
  return result;
}

Flight fly(const Case& each, unsigned seed) {
  Random random{std::mt19937(seed)};
  const Trajectory trajectory = each.trajectory(random);
  SimulatedNoise noise{
      0.1, true, random.normal(0.01), random.normal(each.accel_turn_on), each.imu_times, each.walk_times};
  ImuNoise sheet;
  if (each.sheet_says_so) {
    sheet.gyro_noise *= each.imu_times;
    sheet.accel_noise *= each.imu_times;
    sheet.gyro_walk *= each.walk_times;
    sheet.accel_walk *= each.walk_times;
  }
  EstimatorOptions options;
  options.accel_bias_sigma = std::max(options.accel_bias_sigma, each.accel_turn_on);
  Estimator estimator(options, downward_camera(), sheet, test_camera().focal());
  Flight flight;
  size_t next = 0;
  int session = 0;
  const auto frames = simulate_frames(trajectory, each.longest_wait + kFlight, 0.0, noise, seed, each.camera);
  Feeder feeder(frames);
  while (const auto given = feeder.next(estimator)) {
    const Estimator::Status status = *given;
    const SimulatedFrame& frame = feeder.frame();
    if (status == Estimator::Status::kFailed) {
      ++session;
      if (flight.started >= 0 && next > 0) break;
      estimator.reset();
    }
    if (status != Estimator::Status::kTracking && status != Estimator::Status::kDegraded) continue;
    if (flight.started < 0) flight.started = frame.t;
    if (estimator.rescaled()) ++session;
    if (next < std::size(kTimes) && estimator.keyframe() && frame.t - flight.started >= kTimes[next]) {
      flight.at[kTimes[next++]] = judge(estimator, trajectory, frame);
    }
    if (next == std::size(kTimes)) break;
  }
  flight.sessions = session;
  return flight;
}

// Mean without the largest twentieth, and of all.
std::pair<double, double> means(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const size_t kept = values.size() - values.size() / 20;
  double sum = 0, of_kept = 0;
  for (size_t k = 0; k < values.size(); ++k) {
    sum += values[k];
    if (k < kept) of_kept += values[k];
  }
  return {of_kept / static_cast<double>(kept), sum / static_cast<double>(values.size())};
}

nlohmann::json run(const Case& each, int flights) {
  std::vector<Flight> flown;
  for (int seed = 1; seed <= flights; ++seed) flown.push_back(fly(each, static_cast<unsigned>(seed)));
  std::vector<double> starts;
  int sessions = 0;
  for (const Flight& flight : flown) {
    if (flight.started >= 0) starts.push_back(flight.started);
    sessions += flight.sessions;
  }
  std::printf("%s: %zu of %d started, after %.1f s in the median and %.1f s at most; %d sessions ended\n",
              each.name.c_str(), starts.size(), flights, median(starts), quantile(starts, 1), sessions);
  nlohmann::json report{{"case", each.name}, {"flights", flights}, {"started", starts.size()}};
  for (const double time : kTimes) {
    std::vector<double> scale, s, tilt, velocity, accel, gyro;
    for (const Flight& flight : flown) {
      const auto found = flight.at.find(time);
      if (found == flight.at.end()) continue;
      scale.push_back(std::abs(found->second.scale));
      s.push_back(found->second.nees_scale);
      tilt.push_back(found->second.nees_tilt);
      velocity.push_back(found->second.nees_velocity);
      accel.push_back(found->second.nees_accel);
      gyro.push_back(found->second.nees_gyro);
    }
    if (scale.empty()) continue;
    std::printf("  %3.0f s  %3zu flights  scale off by %5.2f / %5.2f %%  NEES: scale", time, scale.size(),
                100 * median(scale), 100 * quantile(scale, 0.9));
    nlohmann::json row{{"time", time}, {"flights", scale.size()}, {"scale_error", median(scale)}};
    const std::pair<const char*, const std::vector<double>*> all[] = {
        {"scale", &s}, {"tilt", &tilt}, {"velocity", &velocity}, {"accel_bias", &accel}, {"gyro_bias", &gyro}};
    for (const auto& [name, values] : all) {
      const auto [kept, mean] = means(*values);
      std::printf("%s %.1f (%.1f)", values == &s ? "" : (std::string("  ") + name).c_str(), kept, mean);
      row[std::string("nees_") + name] = mean;
    }
    std::printf("\n");
    report["at"].push_back(row);
  }
  std::fflush(stdout);
  return report;
}

}  // namespace
}  // namespace orthonav::vio

int main(int argc, char** argv) {
  using namespace orthonav::vio;
  CLI::App app{"Is what the odometry says of itself true? Many synthetic flights tell."};
  int flights = 50;
  std::string names, json;
  app.add_option("--flights", flights, "of each case");
  app.add_option("--cases", names, "names, separated by spaces; all when none are given");
  app.add_option("--json", json, "file for the figures");
  CLI11_PARSE(app, argc, argv);
  nlohmann::json report = nlohmann::json::array();
  for (const Case& each : cases()) {
    std::istringstream wanted(names);
    bool is_wanted = names.empty();
    for (std::string name; wanted >> name;) is_wanted = is_wanted || name == each.name;
    if (is_wanted) report.push_back(run(each, flights));
  }
  if (!json.empty()) std::ofstream(json) << report.dump(2) << '\n';
  return 0;
}
