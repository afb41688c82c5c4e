// A folder of georeferenced photos, as orthonav-evaluate-registration reads it (README.md beside this file).
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/camera/camera_model.h"
#include "common/geo/enu_frame.h"
#include "common/geo/raster.h"

namespace orthonav::evaluate_registration {

struct Photo {
  std::filesystem::path image;
  Eigen::Vector2d en = Eigen::Vector2d::Zero();  // m in G: the camera, horizontally
  double height = 0;                             // m above the ground
  double heading = 0;                            // rad, true heading of the image's up direction, clockwise
  double pitch = 0, roll = 0;                    // rad, nose up and right wing down positive
  std::string problem;                           // why the row cannot be used; empty when it can
};

struct PhotoFolder {
  CameraModel camera;
  std::vector<Photo> photos;  // in the file's order
};

// Rotation of a body with x along the image's up direction, y left, z up, to axes along east, north, up.
Eigen::Quaterniond q_G_B(const Photo& photo);

// Reads metadata.csv and camera.yaml. `frame` is that of the map; `map` its raster, null when there is only a database.
// Throws std::runtime_error naming file and line for a table that cannot be read; a row with values that are no numbers
// or out of range is kept with its problem.
PhotoFolder read_photos(const std::filesystem::path& folder, const EnuFrame& frame, const Raster* map);

}  // namespace orthonav::evaluate_registration
