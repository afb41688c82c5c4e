#include "common/geo/enu_frame.h"

#include <cmath>
#include <vector>

namespace orthonav {

EnuFrame::EnuFrame(const Geodetic& anchor)
    : anchor_(anchor), local_(anchor.latitude_deg, anchor.longitude_deg, anchor.height) {}

Eigen::Vector3d EnuFrame::to_enu(const Geodetic& position) const {
  Eigen::Vector3d p;
  local_.Forward(position.latitude_deg, position.longitude_deg, position.height, p.x(), p.y(), p.z());
  return p;
}

Geodetic EnuFrame::to_geodetic(const Eigen::Vector3d& p_G) const {
  Geodetic g;
  local_.Reverse(p_G.x(), p_G.y(), p_G.z(), g.latitude_deg, g.longitude_deg, g.height);
  return g;
}

Eigen::Matrix3d EnuFrame::R_local_G(const Eigen::Vector3d& p_G) const {
  // GeographicLib gives the rotation from the local frame at the anchor to geocentric coordinates and, through
  // Reverse, from east-north-up at the point to the anchor's frame: M, row-major, v_anchor = M v_point.
  double lat = 0, lon = 0, h = 0;
  std::vector<double> M(9);
  local_.Reverse(p_G.x(), p_G.y(), p_G.z(), lat, lon, h, M);
  return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(M.data()).transpose();
}

double true_heading(double magnetic_heading, double declination) {
  const double heading = std::fmod(magnetic_heading + declination, 2.0 * M_PI);
  return heading < 0 ? heading + 2.0 * M_PI : heading;
}

}  // namespace orthonav
