// Compares the fused trajectory with the odometry's own: how much longer the same way is on the map.
//
// A loosely coupled loop: fixes hold the fused trajectory's scale, and their ratio goes back into the window
// (Estimator::hint_scale). Each stretch is used once. Not thread-safe; deterministic.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>

#include <Eigen/Core>

namespace orthonav::vio {

struct ScaleHint {
  double ratio = 1;   // true length over the odometry's
  double stddev = 0;  // of the ratio
};

class ScaleHinter {
 public:
  // `distance`: m on the map, length of a stretch.
  explicit ScaleHinter(double distance) : distance_(distance) {}

  // The odometry's position, m, in the W of its session.
  void add_odometry(int64_t utime, int session, const Eigen::Vector3d& p_W);

  // The fused position at a time that add_odometry has had, m in a frame that stays; `stddev`: m, horizontal. `aided`:
  // fixes are in use; `epoch`: anything that changes when the fused position jumps. Returns a hint when a stretch ends.
  std::optional<ScaleHint> add_fused(int64_t utime, int session, bool aided, int epoch, const Eigen::Vector3d& p_G,
                                     double stddev);

 private:
  struct Odometry {
    int64_t utime;
    int session;
    Eigen::Vector3d p_W;
  };
  struct Start {
    int session, epoch;
    Eigen::Vector3d p_W, p_G;
    double stddev;
  };
  double distance_;
  std::deque<Odometry> odometry_;
  std::optional<Start> start_;
};

}  // namespace orthonav::vio
