#include "services/registration/paper/pose.h"

#include <algorithm>
#include <cmath>

#include <opencv2/calib3d.hpp>
#include <opencv2/core.hpp>
#include <opencv2/core/eigen.hpp>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

// A residual is never believed to be better than this, pixels: few points can fit by chance.
constexpr double kMinPixelStddev = 0.3;

}  // namespace

std::optional<PnpResult> solve_pnp(const std::vector<Eigen::Vector2d>& rays,
                                   const std::vector<Eigen::Vector3d>& points_G, double focal,
                                   const CameraPose& guess) {
  if (rays.size() != points_G.size() || rays.size() < 6) return std::nullopt;
  // Coordinates of the map may be kilometres: solve about the points' mean.
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& point : points_G) centre += point / static_cast<double>(points_G.size());
  std::vector<cv::Point3d> object;
  std::vector<cv::Point2d> image;
  for (size_t i = 0; i < rays.size(); ++i) {
    const Eigen::Vector3d point = points_G[i] - centre;
    object.emplace_back(point.x(), point.y(), point.z());
    image.emplace_back(focal * rays[i].x(), focal * rays[i].y());
  }
  const cv::Matx33d intrinsics(focal, 0, 0, 0, focal, 0, 0, 0, 1);
  const Eigen::Matrix3d R_C_G_guess = guess.R_G_C.transpose();
  const Eigen::Vector3d t_guess = -R_C_G_guess * (guess.p_G_C - centre);
  cv::Mat R_guess;
  cv::eigen2cv(R_C_G_guess, R_guess);
  cv::Mat rvec;
  cv::Rodrigues(R_guess, rvec);
  cv::Mat tvec = (cv::Mat_<double>(3, 1) << t_guess.x(), t_guess.y(), t_guess.z());
  if (!cv::solvePnP(object, image, intrinsics, cv::noArray(), rvec, tvec, true, cv::SOLVEPNP_ITERATIVE)) {
    return std::nullopt;
  }
  cv::Mat R_solved;
  cv::Rodrigues(rvec, R_solved);
  Eigen::Matrix3d R_C_G;
  Eigen::Vector3d t_C_G;
  cv::cv2eigen(R_solved, R_C_G);
  cv::cv2eigen(tvec, t_C_G);
  if (!R_C_G.allFinite() || !t_C_G.allFinite()) return std::nullopt;

  PnpResult result;
  result.pose.R_G_C = R_C_G.transpose();
  result.pose.p_G_C = centre - result.pose.R_G_C * t_C_G;
  Eigen::Matrix<double, 6, 6> information = Eigen::Matrix<double, 6, 6>::Zero();
  double sum = 0;
  for (size_t i = 0; i < rays.size(); ++i) {
    const Eigen::Vector3d p_C = R_C_G * (points_G[i] - centre) + t_C_G;
    if (!(p_C.z() > 0.1)) return std::nullopt;
    sum += focal * focal * (p_C.hnormalized() - rays[i]).squaredNorm();
    Eigen::Matrix<double, 2, 3> projection;
    projection << focal / p_C.z(), 0, -focal * p_C.x() / (p_C.z() * p_C.z()),  //
        0, focal / p_C.z(), -focal * p_C.y() / (p_C.z() * p_C.z());
    // p_C = Exp(e) R_C_G (P - p_G_C): columns are the position in G, then e.
    Eigen::Matrix<double, 3, 6> point;
    point << -R_C_G, -skew(p_C);
    const Eigen::Matrix<double, 2, 6> jacobian = projection * point;
    information += jacobian.transpose() * jacobian;
  }
  const double degrees = std::max(1.0, 2.0 * static_cast<double>(rays.size()) - 6.0);
  const double variance = std::max(kMinPixelStddev * kMinPixelStddev, sum / degrees);
  const Eigen::FullPivLU<Eigen::Matrix<double, 6, 6>> solver(information);
  if (!solver.isInvertible()) return std::nullopt;
  result.position_covariance = (variance * solver.inverse()).topLeftCorner<3, 3>();
  result.rms = std::sqrt(sum / static_cast<double>(rays.size()));
  return result;
}

double tilt_difference(const Eigen::Matrix3d& R_G_C_a, const Eigen::Matrix3d& R_G_C_b) {
  // The third row is the direction of up in C.
  return std::acos(std::clamp(R_G_C_a.row(2).dot(R_G_C_b.row(2)), -1.0, 1.0));
}

}  // namespace orthonav::registration
