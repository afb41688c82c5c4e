#include "tools/simulate/world_epoch.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include <opencv2/imgproc.hpp>

#include "tools/simulate/world_random.h"

namespace orthonav::simulate {

namespace {

constexpr double kPi = std::numbers::pi;

cv::Vec3f rgb(double r, double g, double b) {
  return {static_cast<float>(b), static_cast<float>(g), static_cast<float>(r)};
}

// 0 below a, 1 above b, smooth between.
double ramp(double x, double a, double b) {
  const double t = std::clamp((x - a) / (b - a), 0.0, 1.0);
  return t * t * (3 - 2 * t);
}

cv::Vec3f blend(const cv::Vec3f& a, const cv::Vec3f& b, double t) {
  return a + (b - a) * static_cast<float>(t);
}

Material shade(Material m, double factor) {
  m.low *= static_cast<float>(factor);
  m.high *= static_cast<float>(factor);
  return m;
}

Material plain(const cv::Vec3f& low, const cv::Vec3f& high, double soil, double vegetation, double grain,
               double clumps) {
  Material m;
  m.low = low;
  m.high = high;
  m.soil = static_cast<float>(soil);
  m.vegetation = static_cast<float>(vegetation);
  m.grain = static_cast<float>(grain);
  m.clumps = static_cast<float>(clumps);
  return m;
}

double year_day(double day) {
  return day - 365.0 * std::floor(day / 365.0);
}

// How far the trees' leaves are out, and how far autumn has coloured them.
double leaf_out(double day) {
  return ramp(day, 98, 132) * (1 - ramp(day, 292, 325));
}
double autumn(double day) {
  return ramp(day, 262, 300);
}

const cv::Vec3f kSoilWet = rgb(112, 92, 72), kSoilDry = rgb(172, 148, 118);

}  // namespace

Sun sun_at(double latitude_deg, double day, double hour) {
  const double declination = 23.44 * kPi / 180 * std::sin(2 * kPi * (284 + day) / 365);
  const double latitude = latitude_deg * kPi / 180, angle = (hour - 12) * kPi / 12;
  const double east = -std::cos(declination) * std::sin(angle);
  const double north =
      std::sin(declination) * std::cos(latitude) - std::cos(declination) * std::cos(angle) * std::sin(latitude);
  const double up =
      std::sin(declination) * std::sin(latitude) + std::cos(declination) * std::cos(angle) * std::cos(latitude);
  return {std::atan2(east, north), std::asin(up)};
}

Epoch::Epoch(const EpochOptions& options)
    : options_(options), sun_(sun_at(options.latitude_deg, options.day, options.hour)) {
  options_.day = year_day(options.day);
}

bool Epoch::changed(uint64_t id, const char* what, double probability) const {
  if (options_.base) return false;
  return Random(mix(mix(options_.epoch_seed, id), what)).uniform() < probability;
}

double Epoch::draw(uint64_t id, const char* what, double probability) const {
  const uint64_t seed = changed(id, what, probability) ? mix(options_.epoch_seed, "new") : options_.seed;
  return Random(mix(mix(seed, what), id)).uniform();
}

bool Epoch::present(const Patch& patch) const {
  switch (patch.cover) {
    case Cover::kWornGrass:
    case Cover::kReed:
    case Cover::kDirt:
    case Cover::kRepair:
    case Cover::kBed:
      return draw(patch.id, "patch", options_.change.ground_change) < 0.85;
    case Cover::kMarking:
      return draw(patch.id, "marking", 0.5 * options_.change.ground_change) < 0.95;
    default:
      return true;
  }
}

bool Epoch::present(const Building& building) const {
  return draw(building.id, "building", options_.change.building_change) < 0.9;
}

bool Epoch::present(const Tree& tree) const {
  return draw(tree.id, "tree", options_.change.tree_change) < 0.88;
}

bool Epoch::present(const Slot& slot) const {
  return draw(slot.id, "slot", 1.0) < slot.occupancy;
}

Tree Epoch::grown(const Tree& tree) const {
  if (options_.base) return tree;
  Random random(mix(mix(options_.epoch_seed, "grown"), tree.id));
  Tree now = tree;
  const double growth = std::clamp(1.0 + options_.change.growth * random.normal(), 0.4, 1.6);
  now.radius *= growth;
  now.height *= growth;
  now.position += options_.change.crown_shift * Eigen::Vector2d(random.normal(), random.normal());
  return now;
}

double Epoch::leaves(const Tree& tree) const {
  if (tree.plant == Plant::kConifer) return 1.0;
  // Each tree has its own calendar.
  const double own = 8.0 * (draw(tree.id, "leaves", 0) - 0.5) * 2.0;
  return 0.12 + 0.88 * leaf_out(options_.day + own);
}

std::vector<Eigen::Vector2d> Epoch::bales(const Patch& patch) const {
  std::vector<Eigen::Vector2d> places;
  const bool meadow = patch.cover == Cover::kMeadow && options_.day > 140 && options_.day < 280;
  const bool straw = patch.cover == Cover::kArable && options_.day > 195 && options_.day < 235;
  if (!meadow && !straw) return places;
  Random random(mix(mix(options_.epoch_seed, "bales"), patch.field));
  if (!random.chance(0.25)) return places;
  Eigen::Vector2d low = patch.outline.front(), high = low;
  std::vector<cv::Point2f> outline;
  for (const Eigen::Vector2d& p : patch.outline) {
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
    outline.emplace_back(static_cast<float>(p.x()), static_cast<float>(p.y()));
  }
  const int count = static_cast<int>((high - low).prod() / random.uniform(250, 600));
  for (int i = 0; i < count; ++i) {
    const Eigen::Vector2d p(random.uniform(low.x(), high.x()), random.uniform(low.y(), high.y()));
    const cv::Point2f q(static_cast<float>(p.x()), static_cast<float>(p.y()));
    if (cv::pointPolygonTest(outline, q, true) > 4.0) places.push_back(p);
  }
  return places;
}

Material Epoch::crop(const Patch& patch) const {
  const Difference& change = options_.change;
  const double kind = draw(patch.field, "crop", change.crop_change);
  const double own = draw(patch.field, "own", 0.5);  // the farmer's own calendar and care
  const double day = year_day(options_.day + 16.0 * (own - 0.5));
  const double bare_share = draw(patch.field, "bare", change.crop_change);
  Material bare = plain(kSoilWet, kSoilDry, 0.26, 0.05, 0.10, 0.06);
  bare.rows = 0.05F;
  bare.row_period = 0.9F;
  Material m = bare;
  if (kind < 0.42) {  // winter cereal
    const cv::Vec3f green = rgb(84, 112, 50), light = rgb(112, 134, 66), ripe = rgb(196, 172, 112);
    if (day < 65 || day > 285) {
      m = plain(blend(kSoilWet, green, 0.45), blend(kSoilDry, light, 0.6), 0.2, 0.1, 0.08, 0.05);
      m.rows = 0.05F, m.row_period = 0.5F, m.wheels = 0.05F;
    } else if (day < 200) {
      const double t = ramp(day, 162, 186);
      m = plain(blend(green, ripe * 0.92F, t), blend(light, ripe * 1.08F, t), 0.12, 0.18, 0.06, 0.04);
      m.wheels = 0.22F, m.height = static_cast<float>(0.8 * ramp(day, 70, 140));
    } else if (day < 240) {
      m = plain(rgb(170, 148, 104), rgb(204, 184, 138), 0.12, 0.12, 0.08, 0.05);
      m.rows = 0.08F, m.row_period = 6.0F, m.wheels = 0.08F;
    }
  } else if (kind < 0.66) {  // maize
    if (day > 118 && day < 152) {
      m = plain(blend(kSoilWet, rgb(84, 120, 54), 0.2), blend(kSoilDry, rgb(84, 120, 54), 0.3), 0.2, 0.08, 0.08, 0.05);
      m.rows = 0.12F, m.row_period = 0.75F;
    } else if (day >= 152 && day < 282) {
      const double t = ramp(day, 250, 275);
      m = plain(blend(rgb(62, 92, 42), rgb(140, 124, 74), t), blend(rgb(88, 116, 56), rgb(168, 150, 92), t), 0.08, 0.18,
                0.10, 0.07);
      m.rows = 0.10F, m.row_period = 0.75F, m.height = static_cast<float>(2.3 * ramp(day, 150, 200));
    } else if (day >= 282) {
      m = plain(rgb(150, 130, 96), rgb(184, 164, 122), 0.18, 0.1, 0.10, 0.07);
      m.rows = 0.10F, m.row_period = 0.75F;
    }
  } else if (kind < 0.80) {  // rape
    if (day < 195) {
      const double bloom = ramp(day, 100, 112) * (1 - ramp(day, 138, 150)), ripe = ramp(day, 170, 190);
      const cv::Vec3f green = blend(rgb(78, 108, 54), rgb(150, 130, 84), ripe),
                      light = blend(rgb(102, 128, 66), rgb(172, 150, 100), ripe);
      m = plain(blend(green, rgb(188, 180, 56), bloom), blend(light, rgb(214, 206, 74), bloom), 0.1, 0.16, 0.07, 0.05);
      m.wheels = 0.2F, m.height = static_cast<float>(1.3 * ramp(day, 60, 120));
    } else if (day < 225) {
      m = plain(rgb(158, 138, 100), rgb(188, 168, 126), 0.14, 0.12, 0.1, 0.06);
    } else {
      m = plain(rgb(78, 108, 54), rgb(108, 130, 70), 0.2, 0.12, 0.08, 0.05);
    }
  } else {  // beet, potatoes
    if (day > 110 && day < 275) {
      const double t = ramp(day, 120, 160);
      m = plain(blend(kSoilWet, rgb(70, 104, 46), t), blend(kSoilDry, rgb(98, 128, 60), t), 0.12, 0.14, 0.1, 0.06);
      m.rows = 0.09F, m.row_period = 0.75F, m.wheels = 0.10F;
    }
  }
  // Some of the fields that could lie bare carry a catch crop instead.
  if (m.soil == bare.soil && bare_share < 0.4) m = plain(rgb(92, 112, 58), rgb(126, 134, 78), 0.18, 0.16, 0.1, 0.07);
  const double lay = draw(patch.field, "lay", change.tillage_change);
  m.wheel_period = lay < 0.5 ? 21.0F : 27.0F;
  m.wheel_phase = static_cast<float>(40 * lay);
  m.row_angle = static_cast<float>(patch.row_angle +
                                   (draw(patch.field, "turned", 0.3 * change.tillage_change) < 0.15 ? kPi / 2 : 0));
  return shade(m, 0.88 + 0.24 * draw(patch.field, "tone", 0.7));
}

Material Epoch::grass(const Patch& patch) const {
  const Difference& change = options_.change;
  const double day = options_.day;
  const double dry = 0.7 * ramp(day, 170, 215) * (1 - ramp(day, 255, 285)),
               dull = (1 - ramp(day, 75, 110)) + ramp(day, 300, 340);
  cv::Vec3f low = blend(rgb(80, 106, 48), rgb(140, 132, 80), 0.8 * dry),
            high = blend(rgb(124, 142, 72), rgb(178, 166, 112), dry);
  low = blend(low, rgb(104, 106, 64), 0.7 * dull);
  high = blend(high, rgb(146, 142, 92), 0.7 * dull);
  Material m = plain(low, high, 0.18, 0.16, 0.10, 0.07);
  m.row_angle = static_cast<float>(patch.row_angle);
  if (patch.cover == Cover::kMeadow) {
    const double cut = draw(patch.field, "cut", 1.0);
    if (day > 135 && day < 290 && cut < 0.35) {  // swaths of cut grass
      m = plain(blend(low, rgb(150, 148, 92), 0.5), blend(high, rgb(178, 172, 118), 0.5), 0.14, 0.1, 0.08, 0.06);
      m.rows = static_cast<float>(0.05 + 0.3 * cut);
      m.row_period = 5.0F;
    } else if (day > 100 && day < 300 && cut < 0.7) {  // standing high
      m = shade(m, 0.92);
      m.vegetation = 0.24F;
      m.height = 0.4F;
    }
  } else if (patch.cover == Cover::kPasture) {
    m.vegetation = 0.26F;
    m.clumps = 0.13F;
  } else if (patch.cover == Cover::kVerge || patch.cover == Cover::kOrchard) {
    m = shade(m, 0.96);
    m.clumps = 0.11F;
  } else if (patch.cover == Cover::kGarden) {
    m.clumps = 0.05F;
    m.vegetation = 0.1F;
  }
  return shade(m, 0.9 + 0.2 * draw(key(patch), "tone", change.pattern_change));
}

Material Epoch::ground(const Patch& patch) const {
  const double tone = 0.9 + 0.2 * draw(key(patch), "tone", options_.change.roof_change);
  switch (patch.cover) {
    case Cover::kArable:
    case Cover::kHeadland:
      return crop(patch);
    case Cover::kMeadow:
    case Cover::kPasture:
    case Cover::kOrchard:
    case Cover::kVerge:
    case Cover::kGarden:
      return grass(patch);
    case Cover::kForestFloor:
      return plain(rgb(70, 68, 44), rgb(112, 100, 70), 0.15, 0.2, 0.14, 0.14);
    case Cover::kWornGrass:
      return plain(rgb(128, 122, 76), rgb(170, 154, 108), 0.2, 0.25, 0.12, 0.08);
    case Cover::kReed:
      return plain(rgb(70, 88, 46), rgb(112, 118, 66), 0.15, 0.25, 0.16, 0.14);
    case Cover::kBed:
      return plain(rgb(96, 84, 56), rgb(132, 124, 84), 0.15, 0.3, 0.14, 0.12);
    case Cover::kDirt:
      return shade(plain(rgb(122, 100, 74), rgb(172, 148, 116), 0.25, 0.06, 0.1, 0.07), tone);
    case Cover::kGravel:
      return shade(plain(rgb(158, 150, 134), rgb(192, 184, 168), 0.2, 0.05, 0.09, 0.04), tone);
    case Cover::kTrack:
      return shade(plain(rgb(136, 116, 88), rgb(182, 162, 132), 0.25, 0.1, 0.1, 0.06), tone);
    case Cover::kAsphalt:
      return shade(plain(rgb(104, 104, 106), rgb(126, 126, 126), 0.22, 0, 0.05, 0.02), tone);
    case Cover::kRepair:
      return shade(plain(rgb(78, 78, 80), rgb(92, 92, 92), 0.15, 0, 0.05, 0.02), tone * tone);
    case Cover::kConcrete:
      return shade(plain(rgb(158, 156, 150), rgb(184, 182, 174), 0.22, 0, 0.04, 0.02), tone);
    case Cover::kPaving:
      return shade(plain(rgb(136, 128, 120), rgb(168, 160, 150), 0.2, 0, 0.07, 0.04), tone);
    case Cover::kMarking:
      return plain(rgb(205, 205, 200), rgb(226, 226, 220), 0.2, 0, 0.05, 0.02);
    case Cover::kWater:
      return plain(rgb(52, 62, 56), rgb(74, 84, 72), 0.08, 0.08, 0.03, 0.02);
    case Cover::kPool:
      return plain(rgb(88, 170, 190), rgb(108, 190, 206), 0.05, 0, 0.02, 0.02);
  }
  return {};
}

Material Epoch::crown(const Tree& tree) const {
  const double variant = static_cast<double>(mix(key(tree), "hue") % 1024) / 1024;
  const double day = options_.day;
  if (tree.plant == Plant::kConifer)
    return shade(plain(rgb(44, 62, 40), rgb(66, 86, 54), 0, 0.2, 0.16, 0.14), 0.85 + 0.3 * variant);
  const cv::Vec3f spring = rgb(92, 122, 52), summer = rgb(66, 92, 44),
                  fall = variant < 0.4 ? rgb(156, 118, 58) : rgb(124, 104, 56);
  const cv::Vec3f twigs = rgb(112, 100, 88);
  cv::Vec3f colour = blend(spring, summer, ramp(day, 125, 165));
  colour = blend(colour, fall, autumn(day));
  colour = blend(twigs, colour, leaf_out(day));
  if (tree.plant == Plant::kFruit) colour = blend(colour, rgb(120, 132, 84), 0.35);
  return shade(plain(colour * 0.86F, colour * 1.14F, 0, 0.2, 0.15, 0.16), 0.85 + 0.3 * variant);
}

Material Epoch::roof(const Building& building) const {
  static const std::array<cv::Vec3f, 7> kTiles{rgb(150, 84, 62), rgb(170, 100, 70), rgb(112, 82, 70), rgb(92, 90, 92),
                                               rgb(132, 74, 58), rgb(120, 104, 92), rgb(184, 128, 98)};
  static const std::array<cv::Vec3f, 6> kSheets{rgb(186, 190, 194), rgb(206, 206, 204), rgb(128, 132, 136),
                                                rgb(104, 116, 124), rgb(150, 142, 130), rgb(118, 138, 124)};
  const double colour = draw(building.id, "roof", options_.change.roof_change),
               tone = draw(building.id, "tone", options_.change.roof_change);
  const cv::Vec3f base = building.hall || building.roof == Roof::kFlat
                             ? kSheets[static_cast<size_t>(colour * kSheets.size())]
                             : kTiles[static_cast<size_t>(colour * kTiles.size())];
  Material m = plain(base * 0.92F, base * 1.08F, 0.1, 0, 0.05, 0.03);
  m.rows = building.hall ? 0.05F : 0.06F;
  m.row_period = building.hall ? 1.1F : 0.4F;
  m.row_angle = static_cast<float>(building.angle + (building.hall ? kPi / 2 : 0));
  return shade(m, 0.85 + 0.3 * tone);
}

Material Epoch::vehicle(const Slot& slot) const {
  static const std::array<cv::Vec3f, 9> kPaint{rgb(222, 222, 222), rgb(40, 40, 44),  rgb(150, 152, 156),
                                               rgb(92, 94, 98),    rgb(150, 34, 32), rgb(40, 62, 120),
                                               rgb(196, 196, 190), rgb(48, 84, 58),  rgb(176, 108, 40)};
  const cv::Vec3f& paint = kPaint[static_cast<size_t>(draw(slot.id, "paint", 1.0) * kPaint.size())];
  return plain(paint * 0.95F, paint * 1.05F, 0, 0, 0.02, 0.01);
}

uint64_t Epoch::key(const Patch& patch) {
  const uint64_t cover = static_cast<uint64_t>(patch.cover);
  switch (patch.cover) {
    case Cover::kArable:
    case Cover::kHeadland:
    case Cover::kMeadow:
    case Cover::kPasture:
    case Cover::kOrchard:
      return mix(cover, patch.field);
    case Cover::kWater:
    case Cover::kPool:
    case Cover::kMarking:
      return cover;
    default:
      return mix(cover, patch.id % 24);
  }
}

uint64_t Epoch::key(const Tree& tree) {
  return mix(static_cast<uint64_t>(tree.plant) + 1000, tree.id % 24);
}

}  // namespace orthonav::simulate
