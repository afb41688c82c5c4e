// A flight in closed form for tests of the odometry: exact IMU samples, exact bearings of points on the ground, and
// plain pictures of a textured plane. Noise is added on request.
#pragma once

#include <functional>
#include <optional>
#include <random>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "services/vio/estimator.h"
#include "services/vio/state.h"

namespace orthonav::vio {

// Body x forward, y left, z up; the camera looks down, the top of the picture forward.
Extrinsics downward_camera();
CameraModel test_camera();  // 640x480, 850 pixels of focal length, no distortion

struct Trajectory {
  std::function<Eigen::Vector3d(double)> position;     // m at a time in s
  std::function<Eigen::Vector3d(double)> orientation;  // roll, pitch, yaw in rad

  Eigen::Quaterniond attitude(double t) const;
  Eigen::Vector3d velocity(double t) const;
  // What an ideal IMU measures, by central differences to 1e-7.
  ImuSample imu(double t, double gravity) const;
};

// IMU samples of a trajectory every 5 ms from `from` to `to` (s), both ends included, whatever they are.
std::vector<ImuSample> ideal_imu(const Trajectory& trajectory, double from, double to);

// The flight with its time standing still from `from` to `to`, s; the flight must be slow about then. With `sway` the
// aircraft hovers meanwhile: it wanders by so much (m) and rocks by 2 degrees.
Trajectory with_pause(const Trajectory& flight, double from, double to, double sway);

// A multirotor's forward flight at `height` (m) and `speed` (m/s) with a sway of a few seconds' period; it stands
// still at its start for `rest` seconds.
Trajectory survey_flight(double height, double speed, double rest = 0);

struct SimulatedNoise {
  double pixel = 0;                                      // pixels, 1 sigma
  bool imu = false;                                      // of ImuNoise's default class, with the biases below
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();   // rad/s
  Eigen::Vector3d accel_bias = Eigen::Vector3d::Zero();  // m/s^2
  double imu_times = 1;                                  // white noise over that of the class: an airframe that shakes
  double walk_times = 1;                                 // likewise the random walks of the biases
};

// What the camera really is, where the estimator believes in downward_camera() and a global shutter in time.
struct SimulatedCamera {
  Extrinsics extrinsics = downward_camera();
  double time_offset = 0;   // s: a picture stamped t shows what was at t + this
  double time_jitter = 0;   // s, 1 sigma: and another time again in each picture
  double focal = 1;         // true focal length over the one that is believed
  double readout_time = 0;  // s, from the first row to the last, about the stamp
};

struct SimulatedFrame {
  int64_t utime = 0;
  double t = 0;
  std::vector<TrackedFeature> features;
  std::vector<ImuSample> imu;  // since the previous frame, both ends included
  // The sensor's true biases by then.
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero(), accel_bias = Eigen::Vector3d::Zero();
};

// Frames at 10 Hz with points on a ground of `relief` (m, 1 sigma). A point keeps its id while it is in view.
std::vector<SimulatedFrame> simulate_frames(const Trajectory& trajectory, double duration, double relief,
                                            const SimulatedNoise& noise, unsigned seed,
                                            const SimulatedCamera& simulated = {});

// One frame, as Vio gives it to the estimator, and the start that it may make due. Returns the frame's own status.
Estimator::Status process(Estimator& estimator, const SimulatedFrame& frame,
                          const std::optional<HeightMeasurement>& height = std::nullopt);

// Gives a flight's frames to the estimator as Vio does: the inertial samples are cut at the images' times by the
// sensor's clock, as far as the estimator knows it by then.
class Feeder {
 public:
  explicit Feeder(const std::vector<SimulatedFrame>& frames);  // which outlive it
  // The next frame, and the start that it may make due. Returns the frame's own status; nullopt after the last.
  std::optional<Estimator::Status> next(Estimator& estimator);
  const SimulatedFrame& frame() const { return frames_[index_ - 1]; }  // that was given last

 private:
  const std::vector<SimulatedFrame>& frames_;
  std::vector<ImuSample> samples_;
  size_t index_ = 0;
  int64_t until_ = 0;  // of the samples given
};

// The picture of the plane z = 0 under a fixed random texture.
class TexturedGround {
 public:
  // `extent`: m, half the side of the square that the texture covers around the origin.
  TexturedGround(double extent, double metres_per_pixel, unsigned seed);
  cv::Mat picture(const Trajectory& trajectory, double t) const;

 private:
  double extent_, metres_per_pixel_;
  cv::Mat texture_;
};

}  // namespace orthonav::vio
