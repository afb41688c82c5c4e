#include "common/math/align.h"

#include <cmath>
#include <stdexcept>

#include <Eigen/Geometry>

namespace orthonav {

namespace {

using Points = std::vector<Eigen::Vector3d>;

void check_pairs(const Points& from, const Points& to, size_t minimum) {
  if (from.size() != to.size()) throw std::invalid_argument("alignment needs as many points on both sides");
  if (from.size() < minimum)
    throw std::invalid_argument("alignment needs at least " + std::to_string(minimum) + " pairs");
}

Eigen::Vector3d mean(const Points& points) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const auto& p : points) sum += p;
  return sum / static_cast<double>(points.size());
}

}  // namespace

Similarity align_umeyama(const Points& from, const Points& to, bool with_scale) {
  check_pairs(from, to, 3);
  const auto n = static_cast<Eigen::Index>(from.size());
  Eigen::Matrix3Xd a(3, n), b(3, n);
  for (Eigen::Index i = 0; i < n; ++i) {
    a.col(i) = from[static_cast<size_t>(i)];
    b.col(i) = to[static_cast<size_t>(i)];
  }
  const Eigen::Matrix4d T = Eigen::umeyama(a, b, with_scale);
  Similarity result;
  result.scale = with_scale ? std::cbrt(T.topLeftCorner<3, 3>().determinant()) : 1.0;
  result.R = T.topLeftCorner<3, 3>() / result.scale;
  result.t = T.topRightCorner<3, 1>();
  return result;
}

Similarity align_yaw_translation(const Points& from, const Points& to) {
  check_pairs(from, to, 2);
  const Eigen::Vector3d mean_from = mean(from), mean_to = mean(to);
  double sine = 0, cosine = 0;
  for (size_t i = 0; i < from.size(); ++i) {
    const Eigen::Vector3d a = from[i] - mean_from, b = to[i] - mean_to;
    cosine += a.x() * b.x() + a.y() * b.y();
    sine += a.x() * b.y() - a.y() * b.x();
  }
  Similarity result;
  result.R = Eigen::AngleAxisd(std::atan2(sine, cosine), Eigen::Vector3d::UnitZ()).toRotationMatrix();
  result.t = mean_to - result.R * mean_from;
  return result;
}

}  // namespace orthonav
