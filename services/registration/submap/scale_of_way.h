// The odometry's scale from the way flown over the map.
//
// What one image shows tells a scale no better than trees and houses, which lean outward in it and not on the map, let
// it: two metres over the height. The way between keyframes tells it several times better, once some lengths of the
// height were flown. Beginning at the newest keyframes, where they were fitted, each older keyframe of the submap is
// looked for around the place that the odometry and all those before it give it; where it is found says more of the
// scale, and so the next one has a smaller area. Where keyframes are not found where they have to be, the odometry's
// scale was another one, or its way was lost, and what lies further back says nothing of now.
#pragma once

#include <optional>
#include <vector>

#include "services/registration/map/map_index.h"
#include "services/registration/submap/place_fit.h"
#include "services/registration/submap/place_search.h"
#include "services/registration/submap/view.h"

namespace orthonav::registration {

// `views`: newest first, of which the first `fitted` are those of `fit`. What its matches say of the scale is where to
// begin, and no part of the result. Nothing where the way says nothing that they do not.
std::optional<ScaleBelief> scale_of_way(const std::vector<const View*>& views, size_t fitted, const PlaceFit& fit,
                                        const MapIndex& index, const EvidenceOptions& evidence,
                                        const FitOptions& options);

}  // namespace orthonav::registration
