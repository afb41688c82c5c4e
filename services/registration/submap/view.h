// A keyframe as method "submap" compares it with the map: its tracked points, each described in its own image as the
// map would show it.
//
// The image is not resampled to the map. Its gradients are gathered where they are, in pixels about as fine as the
// map's, and each point's descriptor is read off them through the view of flat ground below the camera: heading, tilt,
// perspective and lens are taken into account point by point.
//
// Points are no more witnesses than the ground that they cover has map features: close above it 140 of them name the
// same few, and made a place 310 m off the surest of a flight.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "common/features/orientation_field.h"
#include "services/registration/image_similarity.h"
#include "services/registration/map/map_index.h"
#include "services/registration/types.h"

namespace orthonav::registration {

// How a point's likeness to the map's features is judged: the correlation of the descriptors' differences from the
// map's mean one (map_index.h), in standard deviations above what places of no relation give.
struct Background {
  float product = 0;  // of the point's descriptor with the mean one
  float mean = 0;     // of `correlation` over the map
  float stddev = 1;

  // Correlation, but for a factor of the point's own.
  float correlation(float with_point, const MapIndex::Centring& feature) const {
    return (with_point - product) * feature.scale - feature.offset;
  }
  float excess(float with_point, const MapIndex::Centring& feature) const {
    return (correlation(with_point, feature) - mean) / stddev;
  }
};

// Where a point's image looks most like a map feature, looked for around `start`: map pixels (east, south) from the
// point. No peak: nowhere nearby.
struct AlignedFeature {
  int feature = -1;
  Eigen::Vector2f start = Eigen::Vector2f::Zero();
  std::optional<Eigen::Vector2f> peak;
};

struct ViewPoint {
  int index = -1;            // in Keyframe::points
  Eigen::Vector2d ray;       // undistorted image coordinates at z = 1
  Eigen::Vector3d p_W;       // m
  Eigen::Vector2f pixel;     // in the field's image
  Eigen::Matrix2f jacobian;  // of `pixel` by map pixels (east, south)
  std::array<uint8_t, kSiftBytes> descriptor;
  std::array<uint8_t, kCoarseBytes> coarse;
  Background background, coarse_background;
  // By the fits so far: a point is aligned to a feature once, not in each submap that it is part of.
  mutable std::vector<AlignedFeature> aligned;
};

struct View {
  std::string refused;  // why the keyframe cannot be compared; empty when it can
  Keyframe keyframe;
  double yaw = 0;  // rad: rotation about z that takes W to G, as assumed for the descriptors
  std::optional<OrientationField> field;
  std::vector<ViewPoint> points;
  int num_contradicted = 0;  // points left out because their depth contradicts the height
};

// How far from the newest body points lie, horizontally, m in W: their root mean square, but for those three times as
// far as the median. `views`: newest first.
double spread_of(const std::vector<const View*>& views);

// `scale` is the true size over the odometry's, as far as known. Bad input (NaN, height <= 0, wrong image size, too few
// points) gives a refusal, never an exception.
View make_view(const Keyframe& keyframe, const cv::Mat& image, const CameraModel& camera, double true_heading,
               double scale, const MapIndex& index, const MapGeometry& map, const QueryOptions& options);

}  // namespace orthonav::registration
