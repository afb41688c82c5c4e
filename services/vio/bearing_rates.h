// How fast the bearings of an image move: by so much an error of the time offset, or the row of a rolling shutter,
// shifts them. By rotation they move as the gyroscope tells; by translation as velocity and depth of the estimate tell,
// and before there is an estimate as they did between the images before.
//
// A rate holds none of its own image's noise, which would look like a time offset, and as little as can be of that of
// others (errors in variables): rates by differences alone made 3-15 ms out of no offset, with tracks of 0.2 pixels.
#pragma once

#include <cstdint>
#include <map>
#include <vector>

#include <Eigen/Core>

#include "common/camera/aircraft.h"
#include "services/vio/preintegration.h"
#include "services/vio/state.h"

namespace orthonav::vio {

class BearingRates {
 public:
  // Takes the next image: its features, and the IMU samples since the one before. False for the first one and after
  // clear(): nothing tells yet how fast its bearings move.
  bool see(const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu, const Extrinsics& extrinsics,
           const Eigen::Vector3d& gyro_bias);
  void clear() { sights_.clear(); }

  // Rates of a feature's ray on z = 1 in the image seen last, 1/s: by the differences between the images before; and of
  // a point at an inverse depth (1/m, along z of C) while the camera moves at `velocity_C` (m/s, in C).
  Eigen::Vector2d by_differences(const TrackedFeature& feature) const;
  Eigen::Vector2d by_motion(const TrackedFeature& feature, const Eigen::Vector3d& velocity_C,
                            double inverse_depth) const;
  // rad/s, of the camera in C.
  const Eigen::Vector3d& turn_rate() const { return turn_rate_; }

 private:
  struct Sight {
    Eigen::Vector3d ray;
    Eigen::Vector2d drift;    // 1/s, of the ray by translation, averaged
    int differences = 0;      // that went into it
    Eigen::Vector2d earlier;  // the same, without this image's
  };
  Eigen::Vector2d by_rotation(const Eigen::Vector3d& ray) const;

  std::map<int64_t, Sight> sights_;  // of the newest image
  Eigen::Vector3d turn_rate_ = Eigen::Vector3d::Zero();
};

}  // namespace orthonav::vio
