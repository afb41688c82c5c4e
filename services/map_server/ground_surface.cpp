#include "services/map_server/ground_surface.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "common/math/statistics.h"

namespace orthonav::map_server {

GroundSurface::GroundSurface(double height) : reference_height_(height) {}

GroundSurface::GroundSurface(const std::filesystem::path& model, const std::vector<Geodetic>& area)
    : reference_height_(0), model_(std::make_unique<Raster>(model)) {
  Eigen::Array2d low(1e300, 1e300);
  Eigen::Array2d high = -low;
  for (const Geodetic& position : area) {
    const Eigen::Array2d pixel = model_->geodetic_to_pixel(position).array();
    low = low.min(pixel);
    high = high.max(pixel);
  }
  const Eigen::Array2d size(model_->width(), model_->height());
  low = (low.floor() - 2).max(0);
  high = (high.ceil() + 3).min(size);
  const std::string no_data = model.string() + ": the elevation model has no data in the map's area";
  if (!(low < high).all()) throw std::runtime_error(no_data);
  corner_ = cv::Point(static_cast<int>(low.x()), static_cast<int>(low.y()));
  heights_ = model_->read_float(cv::Rect(corner_, cv::Point(static_cast<int>(high.x()), static_cast<int>(high.y()))));
  std::vector<double> known;
  for (int v = 0; v < heights_.rows; ++v) {
    for (int u = 0; u < heights_.cols; ++u) {
      const double height = heights_.at<float>(v, u);
      if (std::isfinite(height)) known.push_back(height);
    }
  }
  if (known.empty()) throw std::runtime_error(no_data);
  reference_height_ = median(std::move(known));
}

double GroundSurface::height_at(const Geodetic& position) const {
  if (!model_) return reference_height_;
  const Eigen::Vector2d pixel = model_->geodetic_to_pixel(position) - Eigen::Vector2d(corner_.x, corner_.y);
  if (!(pixel.x() > -1 && pixel.y() > -1 && pixel.x() < heights_.cols && pixel.y() < heights_.rows)) {
    return std::numeric_limits<double>::quiet_NaN();
  }
  const int u = static_cast<int>(std::floor(pixel.x()));
  const int v = static_cast<int>(std::floor(pixel.y()));
  const double a = pixel.x() - u;
  const double b = pixel.y() - v;
  const auto value = [&](int du, int dv) {
    return heights_.at<float>(std::clamp(v + dv, 0, heights_.rows - 1), std::clamp(u + du, 0, heights_.cols - 1));
  };
  return (1 - b) * ((1 - a) * value(0, 0) + a * value(1, 0)) + b * ((1 - a) * value(0, 1) + a * value(1, 1));
}

Geodetic GroundSurface::at(const Geodetic& position) const {
  const double height = height_at(position);
  return {position.latitude_deg, position.longitude_deg, std::isfinite(height) ? height : reference_height_};
}

GroundPoint GroundSurface::below(const EnuFrame& frame, const Eigen::Vector2d& en) const {
  // G's vertical leans by the distance over the Earth's radius, so latitude and longitude depend on the height,
  // weakly: each step shrinks the error by far more than the slope of any terrain.
  double up = 0;
  double height = reference_height_;
  Geodetic position;
  for (int i = 0; i < 3; ++i) {
    position = frame.to_geodetic({en.x(), en.y(), up});
    height = height_at(position);
    up += (std::isfinite(height) ? height : reference_height_) - position.height;
  }
  return {frame.to_geodetic({en.x(), en.y(), up}), up, std::isfinite(height)};
}

}  // namespace orthonav::map_server
