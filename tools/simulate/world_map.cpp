#include "tools/simulate/world_map.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <numbers>
#include <stdexcept>

#include <fmt/format.h>
#include <ogr_spatialref.h>
#include <opencv2/imgproc.hpp>

#include "common/geo/raster.h"
#include "common/math/angles.h"
#include "tools/simulate/world_random.h"

namespace orthonav::simulate {

namespace {

// A coordinate system, x to the east and y to the north, and WGS84.
class Projection {
 public:
  explicit Projection(const std::string& crs) : crs_(crs) {
    OGRSpatialReference map, geographic;
    if (map.SetFromUserInput(crs.c_str()) != OGRERR_NONE)
      throw std::runtime_error(fmt::format("map.crs: GDAL knows no coordinate system '{}'", crs));
    geographic.SetWellKnownGeogCS("WGS84");
    map.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
    geographic.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
    to_map_.reset(OGRCreateCoordinateTransformation(&geographic, &map));
    to_geographic_.reset(OGRCreateCoordinateTransformation(&map, &geographic));
    if (!to_map_ || !to_geographic_)
      throw std::runtime_error(fmt::format("map.crs: '{}' cannot be brought to WGS84", crs));
  }

  Eigen::Vector2d to_map(const Geodetic& p) const {
    Eigen::Vector2d xy(p.longitude_deg, p.latitude_deg);
    if (to_map_->Transform(1, &xy.x(), &xy.y()) == 0)
      throw std::runtime_error(
          fmt::format("map.crs: '{}' does not cover {:.4f}, {:.4f}", crs_, p.latitude_deg, p.longitude_deg));
    return xy;
  }
  Geodetic to_geodetic(Eigen::Vector2d xy) const {
    if (to_geographic_->Transform(1, &xy.x(), &xy.y()) == 0)
      throw std::runtime_error(
          fmt::format("map.crs: {:.1f}, {:.1f} in '{}' has no WGS84 position", xy.x(), xy.y(), crs_));
    return {xy.y(), xy.x(), 0};
  }

 private:
  std::string crs_;
  std::unique_ptr<OGRCoordinateTransformation> to_map_, to_geographic_;
};

// A raster's pixel grid in a coordinate system, its upper-left corner at a given place.
class MapGrid {
 public:
  MapGrid(const std::string& crs, const Geodetic& corner, double resolution, double width, double height)
      : size_(std::max(1, static_cast<int>(std::lround(width / resolution))),
              std::max(1, static_cast<int>(std::lround(height / resolution)))),
        projection_(crs) {
    const EnuFrame frame({corner.latitude_deg, corner.longitude_deg, 0});
    const auto to_map = [this](const Geodetic& p) { return projection_.to_map(p); };
    const Eigen::Vector2d origin = to_map(corner);
    // Units of the CRS per metre in the middle of the map.
    const Geodetic middle = frame.to_geodetic({width / 2, -height / 2, 0});
    const EnuFrame around({middle.latitude_deg, middle.longitude_deg, 0});
    const double unit_x =
        (to_map(around.to_geodetic({10, 0, 0})) - to_map(around.to_geodetic({-10, 0, 0}))).norm() / 20;
    const double unit_y =
        (to_map(around.to_geodetic({0, 10, 0})) - to_map(around.to_geodetic({0, -10, 0}))).norm() / 20;
    grid_.crs = crs;
    const double transform[6] = {origin.x(), resolution * unit_x, 0, origin.y(), 0, -resolution * unit_y};
    std::copy(std::begin(transform), std::end(transform), std::begin(grid_.transform));
  }

  const RasterGrid& grid() const { return grid_; }
  cv::Size size() const { return size_; }

  Geodetic geodetic(double u, double v, double height) const {
    const Geodetic p = projection_.to_geodetic(
        {grid_.transform[0] + grid_.transform[1] * (u + 0.5), grid_.transform[3] + grid_.transform[5] * (v + 0.5)});
    return {p.latitude_deg, p.longitude_deg, height};
  }

 private:
  cv::Size size_;
  RasterGrid grid_;
  Projection projection_;
};

// For every map pixel, where in the scene's image it was taken from.
cv::Mat source_pixels(const MapGrid& map, const MapSensor& sensor, const EnuFrame& frame, const Scene& scene,
                      const MapOffset& offset, uint64_t seed) {
  // Projection, offset and direction of view are smooth: exact on a coarse grid, interpolated in between.
  constexpr int kStep = 16;
  const cv::Size nodes(map.size().width / kStep + 2, map.size().height / kStep + 2);
  const double lean = std::tan(sensor.lean_deg * kDegree);
  const SmoothField view(mix(seed, "view"), lean, std::max(1.0, sensor.lean_wavelength));
  Random random(mix(seed, "lean"));
  const double azimuth = random.uniform(0, 2 * std::numbers::pi);
  cv::Mat place(nodes, CV_32FC2), slant(nodes, CV_32FC2);
  for (int j = 0; j < nodes.height; ++j) {
    for (int i = 0; i < nodes.width; ++i) {
      const Eigen::Vector2d shown = frame.to_enu(map.geodetic(i * kStep, j * kStep, frame.anchor().height)).head<2>();
      Eigen::Vector2d p = shown;
      for (int k = 0; k < 4; ++k) p = shown - offset(p);
      const Eigen::Vector2d s =
          sensor.lean_wavelength > 0 ? view(p) : Eigen::Vector2d(lean * std::cos(azimuth), lean * std::sin(azimuth));
      place.at<cv::Vec2f>(j, i) = {static_cast<float>((p.x() - scene.east_min) / scene.resolution - 0.5),
                                   static_cast<float>((scene.north_max - p.y()) / scene.resolution - 0.5)};
      slant.at<cv::Vec2f>(j, i) = {static_cast<float>(s.x() / scene.resolution),
                                   static_cast<float>(-s.y() / scene.resolution)};
    }
  }
  double highest = 0;
  if (!scene.above_ground.empty()) cv::minMaxLoc(scene.above_ground, nullptr, &highest);
  cv::Mat source(map.size(), CV_32FC2);
  for (int v = 0; v < source.rows; ++v) {
    cv::Vec2f* row = source.ptr<cv::Vec2f>(v);
    const int j = v / kStep;
    const float b = static_cast<float>(v % kStep) / kStep;
    for (int u = 0; u < source.cols; ++u) {
      const int i = u / kStep;
      const float a = static_cast<float>(u % kStep) / kStep;
      const auto at = [&](const cv::Mat& m) -> cv::Vec2f {
        return (m.at<cv::Vec2f>(j, i) * (1 - a) + m.at<cv::Vec2f>(j, i + 1) * a) * (1 - b) +
               (m.at<cv::Vec2f>(j + 1, i) * (1 - a) + m.at<cv::Vec2f>(j + 1, i + 1) * a) * b;
      };
      cv::Vec2f p = at(place);
      if (highest > 0) {
        // Down the line of sight: what stands h above the ground appears displaced by h times the slant.
        const cv::Vec2f s = at(slant);
        const double steps = std::ceil(highest * cv::norm(s));
        for (double k = steps; k > 0; --k) {
          const float h = static_cast<float>(highest * k / steps);
          const cv::Vec2f q = p - s * h;
          const int x = cvRound(q[0]), y = cvRound(q[1]);
          if (x < 0 || y < 0 || x >= scene.above_ground.cols || y >= scene.above_ground.rows) continue;
          if (scene.above_ground.at<float>(y, x) >= h) {
            p = q;
            break;
          }
        }
      }
      row[u] = p;
    }
  }
  return source;
}

void develop(cv::Mat& image, const MapSensor& sensor, uint64_t seed) {
  Random random(mix(seed, "develop"));
  cv::Mat real;
  image.convertTo(real, CV_32F);
  const cv::Scalar mean = cv::mean(real);
  const int channels = real.channels();
  double gain[3] = {1, 1, 1};
  if (channels == 3)
    for (double& g : gain) g += sensor.tint * random.normal();
  const size_t width = static_cast<size_t>(real.cols) * static_cast<size_t>(channels);
  if (sensor.sharpening > 0) {
    cv::Mat soft;
    cv::GaussianBlur(real, soft, {}, 1.0);
    cv::addWeighted(real, 1 + sensor.sharpening, soft, -sensor.sharpening, 0, real);
  }
  for (int v = 0; v < real.rows; ++v) {
    float* row = real.ptr<float>(v);
    for (size_t i = 0; i < width; ++i) {
      const size_t c = i % static_cast<size_t>(channels);
      const double level = std::max(0.0, static_cast<double>(row[i]) * gain[c]) / 255.0;
      const double noise =
          sensor.noise > 0 ? sensor.noise * 2.0 * (random.uniform() + random.uniform() + random.uniform() - 1.5) : 0;
      const double shown = 255.0 * std::pow(level, sensor.gamma);
      const double middle = 255.0 * std::pow(mean[static_cast<int>(c)] / 255.0, sensor.gamma);
      row[i] = static_cast<float>(middle + sensor.contrast * (shown - middle) + sensor.brightness + noise);
    }
  }
  real.convertTo(image, CV_8U);
}

}  // namespace

MapOffset make_map_offset(const MapOptions& options, const Bounds& area, uint64_t seed) {
  if (options.offset_rms <= 0) return [](const Eigen::Vector2d&) { return Eigen::Vector2d(0, 0); };
  Random random(mix(seed, "offset"));
  const double angle = random.uniform(0, 2 * std::numbers::pi);
  const Eigen::Vector2d bias = std::sqrt(options.bias_share) * Eigen::Vector2d(std::cos(angle), std::sin(angle));
  const SmoothField warp(mix(seed, "warp"), std::sqrt(0.5 * (1 - options.bias_share)), options.warp_wavelength);
  double sum = 0;
  constexpr int kNodes = 64;
  for (int j = 0; j < kNodes; ++j)
    for (int i = 0; i < kNodes; ++i)
      sum += (bias + warp({area.east_min + (area.east_max - area.east_min) * (i + 0.5) / kNodes,
                           area.north_min + (area.north_max - area.north_min) * (j + 0.5) / kNodes}))
                 .squaredNorm();
  const double scale = options.offset_rms / std::sqrt(sum / (kNodes * kNodes));
  return [=](const Eigen::Vector2d& p) -> Eigen::Vector2d { return scale * (bias + warp(p)); };
}

void write_map(const std::filesystem::path& file, const MapOptions& options, const MapSensor& sensor,
               const EnuFrame& frame, double width, double height, const Scene& scene, const MapOffset& offset,
               uint64_t seed) {
  const MapGrid map(options.crs, frame.anchor(), options.resolution, width, height);
  // Optics, and the area that a map pixel gathers over.
  const double spread = std::hypot(sensor.blur, options.resolution / std::sqrt(12.0)) / scene.resolution;
  cv::Mat soft, image;
  cv::GaussianBlur(scene.image, soft, {}, spread);
  cv::remap(soft, image, source_pixels(map, sensor, frame, scene, offset, seed), cv::Mat(), cv::INTER_LINEAR,
            cv::BORDER_REPLICATE);
  soft.release();
  develop(image, sensor, seed);
  if (!options.colour && image.channels() == 3) cv::cvtColor(image, image, cv::COLOR_BGR2GRAY);
  write_geotiff(file, image, map.grid(), options.jpeg_quality);
}

void write_dem(const std::filesystem::path& file, const MapOptions& options, const EnuFrame& frame, const Bounds& area,
               const std::function<double(const Eigen::Vector2d&)>& ground, uint64_t seed) {
  const double margin = 3 * options.dem_resolution;
  const Geodetic corner = frame.to_geodetic({area.east_min - margin, area.north_max + margin, 0});
  const MapGrid grid("EPSG:4326", corner, options.dem_resolution, area.east_max - area.east_min + 2 * margin,
                     area.north_max - area.north_min + 2 * margin);
  const SmoothField error(mix(seed, "dem"), options.dem_error_rms, 10 * options.dem_resolution);
  cv::Mat heights(grid.size(), CV_32F);
  for (int v = 0; v < heights.rows; ++v) {
    for (int u = 0; u < heights.cols; ++u) {
      // The ellipsoidal height at which this plumb line meets the ground.
      double h = frame.anchor().height;
      Eigen::Vector3d p;
      for (int k = 0; k < 3; ++k) {
        p = frame.to_enu(grid.geodetic(u, v, h));
        h += ground(p.head<2>()) - p.z();
      }
      heights.at<float>(v, u) = static_cast<float>(h + error(p.head<2>()).x());
    }
  }
  write_geotiff(file, heights, grid.grid(), 0);
}

Bounds map_bounds(const MapOptions& options, const EnuFrame& frame, double width, double height) {
  const MapGrid map(options.crs, frame.anchor(), options.resolution, width, height);
  const double right = map.size().width - 0.5, bottom = map.size().height - 0.5;
  const auto corner = [&](double u, double v) { return frame.to_enu(map.geodetic(u, v, frame.anchor().height)); };
  const Eigen::Vector3d nw = corner(-0.5, -0.5), ne = corner(right, -0.5), sw = corner(-0.5, bottom),
                        se = corner(right, bottom);
  return {std::max(nw.x(), sw.x()), std::min(ne.x(), se.x()), std::max(sw.y(), se.y()), std::min(nw.y(), ne.y())};
}

MapArea map_area(const MapOptions& options, const std::vector<double>& area, double ellipsoidal_height) {
  const Projection projection(options.crs);
  Geodetic corner = projection.to_geodetic({area[0], area[3]});
  corner.height = ellipsoidal_height;
  const EnuFrame frame(corner);
  const auto to = [&](double x, double y) {
    Geodetic p = projection.to_geodetic({x, y});
    p.height = ellipsoidal_height;
    return frame.to_enu(p).head<2>().norm();
  };
  return {corner, to(area[2], area[3]), to(area[0], area[1])};
}

}  // namespace orthonav::simulate
