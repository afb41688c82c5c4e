#include "services/vio/two_point.h"

#include <algorithm>
#include <cmath>
#include <cstdint>

#include <Eigen/Geometry>

namespace orthonav::vio {

std::vector<bool> two_point_inliers(const std::vector<Eigen::Vector3d>& rays_1,
                                    const std::vector<Eigen::Vector3d>& rays_2, const Eigen::Matrix3d& R_2_1,
                                    double threshold) {
  constexpr int kHypotheses = 60;
  const size_t n = rays_1.size();
  std::vector<bool> best(n, true);
  if (n < 8) return best;
  std::vector<Eigen::Vector3d> turned(n);
  std::vector<Eigen::Vector3d> normals(n);
  std::vector<bool> still(n);  // moved less than the threshold: an inlier of every direction
  std::vector<size_t> moving;
  for (size_t i = 0; i < n; ++i) {
    turned[i] = R_2_1 * rays_1[i];
    normals[i] = turned[i].cross(rays_2[i]);
    still[i] = turned[i].z() > 0 && (turned[i].head<2>() / turned[i].z() - rays_2[i].head<2>()).norm() < threshold;
    if (!still[i]) moving.push_back(i);
  }
  if (moving.size() < 3) {
    // Nothing moves: those few that do are not part of the scene.
    return still;
  }
  uint64_t state = 0x9E3779B97F4A7C15ULL;  // a fixed sequence, so that a replay repeats
  const auto draw = [&state](size_t below) {
    state = state * 6364136223846793005ULL + 1442695040888963407ULL;
    return static_cast<size_t>((state >> 33) % below);
  };
  size_t most = 0;
  std::vector<bool> inliers(n);
  for (int h = 0; h < kHypotheses; ++h) {
    const size_t a = moving[draw(moving.size())], b = moving[draw(moving.size())];
    const Eigen::Vector3d t = normals[a].cross(normals[b]);
    if (a == b || t.norm() < 1e-12) continue;
    const Eigen::Vector3d direction = t.normalized();
    size_t count = 0;
    for (size_t i = 0; i < n; ++i) {
      const Eigen::Vector3d line = direction.cross(turned[i]);
      const double distance = std::abs(line.dot(rays_2[i])) / std::max(1e-12, line.head<2>().norm());
      inliers[i] = still[i] || distance < threshold;
      count += inliers[i] ? 1 : 0;
    }
    if (count > most) {
      most = count;
      best = inliers;
    }
  }
  return best;
}

}  // namespace orthonav::vio
