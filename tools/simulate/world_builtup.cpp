// Farmsteads, settlements and industrial ground of the layout.
#include <algorithm>
#include <cmath>
#include <numbers>

#include "tools/simulate/world_layout_builder.h"

namespace orthonav::simulate {

namespace {

constexpr double kPi = std::numbers::pi;

Eigen::Vector2d direction_of(double angle) {
  return {std::cos(angle), std::sin(angle)};
}

Eigen::Vector2d at(const Box& box, double a, double b) {
  return box.centre + Eigen::Rotation2Dd(box.angle) * Eigen::Vector2d(a, b);
}

}  // namespace

void LayoutBuilder::parking(const Eigen::Vector2d& centre, double angle, double length, double width) {
  patch(rectangle(centre, angle, length, width), Cover::kAsphalt, next_id_, angle);
  const Eigen::Vector2d along = direction_of(angle), across(-along.y(), along.x());
  for (const double row : {-1.0, 1.0}) {
    if (width < 11 && row > 0) break;
    const double b = row * (0.5 * width - 2.6);
    for (double a = -0.5 * length + 1.5; a < 0.5 * length - 1.2; a += 2.5) {
      const Eigen::Vector2d p = centre + along * a + across * b;
      slot(p, angle + kPi / 2, 4.3, 1.8, 1.5, 0.55);
      const Eigen::Vector2d line = p + along * 1.25;
      strip({line - across * 2.3, line + across * 2.3}, 0, 0.12, Cover::kMarking);
    }
  }
}

void LayoutBuilder::farmstead(const Outline& polygon) {
  grassland(polygon, Cover::kMeadow);
  const Box box = bounding_box(polygon);
  const double l = std::min(52.0, 0.7 * box.length), w = std::min(44.0, 0.75 * box.width);
  patch(rectangle(box.centre, box.angle, l, w), random_.chance(0.5) ? Cover::kPaving : Cover::kGravel, next_id_,
        box.angle);
  wander(box.centre, at(box, 0.6 * box.length, 0), 3.5, Cover::kGravel);
  const double quarter = kPi / 2;
  building(at(box, 0, 0.5 * w), box.angle, random_.uniform(20, 34), random_.uniform(9, 13), 4.5, 0.75, Roof::kGable,
           false);
  building(at(box, -0.5 * l, -2), box.angle + quarter, random_.uniform(16, 26), random_.uniform(9, 14), 5.5, 0.5,
           Roof::kGable, true);
  building(at(box, 0.42 * l, -0.5 * w), box.angle, random_.uniform(10, 14), random_.uniform(8, 10), 5.5, 0.8,
           Roof::kHip, false);
  if (random_.chance(0.7))
    building(at(box, -0.2 * l, -0.62 * w), box.angle, random_.uniform(8, 16), random_.uniform(5, 8), 3.0, 0.3,
             Roof::kShed, true);
  if (random_.chance(0.6)) {
    const Eigen::Vector2d silo = at(box, -0.62 * l, 0.45 * w);
    blob(silo, 8.0, Cover::kConcrete);
    building(silo, random_.uniform(0, kPi), 4.5, 4.5, 9.0, 0, Roof::kFlat, true);
  }
  patch(rectangle(at(box, 0.62 * l, 0.1 * w), box.angle, 14, 12), Cover::kBed, next_id_, box.angle);
  for (int i = 0; i < 4; ++i)
    slot(at(box, random_.uniform(-0.3, 0.3) * l, random_.uniform(-0.25, 0.25) * w), random_.uniform(0, kPi),
         random_.uniform(4.2, 7.5), random_.uniform(1.8, 2.5), random_.uniform(1.5, 3.0), 0.5);
  for (int i = 0; i < 9; ++i) {
    const double r = random_.uniform(1.2, 4.5);
    const double a = random_.uniform(0, 2 * kPi);
    tree(at(box, (0.62 * l + 4) * std::cos(a), (0.72 * w + 5) * std::sin(a)), r, 2.2 * r,
         random_.chance(0.6) ? Plant::kDeciduous : Plant::kFruit);
  }
}

void LayoutBuilder::settlement(const Outline& polygon) {
  patch(polygon, Cover::kGarden, next_id_, 0);
  std::vector<Segment> streets;
  const std::vector<Outline> blocks = divide(
      polygon, 3800, 0.06, 0.12, [this] { return random_.uniform(); },
      [&](const Segment& cut, int) { streets.push_back(cut); });
  for (const Outline& block : blocks)
    for (const Outline& lot : divide(
             inset(block, 4.0), 620, 0.03, 0.08, [this] { return random_.uniform(); }, [](const Segment&, int) {}))
      house_lot(lot);
  for (const Segment& street : streets) {
    strip(street, 0, 8.4, Cover::kPaving);
    strip(street, 0, 5.4, Cover::kAsphalt);
    const Eigen::Vector2d d = street.b - street.a;
    const double length = d.norm();
    if (length < 5) continue;
    const Eigen::Vector2d along = d / length, side(-along.y(), along.x());
    for (double s = 4; s < length - 4; s += random_.uniform(6, 14))
      slot(street.a + along * s + side * (random_.chance(0.5) ? 1.8 : -1.8), std::atan2(d.y(), d.x()), 4.3, 1.8, 1.5,
           0.4);
    for (double s = random_.uniform(0, 30); s < length; s += random_.uniform(10, 50))
      strip({street.a + along * s, street.a + along * std::min(length, s + random_.uniform(1, 8))},
            random_.uniform(-1.8, 1.8), random_.uniform(0.4, 1.6), Cover::kRepair);
    for (double s = 10; s < length; s += 35) {
      const Eigen::Vector2d p = street.a + along * s + side * 3.9;
      layout_.poles.push_back({p + bend_(p), 6.0});
    }
  }
}

void LayoutBuilder::house_lot(const Outline& lot) {
  if (lot.size() < 3 || area(lot) < 150) return;
  const Box box = bounding_box(lot);
  patch(inset(lot, 0.4), Cover::kGarden, next_id_, box.angle);
  const bool turned = random_.chance(0.4);
  const double angle = box.angle + (turned ? kPi / 2 : 0.0);
  const double room_l = 0.75 * (turned ? box.width : box.length), room_w = 0.75 * (turned ? box.length : box.width);
  const double l = std::min(room_l, random_.uniform(9.5, 15)), w = std::min(room_w, random_.uniform(7.5, 10.5));
  const Eigen::Vector2d house =
      at(box, random_.uniform(-0.15, 0.15) * box.length, random_.uniform(-0.1, 0.1) * box.width);
  const double draw = random_.uniform();
  const Roof roof = draw < 0.62 ? Roof::kGable : draw < 0.85 ? Roof::kHip : Roof::kFlat;
  patch(rectangle(house, angle, l + 3.5, w + 3.0), Cover::kPaving, next_id_, angle);
  building(house, angle, l, w, random_.uniform(3.2, 6.0), random_.uniform(0.5, 0.9), roof, false);
  const Eigen::Vector2d along = direction_of(angle), across(-along.y(), along.x());
  if (random_.chance(0.35))
    building(house + along * 0.35 * l + across * 0.55 * w, angle + kPi / 2, 0.6 * w, 0.4 * l, 3.0, 0.6, Roof::kGable,
             false);
  if (random_.chance(0.55))
    building(house - along * (0.5 * l + 3.2) + across * random_.uniform(-2, 2), angle, 6.0, 3.2, 2.5, 0.15, Roof::kFlat,
             false);
  const Eigen::Vector2d drive = house - along * (0.5 * l + 4.0);
  patch(rectangle(drive - across * 5.0, angle + kPi / 2, 11.0, 3.0), Cover::kPaving, next_id_, angle);
  slot(drive - across * 6.0, angle + kPi / 2, 4.3, 1.8, 1.5, 0.45);
  if (random_.chance(0.14)) patch(rectangle(point_in(inner(lot, 4)), angle, 8.0, 4.0), Cover::kPool, next_id_, angle);
  if (random_.chance(0.5))
    patch(rectangle(point_in(inner(lot, 3)), angle, random_.uniform(3, 8), random_.uniform(2, 5)), Cover::kBed,
          next_id_, angle);
  const int plants = 3 + random_.index(9);
  for (int i = 0; i < plants; ++i) {
    const double r = random_.chance(0.3) ? random_.uniform(1.5, 3.6) : random_.uniform(0.4, 1.3);
    const double kind = random_.uniform();
    const Eigen::Vector2d p = point_in(inner(lot, 1.0));
    if ((p - house).norm() < 0.5 * std::max(l, w) + 0.6 * r) continue;
    tree(p, r, r * random_.uniform(1.5, 2.4),
         kind < 0.45   ? Plant::kShrub
         : kind < 0.7  ? Plant::kFruit
         : kind < 0.88 ? Plant::kDeciduous
                       : Plant::kConifer);
  }
  for (size_t i = 0; i < lot.size(); ++i)
    if (random_.chance(0.3)) hedge({lot[i], lot[(i + 1) % lot.size()]}, 0.6);
}

void LayoutBuilder::industrial(const Outline& polygon) {
  std::vector<Segment> streets;
  const std::vector<Outline> lots = divide(
      polygon, 9000, 0.03, 0.15, [this] { return random_.uniform(); },
      [&](const Segment& cut, int) { streets.push_back(cut); });
  for (const Outline& lot : lots) {
    patch(lot, Cover::kVerge, next_id_, 0);
    works(inset(lot, 6.0));
  }
  for (const Segment& street : streets) road(street, 7.0, true);
}

void LayoutBuilder::works(const Outline& lot) {
  if (lot.size() < 3 || area(lot) < 800) return;
  const Box box = bounding_box(lot);
  const double draw = random_.uniform();
  const Cover ground = draw < 0.45 ? Cover::kAsphalt : draw < 0.75 ? Cover::kConcrete : Cover::kGravel;
  patch(lot, ground, next_id_, box.angle);
  const int repairs = 2 + random_.index(6);
  for (int i = 0; i < repairs; ++i)
    patch(rectangle(point_in(inner(lot, 4)), box.angle + (random_.chance(0.3) ? kPi / 2 : 0), random_.uniform(3, 25),
                    random_.uniform(1, 7)),
          random_.chance(0.6) ? Cover::kRepair : Cover::kConcrete, next_id_, box.angle);
  const double l = std::min(0.55 * box.length, random_.uniform(28, 70)),
               w = std::min(0.5 * box.width, random_.uniform(18, 36));
  const Roof roof = random_.chance(0.6) ? Roof::kFlat : Roof::kGable;
  const Eigen::Vector2d hall = at(box, -0.5 * box.length + 0.62 * l + 3, 0.5 * box.width - 0.55 * w - 3);
  building(hall, box.angle, l, w, random_.uniform(6, 11), 0.18, roof, true);
  if (random_.chance(0.6))
    building(at(box, -0.5 * box.length + 0.62 * l + 3, 0.5 * box.width - 1.1 * w - 7), box.angle, 0.5 * l, 9, 4.0, 0.2,
             Roof::kShed, true);
  if (random_.chance(0.5))
    building(at(box, 0.36 * box.length, 0.30 * box.width), box.angle, random_.uniform(10, 18), random_.uniform(9, 13),
             random_.uniform(6, 12), 0.5, random_.chance(0.5) ? Roof::kFlat : Roof::kHip, false);
  parking(at(box, 0.25 * box.length, -0.5 * box.width + 9), box.angle, std::min(0.42 * box.length, 40.0), 15);
  const Eigen::Vector2d yard = at(box, -0.25 * box.length, -0.32 * box.width);
  const int rows = 2 + random_.index(4);
  for (int r = 0; r < rows; ++r)
    for (int c = 0; c < 5; ++c)
      slot(yard + Eigen::Rotation2Dd(box.angle) * Eigen::Vector2d(7.0 * c - 14.0, 3.4 * r), box.angle, 6.1, 2.4, 2.6,
           0.5);
  for (int i = 0; i < 3; ++i)
    blob(point_in(inner(lot, 5)), random_.uniform(1.5, 6), random_.chance(0.5) ? Cover::kDirt : Cover::kGravel);
  for (int i = 0; i < 5; ++i) {
    const double r = random_.uniform(0.6, 3.0);
    tree(at(box, random_.uniform(-0.5, 0.5) * box.length,
            random_.chance(0.5) ? -0.5 * box.width - 3 : 0.5 * box.width + 3),
         r, 2.0 * r, Plant::kDeciduous);
  }
}

}  // namespace orthonav::simulate
