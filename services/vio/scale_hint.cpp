#include "services/vio/scale_hint.h"

#include <cmath>

namespace orthonav::vio {

void ScaleHinter::add_odometry(int64_t utime, int session, const Eigen::Vector3d& p_W) {
  constexpr size_t kMost = 50;  // the fused positions follow within a frame or two
  odometry_.push_back({utime, session, p_W});
  if (odometry_.size() > kMost) odometry_.pop_front();
}

std::optional<ScaleHint> ScaleHinter::add_fused(int64_t utime, int session, bool aided, int epoch,
                                                const Eigen::Vector3d& p_G, double stddev) {
  while (!odometry_.empty() && odometry_.front().utime < utime) odometry_.pop_front();
  const bool usable = aided && p_G.allFinite() && stddev > 0 && !odometry_.empty() &&
                      odometry_.front().utime == utime && odometry_.front().session == session;
  if (!usable) {
    if (!aided) start_.reset();
    return std::nullopt;
  }
  const Start now{session, epoch, odometry_.front().p_W, p_G, stddev};
  if (!start_ || start_->session != session || start_->epoch != epoch) {
    start_ = now;
    return std::nullopt;
  }
  // Horizontal lengths: the fixes know heights less well.
  const double fused = (now.p_G - start_->p_G).head<2>().norm();
  const double own = (now.p_W - start_->p_W).head<2>().norm();
  if (fused < distance_ || own < 1e-3) return std::nullopt;
  const ScaleHint hint{fused / own, std::hypot(now.stddev, start_->stddev) / own};
  start_ = now;
  return hint;
}

}  // namespace orthonav::vio
