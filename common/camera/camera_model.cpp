#include "common/camera/camera_model.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <Eigen/Geometry>
#include <Eigen/LU>

#include "common/config/config.h"

namespace orthonav {

namespace {

[[noreturn]] void bad(const std::string& member, const std::string& what) {
  throw std::invalid_argument("camera parameter '" + member + "' " + what);
}

}  // namespace

void CameraParameters::validate() const {
  if (width <= 0) bad("width", "must be positive");
  if (height <= 0) bad("height", "must be positive");
  if (!(fx > 0) || !std::isfinite(fx)) bad("fx", "must be positive");
  if (!(fy > 0) || !std::isfinite(fy)) bad("fy", "must be positive");
  if (!(cx > -width && cx < 2 * width)) bad("cx", "lies far outside the image");
  if (!(cy > -height && cy < 2 * height)) bad("cy", "lies far outside the image");
  for (const double k : distortion) {
    if (!std::isfinite(k)) bad("distortion", "must be finite");
  }
}

CameraModel::CameraModel(const CameraParameters& parameters) : parameters_(parameters) {
  parameters_.validate();
}

CameraModel CameraModel::from_config(ConfigNode& node) {
  CameraParameters p;
  node.require("width", p.width);
  node.require("height", p.height);
  node.require("fx", p.fx);
  node.require("fy", p.fy);
  node.require("cx", p.cx);
  node.require("cy", p.cy);
  std::string model = "radtan";
  node.read("model", model);
  if (model == "equidistant") {
    p.model = LensModel::kEquidistant;
  } else if (model != "radtan") {
    node.fail("model", "must be radtan or equidistant, not '" + model + "'");
  }
  std::vector<double> distortion(4, 0.0);
  node.read("distortion", distortion);
  if (distortion.size() != 4) node.fail("distortion", "must have 4 numbers");
  std::copy(distortion.begin(), distortion.end(), p.distortion.begin());
  node.finish();
  try {
    return CameraModel(p);
  } catch (const std::invalid_argument& error) {
    node.fail("width", error.what());
  }
}

Eigen::Vector2d CameraModel::distort(const Eigen::Vector2d& xy, Eigen::Matrix2d* jacobian) const {
  const double x = xy.x(), y = xy.y(), r2 = x * x + y * y;
  const auto& k = parameters_.distortion;
  if (parameters_.model == LensModel::kRadtan) {
    const double radial = 1.0 + r2 * (k[0] + r2 * k[1]);
    if (jacobian != nullptr) {
      const double d = 2.0 * (k[0] + 2.0 * r2 * k[1]);  // d radial / d r2 times 2
      *jacobian << radial + x * x * d + 2 * k[2] * y + 6 * k[3] * x, x * y * d + 2 * k[2] * x + 2 * k[3] * y,
          x * y * d + 2 * k[2] * x + 2 * k[3] * y, radial + y * y * d + 6 * k[2] * y + 2 * k[3] * x;
    }
    return {x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y};
  }
  const double r = std::sqrt(r2);
  if (r < 1e-9) {
    if (jacobian != nullptr) jacobian->setIdentity();
    return xy;
  }
  const double theta = std::atan(r), t2 = theta * theta;
  const double theta_d = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
  const double scale = theta_d / r;
  if (jacobian != nullptr) {
    const double dtheta_d = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])));
    const double dscale_dr = (dtheta_d / (1 + r2) - scale) / r;
    *jacobian = scale * Eigen::Matrix2d::Identity() + dscale_dr / r * xy * xy.transpose();
  }
  return scale * xy;
}

std::optional<Eigen::Vector2d> CameraModel::project(const Eigen::Vector3d& p_C) const {
  if (!(p_C.z() > 1e-6 * p_C.norm())) return std::nullopt;
  const Eigen::Vector2d xy = p_C.head<2>() / p_C.z();
  Eigen::Matrix2d J;
  const Eigen::Vector2d d = distort(xy, &J);
  // Past the radius where the polynomial turns back, far points would fold into the image.
  if (J.determinant() <= 0 || J.trace() <= 0) return std::nullopt;
  return Eigen::Vector2d(parameters_.fx * d.x() + parameters_.cx, parameters_.fy * d.y() + parameters_.cy);
}

std::optional<Eigen::Vector3d> CameraModel::unproject(const Eigen::Vector2d& pixel) const {
  const Eigen::Vector2d target((pixel.x() - parameters_.cx) / parameters_.fx,
                               (pixel.y() - parameters_.cy) / parameters_.fy);
  Eigen::Vector2d xy = target;
  for (int i = 0; i < 30; ++i) {
    Eigen::Matrix2d J;
    const Eigen::Vector2d error = distort(xy, &J) - target;
    if (error.squaredNorm() < 1e-20) return Eigen::Vector3d(xy.x(), xy.y(), 1.0);
    const double determinant = J.determinant();
    if (!(determinant > 1e-6)) return std::nullopt;
    const Eigen::Vector2d step = J.inverse() * error;
    // A full Newton step may leave the invertible region of a strong lens: bound it.
    const double limit = 0.5 * (1.0 + xy.norm());
    xy -= step.norm() > limit ? Eigen::Vector2d(step * (limit / step.norm())) : step;
  }
  return std::nullopt;
}

bool CameraModel::contains(const Eigen::Vector2d& pixel, double margin) const {
  return pixel.x() >= margin && pixel.y() >= margin && pixel.x() <= width() - 1 - margin &&
         pixel.y() <= height() - 1 - margin;
}

Extrinsics Extrinsics::from_config(ConfigNode& node) {
  std::vector<double> p, R;
  node.require("p_B_C", p);
  node.require("R_B_C", R);
  if (p.size() != 3) node.fail("p_B_C", "must have 3 numbers");
  if (R.size() != 9) node.fail("R_B_C", "must have 9 numbers, row by row");
  Extrinsics e;
  e.p_B_C = Eigen::Vector3d(p[0], p[1], p[2]);
  const Eigen::Matrix3d raw = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(R.data());
  if (!((raw * raw.transpose() - Eigen::Matrix3d::Identity()).norm() < 1e-3) || raw.determinant() < 0) {
    node.fail("R_B_C", "is not a rotation matrix");
  }
  e.R_B_C = Eigen::Quaterniond(raw).normalized().toRotationMatrix();
  node.read("time_offset", e.time_offset, -1.0, 1.0);
  node.finish();
  return e;
}

}  // namespace orthonav
