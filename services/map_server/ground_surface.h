// Height of the ground below a map: flat at one ellipsoidal height, or from an elevation model.
#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/geo/enu_frame.h"
#include "common/geo/raster.h"

namespace orthonav::map_server {

struct GroundPoint {
  Geodetic position;   // on the ground
  double up = 0;       // m in G
  bool known = false;  // false: the elevation model has no data there; the reference height was taken
};

// Not thread-safe.
class GroundSurface {
 public:
  // Flat ground, m above the ellipsoid.
  explicit GroundSurface(double height);

  // An elevation model of ellipsoidal heights, any raster. Bilinear. The part around `area` is held in memory, a large
  // one thinned out. Throws std::runtime_error naming the file when it cannot be read or has no data in the area.
  GroundSurface(const std::filesystem::path& model, const std::vector<Geodetic>& area);

  // Holds what lies around these points in full, where the model had to be thinned out. Throws as the constructor does.
  void focus(const std::vector<Geodetic>& area);

  bool has_model() const { return model_ != nullptr; }

  // The flat ground's height, or the median height of the (thinned out) model in the area: z = 0 of G.
  double reference_height() const { return reference_height_; }

  // `position` with the ground's height at its latitude and longitude.
  Geodetic at(const Geodetic& position) const;

  // The ground where G's east and north have these values.
  GroundPoint below(const EnuFrame& frame, const Eigen::Vector2d& en) const;

  // Of the model, if there is one: the pixel of a position, and the height at a pixel, NaN without data.
  Eigen::Vector2d pixel_of(const Geodetic& position) const;
  double height_at(const Eigen::Vector2d& pixel) const;

 private:
  // Part of the model: heights at every `step` pixels of its raster.
  struct Heights {
    cv::Rect window;
    double step_u = 1, step_v = 1;
    cv::Mat values;                                 // CV_32F, NaN without data
    double at(const Eigen::Vector2d& pixel) const;  // NaN outside
  };
  cv::Rect window_around(const std::vector<Geodetic>& area) const;
  double reference_height_;
  std::unique_ptr<Raster> model_;
  Heights all_;
  Heights near_;  // empty unless all_ is thinned out
};

// The same for many places of a small part of G, some kilometres wide: conversions are interpolated between nodes, to
// less than a millimetre. `surface` must outlive it, and stay focused on that part.
class GroundPatch {
 public:
  // Corners of the part, m in G.
  GroundPatch(const GroundSurface& surface, const EnuFrame& frame, const Eigen::Vector2d& south_west,
              const Eigen::Vector2d& north_east);

  // Height in G of the ground below a place of the part, m; nothing where the model has no data.
  std::optional<double> up(const Eigen::Vector2d& en) const;

 private:
  const GroundSurface* surface_;
  Eigen::Vector2d south_west_, spacing_;
  // By row from the south and column from the west: the model's pixel, and what a height above the ellipsoid is more
  // than one in G.
  std::vector<Eigen::Vector3d> nodes_;
};

}  // namespace orthonav::map_server
