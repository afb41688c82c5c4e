#include "services/registration/tile_store.h"

#include <cmath>
#include <cstring>
#include <stdexcept>

#include <fmt/format.h>

#include "common/features/fixed_sift.h"

namespace orthonav::registration {
namespace {

constexpr int kMaxParts = 100'000;

}  // namespace

std::string MapLayout::problem() const {
  if (fingerprint.empty()) return "map without a fingerprint";
  if (tile_columns <= 0 || tile_rows <= 0 || static_cast<int64_t>(tile_columns) * tile_rows > 10'000'000) {
    return fmt::format("map of {} x {} tiles", tile_columns, tile_rows);
  }
  if (num_features <= 0) return "map without features";
  if (num_features > max_features) {
    return fmt::format("map of {} features, max_features is {}", num_features, max_features);
  }
  return {};
}

TileStore::TileStore(const MapLayout& layout) : layout_(layout) {
  if (const std::string problem = layout.problem(); !problem.empty()) throw std::invalid_argument(problem);
  tiles_.resize(static_cast<size_t>(layout.tile_columns) * static_cast<size_t>(layout.tile_rows));
}

TileStore::Outcome TileStore::add(const TilePart& part, int64_t utime) {
  const size_t count = part.positions.size() / 3;
  if (part.tile < 0 || part.tile >= num_tiles() || part.num_parts < 1 || part.num_parts > kMaxParts || part.part < 0 ||
      part.part >= part.num_parts || part.positions.size() % 3 != 0 || part.descriptors.size() != count * kSiftBytes) {
    return Outcome::kMalformed;
  }
  for (const float value : part.positions) {
    if (!std::isfinite(value)) return Outcome::kMalformed;
  }
  Tile& tile = tiles_[static_cast<size_t>(part.tile)];
  if (tile.parts.empty()) tile.parts.resize(static_cast<size_t>(part.num_parts));
  if (static_cast<int>(tile.parts.size()) != part.num_parts) return Outcome::kMalformed;
  Part& stored = tile.parts[static_cast<size_t>(part.part)];
  if (stored.present) return Outcome::kDuplicate;
  // A server that sends more than it said would fill the memory.
  if (num_features_ + static_cast<int64_t>(count) > layout_.num_features) return Outcome::kMalformed;
  stored.present = true;
  stored.positions.resize(count);
  for (size_t i = 0; i < count; ++i) {
    stored.positions[i] = {part.positions[3 * i], part.positions[3 * i + 1], part.positions[3 * i + 2]};
  }
  stored.descriptors.assign(part.descriptors.begin(), part.descriptors.end());
  ++tile.num_present;
  tile.last_utime = utime;
  num_features_ += static_cast<int64_t>(count);
  if (tile.complete()) ++num_complete_;
  return Outcome::kAccepted;
}

std::vector<int> TileStore::ask(int64_t utime, int max_outstanding, int64_t retry_after) {
  int outstanding = 0;
  for (const Tile& tile : tiles_) {
    if (!tile.complete() && tile.asked && utime - tile.last_utime < retry_after) ++outstanding;
  }
  std::vector<int> wanted;
  for (int i = 0; i < num_tiles() && outstanding < max_outstanding; ++i) {
    Tile& tile = tiles_[static_cast<size_t>(i)];
    if (tile.complete() || (tile.asked && utime - tile.last_utime < retry_after)) continue;
    if (tile.asked) ++num_asked_again_;
    tile.asked = true;
    tile.last_utime = utime;
    wanted.push_back(i);
    ++outstanding;
  }
  return wanted;
}

MapFeatures TileStore::take() {
  MapFeatures features;
  features.positions.reserve(static_cast<size_t>(num_features_));
  features.descriptors.create(static_cast<int>(num_features_), kSiftBytes, CV_8U);
  int row = 0;
  for (Tile& tile : tiles_) {
    for (Part& part : tile.parts) {
      features.positions.insert(features.positions.end(), part.positions.begin(), part.positions.end());
      if (!part.descriptors.empty()) {
        std::memcpy(features.descriptors.ptr(row), part.descriptors.data(), part.descriptors.size());
      }
      row += static_cast<int>(part.positions.size());
      part = {};  // the map is large: never hold it twice
    }
  }
  tiles_.clear();
  num_complete_ = 0;
  num_features_ = 0;
  return features;
}

}  // namespace orthonav::registration
