#include "tests/fusion/synthetic_flight.h"

#include <cmath>
#include <numbers>
#include <random>

#include "common/geo/enu_frame.h"
#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

constexpr int64_t kStart = 1'700'000'000'000'000;
constexpr double kStep = 0.1;
constexpr double kGravity = 9.81;

class Dice {
 public:
  explicit Dice(uint64_t seed) : engine_(seed) {}
  // Written out, because the standard's distributions differ between libraries.
  double uniform() { return static_cast<double>(engine_() >> 11) * 0x1.0p-53; }
  double normal(double stddev) {
    return stddev * std::sqrt(-2.0 * std::log(1.0 - uniform())) * std::cos(2.0 * std::numbers::pi * uniform());
  }
  Eigen::Vector3d normal3(double horizontal, double vertical) {
    const double east = normal(horizontal);
    const double north = normal(horizontal);
    return Eigen::Vector3d(east, north, normal(vertical));
  }

 private:
  std::mt19937_64 engine_;
};

// A meander of legs with smooth turns, with gentle changes of height, and the tilt of a multirotor.
struct Path {
  double speed, leg;
  double course(double t) const { return 0.4 + 1.2 * std::sin(2.0 * std::numbers::pi * speed * t / leg); }
  Eigen::Vector3d velocity(double t) const {
    return Eigen::Vector3d(speed * std::cos(course(t)), speed * std::sin(course(t)), 0.5 * std::sin(0.05 * t));
  }
  Eigen::Quaterniond attitude(double t) const {
    return Eigen::AngleAxisd(course(t), Eigen::Vector3d::UnitZ()) *
           Eigen::AngleAxisd(0.1 * std::sin(0.7 * t), Eigen::Vector3d::UnitY()) *
           Eigen::AngleAxisd(0.08 * std::sin(0.9 * t + 1.0), Eigen::Vector3d::UnitX());
  }
  // What an inertial sensor without errors measures.
  ImuSample inertial(double t) const {
    constexpr double h = 1e-3;
    const Eigen::Vector3d acceleration = (velocity(t + h) - velocity(t - h)) / (2.0 * h);
    ImuSample sample;
    sample.angular_rate = so3_log(attitude(t - h).conjugate() * attitude(t + h)) / (2.0 * h);
    sample.specific_force = attitude(t).conjugate() * (acceleration + Eigen::Vector3d(0, 0, kGravity));
    return sample;
  }
};

}  // namespace

SyntheticFlight make_flight(const SyntheticOptions& options, uint64_t seed) {
  SyntheticFlight flight;
  Dice dice(seed);
  Dice noise(seed + 1'000'000);  // of the compass and the inertial sensor: a stream of their own
  const EnuFrame frame(flight.anchor);
  const Path path{options.speed, 260.0};

  const double yaw_W_G = 2.0 * std::numbers::pi * dice.uniform();
  double heading_error = 0.0;
  double log_scale = dice.normal(options.scale_stddev);  // odometry = truth * exp(-log_scale)
  const double heading_bias = dice.normal(options.heading_bias_stddev);
  Eigen::Vector3d walking_W = noise.normal3(options.lean_stddev, 0.0);
  const Eigen::Vector3d gyro_bias = noise.normal3(0.01, 0.01);
  const Eigen::Vector3d accel_bias = noise.normal3(0.05, 0.05);
  const Eigen::Vector3d accel_bias_error = noise.normal3(0.02, 0.02);
  Eigen::Vector3d p_G_B(150.0, -300.0, options.height);
  Eigen::Vector3d p_W_B = dice.normal3(5.0, 5.0);
  Eigen::Vector3d shared = dice.normal3(options.fix_shared_stddev, options.fix_shared_vertical_stddev);
  int run_left = options.wrong_at_start;
  auto far = [&] {
    const double angle = 2.0 * std::numbers::pi * dice.uniform();
    const double distance = options.wrong_distance * (0.3 + 1.4 * dice.uniform());
    return Eigen::Vector3d(distance * std::cos(angle), distance * std::sin(angle), dice.normal(5.0));
  };
  Eigen::Vector3d run_offset = far();
  struct Waiting {
    size_t fix, due;
  };
  std::vector<Waiting> waiting;

  const auto count = static_cast<size_t>(options.duration / kStep);
  const auto keyframe_every = static_cast<size_t>(std::lround(options.keyframe_interval / kStep));
  for (size_t k = 0; k < count; ++k) {
    const double t = kStep * static_cast<double>(k);
    const Eigen::Vector3d velocity = path.velocity(t);
    const Eigen::Quaterniond q_G_B = path.attitude(t);
    const Eigen::Vector3d constant(options.lean.x(), options.lean.y(), 0.0);
    const bool learnt = t >= options.lean_learnt_at;
    const Eigen::AngleAxisd yaw(yaw_W_G + heading_error, Eigen::Vector3d::UnitZ());
    const Eigen::AngleAxisd heading(yaw_of(q_G_B), Eigen::Vector3d::UnitZ());
    // Of gravity, R_G_B = Exp(tilt) R_odometry; and what of it the odometry has levelled its attitude by.
    const Eigen::Vector3d of_bias = heading * constant;
    const Eigen::Vector3d tilt =
        (learnt ? Eigen::Vector3d(Eigen::Vector3d::Zero()) : of_bias) + yaw.inverse() * walking_W;
    const Eigen::Vector3d levelled_W =
        learnt ? Eigen::Vector3d(Eigen::Vector3d::Zero()) : Eigen::Vector3d(-(yaw * of_bias));
    const Eigen::Quaterniond q_W_G = yaw * so3_exp(-tilt);
    // An odometry that leans has taken so much of gravity for the accelerometer's bias, m/s^2 in B.
    const auto of_gravity = [&](const Eigen::Vector3d& by) -> Eigen::Vector3d {
      const Eigen::Vector3d up(0, 0, kGravity);
      return q_G_B.conjugate() * up - (so3_exp(-by) * q_G_B).conjugate() * up;
    };
    const Eigen::Vector3d true_bias = accel_bias - of_gravity(of_bias + yaw.inverse() * walking_W);
    if (k > 0) {
      const Eigen::Vector3d moved = 0.5 * kStep * (velocity + path.velocity(t - kStep));
      p_G_B += moved;
      p_W_B += std::exp(-log_scale) * (q_W_G * moved);
    }
    const bool is_keyframe = k % keyframe_every == 0;
    if (is_keyframe) p_W_B += dice.normal3(options.position_noise, options.position_noise);
    const auto utime = kStart + static_cast<int64_t>(k) * 100'000;

    // What the sensors measured up to the image comes before the odometry's state of it.
    if (options.imu && k > 0) {
      for (int i = 19; i >= 0; --i) {
        ImuSample sample = path.inertial(t - 0.005 * i);
        sample.utime = utime - 5000 * i;
        sample.angular_rate += gyro_bias + noise.normal3(0.0024, 0.0024);
        sample.specific_force += true_bias + noise.normal3(0.028, 0.028);
        flight.steps.push_back({SyntheticFlight::Step::Kind::kImu, flight.imu.size()});
        flight.imu.push_back(sample);
      }
    }
    CompassReading reading;
    reading.utime = utime;
    reading.heading = heading_of(q_G_B) + heading_bias + noise.normal(options.compass_noise);
    reading.heading_stddev = options.heading_bias_stddev;
    flight.steps.push_back({SyntheticFlight::Step::Kind::kCompass, flight.compass.size()});
    flight.compass.push_back(reading);

    OdometryState state;
    state.utime = utime;
    state.session = 1;
    state.has_pose = true;
    state.p_W_B = p_W_B;
    state.q_W_B = q_W_G * q_G_B;
    state.v_W_B = std::exp(-log_scale) * (q_W_G * velocity);
    state.gyro_bias = gyro_bias;
    state.accel_bias = accel_bias + accel_bias_error;
    if (learnt) state.accel_bias -= of_gravity(of_bias);
    state.levelled = levelled_W.head<2>();
    state.lean_stddev = options.lean_word;
    flight.states.push_back(state);
    flight.truth.push_back(p_G_B);
    flight.truth_q.push_back(q_G_B);
    flight.steps.push_back({SyntheticFlight::Step::Kind::kState, k});

    if (is_keyframe) {
      Keyframe keyframe;
      keyframe.utime = utime;
      keyframe.session = 1;
      keyframe.id = static_cast<int>(flight.keyframes.size());
      keyframe.p_W_B = state.p_W_B;
      keyframe.q_W_B = state.q_W_B;
      keyframe.levelled = state.levelled;
      keyframe.height_above_ground = std::exp(-log_scale) * p_G_B.z();
      const size_t index = flight.keyframes.size();
      flight.steps.push_back({SyntheticFlight::Step::Kind::kKeyframe, index});
      flight.keyframes.push_back(keyframe);

      const double way = options.speed * options.keyframe_interval;
      const Eigen::Vector3d renewed = dice.normal3(options.fix_shared_stddev, options.fix_shared_vertical_stddev);
      for (int axis = 0; axis < 3; ++axis) {
        const double keep =
            std::exp(-way / (axis < 2 ? options.fix_shared_distance : options.fix_shared_vertical_distance));
        shared(axis) = keep * shared(axis) + std::sqrt(1.0 - keep * keep) * renewed(axis);
      }
      if (dice.uniform() < options.fix_rate) {
        if (run_left == 0 && dice.uniform() < options.wrong_run_rate) {
          run_left = 1 + static_cast<int>(-options.wrong_run_length * std::log(1.0 - dice.uniform()));
          run_offset = far();
        }
        const bool in_run = run_left > 0;
        if (in_run) --run_left;
        const bool single = !in_run && dice.uniform() < options.single_wrong_rate;
        const Eigen::Vector3d offset =
            in_run ? run_offset : (single ? far() : Eigen::Vector3d(Eigen::Vector3d::Zero()));
        Fix fix;
        fix.utime = utime;
        fix.session = 1;
        fix.keyframe_id = keyframe.id;
        // The ground below is where the map has it; who leans takes it to be in another direction, and himself with it.
        const Eigen::Vector3d to_ground(0.0, 0.0, -p_G_B.z());
        const Eigen::Vector3d leans = to_ground - so3_exp(-tilt) * to_ground;
        fix.position = frame.to_geodetic(p_G_B + leans + offset + shared +
                                         dice.normal3(options.fix_stddev, options.fix_vertical_stddev));
        fix.anchor = flight.anchor;
        fix.covariance = Eigen::Vector3d(options.fix_stddev, options.fix_stddev, options.fix_vertical_stddev)
                             .cwiseAbs2()
                             .asDiagonal();
        if (std::isfinite(options.perspective_stddev)) {
          const double variance = options.perspective_stddev * options.perspective_stddev;
          const Eigen::Vector3d error = noise.normal3(options.perspective_stddev, 0.0);
          fix.upright = Upright{Eigen::Vector3d::Zero(), fix.covariance, -skew(to_ground).leftCols<2>(),
                                (tilt + error).head<2>(), variance * Eigen::Matrix2d::Identity()};
        }
        fix.heading = heading_of(q_G_B) + heading_bias + dice.normal(0.01);
        fix.heading_stddev = 0.06;
        waiting.push_back({flight.fixes.size(), index + static_cast<size_t>(options.fix_delay)});
        flight.fixes.push_back(fix);
        flight.wrong.push_back(in_run || single);
      }
      while (!waiting.empty() && waiting.front().due <= index) {
        flight.steps.push_back({SyntheticFlight::Step::Kind::kFix, waiting.front().fix});
        waiting.erase(waiting.begin());
      }
    }
    // The scale wanders about one.
    walking_W += noise.normal3(options.lean_walk * std::sqrt(kStep), 0.0);
    heading_error += dice.normal(options.heading_walk * std::sqrt(kStep));
    const double keep_scale = std::exp(-kStep / options.scale_time);
    log_scale = keep_scale * log_scale + dice.normal(options.scale_walk * std::sqrt(kStep)) +
                noise.normal(options.scale_stddev * std::sqrt(1.0 - keep_scale * keep_scale));
  }
  return flight;
}

}  // namespace orthonav::fusion
