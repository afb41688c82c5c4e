// What the output is worth, as a state machine. docs/fusion.md has its picture.
//
//   WAITING_FOR_VIO ──odometry──► DEAD_RECKONING ──lock──► MAP_AIDED ◄──fix── COASTING
//                                                            │  └─no fix for a while─► ▲ │
//                                       contradicted, too    │                          │ │
//                                       uncertain, or gone   ▼                          │ ▼
//                                                          LOST ──fix or lock──► REACQUIRED ──some seconds──► MAP_AIDED
//
// Deterministic; not thread-safe.
#pragma once

#include <cstdint>

#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// What the mode depends on, at one instant.
struct Evidence {
  int64_t utime = 0;                 // microseconds
  bool odometry = false;             // there is a pose, of the odometry or of the inertial sensor
  bool located = false;              // it is a pose on the map
  bool blind = false;                // the inertial sensor alone carries it
  bool unconfirmed = false;          // carried across a restart, and fixes have yet to agree
  bool contradicted = false;         // another place is likelier, by the fixes that agree there and here
  double level = kUnknown;           // m, horizontal protection level, or what the covariance says; NaN: unknown
  double time_since_fix = kUnknown;  // s
  int moves = 0;  // times that the position was moved to another place on the map, first lock included
};

class ModeMachine {
 public:
  explicit ModeMachine(const FusionOptions& options) : options_(options) {}

  // The mode after this instant. Instants may repeat or step back a little (a frame's state is older than the
  // inertial sensor's newest sample).
  Mode update(const Evidence& evidence);
  Mode mode() const { return mode_; }

 private:
  FusionOptions options_;
  Mode mode_ = Mode::kWaitingForVio;
  bool was_located_ = false;
  int moves_ = 0;
  int64_t reacquired_utime_ = 0;
};

}  // namespace orthonav::fusion
