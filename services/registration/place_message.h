// What is believed of the place, as messages: PLACE_HYPOTHESES out, POSITION_HINT in. Pure functions, thread-safe.
#pragma once

#include <string>

#include "common/geo/enu_frame.h"
#include "orthonav/place_hypotheses_t.hpp"
#include "orthonav/position_hint_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "services/registration/place_belief.h"
#include "services/registration/place_prior.h"

namespace orthonav::registration {

// `keyframe`: the one that was looked at last; `frame`: of G.
place_hypotheses_t hypotheses_message(const PlaceBelief& belief, const vio_keyframe_t& keyframe, const EnuFrame& frame);

// What the hint says in G, or why it says nothing that can be used.
struct HintedArea {
  ExpectedArea area;
  std::string problem;  // empty: there is none
};
HintedArea area_of(const position_hint_t& hint, const EnuFrame& frame);

}  // namespace orthonav::registration
