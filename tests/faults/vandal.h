// Messages that no honest publisher sends, on every channel of the bus.
#pragma once

#include <cstdint>
#include <random>

#include <lcm/lcm-cpp.hpp>

namespace orthonav::faults {

// What marks a NAV_STATE of publish_absurd, in processing_ms, which no service reads: who measures a flight passes over
// it.
inline constexpr double kForged = -1;

// Random bytes, empty messages, and sound messages cut short.
void publish_garbage(lcm::LCM& bus, std::mt19937_64& random);

// Well-formed messages with absurd contents: NaN and infinite values, fixes 100 km away, time from tomorrow or before
// the epoch, positions of an aircraft 100 km away, sessions and keyframes that never were, tiles of another map, images
// that lie about their size. `now` is the flight's time, microseconds; `session` and `keyframe` are those of the
// flight, so that nothing is refused merely for being unknown.
void publish_absurd(lcm::LCM& bus, std::mt19937_64& random, int64_t now, int32_t session, int32_t keyframe);

}  // namespace orthonav::faults
