#include "services/registration/image_similarity.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <fmt/format.h>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

// Sides of the turned image, pixels: smaller cannot hold a descriptor, larger means a height that is far off.
constexpr double kMinSide = 32;
constexpr double kMaxSide = 6000;

Eigen::Matrix2d rotation2(double angle) {
  return Eigen::Rotation2Dd(angle).toRotationMatrix();
}

}  // namespace

QueryOptions QueryOptions::from_config(ConfigNode& node) {
  QueryOptions options;
  ConfigNode query = node.child_or_empty("query");
  query.read("max_reprojection_error", options.max_reprojection_error, 0, 100);
  query.read("min_points", options.min_points, 6, 10000);
  double max_tilt_deg = options.max_tilt * 180 / M_PI;
  query.read("max_tilt_deg", max_tilt_deg, 0, 80);
  options.max_tilt = max_tilt_deg * M_PI / 180;
  query.finish();
  return options;
}

bool usable(const TrackedPoint& point) {
  return point.pixel.allFinite() && point.ray_C.allFinite() && point.p_W.allFinite() && point.ray_C.z() > 1e-6 &&
         std::isfinite(point.reprojection_error);
}

std::string reason_to_refuse(const Keyframe& keyframe, const cv::Mat& image, const CameraModel& camera,
                             double true_heading) {
  if (!keyframe.p_W_B.allFinite() || !keyframe.q_W_B.coeffs().allFinite() ||
      std::abs(keyframe.q_W_B.norm() - 1.0) > 1e-3) {
    return "pose of the keyframe is not finite or no rotation";
  }
  if (!keyframe.extrinsics.p_B_C.allFinite() || !keyframe.extrinsics.R_B_C.allFinite()) {
    return "extrinsics of the keyframe are not finite";
  }
  if (!(keyframe.height_above_ground > 0) || !std::isfinite(keyframe.height_above_ground)) {
    return fmt::format("height above ground is {}", keyframe.height_above_ground);
  }
  if (!std::isfinite(true_heading)) return "heading is not a number";
  if (image.empty() || image.type() != CV_8UC1) return "no grey image";
  if (image.cols != camera.width() || image.rows != camera.height()) {
    return fmt::format("image is {} x {}, the camera {} x {}", image.cols, image.rows, camera.width(), camera.height());
  }
  return {};
}

Eigen::Matrix3d rotation_G_W(const Eigen::Quaterniond& q_W_B, double true_heading) {
  // Headings run clockwise, rotations about z counter-clockwise.
  const double yaw = wrap_angle(heading_of(q_W_B) - true_heading);
  return Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
}

Eigen::Vector2d ImageSimilarity::apply(const Eigen::Vector2d& xy) const {
  return scale * (rotation2(angle) * xy) + origin;
}

Eigen::Vector2d ImageSimilarity::invert(const Eigen::Vector2d& pixel) const {
  return rotation2(-angle) * (pixel - origin) / scale;
}

ImageSimilarity view_similarity(const CameraModel& camera, const Eigen::Matrix3d& R_G_C, double height,
                                double metres_per_pixel, double max_tilt) {
  const Eigen::Vector3d axis = R_G_C.col(2);
  if (!(-axis.z() > std::cos(max_tilt))) {
    throw std::invalid_argument(fmt::format("camera looks {:.0f} degrees from the vertical",
                                            std::acos(std::clamp(-axis.z(), -1.0, 1.0)) * 180.0 / M_PI));
  }
  // A ray r through (x, y) meets the ground at height * r_xy / -r_z: the derivative at the centre, in (east, south).
  Eigen::Matrix2d ground;
  for (int i = 0; i < 2; ++i) {
    const Eigen::Vector3d r = R_G_C.col(i);
    const Eigen::Vector2d en = r.head<2>() / -axis.z() + axis.head<2>() * r.z() / (axis.z() * axis.z());
    ground.col(i) = Eigen::Vector2d(en.x(), -en.y());
  }
  ImageSimilarity similarity;
  similarity.scale = height / metres_per_pixel;  // s of equation (5) is focal / scale
  similarity.angle = std::atan2(ground(1, 0) - ground(0, 1), ground(0, 0) + ground(1, 1));

  Eigen::Vector2d low(1e300, 1e300);
  Eigen::Vector2d high = -low;
  constexpr int kSteps = 8;
  for (int i = 0; i <= kSteps; ++i) {
    const double u = (camera.width() - 1.0) * i / kSteps;
    const double v = (camera.height() - 1.0) * i / kSteps;
    for (const Eigen::Vector2d& pixel : {Eigen::Vector2d(u, 0), Eigen::Vector2d(u, camera.height() - 1.0),
                                         Eigen::Vector2d(0, v), Eigen::Vector2d(camera.width() - 1.0, v)}) {
      const auto ray = camera.unproject(pixel);
      if (!ray) continue;
      const Eigen::Vector2d corner = similarity.apply(ray->head<2>());
      low = low.cwiseMin(corner);
      high = high.cwiseMax(corner);
    }
  }
  const Eigen::Vector2d size = high - low;
  if (!(size.minCoeff() >= kMinSide && size.maxCoeff() <= kMaxSide)) {
    throw std::invalid_argument(fmt::format("image would be {:.0f} x {:.0f} map pixels from {:.1f} m above ground",
                                            size.x(), size.y(), height));
  }
  similarity.origin = -low;
  similarity.size = cv::Size(static_cast<int>(std::ceil(size.x())) + 1, static_cast<int>(std::ceil(size.y())) + 1);
  return similarity;
}

}  // namespace orthonav::registration
