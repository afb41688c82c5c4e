#include "tools/simulate/world_layout.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "tools/simulate/world_layout_builder.h"

namespace orthonav::simulate {

namespace {

constexpr double kPi = std::numbers::pi;

Eigen::Vector2d direction_of(double angle) {
  return {std::cos(angle), std::sin(angle)};
}

}  // namespace

Layout make_layout(const LandOptions& options, const Bounds& bounds, uint64_t seed) {
  return LayoutBuilder(options, bounds, seed).build();
}

LayoutBuilder::LayoutBuilder(const LandOptions& options, const Bounds& bounds, uint64_t seed)
    : options_(options),
      bounds_(bounds),
      seed_(mix(seed, "layout")),
      random_(seed_),
      bend_(mix(seed, "bend"), options.border_bend, options.border_wavelength) {}

Layout LayoutBuilder::build() {
  const Eigen::Vector2d centre(0.5 * (bounds_.east_min + bounds_.east_max),
                               0.5 * (bounds_.north_min + bounds_.north_max));
  const double side = 1.5 * std::max(bounds_.east_max - bounds_.east_min, bounds_.north_max - bounds_.north_min);
  const Outline land = rectangle(centre, random_.uniform(0.15, kPi / 2 - 0.15), side, side);
  std::vector<std::pair<Segment, int>> cuts;
  std::vector<Outline> parcels = divide(
      land, options_.parcel_area, 0.16, 0.2, [this] { return random_.uniform(); },
      [&](const Segment& cut, int depth) { cuts.emplace_back(cut, depth); });
  std::erase_if(parcels, [this](const Outline& parcel) { return outside(parcel); });

  // Built-up land lies together; the rest is dealt at random.
  const Eigen::Vector2d village =
      centre + Eigen::Vector2d(random_.uniform(-0.15, 0.15), random_.uniform(-0.15, 0.15)) * side;
  const Eigen::Vector2d works_place =
      centre - (village - centre) + Eigen::Vector2d(random_.uniform(-60, 60), random_.uniform(-60, 60));
  double total = 0;
  for (const Outline& parcel : parcels) total += area(parcel);
  const std::array<double, 9> shares{options_.settlement, options_.industrial, options_.farmstead,
                                     options_.pond,       options_.wood,       options_.orchard,
                                     options_.pasture,    options_.meadow,     options_.arable};
  double sum = 0;
  for (const double share : shares) sum += share;
  size_t use = 0;
  double left = shares[0] / sum * total;
  while (!parcels.empty()) {
    while (use + 1 < shares.size() && left <= 0) left += shares[++use] / sum * total;
    size_t pick = 0;
    if (use <= 1) {
      const Eigen::Vector2d place = use == 0 ? village : works_place;
      for (size_t i = 1; i < parcels.size(); ++i)
        if ((centroid(parcels[i]) - place).norm() < (centroid(parcels[pick]) - place).norm()) pick = i;
    } else {
      pick = static_cast<size_t>(random_.index(static_cast<int>(parcels.size())));
    }
    const Outline parcel = parcels[pick];
    parcels.erase(parcels.begin() + static_cast<std::ptrdiff_t>(pick));
    left -= area(parcel);
    switch (use) {
      case 0:
        settlement(parcel);
        break;
      case 1:
        industrial(parcel);
        break;
      case 2:
        farmstead(parcel);
        break;
      case 3:
        pond(parcel);
        break;
      case 4:
        wood(parcel);
        break;
      case 5:
        orchard(parcel);
        break;
      case 6:
        grassland(parcel, Cover::kPasture);
        break;
      case 7:
        grassland(parcel, Cover::kMeadow);
        break;
      default:
        arable(parcel);
        break;
    }
  }
  // The deepest cuts are the least of the borders, and lie below the others.
  std::stable_sort(cuts.begin(), cuts.end(), [](const auto& a, const auto& b) { return a.second > b.second; });
  for (const auto& [cut, depth] : cuts) border(cut, depth);
  layout_.patches.insert(layout_.patches.end(), roads_.begin(), roads_.end());
  layout_.patches.insert(layout_.patches.end(), markings_.begin(), markings_.end());
  return std::move(layout_);
}

Outline LayoutBuilder::bend(const Outline& outline, double step) const {
  Outline bent;
  for (size_t i = 0; i < outline.size(); ++i) {
    const Eigen::Vector2d &a = outline[i], &b = outline[(i + 1) % outline.size()];
    const int pieces = std::max(1, static_cast<int>((b - a).norm() / step));
    for (int k = 0; k < pieces; ++k) {
      const Eigen::Vector2d p = a + (b - a) * (static_cast<double>(k) / pieces);
      bent.push_back(p + bend_(p));
    }
  }
  return bent;
}

double LayoutBuilder::bend_angle(const Eigen::Vector2d& position, double angle) const {
  const Eigen::Vector2d a = position - direction_of(angle), b = position + direction_of(angle);
  const Eigen::Vector2d d = b + bend_(b) - a - bend_(a);
  return std::atan2(d.y(), d.x());
}

bool LayoutBuilder::outside(const Outline& outline) const {
  const double reach = 4.0 * options_.border_bend + 10.0;
  Eigen::Vector2d low = outline.front(), high = outline.front();
  for (const Eigen::Vector2d& p : outline) {
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
  }
  return high.x() < bounds_.east_min - reach || low.x() > bounds_.east_max + reach ||
         high.y() < bounds_.north_min - reach || low.y() > bounds_.north_max + reach;
}

Eigen::Vector2d LayoutBuilder::point_in(const Outline& polygon) {
  const Box box = bounding_box(polygon);
  const Eigen::Vector2d along = direction_of(box.angle), across(-along.y(), along.x());
  for (int attempt = 0; attempt < 50; ++attempt) {
    Eigen::Vector2d p =
        box.centre + along * box.length * random_.uniform(-0.5, 0.5) + across * box.width * random_.uniform(-0.5, 0.5);
    if (contains(polygon, p)) return p;
  }
  return centroid(polygon);
}

void LayoutBuilder::patch(const Outline& outline, Cover cover, uint64_t field, double row_angle) {
  if (outline.size() < 3 || outside(outline)) return;
  const Patch made{bend(outline, 4.0), cover, next_id_++, field, bend_angle(outline.front(), row_angle)};
  layout_.patches.push_back(made);
}

void LayoutBuilder::strip(const Segment& segment, double offset, double width, Cover cover) {
  const Eigen::Vector2d d = segment.b - segment.a;
  if (d.norm() < 1.0) return;
  const Eigen::Vector2d side = Eigen::Vector2d(-d.y(), d.x()).normalized();
  const Eigen::Vector2d centre = 0.5 * (segment.a + segment.b) + side * offset;
  const Outline outline = rectangle(centre, std::atan2(d.y(), d.x()), d.norm() + 0.5 * width, width);
  if (outside(outline)) return;
  std::vector<Patch>& where = cover == Cover::kMarking ? markings_ : roads_;
  where.push_back({bend(outline, 3.0), cover, next_id_, next_id_, std::atan2(d.y(), d.x())});
  ++next_id_;
}

void LayoutBuilder::blob(const Eigen::Vector2d& centre, double radius, Cover cover) {
  Outline outline;
  const SmoothField wobble(mix(seed_, next_id_), 0.12 * radius, 1.2 * radius);
  const double stretch = random_.uniform(0.5, 1.0), turn = random_.uniform(0, kPi);
  for (int i = 0; i < 36; ++i) {
    const double a = i * 2 * kPi / 36;
    const Eigen::Vector2d p =
        centre + Eigen::Rotation2Dd(turn) * Eigen::Vector2d(radius * std::cos(a), stretch * radius * std::sin(a));
    outline.push_back(p + wobble(p));
  }
  patch(outline, cover, next_id_, random_.uniform(0, kPi));
}

void LayoutBuilder::wander(const Eigen::Vector2d& from, const Eigen::Vector2d& to, double width, Cover cover) {
  const SmoothField sway(mix(seed_, next_id_), 2.0, 30.0);
  const Eigen::Vector2d d = to - from, side = Eigen::Vector2d(-d.y(), d.x()).normalized();
  Outline left, right;
  const int steps = std::max(2, static_cast<int>(d.norm() / 2.0));
  for (int i = 0; i <= steps; ++i) {
    const Eigen::Vector2d p = from + d * (static_cast<double>(i) / steps);
    const double half = 0.5 * width * random_.uniform(0.6, 1.4);
    left.push_back(p + sway(p) + side * half);
    right.push_back(p + sway(p) - side * half);
  }
  right.insert(right.end(), left.rbegin(), left.rend());
  if (outside(right)) return;
  layout_.patches.push_back({bend(right, 10.0), cover, next_id_, next_id_, std::atan2(d.y(), d.x())});
  ++next_id_;
}

void LayoutBuilder::tree(const Eigen::Vector2d& position, double radius, double height, Plant plant) {
  const Eigen::Vector2d p = position + bend_(position);
  layout_.trees.push_back({p, radius, height, plant, next_id_++});
}

void LayoutBuilder::building(const Eigen::Vector2d& centre, double angle, double length, double width, double eave,
                             double pitch, Roof roof, bool hall) {
  layout_.buildings.push_back(
      {centre + bend_(centre), bend_angle(centre, angle), length, width, eave, pitch, roof, hall, next_id_++});
}

void LayoutBuilder::slot(const Eigen::Vector2d& position, double angle, double length, double width, double height,
                         double occupancy) {
  layout_.slots.push_back(
      {position + bend_(position), bend_angle(position, angle), length, width, height, next_id_++, occupancy});
}

void LayoutBuilder::dashes(const Segment& segment, double offset, double width, double dash, double gap) {
  const Eigen::Vector2d d = segment.b - segment.a;
  const double length = d.norm();
  for (double s = gap; s + dash < length; s += dash + gap)
    strip({segment.a + d * (s / length), segment.a + d * ((s + dash) / length)}, offset, width, Cover::kMarking);
}

void LayoutBuilder::border(const Segment& segment, int depth) {
  const double draw = random_.uniform();
  if (depth <= 1) {
    road(segment, depth == 0 ? 6.5 : 5.0, true);
  } else if (depth <= 3 && draw < 0.35) {
    road(segment, 3.6, false);
  } else if (draw < 0.30) {
    track(segment);
  } else if (draw < 0.48) {
    strip(segment, 0, random_.uniform(2.5, 4.5), Cover::kVerge);
    hedge(segment, 0);
  } else if (draw < 0.62) {
    strip(segment, 0, random_.uniform(3.5, 6.0), Cover::kVerge);
    strip(segment, random_.uniform(-0.5, 0.5), random_.uniform(0.7, 1.8), Cover::kWater);
    hedge(segment, random_.chance(0.5) ? 2.2 : -2.2);
  } else if (draw < 0.85) {
    strip(segment, 0, random_.uniform(0.8, 2.5), Cover::kVerge);
  }
}

void LayoutBuilder::road(const Segment& segment, double width, bool marked) {
  strip(segment, 0, width + random_.uniform(4.0, 6.0), Cover::kVerge);
  strip(segment, 0, width + 1.2, Cover::kGravel);
  strip(segment, 0, width, Cover::kAsphalt);
  const Eigen::Vector2d d = segment.b - segment.a;
  const double length = d.norm(), angle = std::atan2(d.y(), d.x());
  if (length < 5) return;
  const Eigen::Vector2d along = d / length, side(-along.y(), along.x());
  if (marked) {
    dashes(segment, 0, 0.15, 4.0, 8.0);
    if (width > 6) {
      strip(segment, 0.5 * width - 0.25, 0.13, Cover::kMarking);
      strip(segment, 0.25 - 0.5 * width, 0.13, Cover::kMarking);
    }
  }
  for (double s = random_.uniform(0, 40); s < length; s += random_.uniform(15, 70)) {
    const double repair = random_.uniform(1.0, 9.0);
    strip({segment.a + along * s, segment.a + along * std::min(length, s + repair)}, random_.uniform(-0.3, 0.3) * width,
          random_.uniform(0.4, 0.45 * width), Cover::kRepair);
  }
  for (double s = random_.uniform(0, 60); s < length; s += random_.uniform(25, 120)) {
    const double lane = random_.chance(0.5) ? 1.0 : -1.0;
    slot(segment.a + along * s + side * lane * 0.25 * width, angle + (lane > 0 ? kPi : 0.0), 4.4, 1.8, 1.5, 0.25);
  }
  const bool avenue = random_.chance(0.35);
  const double spacing = avenue ? random_.uniform(9, 14) : random_.uniform(30, 80);
  const double hand = random_.chance(0.5) ? 1.0 : -1.0;
  for (double s = 0; s < length; s += spacing * random_.uniform(0.85, 1.2)) {
    if (random_.chance(0.25)) continue;
    const double radius = random_.uniform(2.0, 4.2);
    tree(segment.a + along * s + side * hand * (0.5 * width + 3.0), radius, radius * random_.uniform(2.2, 2.9),
         Plant::kDeciduous);
  }
  for (double s = 20; s < length; s += 45) {
    const Eigen::Vector2d p = segment.a + along * s - side * hand * (0.5 * width + 2.2);
    layout_.poles.push_back({p + bend_(p), 8.0});
  }
}

void LayoutBuilder::track(const Segment& segment) {
  strip(segment, 0, random_.uniform(4.0, 5.5), Cover::kVerge);
  const Cover surface = random_.chance(0.5) ? Cover::kTrack : Cover::kGravel;
  strip(segment, 0.85, random_.uniform(0.7, 1.1), surface);
  strip(segment, -0.85, random_.uniform(0.7, 1.1), surface);
  if (random_.chance(0.4)) hedge(segment, 3.0);
}

void LayoutBuilder::hedge(const Segment& segment, double offset) {
  const Eigen::Vector2d d = segment.b - segment.a;
  const double length = d.norm();
  if (length < 5) return;
  const Eigen::Vector2d along = d / length, side(-along.y(), along.x());
  const double density = random_.uniform(0.15, 0.95);
  const SmoothField gaps(mix(seed_, next_id_), 1.0, 40.0);
  for (double s = 0; s < length; s += random_.uniform(1.1, 2.4)) {
    const Eigen::Vector2d p = segment.a + along * s + side * (offset + random_.normal() * 0.4);
    if (0.5 + 0.4 * gaps(p).x() > density) continue;
    if (random_.chance(0.08)) {
      const double radius = random_.uniform(1.8, 4.0);
      tree(p, radius, radius * random_.uniform(2.0, 2.8), Plant::kDeciduous);
    } else {
      const double radius = random_.uniform(0.7, 1.5);
      tree(p, radius, radius * random_.uniform(1.2, 2.0), Plant::kShrub);
    }
  }
}

void LayoutBuilder::scatter(const Outline& polygon, double per_hectare) {
  const int count =
      static_cast<int>(area(polygon) * 1e-4 * per_hectare * random_.uniform(0.2, 1.8) + random_.uniform());
  for (int i = 0; i < count; ++i) {
    const Eigen::Vector2d p = point_in(polygon);
    if (random_.chance(0.2)) {
      const double radius = random_.uniform(1.5, 4.5);
      tree(p, radius, radius * random_.uniform(1.7, 2.6), random_.chance(0.8) ? Plant::kDeciduous : Plant::kConifer);
    } else {
      const double radius = random_.uniform(0.3, 1.2);
      tree(p, radius, radius * random_.uniform(1.0, 1.8), Plant::kShrub);
    }
  }
}

void LayoutBuilder::arable(const Outline& polygon) {
  const uint64_t field = next_id_;
  const double row_angle = bounding_box(polygon).angle;
  patch(polygon, Cover::kHeadland, field, row_angle + kPi / 2);
  patch(inset(polygon, random_.uniform(9, 14)), Cover::kArable, field, row_angle);
  if (random_.chance(0.4)) scatter(polygon, 0.7);
}

void LayoutBuilder::grassland(const Outline& polygon, Cover cover) {
  patch(polygon, cover, next_id_, bounding_box(polygon).angle);
  const int wet = random_.index(4);
  for (int i = 0; i < wet; ++i)
    blob(point_in(polygon), random_.uniform(2, 12), random_.chance(0.6) ? Cover::kReed : Cover::kWornGrass);
  const int paths = random_.index(cover == Cover::kPasture ? 4 : 3);
  for (int i = 0; i < paths; ++i)
    wander(point_in(polygon), point_in(polygon), random_.uniform(0.4, 1.2), Cover::kWornGrass);
  if (cover == Cover::kPasture) blob(point_in(polygon), random_.uniform(2, 5), Cover::kDirt);
  scatter(polygon, options_.scatter * (cover == Cover::kPasture ? 1.6 : 0.8));
}

void LayoutBuilder::wood(const Outline& polygon) {
  patch(polygon, Cover::kForestFloor, next_id_, 0);
  wander(point_in(polygon), point_in(polygon), 2.5, Cover::kTrack);
  const double spacing = random_.uniform(4.2, 6.0), conifers = random_.uniform(0.0, 0.6);
  const SmoothField stand(mix(seed_, next_id_), 1.0, 60.0);
  const Box box = bounding_box(polygon);
  const Outline inner = inset(polygon, 2.0);
  const Eigen::Vector2d along = direction_of(box.angle), across(-along.y(), along.x());
  for (double a = -0.5 * box.length; a < 0.5 * box.length; a += spacing) {
    for (double b = -0.5 * box.width; b < 0.5 * box.width; b += spacing) {
      const Eigen::Vector2d p =
          box.centre + along * (a + random_.normal() * 1.2) + across * (b + random_.normal() * 1.2);
      const double keep = random_.uniform(), kind = random_.uniform(), size = random_.uniform();
      const Eigen::Vector2d s = stand(p);
      if (!contains(inner, p) || keep < 0.12 + 0.15 * s.y()) continue;
      const bool conifer = kind < conifers + 0.3 * s.x();
      const double radius = conifer ? 1.8 + 1.4 * size : 2.2 + 2.8 * size;
      tree(p, radius, (conifer ? 14.0 : 10.0) + 6.0 * size + 2.0 * s.y(),
           conifer ? Plant::kConifer : Plant::kDeciduous);
    }
  }
}

void LayoutBuilder::orchard(const Outline& polygon) {
  const Box box = bounding_box(polygon);
  patch(polygon, Cover::kOrchard, next_id_, box.angle);
  const Outline inner = inset(polygon, 4.0);
  const Eigen::Vector2d along = direction_of(box.angle), across(-along.y(), along.x());
  const double step = random_.uniform(4.5, 7.0), rows = random_.uniform(6.0, 9.0), radius = random_.uniform(1.3, 2.3);
  for (double a = -0.5 * box.length; a < 0.5 * box.length; a += step) {
    for (double b = -0.5 * box.width; b < 0.5 * box.width; b += rows) {
      const Eigen::Vector2d p =
          box.centre + along * (a + random_.normal() * 0.25) + across * (b + random_.normal() * 0.25);
      if (!contains(inner, p) || random_.chance(0.1)) continue;
      const double r = radius * random_.uniform(0.7, 1.2);
      tree(p, r, 2.0 * r, Plant::kFruit);
    }
  }
}

void LayoutBuilder::pond(const Outline& polygon) {
  grassland(polygon, Cover::kMeadow);
  const Eigen::Vector2d centre = centroid(polygon);
  const double radius = 0.28 * bounding_box(polygon).width;
  blob(centre, radius + 3.0, Cover::kReed);
  blob(centre, radius, Cover::kWater);
  for (int i = 0; i < 14; ++i) {
    const double a = random_.uniform(0, 2 * kPi), r = random_.uniform(1.0, 3.5);
    tree(centre + direction_of(a) * (radius + random_.uniform(2, 7)), r, 2.0 * r,
         random_.chance(0.5) ? Plant::kDeciduous : Plant::kShrub);
  }
}

}  // namespace orthonav::simulate
