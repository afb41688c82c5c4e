// From the bus's image message to a grey picture, with everything that can be wrong with it found first.
//
// Pure functions, safe from any thread. Nothing here throws on bad data: a damaged image is the sender's or the
// network's doing, and the caller counts it and goes on.
#pragma once

#include <string>

#include <opencv2/core.hpp>

#include "orthonav/image_t.hpp"

namespace orthonav {

struct DecodedImage {
  cv::Mat grey;       // CV_8UC1, a copy that outlives the message; empty when the image was refused
  std::string error;  // why it was refused, for the health; empty when it was not

  bool ok() const { return error.empty(); }
};

// Decodes `image` (GRAY or MJPEG). Refused: sizes that are not positive, other pixel formats, a buffer shorter than
// its rows need, a JPEG that is truncated (no end marker), corrupt or of another size than the message says (before
// memory is taken for it), and, where `width` and `height` (pixels) are positive, any other size than theirs, because a
// calibration holds for one.
DecodedImage decode_image(const image_t& image, int width = 0, int height = 0);

}  // namespace orthonav
