#include "services/registration/map/tile_store.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

#include <fmt/format.h>

#include "common/features/fixed_sift.h"

namespace orthonav::registration {
namespace {

constexpr int kMaxParts = 100'000;
constexpr int64_t kMaxTiles = 100'000'000;
constexpr int64_t kMaxFeatures = 1'000'000'000'000'000;

static_assert(kFeatureMemory == sizeof(Eigen::Vector3f) + kSiftBytes);

}  // namespace

std::string MapLayout::problem() const {
  if (fingerprint.empty()) return "map without a fingerprint";
  if (tile_columns <= 0 || tile_rows <= 0 || static_cast<int64_t>(tile_columns) * tile_rows > kMaxTiles) {
    return fmt::format("map of {} x {} tiles", tile_columns, tile_rows);
  }
  if (num_features <= 0 || num_features > kMaxFeatures) return fmt::format("map of {} features", num_features);
  if (!(tile_size > 0) || !std::isfinite(tile_size) || !std::isfinite(east_min) || !std::isfinite(north_min)) {
    return "map's tiles have no place";
  }
  return {};
}

TileStore::TileStore(const MapLayout& layout, int64_t memory) : layout_(layout), memory_(memory) {
  if (const std::string problem = layout.problem(); !problem.empty()) throw std::invalid_argument(problem);
}

void TileStore::want(const std::vector<int>& tiles) {
  ++num_wants_;
  order_.clear();
  wanted_.clear();
  num_complete_ = 0;
  for (const int tile : tiles) {
    if (tile < 0 || tile >= layout_.num_tiles() || !wanted_.insert(tile).second) continue;
    order_.push_back(tile);
    Tile& wanted = tiles_[tile];
    wanted.wanted_at = num_wants_;
    if (wanted.complete()) ++num_complete_;
  }
}

TileStore::Outcome TileStore::add(const TilePart& part, int64_t utime) {
  const size_t count = part.positions.size() / 3;
  if (part.tile < 0 || part.tile >= layout_.num_tiles() || part.num_parts < 0 || part.num_parts > kMaxParts ||
      part.part < 0 || part.part >= std::max(part.num_parts, 1) || part.positions.size() % 3 != 0 ||
      part.descriptors.size() != count * kSiftBytes || static_cast<int64_t>(count) > layout_.num_features) {
    return Outcome::kMalformed;
  }
  for (const float value : part.positions) {
    if (!std::isfinite(value)) return Outcome::kMalformed;
  }
  if (!wanted_.contains(part.tile)) return Outcome::kUnwanted;
  Tile& tile = tiles_[part.tile];
  if (part.num_parts == 0) {
    if (tile.complete()) return Outcome::kDuplicate;
    tile.refused = true;
    ++num_refused_;
    ++num_complete_;
    return Outcome::kRefused;
  }
  if (tile.refused) return Outcome::kDuplicate;
  if (tile.parts.empty()) tile.parts.resize(static_cast<size_t>(part.num_parts));
  if (static_cast<int>(tile.parts.size()) != part.num_parts) return Outcome::kMalformed;
  Part& stored = tile.parts[static_cast<size_t>(part.part)];
  if (stored.present) return Outcome::kDuplicate;
  stored.present = true;
  stored.positions.resize(count);
  for (size_t i = 0; i < count; ++i) {
    stored.positions[i] = {part.positions[3 * i], part.positions[3 * i + 1], part.positions[3 * i + 2]};
  }
  stored.descriptors.assign(part.descriptors.begin(), part.descriptors.end());
  ++tile.num_present;
  tile.last_utime = utime;
  tile.memory += static_cast<int64_t>(count) * kFeatureMemory;
  memory_used_ += static_cast<int64_t>(count) * kFeatureMemory;
  if (tile.complete()) ++num_complete_;
  make_room();
  return Outcome::kAccepted;
}

void TileStore::forget(std::map<int, Tile>::iterator tile) {
  memory_used_ -= tile->second.memory;
  tiles_.erase(tile);
}

void TileStore::make_room() {
  while (memory_used_ > memory_) {
    auto oldest = tiles_.end();
    for (auto tile = tiles_.begin(); tile != tiles_.end(); ++tile) {
      if (wanted_.contains(tile->first) || tile->second.memory == 0) continue;
      if (oldest == tiles_.end() || tile->second.wanted_at < oldest->second.wanted_at) oldest = tile;
    }
    if (oldest != tiles_.end()) {
      forget(oldest);
      ++num_given_up_;
    } else {
      // All of it is wanted: the least important finds no room.
      const auto last = tiles_.find(order_.back());
      if (last->second.complete()) --num_complete_;
      forget(last);
      wanted_.erase(order_.back());
      order_.pop_back();
      ++num_beyond_budget_;
    }
  }
}

std::vector<TileRequest> TileStore::ask(int64_t utime, int max_outstanding, int64_t retry_after) {
  const auto on_its_way = [&](const Tile& tile) { return tile.asked && utime - tile.last_utime < retry_after; };
  int outstanding = 0;
  for (const int index : order_) {
    const Tile& tile = tiles_.at(index);
    if (!tile.complete() && on_its_way(tile)) ++outstanding;
  }
  std::vector<TileRequest> requests;
  for (const int index : order_) {
    if (outstanding >= max_outstanding) break;
    Tile& tile = tiles_.at(index);
    if (tile.complete() || on_its_way(tile)) continue;
    if (tile.asked) ++num_asked_again_;
    const int missing = static_cast<int>(tile.parts.size()) - tile.num_present;
    if (tile.parts.empty() || missing > tile.num_present) {
      requests.push_back({index, -1});
    } else {
      for (size_t i = 0; i < tile.parts.size(); ++i) {
        if (!tile.parts[i].present) requests.push_back({index, static_cast<int>(i)});
      }
      num_parts_again_ += missing;
    }
    tile.asked = true;
    tile.last_utime = utime;
    ++outstanding;
  }
  return requests;
}

void TileStore::append(const Tile& tile, MapFeatures& features, int& row) {
  for (const Part& part : tile.parts) {
    features.positions.insert(features.positions.end(), part.positions.begin(), part.positions.end());
    if (!part.descriptors.empty()) {
      std::memcpy(features.descriptors.ptr(row), part.descriptors.data(), part.descriptors.size());
    }
    row += static_cast<int>(part.positions.size());
  }
}

MapFeatures TileStore::collect() const {
  int64_t memory = 0;
  for (const int tile : wanted_) memory += tiles_.at(tile).memory;
  MapFeatures features;
  features.positions.reserve(static_cast<size_t>(memory / kFeatureMemory));
  features.descriptors.create(static_cast<int>(memory / kFeatureMemory), kSiftBytes, CV_8U);
  int row = 0;
  for (const int tile : wanted_) append(tiles_.at(tile), features, row);
  return features;
}

MapFeatures TileStore::take() {
  int64_t memory = 0;
  for (const int tile : wanted_) memory += tiles_.at(tile).memory;
  MapFeatures features;
  features.positions.reserve(static_cast<size_t>(memory / kFeatureMemory));
  features.descriptors.create(static_cast<int>(memory / kFeatureMemory), kSiftBytes, CV_8U);
  int row = 0;
  for (const int tile : wanted_) {
    append(tiles_.at(tile), features, row);
    forget(tiles_.find(tile));  // the map is large: never hold it twice
  }
  tiles_.clear();
  order_.clear();
  wanted_.clear();
  num_complete_ = 0;
  memory_used_ = 0;
  return features;
}

}  // namespace orthonav::registration
