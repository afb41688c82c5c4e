// What the sliding window holds: frames (equation 1) and landmarks.
//
// A frame's state is [position, attitude] and [velocity, accelerometer bias, gyroscope bias] of B in W, kept as two
// parameter blocks for Ceres. Attitude errors are rotation vectors at the right: R = R_hat Exp(e).
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/camera/camera_model.h"
#include "services/vio/imu_noise.h"
#include "services/vio/preintegration.h"

namespace orthonav::vio {

// Values of one frame's state, laid out as Ceres parameter blocks.
struct StateValues {
  std::array<double, 7> pose{0, 0, 0, 0, 0, 0, 1};  // p_W_B (m), q_W_B as x y z w
  std::array<double, 9> speed_bias{};               // v_W_B (m/s), accelerometer bias (m/s^2), gyroscope bias (rad/s)

  Eigen::Map<Eigen::Vector3d> p() { return Eigen::Map<Eigen::Vector3d>(pose.data()); }
  Eigen::Map<const Eigen::Vector3d> p() const { return Eigen::Map<const Eigen::Vector3d>(pose.data()); }
  Eigen::Map<Eigen::Quaterniond> q() { return Eigen::Map<Eigen::Quaterniond>(pose.data() + 3); }
  Eigen::Map<const Eigen::Quaterniond> q() const { return Eigen::Map<const Eigen::Quaterniond>(pose.data() + 3); }
  Eigen::Map<Eigen::Vector3d> v() { return Eigen::Map<Eigen::Vector3d>(speed_bias.data()); }
  Eigen::Map<const Eigen::Vector3d> v() const { return Eigen::Map<const Eigen::Vector3d>(speed_bias.data()); }
  Eigen::Map<Eigen::Vector3d> ba() { return Eigen::Map<Eigen::Vector3d>(speed_bias.data() + 3); }
  Eigen::Map<const Eigen::Vector3d> ba() const { return Eigen::Map<const Eigen::Vector3d>(speed_bias.data() + 3); }
  Eigen::Map<Eigen::Vector3d> bg() { return Eigen::Map<Eigen::Vector3d>(speed_bias.data() + 6); }
  Eigen::Map<const Eigen::Vector3d> bg() const { return Eigen::Map<const Eigen::Vector3d>(speed_bias.data() + 6); }
};

// What all frames share. Frozen parts keep the value they were configured with.
struct SharedValues {
  std::array<double, 7> camera{0, 0, 0, 0, 0, 0, 1};  // T_B_C: p_B_C (m), q_B_C as x y z w
  std::array<double, 1> time_offset{};                // s: IMU time = image time + this
  std::array<double, 1> height_bias{};                // m: measured height = true height + this

  void set(const Extrinsics& extrinsics) {
    Eigen::Map<Eigen::Vector3d>(camera.data()) = extrinsics.p_B_C;
    Eigen::Map<Eigen::Quaterniond>(camera.data() + 3) = Eigen::Quaterniond(extrinsics.R_B_C).normalized();
  }
  Extrinsics extrinsics() const {
    Extrinsics result;
    result.p_B_C = Eigen::Map<const Eigen::Vector3d>(camera.data());
    result.R_B_C = Eigen::Map<const Eigen::Quaterniond>(camera.data() + 3).toRotationMatrix();
    return result;
  }
};

struct Shared {
  SharedValues state;
  bool camera_free = false, time_free = false, height_free = false;  // estimated
};

// A height above ground that was measured at a frame.
struct HeightMeasurement {
  double height = 0;  // m
  double stddev = 1;  // m, of what is not common to all measurements
};

// A frame of the window. Its address is stable for as long as it is in the window.
struct Frame {
  int64_t id = 0;  // counts the frames of a session
  int64_t utime = 0;
  bool keyframe = false;
  int keyframe_id = -1;                     // -1: never published
  bool stationary = false;                  // a keyframe made because of time and not of motion
  double time_shift = 0;                    // s, time offset at which its IMU samples were cut
  StateValues published;                    // of a published keyframe: what was told of it,
  Eigen::Vector2d levelled{0, 0};           // and by which turns in all, as in vio_state_t
  std::optional<Eigen::Vector3d> at_start;  // m, position in W when the session started with it
  std::optional<double> still_sigma;        // m/s: its velocity is zero to this
  bool at_rest = false;                     // the last one before a start that nothing had moved in
  std::optional<HeightMeasurement> height;  // as measured
  std::optional<int64_t> height_landmark;   // the landmark that stands for the ground under it
  StateValues state;
  // From the previous frame of the window to this one; null in the oldest.
  std::unique_ptr<Preintegration> imu;
  ImuVariances variances;  // that it was integrated with
};

// A feature as the tracker saw it in one image.
struct TrackedFeature {
  int64_t id = 0;
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();  // raw image
  Eigen::Vector3d ray = Eigen::Vector3d::UnitZ();   // undistorted bearing in C, z = 1
  double row_delay = 0;                             // s, after the image's time, at which a rolling shutter saw it
};

struct Observation {
  Frame* frame = nullptr;
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();
  Eigen::Vector3d ray = Eigen::Vector3d::UnitZ();  // at the frame's time, where a shutter rolls: of the middle row
  Eigen::Vector2d rate = Eigen::Vector2d::Zero();  // 1/s, of the ray on z = 1
};

// A feature of the window; its depth is along the ray of its first observation (the anchor).
struct Landmark {
  int64_t id = 0;
  std::vector<Observation> observations;  // in the order of time, all in the window
  double inverse_depth = 0;               // 1/m, in the anchor's C along z
  bool has_depth = false;
  bool tracked = true;            // seen in the newest frame
  double reprojection_error = 0;  // pixels, root mean square over the window

  const Observation& anchor() const { return observations.front(); }
};

}  // namespace orthonav::vio
