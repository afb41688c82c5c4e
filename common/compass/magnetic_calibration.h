// Hard and soft iron of an aircraft, and how to find them from a recorded turn.
//
// The magnetometer reads m = S^-1 B + h: h (hard iron) is the field of what is magnetised on board, S^-1 (soft iron)
// what the board's steel does to the Earth's. A turn draws an ellipsoid (level: an ellipse) around h; the fit is
// the linear least-squares quadric through the samples, S its symmetric root with determinant 1. A symmetric S leaves a
// constant turn of the sensor on its mount unseen: that, and what the fit cannot see (iron that moves, currents), is a
// constant error of the heading, which the mount's alignment or the declination has to take up.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace orthonav {

struct MagneticCalibration {
  Eigen::Vector3d hard_iron = Eigen::Vector3d::Zero();      // T, in B
  Eigen::Matrix3d soft_iron = Eigen::Matrix3d::Identity();  // S, no unit
  double heading_stddev = 0.05;                             // rad, 1 sigma of a heading made with it

  // The Earth's field in B, T, from a raw reading.
  Eigen::Vector3d correct(const Eigen::Vector3d& reading) const { return soft_iron * (reading - hard_iron); }

  // Reads `hard_iron` (3 numbers), `soft_iron` (9, row by row) and `heading_stddev_deg` of a compass.yaml. Throws
  // ConfigError with file and line.
  static MagneticCalibration load(const std::filesystem::path& file);
  // A compass.yaml that load() reads back, with `comment` at its head.
  std::string to_yaml(const std::string& comment) const;
};

struct CalibrationFit {
  MagneticCalibration calibration;
  bool full = false;        // all axes; false: a level turn, which shows only the horizontal ones
  double coverage = 0;      // rad, of the circle of headings, 2 pi less the widest gap
  double residual = 0;      // 1 sigma of the corrected field's length, in parts of it
  double raw_residual = 0;  // the same with nothing corrected but the mean
};

// Fits readings[i] (T, in B), taken when ups[i] (unit vector in B) was up. Needs a whole turn: throws
// std::runtime_error naming what is missing when fewer than 50 readings are there, when headings leave a gap of more
// than 40 degrees, or when the readings lie on no ellipsoid.
CalibrationFit fit_calibration(const std::vector<Eigen::Vector3d>& readings, const std::vector<Eigen::Vector3d>& ups);

// Magnetic heading of B's x axis, clockwise from magnetic north, rad in [0, 2 pi), from a corrected field and the unit
// vector up, both in B. NaN where the field is vertical or x is.
double magnetic_heading(const Eigen::Vector3d& field_B, const Eigen::Vector3d& up_B);

}  // namespace orthonav
