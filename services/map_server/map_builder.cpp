#include "services/map_server/map_builder.h"

#include <algorithm>
#include <cmath>
#include <deque>
#include <future>
#include <memory>
#include <thread>
#include <vector>

#include <fmt/format.h>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <spdlog/spdlog.h>

#include "common/features/fixed_sift.h"
#include "common/features/orientation_field.h"
#include "common/features/warp.h"
#include "common/geo/raster.h"
#include "services/map_server/ground_surface.h"

namespace orthonav::map_server {
namespace {

// Side of the square of tiles that is resampled and described at once, map pixels.
constexpr double kBlockPixels = 1200;
// Context for the SIFT detector, whose coarser octaves look further than a fixed descriptor does.
constexpr int kDetectorMargin = 64;
// Sides beyond this would not fit the resampling (OpenCV's remap: 32767).
constexpr double kMaxSourcePixels = 24000;

void add_file(Checksum& checksum, const std::filesystem::path& file) {
  std::ifstream in(file, std::ios::binary);
  if (!in) throw MapDatabaseError(fmt::format("cannot read {}", file.string()));
  std::vector<char> buffer(1 << 20);
  while (in) {
    in.read(buffer.data(), static_cast<std::streamsize>(buffer.size()));
    checksum.add(buffer.data(), static_cast<size_t>(in.gcount()));
  }
  if (in.bad()) throw MapDatabaseError(fmt::format("cannot read {}", file.string()));
}

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

struct BlockFeatures {
  cv::Rect tiles;
  std::vector<TileFeatures> features;  // row by row, the southern first
  int64_t skipped_nodata = 0;
  int64_t skipped_texture = 0;
};

// Builds blocks of one map; one object per thread.
class BlockBuilder {
 public:
  BlockBuilder(const std::filesystem::path& file, const BuildOptions& options)
      : options_(options),
        raster_(file),
        surface_(make_surface(file, options)),
        frame_(anchor()),
        sift_(options.keypoint_size) {
    const Eigen::Vector2d centre(0.5 * (raster_.width() - 1), 0.5 * (raster_.height() - 1));
    const double own = raster_.metres_per_pixel(centre);
    sigma_ = options.metres_per_pixel > 0 ? options.metres_per_pixel : own;
    shrink_ = sigma_ / own;
    if (!(own > 0 && std::isfinite(own))) {
      throw MapDatabaseError(fmt::format("{}: the georeference gives no pixel size", file.string()));
    }
    Bounds bounds;
    along_outline(raster_, [&](const Geodetic& position) { bounds.include(frame_.to_enu(surface_.at(position))); });
    description_.anchor = frame_.anchor();
    description_.metres_per_pixel = sigma_;
    // Whole pixels, so that the bounds do not turn on the last digits of a projection.
    description_.east_min = std::floor(bounds.east_min / sigma_ + 1e-3) * sigma_;
    description_.north_min = std::floor(bounds.north_min / sigma_ + 1e-3) * sigma_;
    description_.tile_size = options.tile_size_m;
    description_.tile_columns =
        static_cast<int>(std::ceil((bounds.east_max - description_.east_min) / options.tile_size_m - 1e-6));
    description_.tile_rows =
        static_cast<int>(std::ceil((bounds.north_max - description_.north_min) / options.tile_size_m - 1e-6));
    description_.east_max = description_.east_min + description_.tile_columns * options.tile_size_m;
    description_.north_max = description_.north_min + description_.tile_rows * options.tile_size_m;
    const bool grid = options.features != FeatureKind::kSift;
    description_.keypoint_size = grid ? options.keypoint_size : 0;
    description_.keypoint_stride = grid ? options.keypoint_stride : 0;
    description_.has_surface = surface_.has_model();
    description_.features = options.features;
  }

  const MapDescription& description() const { return description_; }

  // Tiles to a side of a block.
  int group() const {
    const double limit = std::min(kBlockPixels, kMaxSourcePixels / std::max(shrink_, 1.0));
    return std::max(1, static_cast<int>(limit * sigma_ / options_.tile_size_m));
  }

  // Features of a rectangle of tiles (in tiles).
  BlockFeatures build_block(const cv::Rect& tiles) {
    BlockFeatures result;
    result.tiles = tiles;
    result.features.resize(static_cast<size_t>(tiles.area()));
    const Block block = resample(tiles);
    if (block.grey.empty() || cv::countNonZero(block.valid) == 0) return result;
    std::vector<cv::Point2f> points;
    cv::Mat descriptors;
    if (options_.features != FeatureKind::kSift) {
      points = interest_points(block, tiles, result);
      const cv::Mat filled = fill_invalid(block.grey, block.valid);
      descriptors = options_.features == FeatureKind::kGrid
                        ? sift_.describe(filled, points)
                        : OrientationField(filled, {.keypoint_size = options_.keypoint_size}).describe(points);
    } else {
      DetectedSift detected = detect_sift(fill_invalid(block.grey, block.valid));
      points = std::move(detected.points);
      descriptors = detected.descriptors;
    }
    for (size_t i = 0; i < points.size(); ++i) {
      const cv::Point2f& point = points[i];
      const Eigen::Vector2d en = position(block.i0 + point.x, block.j0 + point.y);
      const int tile = tile_in(tiles, en);
      if (tile < 0 || block.valid.at<uchar>(cv::Point(cvRound(point.x), cvRound(point.y))) == 0) continue;
      const cv::Mat descriptor = descriptors.row(static_cast<int>(i));
      if (cv::countNonZero(descriptor) == 0) {
        ++result.skipped_texture;
        continue;
      }
      const GroundPoint ground = surface_.below(frame_, en);
      if (!ground.known) {
        ++result.skipped_nodata;
        continue;
      }
      TileFeatures& target = result.features[static_cast<size_t>(tile)];
      target.positions.emplace_back(en.cast<float>().x(), en.cast<float>().y(), static_cast<float>(ground.up));
      target.descriptors.insert(target.descriptors.end(), descriptor.ptr(), descriptor.ptr() + kSiftBytes);
    }
    return result;
  }

 private:
  struct Block {
    int i0 = 0, j0 = 0;  // pixel of G's picture at the upper-left of `grey`
    cv::Mat grey;
    cv::Mat valid;
  };

  static GroundSurface make_surface(const std::filesystem::path& file, const BuildOptions& options) {
    const auto model = elevation_model(file, options);
    if (!model) return GroundSurface(options.ground_height_m);
    const Raster raster(file);
    std::vector<Geodetic> outline;
    along_outline(raster, [&](const Geodetic& position) { outline.push_back(position); });
    return GroundSurface(*model, outline);
  }

  Geodetic anchor() const {
    Geodetic corner = raster_.pixel_to_geodetic({-0.5, -0.5});
    corner.height = surface_.reference_height();
    return corner;
  }

  // Resamples the raster where `tiles` and the margin around them lie.
  Block resample(const cv::Rect& tiles) const {
    const int margin = options_.features == FeatureKind::kGrid   ? sift_.support()
                       : options_.features == FeatureKind::kSift ? kDetectorMargin
                                                                 : orientation_margin(options_.keypoint_size);
    const double tile = options_.tile_size_m;
    const double west = description_.east_min + tiles.x * tile;
    const double south = description_.north_min + tiles.y * tile;
    Block block;
    block.i0 = static_cast<int>(std::floor(west / sigma_)) - margin;
    block.j0 = static_cast<int>(std::floor(-(south + tiles.height * tile) / sigma_)) - margin;
    const cv::Size size(static_cast<int>(std::ceil(tiles.width * tile / sigma_)) + 2 * margin + 1,
                        static_cast<int>(std::ceil(tiles.height * tile / sigma_)) + 2 * margin + 1);
    cv::Mat mapping = sample_mapping({size, 32}, [&](const Eigen::Vector2d& pixel) {
      const Eigen::Vector2d en = position(block.i0 + pixel.x(), block.j0 + pixel.y());
      return raster_.geodetic_to_pixel(surface_.below(frame_, en).position);
    });
    std::vector<cv::Mat> uv;
    cv::split(mapping, uv);
    double u_min = 0, u_max = 0, v_min = 0, v_max = 0;
    cv::minMaxLoc(uv[0], &u_min, &u_max);
    cv::minMaxLoc(uv[1], &v_min, &v_max);
    const int pad = 8 + static_cast<int>(2 * shrink_);
    const cv::Rect all(0, 0, raster_.width(), raster_.height());
    const cv::Rect window =
        cv::Rect(cv::Point(static_cast<int>(std::floor(u_min)) - pad, static_cast<int>(std::floor(v_min)) - pad),
                 cv::Point(static_cast<int>(std::ceil(u_max)) + pad, static_cast<int>(std::ceil(v_max)) + pad)) &
        all;
    if (window.empty()) return block;
    cv::Mat source_valid;
    const cv::Mat source = fill_invalid(raster_.read_grey(window, &source_valid), source_valid);
    mapping -= cv::Scalar(window.x, window.y);
    block.grey = warp_grey(source, mapping, shrink_);
    block.valid = warp_mask(source_valid, mapping);
    return block;
  }

  // East and north of a pixel of G's picture.
  Eigen::Vector2d position(double i, double j) const { return {(i + 0.5) * sigma_, -(j + 0.5) * sigma_}; }

  // Index within the block's tiles, -1 for another block's.
  int tile_in(const cv::Rect& tiles, const Eigen::Vector2d& en) const {
    const int tile = description_.tile_of(en.x(), en.y());
    if (tile < 0) return -1;
    const cv::Point place(tile % description_.tile_columns, tile / description_.tile_columns);
    return tiles.contains(place) ? (place.y - tiles.y) * tiles.width + place.x - tiles.x : -1;
  }

  // Points of the grid in these tiles that have enough data around them.
  std::vector<cv::Point2f> interest_points(const Block& block, const cv::Rect& tiles, BlockFeatures& result) const {
    cv::Mat invalid;
    cv::integral(block.valid == 0, invalid, CV_32S);
    const int half = static_cast<int>(std::lround(3 * options_.keypoint_size));
    const double stride = options_.keypoint_stride;
    const double first = 0.5 * stride;
    std::vector<cv::Point2f> points;
    const auto line_before = [&](int origin) { return static_cast<int>(std::floor((origin - first) / stride)); };
    for (int l = line_before(block.j0);; ++l) {
      const double v = first + l * stride - block.j0;
      if (v > block.grey.rows - 1) break;
      for (int k = line_before(block.i0);; ++k) {
        const double u = first + k * stride - block.i0;
        if (u > block.grey.cols - 1) break;
        if (u < 0 || v < 0 || tile_in(tiles, position(block.i0 + u, block.j0 + v)) < 0) continue;
        const cv::Rect square = cv::Rect(cvRound(u) - half, cvRound(v) - half, 2 * half + 1, 2 * half + 1) &
                                cv::Rect(0, 0, block.grey.cols, block.grey.rows);
        const int holes = (invalid.at<int>(square.br()) - invalid.at<int>(square.y, square.x + square.width) -
                           invalid.at<int>(square.y + square.height, square.x) + invalid.at<int>(square.tl())) /
                          255;
        if (block.valid.at<uchar>(cvRound(v), cvRound(u)) == 0 ||
            holes > options_.max_invalid_fraction * square.area()) {
          ++result.skipped_nodata;
          continue;
        }
        points.emplace_back(static_cast<float>(u), static_cast<float>(v));
      }
    }
    return points;
  }

  BuildOptions options_;
  Raster raster_;
  GroundSurface surface_;
  EnuFrame frame_;
  FixedSift sift_;
  double sigma_ = 0;
  double shrink_ = 1;
  MapDescription description_;
};

}  // namespace

std::optional<std::filesystem::path> elevation_model(const std::filesystem::path& raster, const BuildOptions& options) {
  if (options.dem == "none") return std::nullopt;
  if (options.dem != "auto") return std::filesystem::path(options.dem);
  std::filesystem::path beside = raster;
  beside.replace_extension(".dem.tif");
  if (std::filesystem::exists(beside)) return beside;
  return std::nullopt;
}

std::string build_fingerprint(const std::filesystem::path& raster, const BuildOptions& options) {
  Checksum checksum;
  checksum.add(fmt::format("onmap 2 {} {} {} {} {} {} {}", static_cast<int>(options.features), options.keypoint_stride,
                           options.keypoint_size, options.metres_per_pixel, options.tile_size_m,
                           options.max_invalid_fraction, options.ground_height_m));
  add_file(checksum, raster);
  if (const auto model = elevation_model(raster, options)) {
    checksum.add("elevation");
    add_file(checksum, *model);
  }
  return fmt::format("{:016x}", checksum.value());
}

BuildResult build_map(const std::filesystem::path& raster, const BuildOptions& options,
                      const std::filesystem::path& out, const std::function<void(double)>& progress) {
  std::vector<std::unique_ptr<BlockBuilder>> builders;
  for (unsigned i = 0; i < std::max(1U, std::thread::hardware_concurrency()); ++i) {
    builders.push_back(std::make_unique<BlockBuilder>(raster, options));
  }
  BuildResult result;
  result.description = builders.front()->description();
  result.description.fingerprint = build_fingerprint(raster, options);
  const int group = builders.front()->group();
  const int columns = result.description.tile_columns;
  const int rows = result.description.tile_rows;
  const size_t blocks_across = static_cast<size_t>((columns + group - 1) / group);
  const size_t num_blocks = blocks_across * static_cast<size_t>((rows + group - 1) / group);
  MapDatabaseWriter writer(out, result.description);

  // Blocks are written in their order, and a builder gets its next block when its last has been written, so that as
  // many blocks are in memory as there are builders.
  std::deque<std::future<BlockFeatures>> working;
  size_t written = 0;
  const auto write_next = [&] {
    const BlockFeatures block = working.front().get();
    working.pop_front();
    for (int i = 0; i < block.tiles.area(); ++i) {
      const int row = block.tiles.y + i / block.tiles.width;
      const int column = block.tiles.x + i % block.tiles.width;
      writer.write_tile(row * columns + column, block.features[static_cast<size_t>(i)]);
    }
    result.skipped_nodata += block.skipped_nodata;
    result.skipped_texture += block.skipped_texture;
    if (progress) progress(static_cast<double>(++written) / static_cast<double>(num_blocks));
  };
  for (size_t i = 0; i < num_blocks; ++i) {
    if (working.size() == builders.size()) write_next();
    const int row = static_cast<int>(i / blocks_across) * group;
    const int column = static_cast<int>(i % blocks_across) * group;
    const cv::Rect tiles(column, row, std::min(group, columns - column), std::min(group, rows - row));
    working.push_back(std::async(
        std::launch::async, [&builder = *builders[i % builders.size()], tiles] { return builder.build_block(tiles); }));
  }
  while (!working.empty()) write_next();
  if (writer.num_features() == 0) {
    throw MapDatabaseError(fmt::format("{}: no point of the raster has data and texture around it", raster.string()));
  }
  writer.finish();
  result.description.num_features = writer.num_features();
  return result;
}

std::filesystem::path prepare_map(const std::filesystem::path& map, const BuildOptions& options,
                                  const std::function<void(double)>& progress) {
  if (map.extension() == ".onmap") return map;
  std::filesystem::path cache = map;
  cache += fmt::format(".{}.onmap", name_of(options.features));
  if (std::filesystem::exists(cache)) {
    try {
      if (MapDatabase(cache).description().fingerprint == build_fingerprint(map, options)) return cache;
      spdlog::info("{} was made of another raster or with other parameters: building it again", cache.string());
    } catch (const MapDatabaseError& error) {
      spdlog::warn("{}: building it again", error.what());
    }
  }
  build_map(map, options, cache, progress);
  return cache;
}

}  // namespace orthonav::map_server
