#include "services/registration/submap/view.h"

#include <algorithm>
#include <cmath>

#include <gtest/gtest.h>

#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

TEST(View, HasNoMorePointsThanTheGroundThatItCoversHasMapFeatures) {
  const SyntheticFields ground{1};
  const MapIndex index(described_map(ground), kFieldsMap);
  const CameraModel camera = test_camera();
  for (const double height : {12.0, 18.0, 25.0, 35.0, 60.0}) {
    const Capture capture = ground.capture({95, -80, height}, 0.3, 0, 0);
    const View view = make_view(capture.keyframe, capture.image, camera, 0.3, 1, index, kFieldsMap, {});
    const double width = height * camera.width() / camera.focal() / index.pitch();
    const double length = height * camera.height() / camera.focal() / index.pitch();
    const auto points = static_cast<double>(view.points.size());
    EXPECT_LE(points, (width + 1) * (length + 1)) << height;
    EXPECT_GE(points, 0.4 * std::min(width * length, static_cast<double>(capture.keyframe.points.size()))) << height;
  }
}

}  // namespace
}  // namespace orthonav::registration
