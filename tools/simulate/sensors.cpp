#include "tools/simulate/sensors.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <stdexcept>

#include "common/config/config.h"
#include "common/math/angles.h"
#include "common/math/so3.h"
#include "tools/simulate/random_stream.h"

namespace orthonav::simulate {
namespace {

constexpr double kCepPerSigma = 1.17741;  // of a circular normal distribution: sqrt(2 ln 2)

// Stamps of a sensor: whole periods from the start, a fraction of a period late. Microseconds exactly.
std::vector<int64_t> stamps(double rate_hz, double phase, double seconds) {
  std::vector<int64_t> utimes;
  for (int64_t i = 0;; ++i) {
    const double t = (static_cast<double>(i) + phase) / rate_hz;
    if (t > seconds) return utimes;
    utimes.push_back(std::llround(t * 1e6));
  }
}

Eigen::Vector3d gaussian3(RandomStream& stream) {
  const double x = stream.gaussian(), y = stream.gaussian(), z = stream.gaussian();
  return {x, y, z};
}

// Tones within a band, the same power in each.
class Vibration {
 public:
  Vibration(uint64_t seed, const std::string& name, double rms, double low_hz, double high_hz)
      : amplitude_(rms * std::sqrt(2.0 / kTones)) {
    RandomStream stream(seed, name);
    for (auto& axis : tones_) {
      for (Tone& tone : axis) {
        tone.rate = 2 * std::numbers::pi * stream.uniform(low_hz, high_hz);
        tone.phase = stream.uniform(0, 2 * std::numbers::pi);
      }
    }
  }

  Eigen::Vector3d at(double t) const {
    Eigen::Vector3d value = Eigen::Vector3d::Zero();
    if (amplitude_ == 0) return value;
    for (int axis = 0; axis < 3; ++axis) {
      for (const Tone& tone : tones_[axis]) value[axis] += amplitude_ * std::sin(tone.rate * t + tone.phase);
    }
    return value;
  }

 private:
  static constexpr int kTones = 16;  // an axis
  struct Tone {
    double rate = 0, phase = 0;  // rad/s, rad
  };
  double amplitude_;
  std::array<std::array<Tone, kTones>, 3> tones_;
};

// Error of a three-axis sensor's gains: scale factors on the diagonal, axes that lean to the others beside it.
Eigen::Matrix3d gain_error(uint64_t seed, const std::string& name, double scale, double misalignment) {
  RandomStream scales(seed, name + ".scale"), leans(seed, name + ".misalignment");
  Eigen::Matrix3d error;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) {
      error(row, column) = row == column ? scale * scales.gaussian() : misalignment * leans.gaussian();
    }
  }
  return error;
}

// A three-axis MEMS sensor: measurement = truth and what falsifies it + bias + white noise, the bias a random walk from
// its turn-on value.
class InertialChannel {
 public:
  InertialChannel(uint64_t seed, const std::string& name, double rate_hz, double noise, double walk, double turn_on)
      : white_(seed, name + ".white"),
        walk_(seed, name + ".walk"),
        white_stddev_(noise * std::sqrt(rate_hz)),
        walk_stddev_(walk / std::sqrt(rate_hz)) {
    RandomStream start(seed, name + ".turn_on");
    bias_ = turn_on * gaussian3(start);
  }

  const Eigen::Vector3d& bias() const { return bias_; }
  Eigen::Vector3d measure(const Eigen::Vector3d& felt) {
    Eigen::Vector3d value = felt + bias_ + white_stddev_ * gaussian3(white_);
    bias_ += walk_stddev_ * gaussian3(walk_);
    return value;
  }

 private:
  RandomStream white_, walk_;
  double white_stddev_, walk_stddev_;
  Eigen::Vector3d bias_;
};

struct Biases {
  int64_t utime;
  Eigen::Vector3d gyro, accel;
};

std::vector<Biases> simulate_imu(const Trajectory& trajectory, double seconds, double rate_hz,
                                 const SensorOptions::Imu& o, int64_t start_utime, uint64_t seed,
                                 std::vector<imu_t>& out) {
  InertialChannel gyro(seed, "imu.gyro", rate_hz, o.gyro_noise, o.gyro_walk, o.gyro_turn_on);
  InertialChannel accel(seed, "imu.accel", rate_hz, o.accel_noise, o.accel_walk, o.accel_turn_on);
  const Eigen::Matrix3d gyro_gains = gain_error(seed, "imu.gyro", o.gyro_scale, o.gyro_misalignment_deg * kDegree);
  const Eigen::Matrix3d accel_gains = gain_error(seed, "imu.accel", o.accel_scale, o.accel_misalignment_deg * kDegree);
  const Eigen::Matrix3d g_sensitivity =
      gain_error(seed, "imu.g_sensitivity", o.gyro_g_sensitivity, o.gyro_g_sensitivity);
  const Vibration gyro_shake(seed, "imu.gyro.vibration", o.gyro_vibration, o.vibration_low_hz, o.vibration_high_hz);
  const Vibration accel_shake(seed, "imu.accel.vibration", o.accel_vibration, o.vibration_low_hz, o.vibration_high_hz);
  std::vector<Biases> biases;
  for (const int64_t utime : stamps(rate_hz, 0.0, seconds)) {
    const double t = static_cast<double>(utime) * 1e-6;
    const MotionState state = trajectory.at(t);
    const Eigen::Vector3d force = state.specific_force + accel_shake.at(t);
    const Eigen::Vector3d rate = state.angular_rate + gyro_shake.at(t);
    biases.push_back({start_utime + utime, gyro.bias(), accel.bias()});
    imu_t message;
    message.utime = start_utime + utime;
    Eigen::Map<Eigen::Vector3d>(message.angular_rate) = gyro.measure(rate + gyro_gains * rate + g_sensitivity * force);
    Eigen::Map<Eigen::Vector3d>(message.specific_force) = accel.measure(force + accel_gains * force);
    message.temperature_deg_c = std::numeric_limits<float>::quiet_NaN();
    out.push_back(message);
  }
  return biases;
}

std::vector<FrameTime> simulate_frame_times(double seconds, const SensorOptions::Camera& o, int64_t start_utime,
                                            uint64_t seed) {
  RandomStream jitter(seed, "camera.time"), lost(seed, "camera.lost");
  std::vector<FrameTime> frames;
  size_t index = 0;
  // Half a period late, so that neither end of an exposure lies outside the flight.
  for (const int64_t utime : stamps(o.rate_hz, 0.5, seconds - 0.5 / o.rate_hz)) {
    FrameTime frame;
    frame.t = static_cast<double>(utime) * 1e-6;
    frame.index = index++;
    const double late_ms =
        o.time_offset_ms + o.time_drift_ms_min * frame.t / 60.0 + o.time_jitter_ms * jitter.gaussian();
    frame.utime = start_utime + utime + std::llround(1e3 * late_ms);
    if (lost.uniform(0, 1) < o.dropped) continue;
    if (!frames.empty() && frame.utime <= frames.back().utime) {
      throw std::invalid_argument("sensors.camera: time_jitter_ms or time_drift_ms_min puts frames out of order");
    }
    frames.push_back(frame);
  }
  return frames;
}

double body_heading(const MotionState& state, const SensorSurroundings& around) {
  const Eigen::Quaterniond q_ENU_B(around.frame.R_local_G(state.p_G_B) * state.R_G_B);
  return heading_of(q_ENU_B);
}

void simulate_compass(const Trajectory& trajectory, double seconds, const SensorOptions::Compass& o, double bias,
                      const SensorSurroundings& around, uint64_t seed, std::vector<compass_t>& out) {
  if (!o.enabled) return;
  RandomStream noise(seed, "compass.noise");
  for (const int64_t utime : stamps(o.rate_hz, 0.25, seconds)) {
    const MotionState state = trajectory.at(static_cast<double>(utime) * 1e-6);
    const double magnetic = body_heading(state, around) - around.magnetic_declination;
    compass_t message;
    message.utime = around.start_utime + utime;
    message.heading = true_heading(magnetic + bias + o.noise_deg * kDegree * noise.gaussian(), 0.0);
    message.heading_stddev = std::hypot(o.bias_deg, o.noise_deg) * kDegree;
    out.push_back(message);
  }
}

void simulate_altitude(const Trajectory& trajectory, double seconds, const SensorOptions::Altitude& o,
                       const SensorSurroundings& around, uint64_t seed, std::vector<altitude_t>& out) {
  if (!o.enabled) return;
  RandomStream bias_stream(seed, "altitude.bias"), noise(seed, "altitude.noise");
  const double bias = o.bias_m * bias_stream.gaussian();
  for (const int64_t utime : stamps(o.rate_hz, 0.75, seconds)) {
    const MotionState state = trajectory.at(static_cast<double>(utime) * 1e-6);
    altitude_t message;
    message.utime = around.start_utime + utime;
    message.height_above_ground =
        state.p_G_B.z() - around.surface(state.p_G_B.head<2>()) + bias + o.noise_m * noise.gaussian();
    message.stddev = std::hypot(o.bias_m, o.noise_m);
    out.push_back(message);
  }
}

void simulate_gnss(const Trajectory& trajectory, double seconds, const SensorOptions::Gnss& o,
                   const SensorSurroundings& around, uint64_t seed, std::vector<gnss_reference_t>& out) {
  const std::vector<int64_t> utimes = stamps(o.rate_hz, 0.0, seconds);
  const double horizontal = o.cep_m / kCepPerSigma;
  const Eigen::Vector3d stddev(horizontal, horizontal, o.vertical_ratio * horizontal);
  const char* const names[3] = {"gnss.east", "gnss.north", "gnss.up"};
  std::vector<double> slow[3];
  for (int axis = 0; axis < 3; ++axis) {
    RandomStream stream(seed, names[axis]);
    slow[axis] =
        correlated_noise(stream, utimes.size(), 1.0 / o.rate_hz,
                         stddev[axis] * std::sqrt(1 - o.white_fraction * o.white_fraction), o.correlation_time_s);
  }
  RandomStream white(seed, "gnss.white");
  for (size_t i = 0; i < utimes.size(); ++i) {
    const MotionState state = trajectory.at(static_cast<double>(utimes[i]) * 1e-6);
    const Eigen::Vector3d error =
        Eigen::Vector3d(slow[0][i], slow[1][i], slow[2][i]) + o.white_fraction * stddev.cwiseProduct(gaussian3(white));
    const Geodetic position = around.frame.to_geodetic(state.p_G_B + error);
    gnss_reference_t message;
    message.utime = around.start_utime + utimes[i];
    message.latitude_deg = position.latitude_deg;
    message.longitude_deg = position.longitude_deg;
    message.ellipsoidal_height = position.height;
    message.horizontal_stddev = horizontal;
    message.vertical_stddev = stddev.z();
    out.push_back(message);
  }
}

truth_t truth_at(const Trajectory& trajectory, int64_t utime, const Biases& biases, double compass_bias,
                 const SensorSurroundings& around) {
  const MotionState state = trajectory.at(static_cast<double>(utime - around.start_utime) * 1e-6);
  const Eigen::Vector2d p_en = state.p_G_B.head<2>();
  const Eigen::Matrix3d R_local_G = around.frame.R_local_G(state.p_G_B);
  const Geodetic position = around.frame.to_geodetic(state.p_G_B);
  const Eigen::Quaterniond q(R_local_G * state.R_G_B);
  truth_t truth;
  truth.utime = utime;
  truth.latitude_deg = position.latitude_deg;
  truth.longitude_deg = position.longitude_deg;
  truth.ellipsoidal_height = position.height;
  Eigen::Map<Eigen::Vector4d>(truth.q_ENU_B) << q.w(), q.x(), q.y(), q.z();
  Eigen::Map<Eigen::Vector3d>(truth.velocity_enu) = R_local_G * state.v_G_B;
  Eigen::Map<Eigen::Vector3d>(truth.gyro_bias) = biases.gyro;
  Eigen::Map<Eigen::Vector3d>(truth.accel_bias) = biases.accel;
  truth.height_above_ground = state.p_G_B.z() - around.surface(p_en);
  truth.compass_bias = compass_bias;
  truth.magnetic_declination = around.magnetic_declination;
  Eigen::Map<Eigen::Vector2d>(truth.map_offset_en) = around.map_offset(p_en);
  return truth;
}

}  // namespace

SensorOptions SensorOptions::from_config(ConfigNode& node) {
  SensorOptions o;
  ConfigNode imu = node.child_or_empty("imu");
  imu.read("gyro_noise", o.imu.gyro_noise, 0.0, 1.0);
  imu.read("gyro_walk", o.imu.gyro_walk, 0.0, 1.0);
  imu.read("gyro_turn_on", o.imu.gyro_turn_on, 0.0, 1.0);
  imu.read("accel_noise", o.imu.accel_noise, 0.0, 10.0);
  imu.read("accel_walk", o.imu.accel_walk, 0.0, 10.0);
  imu.read("accel_turn_on", o.imu.accel_turn_on, 0.0, 10.0);
  imu.read("gyro_scale", o.imu.gyro_scale, 0.0, 0.5);
  imu.read("accel_scale", o.imu.accel_scale, 0.0, 0.5);
  imu.read("gyro_misalignment_deg", o.imu.gyro_misalignment_deg, 0.0, 20.0);
  imu.read("accel_misalignment_deg", o.imu.accel_misalignment_deg, 0.0, 20.0);
  imu.read("gyro_g_sensitivity", o.imu.gyro_g_sensitivity, 0.0, 1.0);
  imu.read("gyro_vibration", o.imu.gyro_vibration, 0.0, 10.0);
  imu.read("accel_vibration", o.imu.accel_vibration, 0.0, 100.0);
  imu.read("vibration_low_hz", o.imu.vibration_low_hz, 0.1, 1000.0);
  imu.read("vibration_high_hz", o.imu.vibration_high_hz, o.imu.vibration_low_hz, 1000.0);
  imu.finish();
  ConfigNode camera = node.child_or_empty("camera");
  camera.read("rate_hz", o.camera.rate_hz, 0.1, 200.0);
  camera.read("time_offset_ms", o.camera.time_offset_ms, -1000.0, 1000.0);
  camera.read("time_jitter_ms", o.camera.time_jitter_ms, 0.0, 100.0);
  camera.read("time_drift_ms_min", o.camera.time_drift_ms_min, -100.0, 100.0);
  camera.read("dropped", o.camera.dropped, 0.0, 1.0);
  camera.finish();
  ConfigNode compass = node.child_or_empty("compass");
  compass.read("enabled", o.compass.enabled);
  compass.read("rate_hz", o.compass.rate_hz, 0.1, 1000.0);
  compass.read("bias_deg", o.compass.bias_deg, 0.0, 90.0);
  compass.read("offset_deg", o.compass.offset_deg, -180.0, 180.0);
  compass.read("noise_deg", o.compass.noise_deg, 0.0, 90.0);
  compass.finish();
  ConfigNode altitude = node.child_or_empty("altitude");
  altitude.read("enabled", o.altitude.enabled);
  altitude.read("rate_hz", o.altitude.rate_hz, 0.1, 1000.0);
  altitude.read("bias_m", o.altitude.bias_m, 0.0, 1000.0);
  altitude.read("noise_m", o.altitude.noise_m, 0.0, 1000.0);
  altitude.finish();
  ConfigNode gnss = node.child_or_empty("gnss");
  gnss.read("rate_hz", o.gnss.rate_hz, 0.1, 100.0);
  gnss.read("cep_m", o.gnss.cep_m, 0.0, 1000.0);
  gnss.read("correlation_time_s", o.gnss.correlation_time_s, 0.01, 1e5);
  gnss.read("white_fraction", o.gnss.white_fraction, 0.0, 1.0);
  gnss.read("vertical_ratio", o.gnss.vertical_ratio, 0.0, 10.0);
  gnss.finish();
  node.read("truth_rate_hz", o.truth_rate_hz, 0.1, 1000.0);
  node.finish();
  return o;
}

SensorRecord simulate_sensors(const Trajectory& trajectory, double seconds, double imu_rate_hz,
                              const SensorOptions& options, const SensorSurroundings& around, uint64_t seed) {
  SensorRecord record;
  const std::vector<Biases> biases =
      simulate_imu(trajectory, seconds, imu_rate_hz, options.imu, around.start_utime, seed, record.imu);
  record.frames = simulate_frame_times(seconds, options.camera, around.start_utime, seed);

  RandomStream compass_stream(seed, "compass.bias");
  const double compass_bias =
      options.compass.bias_deg * kDegree * compass_stream.gaussian() + options.compass.offset_deg * kDegree;
  simulate_compass(trajectory, seconds, options.compass, compass_bias, around, seed, record.compass);
  simulate_altitude(trajectory, seconds, options.altitude, around, seed, record.altitude);
  simulate_gnss(trajectory, seconds, options.gnss, around, seed, record.gnss);

  std::vector<int64_t> truth_times = stamps(options.truth_rate_hz, 0.0, seconds);
  for (int64_t& utime : truth_times) utime += around.start_utime;
  for (const FrameTime& frame : record.frames) truth_times.push_back(frame.utime);
  std::sort(truth_times.begin(), truth_times.end());
  truth_times.erase(std::unique(truth_times.begin(), truth_times.end()), truth_times.end());
  for (const int64_t utime : truth_times) {
    const auto next = std::upper_bound(biases.begin(), biases.end(), utime,
                                       [](int64_t time, const Biases& b) { return time < b.utime; });
    const Biases& newest = next == biases.begin() ? biases.front() : *(next - 1);
    record.truth.push_back(truth_at(trajectory, utime, newest, compass_bias, around));
  }
  return record;
}

}  // namespace orthonav::simulate
