// What the sliding window holds: frames (equation 1) and landmarks.
//
// A frame's state is [position, attitude] and [velocity, accelerometer bias, gyroscope bias] of B in W, kept as two
// parameter blocks for Ceres. Attitude errors are rotation vectors at the right: R = R_hat Exp(e).
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

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

// A frame of the window. Its address is stable for as long as it is in the window.
struct Frame {
  int64_t id = 0;  // counts the frames of a session
  int64_t utime = 0;
  bool keyframe = false;
  int keyframe_id = -1;   // -1: never published
  StateValues published;  // of a published keyframe: what was told of it
  StateValues state;
  // First-estimate linearisation points: once a block is in the marginalisation prior, every Jacobian with respect
  // to it is taken where the prior was, or the estimator would gain information it does not have, about yaw and, on
  // straight legs, about scale.
  StateValues first_estimate;
  bool pose_fixed = false;        // the pose's linearisation point is first_estimate
  bool speed_bias_fixed = false;  // likewise
  // From the previous frame of the window to this one; null in the oldest.
  std::unique_ptr<Preintegration> imu;
};

// A feature as the tracker saw it in one image.
struct TrackedFeature {
  int64_t id = 0;
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();  // raw image
  Eigen::Vector3d ray = Eigen::Vector3d::UnitZ();   // undistorted bearing in C, z = 1
};

struct Observation {
  Frame* frame = nullptr;
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();
  Eigen::Vector3d ray = Eigen::Vector3d::UnitZ();
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
