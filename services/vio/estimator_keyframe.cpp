// What the estimator tells others of a keyframe.
#include <cmath>
#include <limits>

#include "common/math/so3.h"
#include "services/vio/estimator.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {

void Estimator::publish_keyframe() {
  Frame& newest = *frames_.back();
  newest.keyframe_id = next_keyframe_id_++;
  Keyframe keyframe;
  keyframe.utime = newest.utime;
  keyframe.id = newest.keyframe_id;
  keyframe.state = newest.state;
  keyframe.height_above_ground = height_;
  keyframe.relative_covariance.setConstant(std::numeric_limits<double>::quiet_NaN());
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || !landmark.has_depth || landmark.observations.size() < 2) continue;
    const Observation& anchor = landmark.anchor();
    const Observation& here = landmark.observations.back();
    const StateValues& at = anchor.frame->state;
    KeyframeFeature feature;
    feature.id = id;
    feature.pixel = here.pixel;
    feature.ray_C = here.ray;
    feature.p_W = at.q() * (extrinsics_.R_B_C * anchor.ray / landmark.inverse_depth + extrinsics_.p_B_C) + at.p();
    feature.reprojection_error = landmark.reprojection_error;
    double information = 0;
    for (size_t k = 1; k < landmark.observations.size(); ++k) {
      const Observation& other = landmark.observations[k];
      ProjectionFactor::Jacobians J;
      if (ProjectionFactor::evaluate(anchor.ray, other.ray, extrinsics_, weight(), at.pose.data(),
                                     other.frame->state.pose.data(), landmark.inverse_depth, nullptr, &J)) {
        information += J.inverse_depth.squaredNorm();
      }
    }
    feature.depth_stddev = 1.0 / (std::sqrt(information) * landmark.inverse_depth * landmark.inverse_depth);
    keyframe.features.push_back(feature);
  }

  const Frame& previous = *frames_[frames_.size() - 2];
  const NormalEquations equations = normal_equations();
  const Eigen::MatrixXd joint =
      equations.pose_covariance({equations.pose_offset(previous), equations.pose_offset(newest)});
  if (joint.size() > 0) {
    const Eigen::Matrix3d R_prev = previous.state.q().toRotationMatrix();
    const Eigen::Matrix3d R_new = newest.state.q().toRotationMatrix();
    // To a rotation vector in W: R_hat Exp(e) = Exp(R_hat e) R_hat.
    Eigen::Matrix<double, 6, 6> to_world = Eigen::Matrix<double, 6, 6>::Identity();
    to_world.bottomRightCorner<3, 3>() = R_new;
    pose_covariance_ = to_world * joint.bottomRightCorner<6, 6>() * to_world.transpose();
    if (previous.keyframe_id == keyframe.id - 1 && previous.keyframe_id >= 0) {
      Eigen::Matrix<double, 6, 12> J = Eigen::Matrix<double, 6, 12>::Zero();
      J.block<3, 3>(0, 0) = -R_prev.transpose();
      J.block<3, 3>(0, 3) = skew(R_prev.transpose() * (newest.state.p() - previous.state.p()));
      J.block<3, 3>(0, 6) = R_prev.transpose();
      J.block<3, 3>(3, 3) = -R_new.transpose() * R_prev;
      J.block<3, 3>(3, 9).setIdentity();
      keyframe.relative_covariance = J * joint * J.transpose();
    }
  }
  published_ = std::move(keyframe);
}

}  // namespace orthonav::vio
