#include "services/map_server/block_builder.h"

#include <algorithm>
#include <cmath>
#include <functional>

#include <fmt/format.h>
#include <opencv2/imgproc.hpp>

#include "common/features/orientation_field.h"
#include "common/features/warp.h"

namespace orthonav::map_server {
namespace {

// Side of the square of tiles that is resampled and described at once, map pixels.
constexpr double kBlockPixels = 1200;
// Context for the SIFT detector, whose coarser octaves look further than a fixed descriptor does.
constexpr int kDetectorMargin = 64;
// Sides beyond this would take memory by the square, and not fit the resampling (OpenCV's remap: 32767).
constexpr double kMaxSourcePixels = 6000;
// Contrast is that of averages over squares of this side, map pixels: about what a descriptor's own blur leaves.
constexpr int kGrain = 4;

struct Bounds {
  double east_min = 1e300, east_max = -1e300, north_min = 1e300, north_max = -1e300;

  void include(const Eigen::Vector3d& p_G) {
    east_min = std::min(east_min, p_G.x());
    east_max = std::max(east_max, p_G.x());
    north_min = std::min(north_min, p_G.y());
    north_max = std::max(north_max, p_G.y());
  }
};

// Calls `visit` for points along the outline of the raster.
void along_outline(const Raster& raster, const std::function<void(const Geodetic&)>& visit) {
  constexpr int kSteps = 64;
  const double right = raster.width() - 0.5;
  const double bottom = raster.height() - 0.5;
  for (int i = 0; i <= kSteps; ++i) {
    const double u = -0.5 + (right + 0.5) * i / kSteps;
    const double v = -0.5 + (bottom + 0.5) * i / kSteps;
    for (const Eigen::Vector2d& pixel :
         {Eigen::Vector2d(u, -0.5), Eigen::Vector2d(u, bottom), Eigen::Vector2d(-0.5, v), Eigen::Vector2d(right, v)}) {
      visit(raster.pixel_to_geodetic(pixel));
    }
  }
}

Geodetic anchor_of(const Raster& raster, const GroundSurface& surface) {
  Geodetic corner = raster.pixel_to_geodetic({-0.5, -0.5});
  corner.height = surface.reference_height();
  return corner;
}

// Sum of an integral image over a square clipped to the image.
template <class T>
double sum_in(const cv::Mat& integral, const cv::Rect& square) {
  return static_cast<double>(integral.at<T>(square.br()) - integral.at<T>(square.y, square.x + square.width) -
                             integral.at<T>(square.y + square.height, square.x) + integral.at<T>(square.tl()));
}

}  // namespace

std::optional<std::filesystem::path> elevation_model(const std::filesystem::path& raster, const BuildOptions& options) {
  if (options.dem == "none") return std::nullopt;
  if (options.dem != "auto") return std::filesystem::path(options.dem);
  std::filesystem::path beside = raster;
  beside.replace_extension(".dem.tif");
  if (std::filesystem::exists(beside)) return beside;
  return std::nullopt;
}

BlockBuilder::BlockBuilder(const std::filesystem::path& raster, const BuildOptions& options)
    : options_(options),
      raster_(raster),
      surface_(make_surface(raster_, options)),
      frame_(anchor_of(raster_, surface_)),
      sift_(options.keypoint_size),
      own_metres_per_pixel_(raster_.metres_per_pixel({0.5 * (raster_.width() - 1), 0.5 * (raster_.height() - 1)})) {
  if (!(own_metres_per_pixel_ > 0 && std::isfinite(own_metres_per_pixel_))) {
    throw MapDatabaseError(fmt::format("{}: the georeference gives no pixel size", raster.string()));
  }
  for (int level = 0; level < options.levels; ++level) levels_.push_back(describe_level(level));
}

GroundSurface BlockBuilder::make_surface(const Raster& raster, const BuildOptions& options) {
  const auto model = elevation_model(raster.file(), options);
  if (!model) return GroundSurface(options.ground_height_m);
  std::vector<Geodetic> outline;
  along_outline(raster, [&](const Geodetic& position) { outline.push_back(position); });
  return GroundSurface(*model, outline);
}

MapDescription BlockBuilder::describe_level(int level) const {
  const double finest = options_.metres_per_pixel > 0 ? options_.metres_per_pixel : own_metres_per_pixel_;
  const double factor = std::ldexp(1.0, level);
  const double sigma = finest * factor;
  if (options_.tile_size_m > kBlockPixels * finest) {
    throw MapDatabaseError(fmt::format("tiles of {} m have more than {} pixels of {:.3f} m: lower tile_size_m",
                                       options_.tile_size_m, kBlockPixels, finest));
  }
  Bounds bounds;
  along_outline(raster_, [&](const Geodetic& position) { bounds.include(frame_.to_enu(surface_.at(position))); });
  MapDescription description;
  description.anchor = frame_.anchor();
  description.metres_per_pixel = sigma;
  // Whole pixels, so that the bounds do not turn on the last digits of a projection.
  description.east_min = std::floor(bounds.east_min / sigma + 1e-3) * sigma;
  description.north_min = std::floor(bounds.north_min / sigma + 1e-3) * sigma;
  description.tile_size = options_.tile_size_m * factor;
  const auto tiles = [&](double length) {
    const double number = std::ceil(length / description.tile_size - 1e-6);
    if (!(number >= 1 && number < 1e7)) {
      throw MapDatabaseError(fmt::format("{}: {:.0f} m is no size of a map", raster_.file().string(), length));
    }
    return static_cast<int>(number);
  };
  description.tile_columns = tiles(bounds.east_max - description.east_min);
  description.tile_rows = tiles(bounds.north_max - description.north_min);
  description.east_max = description.east_min + description.tile_columns * description.tile_size;
  description.north_max = description.north_min + description.tile_rows * description.tile_size;
  const bool grid = options_.features != FeatureKind::kSift;
  description.keypoint_size = grid ? options_.keypoint_size : 0;
  description.keypoint_stride = grid ? options_.keypoint_stride : 0;
  description.has_surface = surface_.has_model();
  description.features = options_.features;
  return description;
}

std::vector<Block> BlockBuilder::blocks() const {
  std::vector<Block> blocks;
  for (size_t i = 0; i < levels_.size(); ++i) {
    const MapDescription& level = levels_[i];
    const double shrink = std::max(level.metres_per_pixel / own_metres_per_pixel_, 1.0);
    const double side = std::min(kBlockPixels, kMaxSourcePixels / shrink) * level.metres_per_pixel;
    const int group = std::max(1, static_cast<int>(side / level.tile_size));
    for (int row = 0; row < level.tile_rows; row += group) {
      for (int column = 0; column < level.tile_columns; column += group) {
        blocks.push_back(
            {static_cast<int>(i),
             {column, row, std::min(group, level.tile_columns - column), std::min(group, level.tile_rows - row)}});
      }
    }
  }
  return blocks;
}

BlockFeatures BlockBuilder::build(const Block& block) {
  const MapDescription& level = levels_[static_cast<size_t>(block.level)];
  BlockFeatures result;
  result.level = block.level;
  for (int row = block.tiles.y; row < block.tiles.br().y; ++row) {
    for (int column = block.tiles.x; column < block.tiles.br().x; ++column) {
      result.tiles.push_back({block.level, row * level.tile_columns + column, {}});
    }
  }
  const Picture picture = resample(block);
  if (picture.grey.empty() || cv::countNonZero(picture.valid) == 0) return result;
  std::vector<cv::Point2f> points;
  cv::Mat descriptors;
  if (options_.features == FeatureKind::kSift) {
    DetectedSift detected = detect_sift(picture.grey);
    points = std::move(detected.points);
    descriptors = detected.descriptors;
  } else {
    points = interest_points(picture, block, result);
    descriptors = options_.features == FeatureKind::kGrid
                      ? sift_.describe(picture.grey, points)
                      : OrientationField(picture.grey, {.keypoint_size = options_.keypoint_size}).describe(points);
  }
  const Eigen::Vector2d corner(level.east_min + block.tiles.x * level.tile_size,
                               level.north_min + block.tiles.y * level.tile_size);
  const GroundPatch patch(surface_, frame_, corner,
                          corner + level.tile_size * Eigen::Vector2d(block.tiles.width, block.tiles.height));
  for (size_t i = 0; i < points.size(); ++i) {
    const cv::Point2f& point = points[i];
    const Eigen::Vector2d en = position(block.level, picture.i0 + point.x, picture.j0 + point.y);
    const int tile = tile_in(block, en);
    if (tile < 0 || picture.valid.at<uchar>(cv::Point(cvRound(point.x), cvRound(point.y))) == 0) continue;
    const uchar* descriptor = descriptors.ptr(static_cast<int>(i));
    if (std::all_of(descriptor, descriptor + kSiftBytes, [](uchar byte) { return byte == 0; })) {
      ++result.without_texture;
      continue;
    }
    const std::optional<double> up = patch.up(en);
    if (!up) {
      ++result.without_data;
      continue;
    }
    TileFeatures& target = result.tiles[static_cast<size_t>(tile)].features;
    target.positions.emplace_back(en.cast<float>().x(), en.cast<float>().y(), static_cast<float>(*up));
    target.descriptors.insert(target.descriptors.end(), descriptor, descriptor + kSiftBytes);
  }
  return result;
}

// Resamples the raster where the block and the margin around it lie.
BlockBuilder::Picture BlockBuilder::resample(const Block& block) {
  const MapDescription& level = levels_[static_cast<size_t>(block.level)];
  const double sigma = level.metres_per_pixel;
  const double shrink = sigma / own_metres_per_pixel_;
  const int margin = options_.features == FeatureKind::kGrid   ? sift_.support()
                     : options_.features == FeatureKind::kSift ? kDetectorMargin
                                                               : orientation_margin(options_.keypoint_size);
  const double tile = level.tile_size;
  const double west = level.east_min + block.tiles.x * tile;
  const double south = level.north_min + block.tiles.y * tile;
  Picture picture;
  picture.level = block.level;
  picture.i0 = static_cast<int>(std::floor(west / sigma)) - margin;
  picture.j0 = static_cast<int>(std::floor(-(south + block.tiles.height * tile) / sigma)) - margin;
  const cv::Size size(static_cast<int>(std::ceil(block.tiles.width * tile / sigma)) + 2 * margin + 1,
                      static_cast<int>(std::ceil(block.tiles.height * tile / sigma)) + 2 * margin + 1);
  const auto corner = [&](int i, int j) {
    const Eigen::Vector2d en = position(block.level, picture.i0 + i, picture.j0 + j);
    return frame_.to_geodetic({en.x(), en.y(), 0});
  };
  surface_.focus({corner(0, 0), corner(size.width, 0), corner(0, size.height), corner(size.width, size.height)});
  const WarpGrid grid{size, 32};
  const cv::Mat nodes = sample_nodes(grid, [&](const Eigen::Vector2d& pixel) {
    const Eigen::Vector2d en = position(block.level, picture.i0 + pixel.x(), picture.j0 + pixel.y());
    return raster_.geodetic_to_pixel(surface_.below(frame_, en).position);
  });
  cv::Mat low, high;  // between nodes the mapping is between theirs
  cv::reduce(nodes.reshape(0, static_cast<int>(nodes.total())), low, 0, cv::REDUCE_MIN);
  cv::reduce(nodes.reshape(0, static_cast<int>(nodes.total())), high, 0, cv::REDUCE_MAX);
  const cv::Vec2d first = low.at<cv::Vec2d>(0), last = high.at<cv::Vec2d>(0);
  const int pad = 8 + static_cast<int>(2 * shrink);
  const cv::Rect wanted(
      cv::Point(static_cast<int>(std::floor(first[0])) - pad, static_cast<int>(std::floor(first[1])) - pad),
      cv::Point(static_cast<int>(std::ceil(last[0])) + pad, static_cast<int>(std::ceil(last[1])) + pad));
  const cv::Rect window = wanted & cv::Rect(0, 0, raster_.width(), raster_.height());
  if (window.empty()) return picture;
  cv::Mat source_valid;
  const cv::Mat source = fill_invalid(raster_.read_grey(window, &source_valid), source_valid);
  const Mapping mapping = mapping_of(grid, nodes, window.tl());
  picture.grey = warp_grey(source, mapping, shrink);
  const bool all_valid = window == wanted && cv::countNonZero(source_valid) == window.area();
  picture.valid = all_valid ? cv::Mat(size, CV_8U, cv::Scalar(255)) : warp_mask(source_valid, mapping);
  return picture;
}

Eigen::Vector2d BlockBuilder::position(int level, double i, double j) const {
  const double sigma = levels_[static_cast<size_t>(level)].metres_per_pixel;
  return {(i + 0.5) * sigma, -(j + 0.5) * sigma};
}

// Index within the block's tiles, -1 for another block's.
int BlockBuilder::tile_in(const Block& block, const Eigen::Vector2d& en) const {
  const MapDescription& level = levels_[static_cast<size_t>(block.level)];
  const int tile = level.tile_of(en.x(), en.y());
  if (tile < 0) return -1;
  const cv::Point place(tile % level.tile_columns, tile / level.tile_columns);
  const cv::Rect& tiles = block.tiles;
  return tiles.contains(place) ? (place.y - tiles.y) * tiles.width + place.x - tiles.x : -1;
}

// Points of the grid in the block that have enough data and contrast around them.
std::vector<cv::Point2f> BlockBuilder::interest_points(const Picture& picture, const Block& block,
                                                       BlockFeatures& result) const {
  cv::Mat invalid;
  const bool all_valid = cv::countNonZero(picture.valid) == static_cast<int>(picture.valid.total());
  if (!all_valid) cv::integral(picture.valid == 0, invalid, CV_32S);
  // The contrast that a descriptor sees: finer grain, as a sensor's noise on water, is not of the ground.
  cv::Mat coarse, sum, squares;
  const cv::Size size = picture.grey.size() / kGrain;
  cv::resize(picture.grey(cv::Rect({0, 0}, size * kGrain)), coarse, size, 0, 0, cv::INTER_AREA);
  cv::integral(coarse, sum, squares, CV_32S, CV_64F);
  const cv::Rect all_coarse(0, 0, coarse.cols, coarse.rows);
  const int half = static_cast<int>(std::lround(3 * options_.keypoint_size));
  const double stride = options_.keypoint_stride;
  const double first = 0.5 * stride;
  std::vector<cv::Point2f> points;
  const auto line_before = [&](int origin) { return static_cast<int>(std::floor((origin - first) / stride)); };
  for (int l = line_before(picture.j0);; ++l) {
    const double v = first + l * stride - picture.j0;
    if (v > picture.grey.rows - 1) break;
    for (int k = line_before(picture.i0);; ++k) {
      const double u = first + k * stride - picture.i0;
      if (u > picture.grey.cols - 1) break;
      if (u < 0 || v < 0 || tile_in(block, position(block.level, picture.i0 + u, picture.j0 + v)) < 0) continue;
      const cv::Rect square = cv::Rect(cvRound(u) - half, cvRound(v) - half, 2 * half + 1, 2 * half + 1) &
                              cv::Rect(0, 0, picture.grey.cols, picture.grey.rows);
      if (picture.valid.at<uchar>(cvRound(v), cvRound(u)) == 0 ||
          (!all_valid && sum_in<int>(invalid, square) / 255 > options_.max_invalid_fraction * square.area())) {
        ++result.without_data;
        continue;
      }
      const cv::Rect cells =
          cv::Rect(square.x / kGrain, square.y / kGrain, square.width / kGrain, square.height / kGrain) & all_coarse;
      const double mean = sum_in<int>(sum, cells) / cells.area();
      const double variance = sum_in<double>(squares, cells) / cells.area() - mean * mean;
      if (variance < options_.min_contrast * options_.min_contrast) {
        ++result.without_texture;
        continue;
      }
      points.emplace_back(static_cast<float>(u), static_cast<float>(v));
    }
  }
  return points;
}

}  // namespace orthonav::map_server
