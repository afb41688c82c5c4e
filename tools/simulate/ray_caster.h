// Perspective views of the world's surface: for every pixel the first point of the height field on its ray, so that
// buildings and relief give parallax and hide what lies behind them.
//
// Rays start below the highest ground that their tile of 16 x 16 pixels could see, skip cells whose highest point is
// below them and step texel by texel through the others. Luminance is interpolated trilinearly in the pyramid at the
// footprint of a pixel on the ground, so that a coarse view of a fine texture does not alias.
#pragma once

#include <array>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "tools/simulate/height_field.h"

namespace orthonav::simulate {

// Position and attitude of the camera.
struct CameraPose {
  Eigen::Vector3d p_G_C = Eigen::Vector3d::Zero();
  Eigen::Matrix3d R_G_C = Eigen::Matrix3d::Identity();
};

struct View {
  static constexpr int kNodeStep = 16;  // pixels between depth nodes

  cv::Mat luminance;  // CV_32F, 0..255, of the surface as lit, before any effect of the camera
  // CV_32F: depth below the camera, m along -z of G, at pixels (16 i, 16 j). NaN: sky.
  cv::Mat node_depth;
  double outside = 0;  // fraction of pixels that see no world: its border goes on there
};

// Immutable after construction; render() may be called from several threads. Keeps a reference to the field.
class RayCaster {
 public:
  // Throws std::invalid_argument when a pixel of the camera has no ray.
  RayCaster(const HeightField& field, const CameraModel& camera);

  View render(const CameraPose& pose) const { return render(std::vector<CameraPose>{pose}); }

  // As a rolling shutter sees it: one pose for each row of the image. Throws std::invalid_argument for another number
  // of poses, but one is for all rows.
  View render(const std::vector<CameraPose>& rows) const;

  // Bearing in C, z = 1, of a pixel.
  Eigen::Vector3d ray(int u, int v) const;

 private:
  struct Frame;
  // Pixels of the frame's level per m of depth; NaN: sky.
  using Slopes = std::array<Eigen::Vector2f, View::kNodeStep * View::kNodeStep>;

  void render_tile(const Frame& frame, const cv::Rect& tile, View& view, int64_t& outside) const;
  template <bool kInside>
  void shade_tile(const Frame& frame, const cv::Rect& tile, const Slopes& slopes, float begin, float end, View& view,
                  int64_t& outside) const;

  const HeightField& field_;
  int width_, height_;
  double focal_;
  std::vector<Eigen::Vector2f> rays_;  // x, y at z = 1
};

}  // namespace orthonav::simulate
