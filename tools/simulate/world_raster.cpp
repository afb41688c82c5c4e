#include "tools/simulate/world_raster.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include <fmt/format.h>
#include <opencv2/imgproc.hpp>

#include "common/geo/raster.h"
#include "tools/simulate/world_map.h"

namespace orthonav::simulate {

namespace {

// Places of a grid in G on a raster's pixels, exact every kStep cells and interpolated in between.
class Resampler {
 public:
  Resampler(const Raster& raster, const EnuFrame& frame, double east_min, double north_max, double resolution,
            cv::Size size)
      : size_(size) {
    nodes_.create(size.height / kStep + 2, size.width / kStep + 2, CV_32FC2);
    double u_min = 1e12, u_max = -1e12, v_min = 1e12, v_max = -1e12;
    for (int j = 0; j < nodes_.rows; ++j) {
      for (int i = 0; i < nodes_.cols; ++i) {
        const Eigen::Vector3d p(east_min + (i * kStep + 0.5) * resolution, north_max - (j * kStep + 0.5) * resolution,
                                0);
        const Eigen::Vector2d pixel = raster.geodetic_to_pixel(frame.to_geodetic(p));
        u_min = std::min(u_min, pixel.x());
        u_max = std::max(u_max, pixel.x());
        v_min = std::min(v_min, pixel.y());
        v_max = std::max(v_max, pixel.y());
        nodes_.at<cv::Vec2f>(j, i) = {static_cast<float>(pixel.x()), static_cast<float>(pixel.y())};
      }
    }
    window_ = cv::Rect(static_cast<int>(std::floor(u_min)) - 2, static_cast<int>(std::floor(v_min)) - 2,
                       static_cast<int>(u_max - u_min) + 6, static_cast<int>(v_max - v_min) + 6);
    window_ &= cv::Rect(0, 0, raster.width(), raster.height());
    if (window_.empty())
      throw std::runtime_error(fmt::format("{}: lies outside the area of the map", raster.file().string()));
  }

  // The part of the raster that is needed.
  const cv::Rect& window() const { return window_; }

  // `image` is the raster's `window()`.
  cv::Mat operator()(const cv::Mat& image, int interpolation, const cv::Scalar& outside) const {
    cv::Mat result(size_, image.type());
    // In bands: cv::remap's places for the whole grid would take more memory than the grid.
    constexpr int kBand = 512;
    for (int first = 0; first < size_.height; first += kBand) {
      const int rows = std::min(kBand, size_.height - first);
      cv::Mat places(rows, size_.width, CV_32FC2);
      for (int v = 0; v < rows; ++v) {
        const int j = (first + v) / kStep;
        const float b = static_cast<float>((first + v) % kStep) / kStep;
        cv::Vec2f* row = places.ptr<cv::Vec2f>(v);
        for (int u = 0; u < size_.width; ++u) {
          const int i = u / kStep;
          const float a = static_cast<float>(u % kStep) / kStep;
          const cv::Vec2f upper = nodes_.at<cv::Vec2f>(j, i) * (1 - a) + nodes_.at<cv::Vec2f>(j, i + 1) * a;
          const cv::Vec2f lower = nodes_.at<cv::Vec2f>(j + 1, i) * (1 - a) + nodes_.at<cv::Vec2f>(j + 1, i + 1) * a;
          row[u] =
              upper * (1 - b) + lower * b - cv::Vec2f(static_cast<float>(window_.x), static_cast<float>(window_.y));
        }
      }
      cv::Mat band = result.rowRange(first, first + rows);
      cv::remap(image, band, places, cv::Mat(), interpolation, cv::BORDER_CONSTANT, outside);
    }
    return result;
  }

 private:
  static constexpr int kStep = 32;
  cv::Size size_;
  cv::Mat nodes_;
  cv::Rect window_;
};

// Grey of a raster on a grid in G, smoothed to the grid's resolution.
cv::Mat resample_grey(const std::filesystem::path& file, const EnuFrame& frame, double east_min, double north_max,
                      double resolution, cv::Size size) {
  const Raster raster(file);
  const Resampler resampler(raster, frame, east_min, north_max, resolution, size);
  cv::Mat image = raster.read_grey(resampler.window());
  const cv::Rect& window = resampler.window();
  const double own = raster.metres_per_pixel({window.x + window.width / 2.0, window.y + window.height / 2.0});
  const double coarser = (resolution * resolution - own * own) / 12;
  if (coarser > 0 && std::sqrt(coarser) > 0.2 * own) cv::GaussianBlur(image, image, {}, std::sqrt(coarser) / own);
  return resampler(image, cv::INTER_LINEAR, cv::Scalar(0));
}

// Holes take the height of the nearest known cell in their row, then of the row above.
void fill_holes(cv::Mat& height, double otherwise) {
  std::vector<float> previous(static_cast<size_t>(height.cols), static_cast<float>(otherwise));
  for (int v = 0; v < height.rows; ++v) {
    float* row = height.ptr<float>(v);
    for (int u = 0; u < height.cols; ++u) {
      if (std::isfinite(row[u])) continue;
      row[u] = u > 0 && v == 0 ? row[u - 1] : previous[static_cast<size_t>(u)];
    }
    std::copy(row, row + height.cols, previous.begin());
  }
}

}  // namespace

World make_raster_world(const WorldOptions& options, const RasterOptions& rasters,
                        const std::filesystem::path& map_file) {
  const MapArea area = map_area(options.map, rasters.area, options.anchor.height);
  World world{.frame = EnuFrame(area.corner), .surface = {}, .map_offset = [](const Eigen::Vector2d&) {
                return Eigen::Vector2d(0, 0);
              }};
  const Bounds map = map_bounds(options.map, world.frame, area.width, area.height);
  world.map_east_min = map.east_min;
  world.map_east_max = map.east_max;
  world.map_north_min = map.north_min;
  world.map_north_max = map.north_max;
  const double margin = options.margin;
  Surface& surface = world.surface;
  surface.east_min = map.east_min - margin;
  surface.north_max = map.north_max + margin;
  surface.resolution = options.resolution;
  const cv::Size size(static_cast<int>((map.east_max - map.east_min + 2 * margin) / options.resolution),
                      static_cast<int>((map.north_max - map.north_min + 2 * margin) / options.resolution));
  surface.luminance =
      resample_grey(rasters.ortho, world.frame, surface.east_min, surface.north_max, surface.resolution, size);
  if (rasters.surface.empty()) {
    surface.height = cv::Mat::zeros(size, CV_32F);
  } else {
    const Raster raster(rasters.surface);
    const Resampler resampler(raster, world.frame, surface.east_min, surface.north_max, surface.resolution, size);
    cv::Mat heights = raster.read_float(resampler.window());
    fill_holes(heights, options.anchor.height - rasters.surface_offset);
    heights += rasters.surface_offset - options.anchor.height;
    surface.height = resampler(heights, cv::INTER_LINEAR, cv::mean(heights));
  }
  // Bare ground: what an opening wider than houses and crowns leaves, which keeps slopes where they are.
  cv::Mat coarse, ground;
  const double cell = 5.0;
  cv::resize(surface.height, coarse, {}, options.resolution / cell, options.resolution / cell, cv::INTER_NEAREST);
  cv::morphologyEx(coarse, ground, cv::MORPH_OPEN, cv::getStructuringElement(cv::MORPH_ELLIPSE, {7, 7}));
  cv::GaussianBlur(ground, ground, {}, 2.0);
  world.ground_height = cv::mean(ground)[0];
  if (!map_file.empty()) {
    const double detail = 0.5 * options.map.resolution;
    Scene scene{map.east_min - 20, map.north_max + 20, detail, {}, {}};
    const cv::Size detail_size(static_cast<int>((map.east_max - map.east_min + 40) / detail),
                               static_cast<int>((map.north_max - map.north_min + 40) / detail));
    scene.image = resample_grey(rasters.map, world.frame, scene.east_min, scene.north_max, detail, detail_size);
    const MapSensor as_it_is{.blur = 0, .lean_deg = 0, .lean_wavelength = 0, .tint = 0, .noise = 0};
    write_map(map_file, options.map, as_it_is, world.frame, area.width, area.height, scene, world.map_offset, 0);
    std::filesystem::path dem = map_file;
    write_dem(
        dem.replace_extension(".dem.tif"), options.map, world.frame, map,
        [&](const Eigen::Vector2d& p) {
          const int u = std::clamp(static_cast<int>((p.x() - surface.east_min) / cell), 0, ground.cols - 1);
          const int v = std::clamp(static_cast<int>((surface.north_max - p.y()) / cell), 0, ground.rows - 1);
          return static_cast<double>(ground.at<float>(v, u));
        },
        0);
  }
  return world;
}

}  // namespace orthonav::simulate
