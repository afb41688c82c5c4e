// The camera's pose from points that were put onto the map: equation (10).
#pragma once

#include <optional>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace orthonav::registration {

struct CameraPose {
  Eigen::Vector3d p_G_C = Eigen::Vector3d::Zero();  // m
  Eigen::Matrix3d R_G_C = Eigen::Matrix3d::Identity();
};

struct PnpResult {
  CameraPose pose;
  Eigen::Matrix3d position_covariance = Eigen::Matrix3d::Zero();  // m^2, of p_G_C, first order from the residuals
  double rms = 0;                                                 // pixels
};

// PnP by iterative minimisation of the reprojection error (OpenCV's Levenberg-Marquardt), started at `guess`.
// `rays` are undistorted image coordinates at z = 1, `points_G` in m, one for each ray; `focal` in pixels turns
// residuals into pixels. nullopt for fewer than 6 points, a solution behind the ground or one that is not finite.
std::optional<PnpResult> solve_pnp(const std::vector<Eigen::Vector2d>& rays,
                                   const std::vector<Eigen::Vector3d>& points_G, double focal, const CameraPose& guess);

// Angle between the vertical directions two attitudes give the camera, rad: what a wrong heading does not change.
double tilt_difference(const Eigen::Matrix3d& R_G_C_a, const Eigen::Matrix3d& R_G_C_b);

}  // namespace orthonav::registration
