#include "services/registration/keyframe_message.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace orthonav::registration {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

Eigen::Quaterniond quaternion(const double* wxyz) {
  return {wxyz[0], wxyz[1], wxyz[2], wxyz[3]};
}

}  // namespace

Keyframe keyframe_of(const vio_keyframe_t& message) {
  Keyframe keyframe;
  keyframe.id = message.id;
  keyframe.p_W_B = Eigen::Vector3d(message.p_W_B);
  keyframe.q_W_B = quaternion(message.q_W_B);
  keyframe.extrinsics.p_B_C = Eigen::Vector3d(message.p_B_C);
  keyframe.extrinsics.R_B_C = quaternion(message.q_B_C).normalized().toRotationMatrix();
  keyframe.height_above_ground = message.height_above_ground;
  keyframe.scale_stddev = message.scale_stddev;
  for (const vio_feature_t& feature : message.features) {
    TrackedPoint point;
    point.id = feature.id;
    point.pixel = Eigen::Vector2d(feature.pixel[0], feature.pixel[1]);
    point.ray_C = Eigen::Vector3d(feature.ray_C);
    point.p_W = Eigen::Vector3d(feature.p_W);
    point.reprojection_error = feature.reprojection_error;
    keyframe.points.push_back(point);
  }
  return keyframe;
}

void fill_fix(const Fix& fix, const EnuFrame& frame, map_fix_t& out) {
  out.valid = fix.valid ? 1 : 0;
  out.reason = fix.reason;
  out.latitude_deg = out.longitude_deg = out.ellipsoidal_height = kNan;
  std::fill(std::begin(out.p_G_B), std::end(out.p_G_B), kNan);
  std::fill(std::begin(out.position_covariance), std::end(out.position_covariance), kNan);
  std::fill(std::begin(out.q_G_B), std::end(out.q_G_B), kNan);
  if (fix.valid) {
    const Geodetic position = frame.to_geodetic(fix.p_G_B);
    out.latitude_deg = position.latitude_deg;
    out.longitude_deg = position.longitude_deg;
    out.ellipsoidal_height = position.height;
    Eigen::Map<Eigen::Vector3d>(out.p_G_B) = fix.p_G_B;
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(out.position_covariance) = fix.covariance;
    out.q_G_B[0] = fix.q_G_B.w();
    out.q_G_B[1] = fix.q_G_B.x();
    out.q_G_B[2] = fix.q_G_B.y();
    out.q_G_B[3] = fix.q_G_B.z();
  }
  out.anchor_latitude_deg = frame.anchor().latitude_deg;
  out.anchor_longitude_deg = frame.anchor().longitude_deg;
  out.anchor_height = frame.anchor().height;
  out.translation[0] = fix.translation.x();
  out.translation[1] = fix.translation.y();
  out.num_query = fix.num_query;
  out.num_candidates = fix.num_candidates;
  out.num_inliers = fix.num_inliers;
  out.num_second_inliers = fix.num_second_inliers;
  out.scale = fix.scale;
  out.scale_stddev = fix.scale_stddev;
  out.heading_correction = fix.heading_correction;
  out.heading_correction_stddev = fix.heading_correction_stddev;
  out.height_stddev = fix.valid ? std::sqrt(fix.covariance(2, 2)) : kNan;
  out.log_likelihood = fix.log_likelihood;
  out.log_likelihood_ratio = fix.log_likelihood_ratio;
  out.search_radius = fix.search_radius;
  out.num_keyframes = fix.num_keyframes;
  out.log_odds = fix.log_odds;
  out.num_hypotheses = fix.num_hypotheses;
  const Upright upright = fix.valid ? fix.upright : Upright();
  Eigen::Map<Eigen::Vector3d>(out.upright_p_G_B) = upright.p_G_B;
  Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(out.upright_covariance) = upright.covariance;
  Eigen::Map<Eigen::Matrix<double, 3, 2, Eigen::RowMajor>>(out.upright_lever) = upright.lever;
  Eigen::Map<Eigen::Vector2d>(out.tilt) = upright.tilt;
  Eigen::Map<Eigen::Matrix<double, 2, 2, Eigen::RowMajor>>(out.tilt_covariance) = upright.tilt_covariance;
  out.matches.clear();
  for (const Pair& pair : fix.pairs) {
    map_match_t match{};
    match.feature_id = pair.feature_id;
    match.pixel[0] = static_cast<float>(pair.pixel.x());
    match.pixel[1] = static_cast<float>(pair.pixel.y());
    match.map_en[0] = static_cast<float>(pair.map_en.x());
    match.map_en[1] = static_cast<float>(pair.map_en.y());
    match.residual = static_cast<float>(pair.residual);
    out.matches.push_back(match);
  }
  out.num_matches = static_cast<int32_t>(out.matches.size());
}

}  // namespace orthonav::registration
