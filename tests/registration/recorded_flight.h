// What the benchmarks along flights share: the map, the camera, and the keyframes of a replayed log with image, compass
// and truth.
#pragma once

#include <filesystem>
#include <functional>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "common/geo/enu_frame.h"
#include "orthonav/image_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "services/map_server/map_builder.h"
#include "services/registration/types.h"

namespace orthonav::registration {

struct Truth {
  Eigen::Vector3d p_G;         // m
  Eigen::Vector2d map_offset;  // m, east and north
  double heading;              // rad
};

// A map as registration holds it.
struct BenchMap {
  EnuFrame frame;
  MapGeometry geometry;
  MapFeatures features;
  int64_t num_features = 0;
};

// `size`: of the keypoints, map pixels; 0: as map_server.yaml has it. Throws as prepare_map does.
BenchMap load_map(const std::filesystem::path& map, const std::filesystem::path& config, map_server::FeatureKind kind,
                  double size);

struct BenchAircraft {
  CameraModel camera;
  double declination;  // rad
};

BenchAircraft load_bench_aircraft(const std::filesystem::path& config);

struct BenchKeyframe {
  const vio_keyframe_t& message;
  Heading heading;  // of the compass
  Truth truth;
  // Null where no images were asked for.
  const image_t* image;
};

// Each keyframe of the log once, in order; those without image, compass or truth are left out.
void for_each_keyframe(const std::filesystem::path& log, const EnuFrame& frame, double declination, bool with_images,
                       const std::function<void(const BenchKeyframe&)>& visit);

}  // namespace orthonav::registration
