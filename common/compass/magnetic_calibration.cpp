#include "common/compass/magnetic_calibration.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <stdexcept>

#include <Eigen/Dense>
#include <fmt/format.h>

#include "common/config/config.h"
#include "common/math/angles.h"

namespace orthonav {

namespace {

constexpr size_t kFewestReadings = 50;
constexpr double kWidestGap = 40 * kDegree;
// Readings whose thinnest direction is thinner than this part of the thickest lie in a plane: a level turn.
constexpr double kThinnest = 0.25;
// What a turn on the ground cannot show: currents in flight, and the sensor's turn on its mount.
constexpr double kUnseenStddev = 2 * kDegree;

struct Ellipsoid {
  Eigen::VectorXd centre;
  Eigen::MatrixXd root;  // symmetric, determinant 1: root * (x - centre) has constant length
};

// Least squares of x'Ax + 2b'x = 1 over the columns of `points`, in coordinates of about unit size around their mean.
Ellipsoid fit_ellipsoid(const Eigen::MatrixXd& points) {
  const Eigen::Index n = points.rows(), terms = n * (n + 1) / 2 + n;
  const Eigen::VectorXd low = points.rowwise().minCoeff(), high = points.rowwise().maxCoeff();
  const Eigen::VectorXd middle = 0.5 * (low + high);
  const double scale = 0.5 * (high - low).maxCoeff();
  if (!(scale > 0)) throw std::runtime_error("the field does not change: is the magnetometer connected?");
  const Eigen::MatrixXd unit = (points.colwise() - middle) / scale;
  Eigen::MatrixXd design(points.cols(), terms);
  for (Eigen::Index i = 0; i < points.cols(); ++i) {
    Eigen::Index k = 0;
    for (Eigen::Index a = 0; a < n; ++a) {
      for (Eigen::Index b = a; b < n; ++b) design(i, k++) = (a == b ? 1.0 : 2.0) * unit(a, i) * unit(b, i);
    }
    for (Eigen::Index a = 0; a < n; ++a) design(i, k++) = 2 * unit(a, i);
  }
  const Eigen::VectorXd solution = design.colPivHouseholderQr().solve(Eigen::VectorXd::Ones(points.cols()));
  Eigen::MatrixXd A(n, n);
  Eigen::Index k = 0;
  for (Eigen::Index a = 0; a < n; ++a) {
    for (Eigen::Index b = a; b < n; ++b) A(a, b) = A(b, a) = solution(k++);
  }
  const Eigen::VectorXd centre = -A.ldlt().solve(solution.tail(n));
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(A);
  if (!(eigen.eigenvalues().minCoeff() > 1e-3 * eigen.eigenvalues().maxCoeff())) {
    throw std::runtime_error("the readings lie on no ellipsoid: turn the aircraft away from steel and currents");
  }
  const Eigen::VectorXd axes = eigen.eigenvalues().cwiseSqrt();
  const double size = std::pow(axes.prod(), 1.0 / static_cast<double>(n));
  return {middle + scale * centre,
          eigen.eigenvectors() * (axes / size).asDiagonal() * eigen.eigenvectors().transpose()};
}

// 1 sigma of the lengths, in parts of their mean.
double spread(const Eigen::MatrixXd& vectors) {
  const Eigen::VectorXd lengths = vectors.colwise().norm();
  const double mean = lengths.mean();
  return std::sqrt((lengths.array() - mean).square().mean()) / mean;
}

double covered(std::vector<double> headings) {
  std::sort(headings.begin(), headings.end());
  double widest = headings.front() + 2 * std::numbers::pi - headings.back();
  for (size_t i = 1; i < headings.size(); ++i) widest = std::max(widest, headings[i] - headings[i - 1]);
  return 2 * std::numbers::pi - widest;
}

}  // namespace

MagneticCalibration MagneticCalibration::load(const std::filesystem::path& file) {
  ConfigNode node = ConfigNode::load(file);
  std::vector<double> hard, soft;
  MagneticCalibration calibration;
  double stddev_deg = calibration.heading_stddev / kDegree;
  node.require("hard_iron", hard);
  node.require("soft_iron", soft);
  node.read("heading_stddev_deg", stddev_deg, 0.01, 180.0);
  if (hard.size() != 3) node.fail("hard_iron", "must have 3 numbers");
  if (soft.size() != 9) node.fail("soft_iron", "must have 9 numbers, row by row");
  node.finish();
  calibration.hard_iron = Eigen::Map<const Eigen::Vector3d>(hard.data());
  calibration.soft_iron = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(soft.data());
  calibration.heading_stddev = stddev_deg * kDegree;
  if (!(calibration.soft_iron.determinant() > 0)) node.fail("soft_iron", "must have a positive determinant");
  return calibration;
}

std::string MagneticCalibration::to_yaml(const std::string& comment) const {
  const auto& s = soft_iron;
  return fmt::format(
      "# {}\n"
      "hard_iron: [{:.6e}, {:.6e}, {:.6e}]   # T, in B\n"
      "# Row by row: corrected = soft_iron (reading - hard_iron).\n"
      "soft_iron: [{:.6f}, {:.6f}, {:.6f},\n            {:.6f}, {:.6f}, {:.6f},\n            {:.6f}, {:.6f}, {:.6f}]\n"
      "heading_stddev_deg: {:.2f}            # degrees, 1 sigma\n",
      comment, hard_iron.x(), hard_iron.y(), hard_iron.z(), s(0, 0), s(0, 1), s(0, 2), s(1, 0), s(1, 1), s(1, 2),
      s(2, 0), s(2, 1), s(2, 2), heading_stddev / kDegree);
}

CalibrationFit fit_calibration(const std::vector<Eigen::Vector3d>& readings, const std::vector<Eigen::Vector3d>& ups) {
  if (readings.size() != ups.size()) throw std::invalid_argument("one `up` is needed for each reading");
  if (readings.size() < kFewestReadings) {
    throw std::runtime_error(fmt::format("{} readings are too few, {} are needed", readings.size(), kFewestReadings));
  }
  const auto count = static_cast<Eigen::Index>(readings.size());
  Eigen::MatrixXd raw(3, count), level(2, count);
  for (Eigen::Index i = 0; i < count; ++i) {
    const auto k = static_cast<size_t>(i);
    raw.col(i) = readings[k];
    level.col(i) = (Eigen::Quaterniond::FromTwoVectors(ups[k], Eigen::Vector3d::UnitZ()) * readings[k]).head<2>();
  }
  const Eigen::MatrixXd centred = raw.colwise() - raw.rowwise().mean();
  const Eigen::Vector3d thickness = Eigen::JacobiSVD<Eigen::MatrixXd>(centred).singularValues();

  CalibrationFit fit;
  MagneticCalibration& calibration = fit.calibration;
  fit.full = thickness(2) > kThinnest * thickness(0);
  if (fit.full) {
    const Ellipsoid e = fit_ellipsoid(raw);
    calibration.hard_iron = e.centre;
    calibration.soft_iron = e.root;
    fit.residual = spread(e.root * (raw.colwise() - calibration.hard_iron));
    fit.raw_residual = spread(centred);
  } else {
    const Ellipsoid e = fit_ellipsoid(level);
    calibration.hard_iron = {e.centre(0), e.centre(1), 0};
    calibration.soft_iron.topLeftCorner<2, 2>() = e.root;
    fit.residual = spread(e.root * (level.colwise() - Eigen::Vector2d(e.centre)));
    fit.raw_residual = spread(level.colwise() - level.rowwise().mean());
  }
  std::vector<double> headings;
  for (size_t i = 0; i < readings.size(); ++i) {
    const double heading = magnetic_heading(calibration.correct(readings[i]), ups[i]);
    if (std::isfinite(heading)) headings.push_back(heading);
  }
  fit.coverage = headings.empty() ? 0 : covered(headings);
  if (fit.coverage < 2 * std::numbers::pi - kWidestGap) {
    throw std::runtime_error(
        fmt::format("headings cover {:.0f} degrees: a whole turn is needed", fit.coverage / kDegree));
  }
  // The length's noise across the field is the heading's noise.
  calibration.heading_stddev = std::hypot(fit.residual, kUnseenStddev);
  return fit;
}

double magnetic_heading(const Eigen::Vector3d& field_B, const Eigen::Vector3d& up_B) {
  const Eigen::Vector3d north = field_B - field_B.dot(up_B) * up_B;
  const Eigen::Vector3d ahead = Eigen::Vector3d::UnitX() - up_B.x() * up_B;
  if (!(north.norm() > 1e-3 * field_B.norm()) || !(ahead.norm() > 1e-3)) {
    return std::numeric_limits<double>::quiet_NaN();
  }
  const double heading = std::atan2(ahead.cross(north).dot(up_B), north.dot(ahead));
  return heading < 0 ? heading + 2 * std::numbers::pi : heading;
}

}  // namespace orthonav
