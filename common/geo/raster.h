// Georeferenced rasters: any file GDAL reads, in any coordinate system.
//
// Pixel (u, v) has u to the right and v down, with pixel centres at integers (so GDAL's own pixel coordinate is
// u + 0.5). Positions go pixel -> the raster's CRS -> WGS84 -> ENU, never through "pixel x metres" alone: grid
// north is not true north. Not thread-safe: one object per thread.
#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/geo/enu_frame.h"

namespace orthonav {

class Raster {
 public:
  // Throws std::runtime_error naming the file when it cannot be opened, has no band, no georeference, no CRS,
  // or blocks of more than 1 GiB.
  explicit Raster(const std::filesystem::path& file);
  ~Raster();
  Raster(Raster&&) noexcept;
  Raster& operator=(Raster&&) noexcept;

  const std::filesystem::path& file() const;
  int width() const;   // pixels
  int height() const;  // pixels

  // WGS84 position of a pixel (height 0). Throws std::runtime_error when the CRS cannot be transformed.
  Geodetic pixel_to_geodetic(const Eigen::Vector2d& pixel) const;
  // Inverse; exact to 1e-3 px within the raster.
  Eigen::Vector2d geodetic_to_pixel(const Geodetic& position) const;

  // Ground metres per pixel at a pixel: geometric mean of the steps to the right and down.
  double metres_per_pixel(const Eigen::Vector2d& pixel) const;

  // 8-bit luminance of a window, from RGB, grey or a palette. Other than 8-bit values are stretched, by the range that
  // holds 99 % of a sample of the whole raster. `valid` (optional) is 0 where there is no data by mask, alpha or
  // nodata. The window is clipped to the raster, the rest is invalid.
  // Throws std::runtime_error naming file and window when reading fails (truncated file).
  cv::Mat read_grey(const cv::Rect& window, cv::Mat* valid = nullptr) const;

  // Band 1 as float, NaN where there is no data. As read_grey otherwise.
  cv::Mat read_float(const cv::Rect& window) const;
  // The same of `size` samples spread evenly over a window that lies within the raster.
  cv::Mat sample_float(const cv::Rect& window, const cv::Size& size) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

// All files that a raster is made of: itself, masks and world files, and of a mosaic (VRT) its parts, however nested.
// Throws std::runtime_error as the constructor of Raster does when it cannot be opened.
std::vector<std::filesystem::path> raster_files(const std::filesystem::path& file);

// A CRS and affine transform to write a raster with.
struct RasterGrid {
  std::string crs = "EPSG:32633";  // anything GDAL understands
  // GDAL's six numbers: x_crs = g[0] + g[1] (u + 0.5) + g[2] (v + 0.5), y_crs = g[3] + g[4] (u + 0.5) + g[5] (v + 0.5).
  double transform[6] = {0, 1, 0, 0, 0, -1};
};

// Writes an 8-bit (1 or 3 channels, BGR order as in OpenCV) or 32-bit float image as a tiled GeoTIFF.
// `jpeg_quality` 1..100 stores 8-bit pictures with JPEG compression, 0 stores losslessly (DEFLATE).
// Throws std::runtime_error naming the file.
void write_geotiff(const std::filesystem::path& file, const cv::Mat& image, const RasterGrid& grid,
                   int jpeg_quality = 0);

}  // namespace orthonav
