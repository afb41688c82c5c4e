// How fast a test flies a whole flight through processes. Instrumented ones do not keep up with real time.
#pragma once

#include <chrono>
#include <string>

namespace orthonav::test {

inline constexpr double kFlightSpeed = ORTHONAV_FLIGHT_SPEED;  // times real time

// For the arguments of deploy/fly, deploy/fly-boards and orthonav-ingest.
inline std::string flight_speed() {
  return std::to_string(kFlightSpeed);
}
// The time on the wall that so much of a flight takes.
inline std::chrono::milliseconds flown(std::chrono::milliseconds flight) {
  return std::chrono::milliseconds(static_cast<int64_t>(static_cast<double>(flight.count()) / kFlightSpeed));
}

}  // namespace orthonav::test
