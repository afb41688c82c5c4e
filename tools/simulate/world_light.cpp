#include "tools/simulate/world_light.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <future>
#include <numbers>
#include <vector>

#include <opencv2/imgproc.hpp>

#include "tools/simulate/world_random.h"

namespace orthonav::simulate {

namespace {

// Patterns of soil and vegetation are kept on a coarser grid and interpolated.
constexpr double kPatternCell = 0.5;  // m

// One coarse pattern, read row by row at the canvas's resolution.
class PatternRows {
 public:
  PatternRows(const cv::Mat& grid, double scale) : grid_(&grid), scale_(scale) {}

  void read(int v, std::vector<float>& row) const {
    const double y = std::min((v + 0.5) * scale_, grid_->rows - 1.001);
    const int j = static_cast<int>(y);
    const float b = static_cast<float>(y - j);
    const float *upper = grid_->ptr<float>(j), *lower = grid_->ptr<float>(j + 1);
    for (size_t u = 0; u < row.size(); ++u) {
      const float x = static_cast<float>((static_cast<double>(u) + 0.5) * scale_);
      const int i = std::min(static_cast<int>(x), grid_->cols - 2);
      const float a = x - static_cast<float>(i);
      row[u] = (1 - b) * ((1 - a) * upper[i] + a * upper[i + 1]) + b * ((1 - a) * lower[i] + a * lower[i + 1]);
    }
  }

 private:
  const cv::Mat* grid_;
  double scale_;
};

// Gradual variation, and patches with definite edges as soils, wet ground and stands of one plant have them.
cv::Mat patchwork(uint64_t seed, cv::Size size, double longest, double slope, double patch) {
  cv::Mat gradual = noise_grid(seed, size, kPatternCell, longest, 1.0, slope);
  const cv::Mat patches = noise_grid(mix(seed, "patches"), size, kPatternCell, patch, patch / 6, 1.0);
  // The steeper the step, the sharper the edge: it is a metre or two wide here.
  constexpr float kSteepness = 6.0F;
  for (int v = 0; v < gradual.rows; ++v) {
    float* row = gradual.ptr<float>(v);
    const float* step = patches.ptr<float>(v);
    for (int u = 0; u < gradual.cols; ++u) {
      const float t = kSteepness * (std::abs(step[u]) - 0.8F);
      row[u] = 0.75F * row[u] + 0.65F * t / std::sqrt(1 + t * t);
    }
  }
  return gradual;
}

// Base pattern mixed with a new one that takes `change` of its variance.
cv::Mat pattern(const EpochOptions& options, const char* name, cv::Size size, double longest, double slope,
                double patch) {
  cv::Mat base = patchwork(mix(options.seed, name), size, longest, slope, patch);
  if (options.base || options.change.pattern_change <= 0) return base;
  const double change = options.change.pattern_change;
  const cv::Mat fresh = patchwork(mix(options.epoch_seed, name), size, longest, slope, patch);
  cv::addWeighted(base, std::sqrt(1 - change), fresh, std::sqrt(change), 0, base);
  return base;
}

// What a material needs per pixel, prepared once.
struct Paint {
  cv::Vec3f middle, half;  // colour = middle + half * m, m in -1..1
  float soil, vegetation, grain, clumps, rows, wheels;
  float row_x, row_y;  // phase of the rows per m east and north
  float wheel_x, wheel_y, wheel_phase, wheel_width;
};

Paint prepare(const Material& m, float snow) {
  static const cv::Vec3f kSnow(235, 232, 230);
  const float bare = 1 - snow;
  Paint p{};
  p.middle = 0.5F * bare * (m.low + m.high) + snow * kSnow;
  p.half = 0.5F * bare * (m.high - m.low);
  // The patterns have unit variance: the colours `low` and `high` are one and a half deviations out.
  p.soil = 4.0F * m.soil;
  p.vegetation = 4.0F * m.vegetation;
  p.grain = bare * m.grain / 32.0F;
  p.clumps = bare * m.clumps / 32.0F;
  p.rows = 2.0F * bare * m.rows;
  p.wheels = bare * m.wheels;
  // Rows run along row_angle: their phase grows across it.
  const float cx = -std::sin(m.row_angle), cy = std::cos(m.row_angle);
  p.row_x = cx / m.row_period;
  p.row_y = cy / m.row_period;
  p.wheel_x = cx / m.wheel_period;
  p.wheel_y = cy / m.wheel_period;
  p.wheel_phase = m.wheel_phase / m.wheel_period;
  p.wheel_width = 0.25F / m.wheel_period;
  return p;
}

float fraction(float x) {
  return x - std::floor(x);
}

}  // namespace

cv::Mat cast_shadows(const cv::Mat& height, double resolution, const Sun& sun) {
  // The height of the shadow's upper edge is carried from the sun's side across the field: at each pixel it is that of
  // the neighbour towards the sun, lowered by the sun's slope, or the surface itself where that is higher.
  const double east = std::sin(sun.azimuth), north = std::cos(sun.azimuth);
  const double longer = std::max(std::abs(east), std::abs(north));
  const int du = east >= 0 ? 1 : -1, dv = north >= 0 ? -1 : 1;
  const bool by_rows = std::abs(north) >= std::abs(east);
  const float part = static_cast<float>(std::min(std::abs(east), std::abs(north)) / longer);
  const float drop = static_cast<float>(resolution / longer * std::tan(sun.elevation));
  // A surface is in full shadow when the edge passes this far above it: the sun's disc and rough edges.
  const float soft = static_cast<float>(1.5 * drop);
  cv::Mat shadow(height.size(), CV_8U);
  const int width = height.cols;
  std::vector<float> previous(static_cast<size_t>(width)), edge(static_cast<size_t>(width));
  for (int k = 0; k < height.rows; ++k) {
    const int v = dv > 0 ? height.rows - 1 - k : k;
    const float* surface = height.ptr<float>(v);
    uint8_t* out = shadow.ptr<uint8_t>(v);
    for (int i = 0; i < width; ++i) {
      const int u = du > 0 ? width - 1 - i : i;
      const int side = std::clamp(u + du, 0, width - 1);
      float carried = surface[u];
      if (k > 0 && i > 0) {
        const float straight = by_rows ? previous[static_cast<size_t>(u)] : edge[static_cast<size_t>(side)];
        carried = (1 - part) * straight + part * previous[static_cast<size_t>(side)] - drop;
      }
      out[u] = static_cast<uint8_t>(255.0F * std::clamp((carried - surface[u]) / soft, 0.0F, 1.0F));
      edge[static_cast<size_t>(u)] = std::max(carried, surface[u]);
    }
    std::swap(previous, edge);
  }
  return shadow;
}

cv::Mat render(const Canvas& canvas, const Epoch& epoch, const LightOptions& light, bool colour) {
  const EpochOptions& options = epoch.options();
  const double scale = canvas.resolution / kPatternCell;
  const cv::Size cells(static_cast<int>(canvas.size().width * scale) + 3,
                       static_cast<int>(canvas.size().height * scale) + 3);
  const cv::Mat soil = pattern(options, "soil", cells, 80.0, 0.55, 45.0),
                vegetation = pattern(options, "vegetation", cells, 25.0, 0.4, 16.0);
  const cv::Mat grain = noise_tile(mix(options.epoch_seed, "grain"), 0.8),
                clumps = noise_tile(mix(options.epoch_seed, "clumps"), 3.0);
  cv::Mat image = cast_shadows(canvas.height, canvas.resolution, epoch.sun());
  if (colour) {
    cv::Mat wide(image.size(), CV_8UC3);
    cv::cvtColor(image, wide, cv::COLOR_GRAY2BGR);
    image = wide;
  }
  std::vector<Paint> paints;
  for (const Material& material : canvas.materials)
    paints.push_back(prepare(material, static_cast<float>(epoch.options().snow)));
  const Sun& sun = epoch.sun();
  const float sx = static_cast<float>(std::sin(sun.azimuth) * std::cos(sun.elevation)),
              sy = static_cast<float>(std::cos(sun.azimuth) * std::cos(sun.elevation)),
              sz = static_cast<float>(std::sin(sun.elevation));
  const float sky = static_cast<float>(light.sky);
  // Light relative to full sun on level ground, to display brightness.
  std::array<float, 512> display{};
  for (size_t i = 0; i < display.size(); ++i)
    display[i] = static_cast<float>(std::pow(static_cast<double>(i) / 256.0, 1 / 2.2));
  const float texel = static_cast<float>(canvas.resolution * 10.0);  // fine tiles have 0.1 m cells

  const auto shade_rows = [&](int first, int last, int step, float gain, double* sum) {
    const size_t width = static_cast<size_t>(canvas.size().width);
    std::vector<float> soil_row(width), vegetation_row(width);
    const PatternRows soil_rows(soil, scale), vegetation_rows(vegetation, scale);
    const int channels = colour ? 3 : 1;
    for (int v = first; v < last; v += step) {
      soil_rows.read(v, soil_row);
      vegetation_rows.read(v, vegetation_row);
      const float* height = canvas.height.ptr<float>(v);
      const float* above = canvas.height.ptr<float>(std::max(0, v - 1));
      const float* below = canvas.height.ptr<float>(std::min(canvas.size().height - 1, v + 1));
      const uint16_t* label = canvas.label.ptr<uint16_t>(v);
      uint8_t* out = image.ptr<uint8_t>(v);
      const float north = static_cast<float>(canvas.north_max - (v + 0.5) * canvas.resolution);
      const int tv = static_cast<int>(static_cast<float>(v) * texel) & (kTile - 1);
      const int8_t *grain_row = grain.ptr<int8_t>(tv),
                   *clump_row = clumps.ptr<int8_t>((tv * 3 / 2 + 311) & (kTile - 1));
      const float slope = static_cast<float>(0.5 / canvas.resolution);
      for (size_t u = 0; u < width; ++u) {
        const Paint& p = paints[label[u]];
        const float east = static_cast<float>(canvas.east_min + (static_cast<double>(u) + 0.5) * canvas.resolution);
        const int tu = static_cast<int>(static_cast<float>(u) * texel);
        const float m = std::clamp(p.soil * soil_row[u] + p.vegetation * vegetation_row[u], -1.6F, 1.6F);
        float k = 1 + p.grain * static_cast<float>(grain_row[tu & (kTile - 1)]) +
                  p.clumps * static_cast<float>(clump_row[(tu + tu / 7) & (kTile - 1)]);
        if (p.rows > 0) k += p.rows * (std::abs(2 * fraction(p.row_x * east + p.row_y * north) - 1) - 0.5F);
        if (p.wheels > 0) {
          const float w = fraction(p.wheel_x * east + p.wheel_y * north + p.wheel_phase);
          // Two wheels, some 2 m apart.
          if (w < p.wheel_width || std::abs(w - 8 * p.wheel_width) < 0.5F * p.wheel_width) k -= p.wheels;
        }
        const size_t left = u > 0 ? u - 1 : 0, right = u + 1 < width ? u + 1 : u;
        const float gx = std::clamp((height[right] - height[left]) * slope, -3.0F, 3.0F),
                    gy = std::clamp((above[u] - below[u]) * slope, -3.0F, 3.0F);
        const float facing = std::max(0.0F, (sz - gx * sx - gy * sy) / std::sqrt(1 + gx * gx + gy * gy)) / sz;
        const float lit = 1 - static_cast<float>(out[channels * static_cast<int>(u)]) * (1.0F / 255);
        const float brightness = (std::min(2.2F, facing) * lit + sky) / (1 + sky);
        const float factor = k * gain * display[static_cast<size_t>(std::clamp(brightness * 256.0F, 0.0F, 511.0F))];
        if (sum != nullptr) {
          const cv::Vec3f c = p.middle + m * p.half;
          *sum += static_cast<double>(factor * (0.114F * c[0] + 0.587F * c[1] + 0.299F * c[2]));
        } else if (colour) {
          for (int i = 0; i < 3; ++i)
            out[3 * static_cast<int>(u) + i] = cv::saturate_cast<uint8_t>(factor * (p.middle[i] + m * p.half[i]));
        } else {
          const float grey = 0.114F * (p.middle[0] + m * p.half[0]) + 0.587F * (p.middle[1] + m * p.half[1]) +
                             0.299F * (p.middle[2] + m * p.half[2]);
          out[u] = cv::saturate_cast<uint8_t>(factor * grey);
        }
      }
    }
  };

  // Exposure from a sparse look at the scene, as a camera's own.
  double sum = 0;
  constexpr int kLook = 16;
  shade_rows(0, canvas.size().height, kLook, 1.0F, &sum);
  const int looked_rows = (canvas.size().height + kLook - 1) / kLook;
  const double looked = static_cast<double>(looked_rows) * canvas.size().width;
  const float gain = static_cast<float>(light.mean_level / std::max(1.0, sum / looked));
  const int rows = canvas.size().height;
  auto lower_half = std::async(std::launch::async, [&] { shade_rows(rows / 2, rows, 1, gain, nullptr); });
  shade_rows(0, rows / 2, 1, gain, nullptr);
  lower_half.get();
  return image;
}

}  // namespace orthonav::simulate
