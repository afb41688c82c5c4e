#include "tools/evaluate/odometry_scale.h"

#include <algorithm>

#include "tools/evaluate/figures.h"

namespace orthonav::evaluate {

OdometryScale::OdometryScale(const FlightRecord& record) {
  for (const auto& [logged_at, state] : record.vio) {
    if (state.status == vio_state_t::INITIALISING || !vector_of(state.p_W_B).allFinite()) continue;
    const auto sample = best_reference(record).at(state.utime);
    if (sample) poses_.push_back({&state, sample->p_G_B});
  }
}

std::optional<ScaleError> OdometryScale::between(const Pose& from, const Pose& to) const {
  const double true_way = (to.p_G_B - from.p_G_B).norm();
  if (true_way < kStretch) return std::nullopt;
  const double way = (vector_of(to.state->p_W_B) - vector_of(from.state->p_W_B)).norm();
  const double stddev = to.state->scale_stddev;
  return ScaleError{way / true_way - 1.0, stddev > 0 ? stddev : kNan};
}

std::optional<ScaleError> OdometryScale::ending_at(int64_t utime) const {
  const auto after = std::upper_bound(poses_.begin(), poses_.end(), utime,
                                      [](int64_t time, const Pose& pose) { return time < pose.state->utime; });
  if (after == poses_.begin()) return std::nullopt;
  const Pose& last = *(after - 1);
  for (auto pose = after - 1; pose->state->session == last.state->session; --pose) {
    if (const auto error = between(*pose, last)) return error;
    if (pose == poses_.begin()) break;
  }
  return std::nullopt;
}

std::optional<ScaleError> OdometryScale::beginning_at(int64_t utime) const {
  const auto first = std::lower_bound(poses_.begin(), poses_.end(), utime,
                                      [](const Pose& pose, int64_t time) { return pose.state->utime < time; });
  for (auto pose = first; pose != poses_.end() && pose->state->session == first->state->session; ++pose) {
    if (const auto error = between(*first, *pose)) return error;
  }
  return std::nullopt;
}

}  // namespace orthonav::evaluate
