// The map as it arrives in tiles: which are still missing, which to ask for again, and the features once all are there.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "services/registration/types.h"

namespace orthonav::registration {

struct MapLayout {
  std::string fingerprint;
  int tile_columns = 0;
  int tile_rows = 0;
  int64_t num_features = 0;
  int64_t max_features = 0;  // more than this are refused

  // What is wrong with it; empty when it can be fetched.
  std::string problem() const;
};

struct TilePart {
  int tile = -1;
  int part = 0;
  int num_parts = 1;
  std::span<const float> positions;      // east, north, up of each feature, m in G
  std::span<const uint8_t> descriptors;  // 128 of each feature
};

class TileStore {
 public:
  enum class Outcome { kAccepted, kDuplicate, kMalformed };

  TileStore() = default;
  // Throws std::invalid_argument when layout.problem() is not empty.
  explicit TileStore(const MapLayout& layout);

  const MapLayout& layout() const { return layout_; }
  int num_tiles() const { return static_cast<int>(tiles_.size()); }
  int num_complete() const { return num_complete_; }
  bool complete() const { return !tiles_.empty() && num_complete_ == num_tiles(); }
  int64_t num_features() const { return num_features_; }

  Outcome add(const TilePart& part, int64_t utime);

  // Tiles to ask for now, ascending: those never asked for and those asked for longer than `retry_after` microseconds
  // ago without a part since, so many that no more than `max_outstanding` are on their way. They count as asked for at
  // `utime`.
  std::vector<int> ask(int64_t utime, int max_outstanding, int64_t retry_after);
  int64_t num_asked_again() const { return num_asked_again_; }

  // All features in the order of the tiles and their parts, whatever the order they came in. The store is empty after.
  MapFeatures take();

 private:
  struct Part {
    bool present = false;
    std::vector<Eigen::Vector3f> positions;
    std::vector<uint8_t> descriptors;
  };
  struct Tile {
    std::vector<Part> parts;  // empty before the first arrives
    int num_present = 0;
    bool asked = false;
    int64_t last_utime = 0;  // asked for, or a part came
    bool complete() const { return !parts.empty() && num_present == static_cast<int>(parts.size()); }
  };

  MapLayout layout_;
  std::vector<Tile> tiles_;
  int num_complete_ = 0;
  int64_t num_features_ = 0;
  int64_t num_asked_again_ = 0;
};

}  // namespace orthonav::registration
