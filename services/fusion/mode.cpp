#include "services/fusion/mode.h"

namespace orthonav::fusion {

Mode ModeMachine::update(const Evidence& evidence) {
  const bool moved = was_located_ && evidence.moves > moves_;
  moves_ = evidence.moves;
  if (!evidence.located) {
    if (was_located_) {
      mode_ = Mode::kLost;
    } else {
      mode_ = evidence.odometry ? Mode::kDeadReckoning : Mode::kWaitingForVio;
    }
    return mode_;
  }
  was_located_ = true;
  const bool fresh = !evidence.blind && !evidence.unconfirmed && evidence.time_since_fix <= options_.coasting_after;
  const bool uncertain = evidence.level > options_.protection.lost_level;
  if (evidence.contradicted || uncertain) {
    mode_ = Mode::kLost;
  } else if (moved || (mode_ == Mode::kLost && fresh)) {
    mode_ = Mode::kReacquired;
    reacquired_utime_ = evidence.utime;
  } else if (mode_ == Mode::kLost) {
    return mode_;  // only a fix ends it
  } else if (!fresh) {
    mode_ = Mode::kCoasting;
  } else if (mode_ == Mode::kReacquired) {
    const double since = 1e-6 * static_cast<double>(evidence.utime - reacquired_utime_);
    if (since > options_.reacquired_for) mode_ = Mode::kMapAided;
  } else {
    mode_ = Mode::kMapAided;
  }
  return mode_;
}

}  // namespace orthonav::fusion
