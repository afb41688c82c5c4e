// Between the messages of the bus and what registration works on.
#pragma once

#include "common/geo/enu_frame.h"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "services/registration/paper/registrar.h"
#include "services/registration/types.h"

namespace orthonav::registration {

// As it is: whether it can be used is for make_query to say.
Keyframe keyframe_of(const vio_keyframe_t& message);

// The fields of a fix that come from the registration itself; those of a refused one are NaN where the type says so.
// `frame` is G.
void fill_fix(const Fix& fix, const EnuFrame& frame, map_fix_t& out);

}  // namespace orthonav::registration
