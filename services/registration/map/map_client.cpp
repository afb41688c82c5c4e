#include "services/registration/map/map_client.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <fmt/format.h>

namespace orthonav::registration {
namespace {

// A level is fine enough when its pixels are at most this much finer than the camera's.
constexpr double kFinest = 0.75;
// Levels beside the best one are kept so far, in powers of two.
constexpr double kHysteresis = 0.2;
// Part of the radius that the aircraft may move before the part of the map in use is exchanged.
constexpr double kRim = 0.25;
constexpr double kMostTilesAcross = 200;  // of a radius and of the way ahead

}  // namespace

MapClientOptions MapClientOptions::from_config(ConfigNode& map) {
  MapClientOptions options;
  double memory_mb = static_cast<double>(options.memory) * 1e-6;
  double retry_ms = static_cast<double>(options.retry_after) * 1e-3;
  map.read("memory_mb", memory_mb, 1, 1e6);
  map.read("max_outstanding_tiles", options.max_outstanding_tiles, 1, 100'000);
  map.read("retry_ms", retry_ms, 1, 600'000);
  map.read("radius", options.radius, 10, 1e6);
  map.read("prefetch", options.prefetch, 0, 3600);
  options.memory = std::llround(memory_mb * 1e6);
  options.retry_after = std::llround(retry_ms * 1e3);
  if (map.has("start")) {
    ConfigNode start = map.child("start");
    Geodetic place;
    start.require("latitude_deg", place.latitude_deg);
    start.require("longitude_deg", place.longitude_deg);
    start.finish();
    options.start = place;
  }
  return options;
}

std::vector<int> tiles_along(const MapLayout& layout, const Eigen::Vector2d& place, const Eigen::Vector2d& way,
                             double furthest) {
  // Whatever speed and uncertainty somebody claims, on a map of 10^8 tiles.
  const double most = kMostTilesAcross * layout.tile_size;
  const double radius = std::min(furthest, most);
  const Eigen::Vector2d ahead = way.norm() > most ? Eigen::Vector2d(way.normalized() * most) : way;
  const Eigen::Vector2d low = place.cwiseMin(place + ahead).array() - radius;
  const Eigen::Vector2d high = place.cwiseMax(place + ahead).array() + radius;
  const auto index = [&](double metres, double first, int last) {
    return static_cast<int>(std::clamp(std::floor((metres - first) / layout.tile_size), 0.0, last - 1.0));
  };
  std::vector<std::pair<double, int>> tiles;
  for (int row = index(low.y(), layout.north_min, layout.tile_rows);
       row <= index(high.y(), layout.north_min, layout.tile_rows); ++row) {
    for (int column = index(low.x(), layout.east_min, layout.tile_columns);
         column <= index(high.x(), layout.east_min, layout.tile_columns); ++column) {
      const Eigen::Vector2d centre(layout.east_min + (column + 0.5) * layout.tile_size,
                                   layout.north_min + (row + 0.5) * layout.tile_size);
      const double length = ahead.squaredNorm();
      const double part = length > 0 ? std::clamp((centre - place).dot(ahead) / length, 0.0, 1.0) : 0.0;
      if ((centre - place - part * ahead).norm() > radius) continue;
      tiles.emplace_back((centre - place).norm(), row * layout.tile_columns + column);
    }
  }
  std::sort(tiles.begin(), tiles.end());
  std::vector<int> result;
  result.reserve(tiles.size());
  for (const auto& tile : tiles) result.push_back(tile.second);
  return result;
}

int level_for(double ground_pixel, const std::vector<double>& metres_per_pixel, int current) {
  const auto last = static_cast<int>(metres_per_pixel.size()) - 1;
  const auto excess = [&](int level) {
    return std::log2(kFinest * ground_pixel / metres_per_pixel[static_cast<size_t>(level)]);
  };
  if (current >= 0 && (excess(current) <= kHysteresis || current == last) &&
      (current == 0 || excess(current - 1) > -kHysteresis)) {
    return current;
  }
  int level = 0;
  while (level < last && excess(level) > 0) ++level;
  return level;
}

void MapClient::clear() {
  levels_.clear();
  chosen_ = -1;
  store_ = TileStore();
}

bool MapClient::offer(const MapLevel& level) {
  const bool other = levels_.empty() || levels_.begin()->second.map_fingerprint != level.map_fingerprint;
  if (other) clear();
  if (levels_.emplace(level.level, level).second) choose_level();
  return other;
}

const MapLevel* MapClient::level() const {
  return chosen_ < 0 ? nullptr : &levels_.at(chosen_);
}

void MapClient::see(double ground_pixel) {
  if (!(ground_pixel > 0) || !std::isfinite(ground_pixel)) return;
  ground_pixel_ = ground_pixel;
  choose_level();
}

void MapClient::choose_level() {
  if (levels_.empty() || static_cast<int>(levels_.size()) < levels_.begin()->second.num_levels) return;
  if (levels_.size() > 1 && ground_pixel_ == 0) return;
  std::vector<double> widths;
  for (const auto& [index, level] : levels_) widths.push_back(level.geometry.metres_per_pixel);
  const int best = levels_.size() == 1 ? 0 : level_for(ground_pixel_, widths, chosen_);
  if (best == chosen_) return;
  chosen_ = best;
  begin();
}

bool MapClient::fits() const {
  constexpr int64_t kTileMemory = 128;  // bytes, of a tile that is wanted, whatever is in it
  const MapLayout& layout = level()->layout;
  return layout.num_features * kFeatureMemory <= options_.memory && layout.num_tiles() * kTileMemory <= options_.memory;
}

void MapClient::begin() {
  store_ = TileStore(level()->layout, options_.memory);
  planned_ = delivered_ = false;
  if (fits()) {
    std::vector<int> all(static_cast<size_t>(store_.layout().num_tiles()));
    for (size_t i = 0; i < all.size(); ++i) all[i] = static_cast<int>(i);
    store_.want(all);
  } else if (options_.start) {
    const EnuFrame frame(level()->anchor);
    Geodetic start = *options_.start;
    start.height = level()->anchor.height;
    store_.want(tiles_along(store_.layout(), frame.to_enu(start).head<2>(), Eigen::Vector2d::Zero(), options_.radius));
  }
}

void MapClient::move(const Eigen::Vector2d& en, const Eigen::Vector2d& velocity, double stddev) {
  if (level() == nullptr || fits() || !en.allFinite()) return;
  const Eigen::Vector2d ahead =
      velocity.allFinite() ? Eigen::Vector2d(options_.prefetch * velocity) : Eigen::Vector2d(Eigen::Vector2d::Zero());
  const double step = kRim * options_.radius;
  if (planned_ && (en - planned_place_).norm() < step && (en + ahead - planned_place_ - planned_ahead_).norm() < step) {
    return;
  }
  planned_ = true;
  delivered_ = false;
  planned_place_ = en;
  planned_ahead_ = ahead;
  store_.want(tiles_along(store_.layout(), en, ahead, options_.radius + (std::isfinite(stddev) ? 3 * stddev : 0)));
}

std::vector<TileRequest> MapClient::requests(int64_t utime) {
  if (delivered_) return {};
  return store_.ask(utime, options_.max_outstanding_tiles, options_.retry_after);
}

TileStore::Outcome MapClient::add(const TilePart& part, int64_t utime) {
  return store_.add(part, utime);
}

std::optional<MapFeatures> MapClient::take_ready() {
  if (delivered_ || level() == nullptr || !store_.complete()) return std::nullopt;
  delivered_ = true;
  const bool refused = store_.num_refused() > 0;
  MapFeatures features = fits() ? store_.take() : store_.collect();
  if (fits() && !refused && static_cast<int64_t>(features.positions.size()) != level()->layout.num_features) {
    ++num_mismatched_;
    begin();
    return std::nullopt;
  }
  if (features.positions.empty()) return std::nullopt;  // all of it refused
  return features;
}

std::string MapClient::waiting_for() const {
  if (levels_.empty()) return "waiting for MAP_INFO: does orthonav-map-server run on this bus?";
  if (level() == nullptr) return "waiting for VIO_KEYFRAME to choose a level of the map";
  if (delivered_) return {};
  if (store_.num_wanted() == 0) {
    return fmt::format("map of {} features is larger than memory_mb: set map.start, or raise it to {:.0f}",
                       level()->layout.num_features,
                       std::ceil(static_cast<double>(level()->layout.num_features * kFeatureMemory) * 1e-6));
  }
  return fmt::format("fetching the map: {} of {} tiles", store_.num_complete(), store_.num_wanted());
}

}  // namespace orthonav::registration
