// The report as one HTML file: pictures and charts inside, no script, for a phone, a desk and paper.
#pragma once

#include <string>
#include <vector>

#include "tools/evaluate/metrics.h"
#include "tools/evaluate/pictures.h"

namespace orthonav::evaluate {

// `title` is the log's name; `tracks` the SVG of draw_tracks.
std::string to_html(const std::string& title, const FlightRecord& record, const Metrics& metrics,
                    const std::string& tracks, const std::vector<MatchPicture>& matches);

}  // namespace orthonav::evaluate
