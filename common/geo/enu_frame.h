// East-north-up frames tangent to the WGS84 ellipsoid.
#pragma once

#include <Eigen/Core>
#include <GeographicLib/LocalCartesian.hpp>

namespace orthonav {

// A position on WGS84.
struct Geodetic {
  double latitude_deg = 0;
  double longitude_deg = 0;
  double height = 0;  // m above the ellipsoid
};

// The frame G of the design: local Cartesian, x east, y north, z up at the anchor. Exact at any distance
// (GeographicLib::LocalCartesian). Thread-safe after construction.
class EnuFrame {
 public:
  explicit EnuFrame(const Geodetic& anchor);

  const Geodetic& anchor() const { return anchor_; }
  Eigen::Vector3d to_enu(const Geodetic& position) const;  // m
  Geodetic to_geodetic(const Eigen::Vector3d& p_G) const;  // from m

  // Rotation from G to the east-north-up frame at a point of G: differs from identity by the curvature of the
  // Earth and the convergence of meridians.
  Eigen::Matrix3d R_local_G(const Eigen::Vector3d& p_G) const;

 private:
  Geodetic anchor_;
  GeographicLib::LocalCartesian local_;
};

// True heading from magnetic heading: the one place where declination is applied.
// All in rad, clockwise; declination positive east; result in [0, 2 pi).
double true_heading(double magnetic_heading, double declination);

}  // namespace orthonav
