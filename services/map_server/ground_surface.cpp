#include "services/map_server/ground_surface.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "common/math/statistics.h"

namespace orthonav::map_server {
namespace {

constexpr int kPatchSteps = 16;
constexpr double kMaxHeld = 4e6;  // heights of a model held at once: 16 MB

}  // namespace

GroundSurface::GroundSurface(double height) : reference_height_(height) {}

GroundSurface::GroundSurface(const std::filesystem::path& model, const std::vector<Geodetic>& area)
    : reference_height_(0), model_(std::make_unique<Raster>(model)) {
  const std::string no_data = model.string() + ": the elevation model has no data in the map's area";
  all_.window = window_around(area);
  if (all_.window.empty()) throw std::runtime_error(no_data);
  const double thinning =
      std::max(1.0, std::sqrt(static_cast<double>(all_.window.width) * all_.window.height / kMaxHeld));
  const cv::Size size(static_cast<int>(std::ceil(all_.window.width / thinning)),
                      static_cast<int>(std::ceil(all_.window.height / thinning)));
  all_.step_u = static_cast<double>(all_.window.width) / size.width;
  all_.step_v = static_cast<double>(all_.window.height) / size.height;
  all_.values = model_->sample_float(all_.window, size);
  std::vector<double> known;
  for (int v = 0; v < all_.values.rows; ++v) {
    for (int u = 0; u < all_.values.cols; ++u) {
      const double height = all_.values.at<float>(v, u);
      if (std::isfinite(height)) known.push_back(height);
    }
  }
  if (known.empty()) throw std::runtime_error(no_data);
  reference_height_ = median(std::move(known));
}

cv::Rect GroundSurface::window_around(const std::vector<Geodetic>& area) const {
  Eigen::Array2d low(1e300, 1e300);
  Eigen::Array2d high = -low;
  for (const Geodetic& position : area) {
    const Eigen::Array2d pixel = model_->geodetic_to_pixel(position).array();
    low = low.min(pixel);
    high = high.max(pixel);
  }
  low = (low.floor() - 2).max(0);
  high = (high.ceil() + 3).min(Eigen::Array2d(model_->width(), model_->height()));
  if (!(low < high).all()) return {};
  return {cv::Point(static_cast<int>(low.x()), static_cast<int>(low.y())),
          cv::Point(static_cast<int>(high.x()), static_cast<int>(high.y()))};
}

void GroundSurface::focus(const std::vector<Geodetic>& area) {
  if (!model_ || (all_.step_u <= 1 && all_.step_v <= 1)) return;
  near_ = {};
  near_.window = window_around(area);
  if (!near_.window.empty()) near_.values = model_->read_float(near_.window);
}

double GroundSurface::Heights::at(const Eigen::Vector2d& pixel) const {
  const Eigen::Vector2d place((pixel.x() - window.x + 0.5) / step_u - 0.5, (pixel.y() - window.y + 0.5) / step_v - 0.5);
  if (!(place.x() > -1 && place.y() > -1 && place.x() < values.cols && place.y() < values.rows)) {
    return std::numeric_limits<double>::quiet_NaN();
  }
  const int u = static_cast<int>(std::floor(place.x()));
  const int v = static_cast<int>(std::floor(place.y()));
  const double a = place.x() - u;
  const double b = place.y() - v;
  const auto value = [&](int du, int dv) {
    return values.at<float>(std::clamp(v + dv, 0, values.rows - 1), std::clamp(u + du, 0, values.cols - 1));
  };
  return (1 - b) * ((1 - a) * value(0, 0) + a * value(1, 0)) + b * ((1 - a) * value(0, 1) + a * value(1, 1));
}

Eigen::Vector2d GroundSurface::pixel_of(const Geodetic& position) const {
  return model_ ? model_->geodetic_to_pixel(position) : Eigen::Vector2d::Zero();
}

double GroundSurface::height_at(const Eigen::Vector2d& pixel) const {
  if (!model_) return reference_height_;
  if (near_.window.contains(
          cv::Point(static_cast<int>(std::floor(pixel.x())), static_cast<int>(std::floor(pixel.y()))))) {
    return near_.at(pixel);
  }
  return all_.at(pixel);
}

Geodetic GroundSurface::at(const Geodetic& position) const {
  const double height = height_at(pixel_of(position));
  return {position.latitude_deg, position.longitude_deg, std::isfinite(height) ? height : reference_height_};
}

GroundPoint GroundSurface::below(const EnuFrame& frame, const Eigen::Vector2d& en) const {
  // G's vertical leans by the distance over the Earth's radius, so latitude and longitude depend on the height,
  // weakly: each step shrinks the error by far more than the slope of any terrain.
  constexpr double kEnough = 1e-3, kEarthRadius = 6.4e6;  // m; sideways, by an error of the height
  GroundPoint ground;
  for (int i = 0; i < 4; ++i) {
    ground.position = frame.to_geodetic({en.x(), en.y(), ground.up});
    const double height = height_at(pixel_of(ground.position));
    ground.known = std::isfinite(height);
    const double error = (ground.known ? height : reference_height_) - ground.position.height;
    ground.up += error;
    ground.position.height += error;
    if (std::abs(error) * en.norm() < kEnough * kEarthRadius) break;
  }
  return ground;
}

GroundPatch::GroundPatch(const GroundSurface& surface, const EnuFrame& frame, const Eigen::Vector2d& south_west,
                         const Eigen::Vector2d& north_east)
    : surface_(&surface), south_west_(south_west), spacing_((north_east - south_west) / kPatchSteps) {
  for (int row = 0; row <= kPatchSteps; ++row) {
    for (int column = 0; column <= kPatchSteps; ++column) {
      const GroundPoint ground = surface.below(frame, south_west + spacing_.cwiseProduct(Eigen::Vector2d(column, row)));
      const Eigen::Vector2d pixel = surface.pixel_of(ground.position);
      nodes_.emplace_back(pixel.x(), pixel.y(), ground.position.height - ground.up);
    }
  }
}

std::optional<double> GroundPatch::up(const Eigen::Vector2d& en) const {
  const Eigen::Vector2d place = (en - south_west_).cwiseQuotient(spacing_);
  const int column = std::clamp(static_cast<int>(place.x()), 0, kPatchSteps - 1);
  const int row = std::clamp(static_cast<int>(place.y()), 0, kPatchSteps - 1);
  const double a = place.x() - column, b = place.y() - row;
  const Eigen::Vector3d* node = &nodes_[static_cast<size_t>(row * (kPatchSteps + 1) + column)];
  const Eigen::Vector3d* above = node + kPatchSteps + 1;
  const Eigen::Vector3d between = (1 - b) * ((1 - a) * node[0] + a * node[1]) + b * ((1 - a) * above[0] + a * above[1]);
  const double height = surface_->height_at(Eigen::Vector2d(between.head<2>()));
  if (!std::isfinite(height)) return std::nullopt;
  return height - between.z();
}

}  // namespace orthonav::map_server
