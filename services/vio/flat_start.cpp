#include "services/vio/flat_start.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

#include "services/vio/inertial_chain.h"

namespace orthonav::vio {
namespace {

constexpr double kLowest = 0.3;       // cosine of the angle from straight down up to which points are taken
constexpr size_t kFewestSights = 60;  // of points in frames beside their first
constexpr double kHuber = 3e-3;       // rad, of a bearing

struct Sight {
  size_t first, frame;     // indices of frames
  Eigen::Vector3d offset;  // of the point from the camera that saw it first, in B of the first frame, heights
  Eigen::Matrix<double, 2, 3> across;
  Eigen::Vector2d residual = Eigen::Vector2d::Zero();  // heights
};

// Where the cameras were in B of the first frame, less where the first was, in heights above the ground.
std::vector<Eigen::Vector3d> camera_way(std::vector<Sight>& sights, size_t num_frames) {
  const auto n = static_cast<Eigen::Index>(3 * num_frames);
  std::vector<Eigen::Vector3d> way(num_frames, Eigen::Vector3d::Zero());
  for (int iteration = 0; iteration < 4; ++iteration) {
    Eigen::MatrixXd A = 1e-9 * Eigen::MatrixXd::Identity(n, n);
    Eigen::VectorXd b = Eigen::VectorXd::Zero(n);
    A.topLeftCorner<3, 3>() += 1e9 * Eigen::Matrix3d::Identity();
    for (const Sight& sight : sights) {
      const double miss = sight.residual.norm();
      const double weight = miss > kHuber ? kHuber / miss : 1.0;
      const Eigen::Matrix3d M = weight * sight.across.transpose() * sight.across;
      const auto i = static_cast<Eigen::Index>(3 * sight.first), j = static_cast<Eigen::Index>(3 * sight.frame);
      A.block<3, 3>(i, i) += M;
      A.block<3, 3>(j, j) += M;
      A.block<3, 3>(i, j) -= M;
      A.block<3, 3>(j, i) -= M;
      b.segment<3>(j) += M * sight.offset;
      b.segment<3>(i) -= M * sight.offset;
    }
    const Eigen::VectorXd x = A.ldlt().solve(b);
    for (size_t k = 0; k < num_frames; ++k) way[k] = x.segment<3>(static_cast<Eigen::Index>(3 * k));
    for (Sight& sight : sights) {
      sight.residual = sight.across * (way[sight.first] + sight.offset - way[sight.frame]);
    }
  }
  return way;
}

}  // namespace

LinearStart solve_flat_start(const std::vector<Frame*>& frames, std::map<int64_t, Landmark>& landmarks,
                             const Extrinsics& extrinsics, double gravity, const Eigen::Vector3d& gyro_bias,
                             double focal) {
  LinearStart result;
  result.gyro_bias = gyro_bias;
  const std::vector<Inertial> chain = inertial_chain(frames, gyro_bias);
  // Up, as well as the mean specific force tells: good enough for the shape of the ground.
  const Eigen::Vector3d up = chain.back().beta.normalized();
  const auto ray_in_first = [&](size_t frame, const Eigen::Vector3d& ray) -> Eigen::Vector3d {
    return chain[frame].R * (extrinsics.R_B_C * ray);
  };
  const auto index_of = [&](const Observation& observation) {
    return static_cast<size_t>(std::find(frames.begin(), frames.end(), observation.frame) - frames.begin());
  };
  std::vector<Sight> sights;
  for (const auto& [id, landmark] : landmarks) {
    const size_t first = index_of(landmark.anchor());
    const Eigen::Vector3d ray = ray_in_first(first, landmark.anchor().ray);
    const double down = -up.dot(ray);
    if (down < kLowest * ray.norm()) continue;
    for (size_t k = 1; k < landmark.observations.size(); ++k) {
      const Observation& other = landmark.observations[k];
      const size_t frame = index_of(other);
      sights.push_back({first, frame, ray / down, across(ray_in_first(frame, other.ray).normalized())});
    }
  }
  if (sights.size() < kFewestSights) {
    result.reason = "too few features on the ground";
    return result;
  }
  const std::vector<Eigen::Vector3d> way = camera_way(sights, frames.size());
  double squares = 0;
  for (const Sight& sight : sights) squares += std::min(kHuber * kHuber, sight.residual.squaredNorm());
  result.residual = focal * std::sqrt(squares / static_cast<double>(2 * sights.size()));

  // h way = v t + g t^2 / 2 + alpha + (R - I) p_B_C in least squares; g is as long as it must be, about against `up`.
  using Vector7 = Eigen::Matrix<double, 7, 1>;
  Eigen::Vector3d g = -gravity * up;
  Vector7 x = Vector7::Zero();
  for (int iteration = 0; iteration < 5; ++iteration) {
    constexpr double kTurned = 1.0, kLength = 0.05;  // m/s^2, 1 sigma of gravity across and along itself
    constexpr double kMiss = 0.02;                   // m, of a frame's position
    Eigen::Matrix<double, 7, 7> A = Eigen::Matrix<double, 7, 7>::Zero();
    Vector7 b = Vector7::Zero();
    for (size_t k = 1; k < frames.size(); ++k) {
      const double t = chain[k].t;
      Eigen::Matrix<double, 3, 7> M;
      M << way[k], -t * Eigen::Matrix3d::Identity(), -0.5 * t * t * Eigen::Matrix3d::Identity();
      A += M.transpose() * M / (kMiss * kMiss);
      b += M.transpose() * (chain[k].alpha + (chain[k].R - Eigen::Matrix3d::Identity()) * extrinsics.p_B_C) /
           (kMiss * kMiss);
    }
    const Eigen::Vector3d along = g.normalized();
    const Eigen::Matrix3d information =
        Eigen::Matrix3d::Identity() / (kTurned * kTurned) + along * along.transpose() / (kLength * kLength);
    A.bottomRightCorner<3, 3>() += information;
    b.tail<3>() += information * gravity * along;
    x = A.ldlt().solve(b);
    if (!x.allFinite() || !(x.tail<3>().norm() > 1)) break;
    g = gravity * x.tail<3>().normalized();
  }
  const double height = x(0);
  if (!x.allFinite() || !(height > 0.1 && height < 1e4)) {
    result.reason = "no height above flat ground fits the motion";
    return result;
  }
  set_states(frames, chain, x.segment<3>(1), g, Eigen::Vector3d::Zero(), gyro_bias);
  for (auto& [id, landmark] : landmarks) {
    const size_t first = index_of(landmark.anchor());
    const Eigen::Vector3d ray = ray_in_first(first, landmark.anchor().ray);
    const double down = -up.dot(ray);
    landmark.has_depth = landmark.observations.size() >= 2 && down >= kLowest * ray.norm();
    if (landmark.has_depth) landmark.inverse_depth = down / height;
  }
  result.ok = true;
  return result;
}

}  // namespace orthonav::vio
