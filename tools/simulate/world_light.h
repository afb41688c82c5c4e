// Sun and sky on a painted canvas: what a camera above it sees.
#pragma once

#include <opencv2/core.hpp>

#include "tools/simulate/world_epoch.h"
#include "tools/simulate/world_paint.h"

namespace orthonav::simulate {

struct LightOptions {
  double sky = 0.30;        // light of the open sky relative to full sun on level ground
  double mean_level = 108;  // grey level that the exposure aims at
};

// Fraction of the sun's disc hidden by the height field, 0 (lit) .. 255 (shadow), CV_8U of the same size. `height` in
// m on a grid of `resolution` m, row 0 in the north.
cv::Mat cast_shadows(const cv::Mat& height, double resolution, const Sun& sun);

// The canvas as seen from above: CV_8U, or CV_8UC3 (BGR) with `colour`.
cv::Mat render(const Canvas& canvas, const Epoch& epoch, const LightOptions& light, bool colour);

}  // namespace orthonav::simulate
