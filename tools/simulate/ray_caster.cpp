#include "tools/simulate/ray_caster.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace orthonav::simulate {
namespace {

constexpr int kTile = View::kNodeStep;
constexpr int kCell = 1 << HeightField::kCellBits;
constexpr float kSteepestRay = 8.0F;  // horizontal per vertical: rays nearer to the horizon see sky
constexpr float kSkyLuminance = 128.0F;
constexpr int kRefinements = 5;      // of the intersection within one step, at most
constexpr float kOnSurface = 5e-4F;  // m: near enough to the surface, a hundredth of a pixel

// A ray in pixels of a level, as a function of the depth h below the camera: u = u0 + su h, v = v0 + sv h.
struct LevelRay {
  float u0, v0, su, sv;
};

// Depth at which the ray leaves the cell of (u, v), which it has at depth h.
float cell_exit(const LevelRay& ray, float h, int cell_u, int cell_v) {
  float exit = std::numeric_limits<float>::max();
  if (ray.su > 0) exit = std::min(exit, (static_cast<float>((cell_u + 1) * kCell) - ray.u0) / ray.su);
  if (ray.su < 0) exit = std::min(exit, (static_cast<float>(cell_u * kCell) - ray.u0) / ray.su);
  if (ray.sv > 0) exit = std::min(exit, (static_cast<float>((cell_v + 1) * kCell) - ray.v0) / ray.sv);
  if (ray.sv < 0) exit = std::min(exit, (static_cast<float>(cell_v * kCell) - ray.v0) / ray.sv);
  return std::max(exit, h);
}

// Bilinear interpolation in a raster. With `kInside` the caller knows that no position lies outside.
template <class Pixel, bool kInside>
class Sampler {
 public:
  explicit Sampler(const cv::Mat& image)
      : image_(image), data_(image.ptr<Pixel>()), stride_(static_cast<int64_t>(image.step1())) {}

  float operator()(float u, float v) const {
    if constexpr (kInside) return detail::bilinear_inside(data_, stride_, u, v);
    return detail::bilinear<Pixel>(image_, u, v);
  }

 private:
  const cv::Mat& image_;
  const Pixel* data_;
  int64_t stride_;
};

// Depth of the first intersection with the surface in [begin, end]; at `end` the ray is not above the surface.
// `camera_z` is the camera's height.
template <bool kInside>
float intersect(const HeightField::Level& level, const Sampler<float, kInside>& heights, const LevelRay& ray,
                float camera_z, float begin, float end) {
  const float steepness = std::max(std::abs(ray.su), std::abs(ray.sv));
  const float texel_step = steepness > 1e-4F ? 1.0F / steepness : end - begin;
  const auto clearance = [&](float h) { return camera_z - h - heights(ray.u0 + ray.su * h, ray.v0 + ray.sv * h); };
  float h = begin;
  float above = clearance(h);
  if (above <= 0) return h;
  while (h < end) {
    const float u = ray.u0 + ray.su * h, v = ray.v0 + ray.sv * h;
    const int cell_u = static_cast<int>(std::floor(u)) >> HeightField::kCellBits;
    const int cell_v = static_cast<int>(std::floor(v)) >> HeightField::kCellBits;
    const float top = camera_z - level.cell(cell_u, cell_v).high;  // depth of the cell's highest point
    float next = h + texel_step;
    if (h < top) next = std::min(cell_exit(ray, h, cell_u, cell_v) + 0.01F * texel_step, top + 1e-4F);
    next = std::min(std::max(next, h + 1e-4F), end);
    const float below = clearance(next);
    if (below > 0) {
      h = next;
      above = below;
      continue;
    }
    // The surface is crossed between h and next: false position, with halving of the retained end (Illinois).
    float low = h, f_low = above, high = next, f_high = below;
    int side = 0;
    for (int i = 0; i < kRefinements; ++i) {
      const float middle = low + (high - low) * f_low / (f_low - f_high);
      const float f = clearance(middle);
      if (std::abs(f) < kOnSurface) return middle;
      if (f > 0) {
        low = middle;
        f_low = f;
        if (side == 1) f_high *= 0.5F;
        side = 1;
      } else {
        high = middle;
        f_high = f;
        if (side == -1) f_low *= 0.5F;
        side = -1;
      }
    }
    return low + (high - low) * f_low / (f_low - f_high);
  }
  return end;
}

}  // namespace

struct RayCaster::Frame {
  // The camera when a row was read.
  struct Row {
    float z = 0;  // m in G
    Eigen::Matrix3f R;
    Eigen::Vector2f foot;  // pixel of `level` below the camera
  };
  std::vector<Row> rows;  // one for each, or one for all
  const Row& row(int v) const { return rows[rows.size() > 1 ? static_cast<size_t>(v) : 0]; }

  const HeightField::Level* level = nullptr;   // its pixels are at most as large as the camera's on the ground
  const HeightField::Level* coarse = nullptr;  // the next one
  float blend = 0;                             // weight of the coarse level's luminance
  float pixels_per_metre = 0;                  // of `level`
};

RayCaster::RayCaster(const HeightField& field, const CameraModel& camera)
    : field_(field), width_(camera.width()), height_(camera.height()), focal_(camera.focal()) {
  rays_.reserve(static_cast<size_t>(width_) * height_);
  for (int v = 0; v < height_; ++v) {
    for (int u = 0; u < width_; ++u) {
      const auto ray_C = camera.unproject({u, v});
      if (!ray_C) throw std::invalid_argument("RayCaster: the lens model has no ray for some pixels");
      rays_.emplace_back(ray_C->head<2>().cast<float>());
    }
  }
}

Eigen::Vector3d RayCaster::ray(int u, int v) const {
  const Eigen::Vector2f& ray = rays_[static_cast<size_t>(v) * width_ + u];
  return {ray.x(), ray.y(), 1.0};
}

View RayCaster::render(const std::vector<CameraPose>& rows) const {
  if (rows.size() != 1 && rows.size() != static_cast<size_t>(height_)) {
    throw std::invalid_argument("RayCaster: a rolling shutter needs a pose for each row");
  }
  const CameraPose& pose = rows[rows.size() / 2];
  View view;
  view.luminance.create(height_, width_, CV_32F);
  view.node_depth.create((height_ + kTile - 1) / kTile, (width_ + kTile - 1) / kTile, CV_32F);

  // The pyramid level is one for the whole frame, by the height above a smooth ground, so that it neither jumps
  // within a picture nor flickers between pictures.
  const double smooth_ground = field_.smooth_height(pose.p_G_C.head<2>(), 50.0);
  const double footprint = std::max(pose.p_G_C.z() - smooth_ground, 0.05) / focal_;
  const auto& levels = field_.levels();
  const double exact_level =
      std::clamp(std::log2(footprint / field_.resolution()), 0.0, static_cast<double>(levels.size() - 1));
  const auto fine = static_cast<size_t>(exact_level);

  Frame frame;
  frame.level = &levels[fine];
  frame.coarse = &levels[std::min(fine + 1, levels.size() - 1)];
  frame.blend = static_cast<float>(exact_level - static_cast<double>(fine));
  for (const CameraPose& row : rows) {
    frame.rows.push_back({static_cast<float>(row.p_G_C.z()), row.R_G_C.cast<float>(),
                          field_.to_pixel(row.p_G_C.head<2>(), *frame.level).cast<float>()});
  }
  frame.pixels_per_metre = static_cast<float>(1.0 / frame.level->resolution);

  int64_t outside = 0;
  for (int v = 0; v < height_; v += kTile) {
    for (int u = 0; u < width_; u += kTile) {
      render_tile(frame, {u, v, std::min(kTile, width_ - u), std::min(kTile, height_ - v)}, view, outside);
    }
  }
  view.outside = static_cast<double>(outside) / (static_cast<double>(width_) * height_);
  return view;
}

void RayCaster::render_tile(const Frame& frame, const cv::Rect& tile, View& view, int64_t& outside) const {
  const HeightField::Level& level = *frame.level;
  Slopes slopes;
  Eigen::Vector2f slope_min = Eigen::Vector2f::Constant(kSteepestRay * frame.pixels_per_metre);
  Eigen::Vector2f slope_max = -slope_min;
  float z_min = frame.row(tile.y).z, z_max = z_min;
  Eigen::Vector2f foot_min = frame.row(tile.y).foot, foot_max = foot_min;
  for (int y = 0; y < tile.height; ++y) {
    const Eigen::Vector2f* ray = &rays_[static_cast<size_t>(tile.y + y) * width_ + tile.x];
    const Frame::Row& row = frame.row(tile.y + y);
    z_min = std::min(z_min, row.z);
    z_max = std::max(z_max, row.z);
    foot_min = foot_min.cwiseMin(row.foot);
    foot_max = foot_max.cwiseMax(row.foot);
    for (int x = 0; x < tile.width; ++x) {
      const Eigen::Vector3f d = row.R.col(0) * ray[x].x() + row.R.col(1) * ray[x].y() + row.R.col(2);
      Eigen::Vector2f& slope = slopes[y * kTile + x];
      if (!(d.z() < 0) || d.head<2>().squaredNorm() > kSteepestRay * kSteepestRay * d.z() * d.z()) {
        slope.setConstant(std::numeric_limits<float>::quiet_NaN());
        continue;
      }
      slope = Eigen::Vector2f(d.x(), -d.y()) * (frame.pixels_per_metre / -d.z());
      slope_min = slope_min.cwiseMin(slope);
      slope_max = slope_max.cwiseMax(slope);
    }
  }

  // The range of heights that the tile can meet, narrowed by the ground it covers at the range known so far.
  HeightField::Range range = field_.range();
  for (int pass = 0; pass < 3; ++pass) {
    const float near = std::max(0.0F, z_min - range.high), far = std::max(near, z_max - range.low);
    const Eigen::Vector2f low = foot_min + (slope_min * near).cwiseMin(slope_min * far);
    const Eigen::Vector2f high = foot_max + (slope_max * near).cwiseMax(slope_max * far);
    const int u0 = static_cast<int>(std::floor(low.x())) >> HeightField::kCellBits;
    const int v0 = static_cast<int>(std::floor(low.y())) >> HeightField::kCellBits;
    const int u1 = static_cast<int>(std::floor(high.x())) >> HeightField::kCellBits;
    const int v1 = static_cast<int>(std::floor(high.y())) >> HeightField::kCellBits;
    constexpr int kTooMany = 64;  // cells a side: a view to the horizon, not worth the scan
    if (u1 - u0 > kTooMany || v1 - v0 > kTooMany) break;
    HeightField::Range seen{range.high, range.low};
    for (int v = v0; v <= v1; ++v) {
      for (int u = u0; u <= u1; ++u) {
        seen.low = std::min(seen.low, level.cell(u, v).low);
        seen.high = std::max(seen.high, level.cell(u, v).high);
      }
    }
    const float gain = (range.high - range.low) - (seen.high - seen.low);
    range = seen;
    if (gain < 0.5F) break;
  }
  const float begin = std::max(0.0F, z_min - range.high - 1e-3F);
  const float end = std::max(begin, z_max - range.low + 1e-3F);
  const Eigen::Vector2f low = foot_min + (slope_min * begin).cwiseMin(slope_min * end);
  const Eigen::Vector2f high = foot_max + (slope_max * begin).cwiseMax(slope_max * end);
  // The coarser level's neighbours are inside too.
  const bool inside = low.minCoeff() >= 1.0F && high.x() < static_cast<float>(level.height.cols) - 4.0F &&
                      high.y() < static_cast<float>(level.height.rows) - 4.0F;
  if (inside) {
    shade_tile<true>(frame, tile, slopes, begin, end, view, outside);
  } else {
    shade_tile<false>(frame, tile, slopes, begin, end, view, outside);
  }
}

template <bool kInside>
void RayCaster::shade_tile(const Frame& frame, const cv::Rect& tile, const Slopes& slopes, float begin, float end,
                           View& view, int64_t& outside) const {
  const HeightField::Level& level = *frame.level;
  const HeightField::Level& coarse = *frame.coarse;
  const Sampler<float, kInside> heights(level.height);
  const Sampler<uint8_t, kInside> fine_light(level.luminance), coarse_light(coarse.luminance);
  // Pixel centres are at integers, so the coarser level's coordinate is not just the half of the finer one's.
  const auto ratio = static_cast<float>(level.resolution / coarse.resolution);
  for (int y = 0; y < tile.height; ++y) {
    float* out = view.luminance.ptr<float>(tile.y + y) + tile.x;
    const Frame::Row& row = frame.row(tile.y + y);
    for (int x = 0; x < tile.width; ++x) {
      const Eigen::Vector2f& slope = slopes[y * kTile + x];
      float depth = std::numeric_limits<float>::quiet_NaN();
      if (std::isnan(slope.x())) {
        out[x] = kSkyLuminance;
        ++outside;
      } else {
        const LevelRay ray{row.foot.x(), row.foot.y(), slope.x(), slope.y()};
        depth = intersect(level, heights, ray, row.z, begin, end);
        const float u = ray.u0 + ray.su * depth, v = ray.v0 + ray.sv * depth;
        if (!kInside && (u < -0.5F || v < -0.5F || u > static_cast<float>(level.height.cols) - 0.5F ||
                         v > static_cast<float>(level.height.rows) - 0.5F)) {
          ++outside;
        }
        const float fine = fine_light(u, v);
        out[x] = fine + frame.blend * (coarse_light((u + 0.5F) * ratio - 0.5F, (v + 0.5F) * ratio - 0.5F) - fine);
      }
      if (x == 0 && y == 0) view.node_depth.at<float>(tile.y / kTile, tile.x / kTile) = depth;
    }
  }
}

}  // namespace orthonav::simulate
