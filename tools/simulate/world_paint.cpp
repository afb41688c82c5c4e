#include "tools/simulate/world_paint.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
#include <stdexcept>

#include <opencv2/imgproc.hpp>

#include "tools/simulate/world_random.h"

namespace orthonav::simulate {

namespace {

constexpr double kPi = std::numbers::pi;

class Painter {
 public:
  Painter(Canvas& canvas, const Epoch& epoch, const Terrain& terrain)
      : canvas_(canvas),
        epoch_(epoch),
        terrain_(terrain),
        clumps_(noise_tile(mix(epoch.options().seed, "crowns"), 5.0)),
        twigs_(noise_tile(mix(epoch.options().seed, "twigs"), 1.2)) {}

  void ground() {
    for (int v = 0; v < canvas_.height.rows; ++v) {
      float* row = canvas_.height.ptr<float>(v);
      for (int u = 0; u < canvas_.height.cols; ++u) row[u] = static_cast<float>(terrain_.height(position(u, v)));
    }
    add(Material{});
  }

  void patch(const Patch& patch) {
    const uint16_t label = keyed(Epoch::key(patch), [&] { return epoch_.ground(patch); });
    std::vector<cv::Point> points;
    constexpr int kShift = 4;
    for (const Eigen::Vector2d& p : patch.outline) {
      const Eigen::Vector2d q = pixel(p) * (1 << kShift);
      points.emplace_back(cvRound(q.x()), cvRound(q.y()));
    }
    cv::fillPoly(canvas_.label, std::vector<std::vector<cv::Point>>{points}, cv::Scalar(label), cv::LINE_8, kShift);
  }

  void crops() {
    for (int v = 0; v < canvas_.height.rows; ++v) {
      float* height = canvas_.height.ptr<float>(v);
      const uint16_t* label = canvas_.label.ptr<uint16_t>(v);
      for (int u = 0; u < canvas_.height.cols; ++u) height[u] += canvas_.materials[label[u]].height;
    }
  }

  void building(const Building& b) {
    const uint16_t label = add(epoch_.roof(b));
    Material dark = canvas_.materials[label];
    dark.low *= 0.5F;
    dark.high *= 0.5F;
    const uint16_t fixtures = add(dark);
    const float base = static_cast<float>(terrain_.height(b.centre) + b.eave);
    Random random(mix(epoch_.options().seed, b.id));
    const bool skylights = b.hall && random.chance(0.5),
               panels = !b.hall && b.roof != Roof::kFlat && random.chance(0.25);
    const double chimney_a = random.uniform(-0.4, 0.4) * b.length, chimney_b = random.uniform(0.05, 0.2) * b.width;
    each(b.centre, b.angle, 0.5 * b.length, 0.5 * b.width, [&](double x, double y, float& height, uint16_t& cover) {
      const double inside = 0.5 * b.width - std::abs(y), end = 0.5 * b.length - std::abs(x);
      double rise = 0;
      switch (b.roof) {
        case Roof::kGable:
          rise = b.pitch * inside;
          break;
        case Roof::kHip:
          rise = b.pitch * std::min(inside, end);
          break;
        case Roof::kShed:
          rise = 0.5 * b.pitch * (y + 0.5 * b.width);
          break;
        case Roof::kFlat:
          rise = std::min(inside, end) < 0.35 ? 0.4 : 0.0;
          break;
      }
      cover = label;
      if (skylights && std::abs(std::remainder(x, 7.0)) < 0.6 && inside > 2.5 && end > 2.0) cover = fixtures;
      if (panels && y > 0.12 * b.width && inside > 0.8 && std::abs(x) < 0.28 * b.length) cover = fixtures;
      if (!b.hall && std::abs(x - chimney_a) < 0.35 && std::abs(y - chimney_b) < 0.35) {
        rise += 1.1;
        cover = fixtures;
      }
      height = std::max(height, base + static_cast<float>(rise));
    });
  }

  void tree(const Tree& planted) {
    const Tree t = epoch_.grown(planted);
    const uint16_t label = keyed(Epoch::key(t), [&] { return epoch_.crown(t); });
    const float base = static_cast<float>(terrain_.height(t.position));
    const double leaves = epoch_.leaves(t);
    // Bare twigs hide little of the ground: a pixel belongs to the crown where the twigs' noise says so.
    const double threshold = 127.0 * (1.0 - 1.9 * leaves);
    const uint64_t place = mix(epoch_.options().seed, t.id);
    const int du = static_cast<int>(place % kTile), dv = static_cast<int>((place >> 20) % kTile);
    const double clump_scale = 10.0 / std::clamp(0.35 * t.radius, 0.35, 1.0);
    each(t.position, 0, 1.25 * t.radius, 1.25 * t.radius, [&](double x, double y, float& height, uint16_t& cover) {
      const int8_t lobe = clumps_.at<int8_t>((dv + static_cast<int>(std::floor(y * clump_scale))) & (kTile - 1),
                                             (du + static_cast<int>(std::floor(x * clump_scale))) & (kTile - 1));
      const double r = std::hypot(x, y) / t.radius + lobe * (0.22 / 64);
      if (r >= 1) return;
      if (leaves < 0.95) {
        const int8_t twig = twigs_.at<int8_t>((du + static_cast<int>(std::floor(y * 10))) & (kTile - 1),
                                              (dv + static_cast<int>(std::floor(x * 10))) & (kTile - 1));
        if (2.0 * twig < threshold) return;
      }
      const double crown = t.plant == Plant::kConifer ? 1 - r : std::sqrt(1 - r * r);
      const double low = t.plant == Plant::kShrub ? 0.1 : 0.35;
      const float top = base + static_cast<float>(t.height * (low + (1 - low) * crown) -
                                                  lobe * (0.25 / 64) * std::min(1.5, t.radius));
      if (top > height) {
        height = top;
        cover = label;
      }
    });
  }

  void vehicle(const Slot& slot) {
    Random random(mix(epoch_.options().epoch_seed, slot.id));
    Slot s = slot;
    s.position += 0.25 * Eigen::Vector2d(random.normal(), random.normal());
    s.angle += 0.03 * random.normal() + (random.chance(0.5) ? kPi : 0);
    const uint16_t label = add(epoch_.vehicle(s));
    const uint16_t glass = keyed(1, [] {
      Material m;
      m.low = {44, 42, 40};
      m.high = {62, 60, 58};
      return m;
    });
    const float base = static_cast<float>(terrain_.height(s.position));
    const bool car = s.height < 2.0;
    each(s.position, s.angle, 0.5 * s.length, 0.5 * s.width, [&](double x, double y, float& height, uint16_t& cover) {
      const double along = x / s.length;
      const bool cabin = !car || (along > -0.42 && along < 0.22);
      height = std::max(height, base + static_cast<float>(cabin ? s.height : 0.6 * s.height));
      cover = car && std::abs(y) < 0.42 * s.width && ((along > 0.1 && along < 0.24) || (along > -0.45 && along < -0.34))
                  ? glass
                  : label;
    });
  }

  void bale(const Eigen::Vector2d& place) {
    const uint16_t label = keyed(2, [] {
      Material m;
      m.low = {104, 150, 172};
      m.high = {134, 182, 206};
      return m;
    });
    const float top = static_cast<float>(terrain_.height(place) + 1.3);
    each(place, 0, 0.75, 0.75, [&](double x, double y, float& height, uint16_t& cover) {
      if (x * x + y * y > 0.56) return;
      height = std::max(height, top);
      cover = label;
    });
  }

  void pole(const Pole& pole) {
    const float top = static_cast<float>(terrain_.height(pole.position) + pole.height);
    each(pole.position, 0, 0.12, 0.12,
         [&](double, double, float& height, uint16_t&) { height = std::max(height, top); });
  }

 private:
  Eigen::Vector2d position(int u, int v) const {
    return {canvas_.east_min + (u + 0.5) * canvas_.resolution, canvas_.north_max - (v + 0.5) * canvas_.resolution};
  }
  Eigen::Vector2d pixel(const Eigen::Vector2d& p) const {
    return {(p.x() - canvas_.east_min) / canvas_.resolution - 0.5,
            (canvas_.north_max - p.y()) / canvas_.resolution - 0.5};
  }

  uint16_t add(const Material& material) {
    if (canvas_.materials.size() > std::numeric_limits<uint16_t>::max())
      throw std::runtime_error("world: more than 65536 materials; the area is too large for one world");
    canvas_.materials.push_back(material);
    return static_cast<uint16_t>(canvas_.materials.size() - 1);
  }
  template <class Make>
  uint16_t keyed(uint64_t key, Make make) {
    const auto found = labels_.find(key);
    if (found != labels_.end()) return found->second;
    return labels_[key] = add(make());
  }

  // Calls `body(x, y, height, label)` for the pixels of a rectangle, x along `angle`, from its centre.
  template <class Body>
  void each(const Eigen::Vector2d& centre, double angle, double half_length, double half_width, Body body) {
    const double c = std::cos(angle), s = std::sin(angle);
    const Eigen::Vector2d reach(std::abs(c) * half_length + std::abs(s) * half_width,
                                std::abs(s) * half_length + std::abs(c) * half_width);
    const Eigen::Vector2d low = pixel(centre + Eigen::Vector2d(-reach.x(), reach.y())),
                          high = pixel(centre + Eigen::Vector2d(reach.x(), -reach.y()));
    const int u0 = std::max(0, static_cast<int>(std::floor(low.x()))),
              u1 = std::min(canvas_.height.cols - 1, static_cast<int>(std::ceil(high.x())));
    const int v0 = std::max(0, static_cast<int>(std::floor(low.y()))),
              v1 = std::min(canvas_.height.rows - 1, static_cast<int>(std::ceil(high.y())));
    for (int v = v0; v <= v1; ++v) {
      float* height = canvas_.height.ptr<float>(v);
      uint16_t* label = canvas_.label.ptr<uint16_t>(v);
      for (int u = u0; u <= u1; ++u) {
        const Eigen::Vector2d d = position(u, v) - centre;
        const double x = c * d.x() + s * d.y(), y = c * d.y() - s * d.x();
        if (std::abs(x) <= half_length && std::abs(y) <= half_width) body(x, y, height[u], label[u]);
      }
    }
  }

  Canvas& canvas_;
  const Epoch& epoch_;
  const Terrain& terrain_;
  cv::Mat clumps_, twigs_;
  std::map<uint64_t, uint16_t> labels_;
};

}  // namespace

Terrain::Terrain(const Bounds& bounds, double rms, double wavelength, uint64_t seed)
    : origin_(bounds.east_min - 4 * kCell, bounds.north_min - 4 * kCell) {
  const cv::Size size(static_cast<int>((bounds.east_max - bounds.east_min) / kCell) + 10,
                      static_cast<int>((bounds.north_max - bounds.north_min) / kCell) + 10);
  height_ = noise_grid(mix(seed, "terrain"), size, kCell, wavelength, 24.0, 1.4) * rms;
  cv::GaussianBlur(height_, height_, {}, 1.0);
}

double Terrain::height(const Eigen::Vector2d& p) const {
  const double x = std::clamp((p.x() - origin_.x()) / kCell, 0.0, height_.cols - 1.001);
  const double y = std::clamp((p.y() - origin_.y()) / kCell, 0.0, height_.rows - 1.001);
  const int i = static_cast<int>(x), j = static_cast<int>(y);
  const double a = x - i, b = y - j;
  const float *row = height_.ptr<float>(j) + i, *next = height_.ptr<float>(j + 1) + i;
  return (1 - b) * ((1 - a) * row[0] + a * row[1]) + b * ((1 - a) * next[0] + a * next[1]);
}

Canvas paint(const Layout& layout, const Epoch& epoch, const Terrain& terrain, const Bounds& bounds,
             double resolution) {
  Canvas canvas;
  canvas.east_min = bounds.east_min;
  canvas.north_max = bounds.north_max;
  canvas.resolution = resolution;
  const cv::Size size(static_cast<int>(std::ceil((bounds.east_max - bounds.east_min) / resolution)),
                      static_cast<int>(std::ceil((bounds.north_max - bounds.north_min) / resolution)));
  canvas.height.create(size, CV_32F);
  canvas.label = cv::Mat::zeros(size, CV_16U);
  Painter painter(canvas, epoch, terrain);
  painter.ground();
  for (const Patch& patch : layout.patches)
    if (epoch.present(patch)) painter.patch(patch);
  painter.crops();
  for (const Patch& patch : layout.patches)
    for (const Eigen::Vector2d& place : epoch.bales(patch)) painter.bale(place);
  for (const Slot& slot : layout.slots)
    if (epoch.present(slot)) painter.vehicle(slot);
  for (const Building& building : layout.buildings)
    if (epoch.present(building)) painter.building(building);
  for (const Pole& pole : layout.poles) painter.pole(pole);
  for (const Tree& tree : layout.trees)
    if (epoch.present(tree)) painter.tree(tree);
  return canvas;
}

}  // namespace orthonav::simulate
