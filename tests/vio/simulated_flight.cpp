#include "tests/vio/simulated_flight.h"

#include <algorithm>
#include <cmath>
#include <map>

#include <opencv2/imgproc.hpp>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

constexpr double kImuStep = 0.005, kFrameStep = 0.1;

int64_t to_utime(double t) {
  return 1'000'000'000 + static_cast<int64_t>(std::llround(1e6 * t));
}

}  // namespace

Extrinsics downward_camera() {
  Extrinsics extrinsics;
  extrinsics.p_B_C = {0.08, 0.01, -0.05};
  extrinsics.R_B_C << 0, -1, 0, -1, 0, 0, 0, 0, -1;
  return extrinsics;
}

CameraModel test_camera() {
  CameraParameters parameters;
  parameters.width = 640;
  parameters.height = 480;
  parameters.fx = parameters.fy = 850;
  parameters.cx = 319.5;
  parameters.cy = 239.5;
  return CameraModel(parameters);
}

Eigen::Quaterniond Trajectory::attitude(double t) const {
  const Eigen::Vector3d a = orientation(t);
  return Eigen::AngleAxisd(a.z(), Eigen::Vector3d::UnitZ()) * Eigen::AngleAxisd(a.y(), Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(a.x(), Eigen::Vector3d::UnitX());
}

Eigen::Vector3d Trajectory::velocity(double t) const {
  constexpr double h = 1e-4;
  return (position(t + h) - position(t - h)) / (2 * h);
}

ImuSample Trajectory::imu(double t, double gravity) const {
  constexpr double h = 1e-3;
  ImuSample sample;
  sample.utime = to_utime(t);
  sample.gyro = so3_log(attitude(t - h).conjugate() * attitude(t + h)) / (2 * h);
  const Eigen::Vector3d acceleration = (position(t + h) - 2 * position(t) + position(t - h)) / (h * h);
  sample.accel = attitude(t).conjugate() * (acceleration + Eigen::Vector3d(0, 0, gravity));
  return sample;
}

Trajectory survey_flight(double height, double speed, double rest) {
  // Motion fades in over a second so that acceleration is continuous.
  const auto moving_time = [rest](double t) {
    const double s = t - rest;
    if (rest <= 0) return t;
    if (s <= 0) return 0.0;
    return s < 2 ? s * s * s * (4 - s) / 16 : s - 1;  // smooth to the second derivative at 0 and 2
  };
  Trajectory trajectory;
  trajectory.position = [=](double t) {
    const double m = moving_time(t);
    return Eigen::Vector3d(speed * m + 0.8 * (1 - std::cos(0.9 * m)), 1.5 * (1 - std::cos(0.5 * m)),
                           height + 0.6 * std::sin(0.7 * m) * std::sin(0.35 * m));
  };
  trajectory.orientation = [=](double t) {
    const double m = moving_time(t);
    return Eigen::Vector3d(0.06 * std::sin(0.5 * m), 0.05 * std::sin(0.9 * m), 0.1 * std::sin(0.2 * m));
  };
  return trajectory;
}

std::vector<ImuSample> ideal_imu(const Trajectory& trajectory, double from, double to) {
  constexpr double kGravity = 9.81;
  std::vector<ImuSample> samples{trajectory.imu(from, kGravity)};
  for (double t = kImuStep * (std::floor(from / kImuStep + 1e-6) + 1); t < to - 1e-6; t += kImuStep) {
    samples.push_back(trajectory.imu(t, kGravity));
  }
  samples.push_back(trajectory.imu(to, kGravity));
  return samples;
}

Trajectory with_pause(const Trajectory& flight, double from, double to, double sway) {
  // Time slows down to a stop over two seconds and comes back the same way, smoothly to the second derivative.
  const auto ramp = [](double s) {  // the integral of 1 - smoothstep over [0, 1] at s
    const double c = std::clamp(s, 0.0, 1.0);
    return c - (c * c * c - 0.5 * c * c * c * c);
  };
  const auto clock = [=](double t) {
    constexpr double kSlow = 2.0;
    if (t < from) return t;
    const double stopped = from + kSlow * ramp((t - from) / kSlow);
    if (t < to) return stopped;
    return from + kSlow * 0.5 + kSlow * (0.5 - ramp(1 - std::min(1.0, (t - to) / kSlow))) +
           std::max(0.0, t - to - kSlow);
  };
  // The sway fades in and out with the pause.
  const auto fade = [=](double t) {
    const double in = std::clamp((t - from) / 3.0, 0.0, 1.0), out = std::clamp((to - t) / 3.0, 0.0, 1.0);
    const double c = std::min(in, out);
    return c * c * c * (10 - 15 * c + 6 * c * c);
  };
  Trajectory paused;
  paused.position = [=](double t) {
    const double a = sway * fade(t);
    return Eigen::Vector3d(flight.position(clock(t)) +
                           a * Eigen::Vector3d(std::sin(1.1 * t), std::cos(0.8 * t + 1), 0.5 * std::sin(0.6 * t)));
  };
  paused.orientation = [=](double t) {
    const double a = (sway > 0 ? 0.035 : 0.0) * fade(t);
    return Eigen::Vector3d(flight.orientation(clock(t)) +
                           a * Eigen::Vector3d(std::sin(1.3 * t), std::cos(0.9 * t), 0.5 * std::sin(0.4 * t)));
  };
  return paused;
}

std::vector<SimulatedFrame> simulate_frames(const Trajectory& trajectory, double duration, double relief,
                                            const SimulatedNoise& noise, unsigned seed,
                                            const SimulatedCamera& simulated) {
  constexpr double kGravity = 9.81;
  constexpr int kMostFeatures = 120;
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> uniform;
  const auto draw = [&] { return Eigen::Vector3d(normal(generator), normal(generator), normal(generator)); };
  const CameraModel camera = test_camera();
  const Extrinsics& extrinsics = simulated.extrinsics;
  const ImuNoise class_noise;
  const double root = std::sqrt(kImuStep);
  Eigen::Vector3d bg = noise.gyro_bias, ba = noise.accel_bias;

  std::map<int64_t, Eigen::Vector3d> points;
  int64_t next_id = 0;
  std::vector<SimulatedFrame> frames;
  ImuSample last;
  for (int k = 0; k * kFrameStep <= duration; ++k) {
    SimulatedFrame frame;
    frame.t = k * kFrameStep;
    frame.utime = to_utime(frame.t);
    if (k > 0) {
      frame.imu.push_back(last);
      for (int n = 1; n <= 20; ++n) {
        ImuSample sample = trajectory.imu((k - 1) * kFrameStep + n * kImuStep, kGravity);
        sample.gyro += bg;
        sample.accel += ba;
        if (noise.imu) {
          sample.gyro += noise.imu_times * class_noise.gyro_noise / root * draw();
          sample.accel += noise.imu_times * class_noise.accel_noise / root * draw();
          bg += noise.walk_times * class_noise.gyro_walk * root * draw();
          ba += noise.walk_times * class_noise.accel_walk * root * draw();
        }
        frame.imu.push_back(sample);
      }
      last = frame.imu.back();
    } else {
      last = trajectory.imu(0, kGravity);
      last.gyro += bg;
      last.accel += ba;
    }
    double shown = frame.t + simulated.time_offset;
    if (simulated.time_jitter > 0) shown += simulated.time_jitter * normal(generator);
    const Eigen::Vector3d p = trajectory.position(shown);
    const Eigen::Quaterniond q = trajectory.attitude(shown);
    const auto see_at = [&](const Eigen::Vector3d& point, const Eigen::Vector3d& p_W, const Eigen::Quaterniond& q_W) {
      Eigen::Vector3d p_C = extrinsics.R_B_C.transpose() * (q_W.conjugate() * (point - p_W) - extrinsics.p_B_C);
      p_C.head<2>() *= simulated.focal;
      auto pixel = camera.project(p_C);
      if (pixel && !camera.contains(*pixel, 5)) pixel.reset();
      return pixel;
    };
    const auto see = [&](const Eigen::Vector3d& point) {
      auto pixel = see_at(point, p, q);
      if (simulated.readout_time == 0) return pixel;
      // The row that a point falls on says when it is seen, and that where it falls.
      for (int iteration = 0; iteration < 3 && pixel; ++iteration) {
        const double t = shown + simulated.readout_time * (pixel->y() / (camera.height() - 1) - 0.5);
        pixel = see_at(point, trajectory.position(t), trajectory.attitude(t));
      }
      return pixel;
    };
    for (auto it = points.begin(); it != points.end();) it = see(it->second) ? std::next(it) : points.erase(it);
    while (points.size() < kMostFeatures) {
      const Eigen::Vector2d pixel(10 + 620 * uniform(generator), 10 + 460 * uniform(generator));
      const Eigen::Vector3d ray_W = q * (extrinsics.R_B_C * *camera.unproject(pixel));
      const Eigen::Vector3d p_C = p + q * extrinsics.p_B_C;
      const double z = relief * normal(generator);
      const Eigen::Vector3d point = p_C + ray_W * ((z - p_C.z()) / ray_W.z());
      if (see(point)) points[next_id++] = point;
    }
    for (const auto& [id, point] : points) {
      const Eigen::Vector2d pixel = *see(point) + noise.pixel * Eigen::Vector2d(normal(generator), normal(generator));
      frame.features.push_back({id, pixel, *camera.unproject(pixel)});
    }
    frame.gyro_bias = bg;
    frame.accel_bias = ba;
    frames.push_back(std::move(frame));
  }
  return frames;
}

Estimator::Status process(Estimator& estimator, const SimulatedFrame& frame,
                          const std::optional<HeightMeasurement>& height) {
  const auto status = estimator.process(frame.utime, frame.features, frame.imu, height);
  if (estimator.start_due()) estimator.try_start();
  return status;
}

Feeder::Feeder(const std::vector<SimulatedFrame>& frames) : frames_(frames) {
  for (const SimulatedFrame& frame : frames) {
    for (size_t k = samples_.empty() ? 0 : 1; k < frame.imu.size(); ++k) samples_.push_back(frame.imu[k]);
  }
}

std::optional<Estimator::Status> Feeder::next(Estimator& estimator) {
  if (index_ == frames_.size()) return std::nullopt;
  const SimulatedFrame& frame = frames_[index_++];
  const auto offset = static_cast<int64_t>(std::llround(1e6 * estimator.time_offset()));
  const int64_t now = std::clamp(frame.utime + offset, until_ + 1, samples_.back().utime);
  std::vector<ImuSample> cut;
  const auto at = [&](size_t k, int64_t utime) {
    const ImuSample &a = samples_[k], &b = samples_[k + 1];
    const double s = static_cast<double>(utime - a.utime) / static_cast<double>(b.utime - a.utime);
    return ImuSample{utime, (1 - s) * a.gyro + s * b.gyro, (1 - s) * a.accel + s * b.accel};
  };
  for (size_t k = 0; k + 1 < samples_.size() && until_ > 0; ++k) {
    if (samples_[k + 1].utime <= until_) continue;
    if (samples_[k].utime >= now) break;
    if (cut.empty()) cut.push_back(at(k, std::max(until_, samples_[k].utime)));
    cut.push_back(samples_[k + 1].utime > now ? at(k, now) : samples_[k + 1]);
  }
  until_ = now;
  const auto status = estimator.process(now, frame.features, cut);
  if (estimator.start_due()) estimator.try_start();
  return status;
}

TexturedGround::TexturedGround(double extent, double metres_per_pixel, unsigned seed)
    : extent_(extent), metres_per_pixel_(metres_per_pixel) {
  const int side = static_cast<int>(2 * extent / metres_per_pixel);
  cv::RNG random(seed);
  texture_ = cv::Mat(side, side, CV_8U);
  random.fill(texture_, cv::RNG::UNIFORM, 0, 256);
  cv::Mat coarse;
  cv::GaussianBlur(texture_, coarse, {}, 6);
  cv::GaussianBlur(texture_, texture_, {}, 2);
  cv::Mat mixed;
  cv::addWeighted(texture_, 2.0, coarse, 6.0, -7.0 * 127.5, mixed);
  texture_ = mixed;
}

cv::Mat TexturedGround::picture(const Trajectory& trajectory, double t) const {
  const CameraParameters c = test_camera().parameters();
  const Extrinsics extrinsics = downward_camera();
  const Eigen::Quaterniond q = trajectory.attitude(t);
  const Eigen::Matrix3d R_C_W = (q.toRotationMatrix() * extrinsics.R_B_C).transpose();
  const Eigen::Vector3d p_W_C = trajectory.position(t) + q * extrinsics.p_B_C;
  Eigen::Matrix3d K;
  K << c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1;
  Eigen::Matrix3d ground;  // (x, y, 1) on the ground to the picture
  ground << R_C_W.col(0), R_C_W.col(1), -R_C_W * p_W_C;
  Eigen::Matrix3d texture;  // texture pixel to (x, y, 1); row 0 is at +y
  texture << metres_per_pixel_, 0, -extent_, 0, -metres_per_pixel_, extent_, 0, 0, 1;
  const Eigen::Matrix3d H = K * ground * texture;
  cv::Mat H_cv(3, 3, CV_64F);
  for (int r = 0; r < 3; ++r) {
    for (int col = 0; col < 3; ++col) H_cv.at<double>(r, col) = H(r, col);
  }
  cv::Mat picture;
  cv::warpPerspective(texture_, picture, H_cv, {c.width, c.height}, cv::INTER_LINEAR, cv::BORDER_REFLECT);
  return picture;
}

}  // namespace orthonav::vio
