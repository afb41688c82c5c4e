#include "tools/evaluate_registration/evaluation.h"

#include <chrono>
#include <cmath>
#include <optional>
#include <random>

#include <fmt/format.h>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "services/registration/paper/query.h"

namespace orthonav::evaluate_registration {
namespace {

using namespace registration;

struct Errors {
  double heading = 0;  // rad
  double scale = 1;
};

struct Picture {
  cv::Mat grey;
  Keyframe keyframe;
  std::string problem;
};

// W is G moved to the photo that is evaluated, and scaled by the odometry's error.
Picture picture_of(const Photo& photo, const Eigen::Vector2d& origin, const CameraModel& camera, const Errors& errors,
                   int num_corners) {
  Picture picture;
  picture.problem = photo.problem;
  if (!picture.problem.empty()) return picture;
  picture.grey = cv::imread(photo.image.string(), cv::IMREAD_GRAYSCALE);
  if (picture.grey.empty()) {
    picture.problem = "cannot read the image";
    return picture;
  }
  if (picture.grey.cols != camera.width() || picture.grey.rows != camera.height()) {
    picture.problem = fmt::format("image is {} x {}, the camera {} x {}", picture.grey.cols, picture.grey.rows,
                                  camera.width(), camera.height());
    return picture;
  }
  Keyframe& keyframe = picture.keyframe;
  keyframe.extrinsics.R_B_C << 0, -1, 0, -1, 0, 0, 0, 0, -1;
  keyframe.q_W_B = q_G_B(photo);
  keyframe.height_above_ground = errors.scale * photo.height;
  const Eigen::Vector2d en = errors.scale * (photo.en - origin);
  keyframe.p_W_B = {en.x(), en.y(), keyframe.height_above_ground};
  add_flat_ground(picture.grey, camera, num_corners, keyframe);
  return picture;
}

// Horizontal place of the body that a fix means, valid or not; nothing when it names none.
std::optional<Eigen::Vector2d> place_of(const Fix& fix, const Keyframe& keyframe, const Heading& heading, bool points) {
  if (fix.valid) return fix.p_G_B.head<2>();
  if (fix.num_candidates == 0 && !std::isfinite(fix.log_likelihood)) return std::nullopt;
  if (!points) {  // t of m1 and m2 is where the image's centre lies: step back along the optical axis
    const Eigen::Matrix3d R_G_B = rotation_G_W(keyframe.q_W_B, heading.value) * keyframe.q_W_B.toRotationMatrix();
    const Eigen::Vector3d axis = R_G_B * keyframe.extrinsics.R_B_C.col(2);
    return fix.translation + (keyframe.height_above_ground / axis.z() * axis).head<2>();
  }
  const double used = heading.value + (std::isfinite(fix.heading_correction) ? fix.heading_correction : 0);
  const double scale = std::isfinite(fix.scale) ? fix.scale : 1;
  return (rotation_G_W(keyframe.q_W_B, used) * (scale * keyframe.p_W_B)).head<2>() + fix.translation;
}

class Evaluator {
 public:
  Evaluator(const PhotoFolder& folder, const MapFeatures& map, const MapGeometry& geometry,
            const EvaluationOptions& options)
      : folder_(folder),
        options_(options),
        registrar_(options.registrar, folder.camera),
        submap_(options.submaps, folder.camera) {
    MapFeatures copy{map.positions, map.descriptors.clone()};
    options.submap ? submap_.set_map(std::move(copy), geometry) : registrar_.set_map(std::move(copy), geometry);
  }

  Outcome evaluate(size_t index, const Errors& errors) {
    const Photo& photo = folder_.photos[index];
    Outcome outcome;
    outcome.image = photo.image.filename().string();
    const Picture picture = picture_of(photo, photo.en, folder_.camera, errors, options_.corners);
    outcome.refused = picture.problem;
    if (!outcome.refused.empty()) return outcome;
    const Heading heading = heading_of_photo(photo, errors);
    if (options_.submap) remember_before(index, errors);
    const auto start = std::chrono::steady_clock::now();
    const Fix fix = options_.submap ? by_submap(picture, heading) : by_registrar(picture, heading);
    outcome.milliseconds = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
    outcome.accepted = fix.valid;
    outcome.refused = fix.reason;
    outcome.num_inliers = fix.num_inliers;
    const bool points = options_.submap || options_.registrar.method == MethodName::kPaper;
    if (const auto place = place_of(fix, picture.keyframe, heading, points)) outcome.error = (*place - photo.en).norm();
    return outcome;
  }

 private:
  Heading heading_of_photo(const Photo& photo, const Errors& errors) const {
    return {photo.heading + errors.heading, std::max(options_.heading_stddev, 0.01)};
  }

  // The photos before the one evaluated are keyframes of the same submap; each photo begins a new one, so that
  // nothing is known from the last.
  void remember_before(size_t index, const Errors& errors) {
    ++session_;
    for (int k = options_.keyframes - 1; k > 0; --k) {
      const auto back = static_cast<size_t>(k) * static_cast<size_t>(options_.spacing);
      if (back > index) continue;
      const Photo& photo = folder_.photos[index - back];
      const Picture picture = picture_of(photo, folder_.photos[index].en, folder_.camera, errors, options_.corners);
      if (picture.problem.empty()) {
        submap_.describe(picture.keyframe, session_, picture.grey, heading_of_photo(photo, errors));
      }
    }
  }

  Fix by_submap(const Picture& picture, const Heading& heading) {
    submap_.describe(picture.keyframe, session_, picture.grey, heading);
    submap_.search(std::nullopt);
    return submap_.solve();
  }

  Fix by_registrar(const Picture& picture, const Heading& heading) {
    const Query query = registrar_.describe(picture.keyframe, picture.grey, heading);
    return registrar_.solve(picture.keyframe, query, registrar_.match(query), heading);
  }

  const PhotoFolder& folder_;
  EvaluationOptions options_;
  Registrar registrar_;
  SubmapRegistrar submap_;
  int session_ = 0;
};

}  // namespace

void add_flat_ground(const cv::Mat& grey, const CameraModel& camera, int num_corners, Keyframe& keyframe) {
  const Eigen::Matrix3d R_W_C = keyframe.q_W_B * keyframe.extrinsics.R_B_C;
  std::vector<cv::Point2f> corners;
  cv::goodFeaturesToTrack(grey, corners, num_corners, 0.01, 20);
  for (size_t i = 0; i < corners.size(); ++i) {
    TrackedPoint point;
    point.id = static_cast<int64_t>(i);
    point.pixel = {corners[i].x, corners[i].y};
    const auto ray = camera.unproject(point.pixel);
    if (!ray) continue;
    point.ray_C = *ray;
    const Eigen::Vector3d direction = R_W_C * point.ray_C;
    if (!(direction.z() < -0.05)) continue;  // at the horizon
    point.p_W = keyframe.p_W_B - keyframe.p_W_B.z() / direction.z() * direction;
    keyframe.points.push_back(point);
  }
}

std::vector<Outcome> evaluate(const PhotoFolder& folder, const MapFeatures& map, const MapGeometry& geometry,
                              const EvaluationOptions& options) {
  Evaluator evaluator(folder, map, geometry, options);
  std::mt19937 random(options.seed);
  std::normal_distribution<double> normal;
  std::vector<Outcome> outcomes;
  for (size_t i = 0; i < folder.photos.size(); i += static_cast<size_t>(options.every)) {
    const double scale = 1 + options.scale_stddev * normal(random);
    outcomes.push_back(evaluator.evaluate(i, {options.heading_stddev * normal(random), scale}));
  }
  return outcomes;
}

}  // namespace orthonav::evaluate_registration
