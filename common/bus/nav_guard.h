// Which NAV_STATEs a service acts on. The bus is not authenticated, and a position that is wrong is worse than none.
//
// A state is refused that cannot be an aircraft's, or that is farther from the last believed one, at most two seconds
// older, than an aircraft flies while the reset counter says that it moved only by flying. Whoever forges states that
// agree with each other, while the true ones are silent, is believed: only the bus's key stops that (seal.h).
// Not thread-safe.
#pragma once

#include <cstdint>
#include <optional>

#include "orthonav/nav_state_t.hpp"

namespace orthonav {

class NavGuard {
 public:
  // Why `state` is not to be acted on, as the end of a counter's name: "implausible" or "jump"; null where it is. A
  // state that says itself that it has no position (latitude NaN) is none to refuse.
  const char* refusal(const nav_state_t& state);

 private:
  struct Believed {
    int64_t utime;
    double latitude_deg, longitude_deg;
    double stddev;  // m, horizontal
    int32_t reset_counter;
  };
  std::optional<Believed> last_;
};

}  // namespace orthonav
