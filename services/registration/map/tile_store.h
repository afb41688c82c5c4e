// The map as it arrives in tiles: which are still missing, which to ask for again, and the features once they are
// there.
//
// What is wanted is a list of tiles, the most important first. Tiles that are wanted no more stay as long as there is
// room: the store is a cache within a budget of memory, and gives up what was wanted longest ago.
#pragma once

#include <cstdint>
#include <map>
#include <set>
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
  double tile_size = 0;                // m
  double east_min = 0, north_min = 0;  // m in G, corner of tile 0

  int num_tiles() const { return tile_columns * tile_rows; }
  // What is wrong with it; empty when it can be fetched.
  std::string problem() const;
};

struct TilePart {
  int tile = -1;
  int part = 0;
  int num_parts = 1;                     // 0: the server has no such tile to give
  std::span<const float> positions;      // east, north, up of each feature, m in G
  std::span<const uint8_t> descriptors;  // 128 of each feature
};

struct TileRequest {
  int tile = -1;
  int part = -1;  // -1: the whole tile
};

// Memory of one feature: its position and its descriptor.
inline constexpr int64_t kFeatureMemory = 3 * sizeof(float) + 128;

class TileStore {
 public:
  enum class Outcome { kAccepted, kDuplicate, kUnwanted, kRefused, kMalformed };

  TileStore() = default;
  // `memory` in bytes, of features. Throws std::invalid_argument when layout.problem() is not empty.
  TileStore(const MapLayout& layout, int64_t memory);

  const MapLayout& layout() const { return layout_; }

  // Replaces what is wanted; tiles that do not exist are left out.
  void want(const std::vector<int>& tiles);
  int num_wanted() const { return static_cast<int>(wanted_.size()); }
  int num_complete() const { return num_complete_; }  // of the wanted
  bool complete() const { return !wanted_.empty() && num_complete_ == num_wanted(); }

  // A refused tile counts as complete and empty.
  Outcome add(const TilePart& part, int64_t utime);

  // What to ask for now: wanted tiles never asked for, and what is missing of those asked for longer than `retry_after`
  // microseconds ago without a part since; so much that no more than `max_outstanding` tiles are on their way.
  std::vector<TileRequest> ask(int64_t utime, int max_outstanding, int64_t retry_after);

  // Features of the wanted tiles in the order of the tiles and their parts, whatever the order they came in.
  MapFeatures collect() const;
  // The same without a copy: the store is empty after.
  MapFeatures take();

  int64_t memory_used() const { return memory_used_; }
  int64_t num_asked_again() const { return num_asked_again_; }      // tiles of which something was asked for again
  int64_t num_parts_again() const { return num_parts_again_; }      // parts that were asked for again, one by one
  int64_t num_refused() const { return num_refused_; }              // tiles
  int64_t num_given_up() const { return num_given_up_; }            // unwanted tiles, for room
  int64_t num_beyond_budget() const { return num_beyond_budget_; }  // wanted tiles that found no room

 private:
  struct Part {
    bool present = false;
    std::vector<Eigen::Vector3f> positions;
    std::vector<uint8_t> descriptors;
  };
  struct Tile {
    std::vector<Part> parts;  // empty before the first arrives
    int num_present = 0;
    bool refused = false;
    bool asked = false;
    int64_t last_utime = 0;  // asked for, or a part came
    int64_t wanted_at = 0;   // number of the call of want()
    int64_t memory = 0;
    bool complete() const { return refused || (!parts.empty() && num_present == static_cast<int>(parts.size())); }
  };
  void make_room();
  void forget(std::map<int, Tile>::iterator tile);
  static void append(const Tile& tile, MapFeatures& features, int& row);

  MapLayout layout_;
  int64_t memory_ = 0;
  std::map<int, Tile> tiles_;
  std::vector<int> order_;  // wanted tiles, the most important first
  std::set<int> wanted_;    // the same
  int num_complete_ = 0;    // of the wanted
  int64_t num_wants_ = 0;
  int64_t memory_used_ = 0;
  int64_t num_asked_again_ = 0;
  int64_t num_parts_again_ = 0;
  int64_t num_refused_ = 0;
  int64_t num_given_up_ = 0;
  int64_t num_beyond_budget_ = 0;
};

}  // namespace orthonav::registration
