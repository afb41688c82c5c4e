// Chooses what to fetch of the map on offer, and says when it has come.
//
// A map that fits into the memory budget is fetched whole, and its places are searched without any prior. Of a larger
// one, tiles around the expected position and along the flight are fetched: around the navigation's position once there
// is one, around a configured start before. The part in use is exchanged when the aircraft comes near its rim.
//
// Of several levels the one is taken whose pixels are about as wide as the camera's on the ground, H / f: equation (5)
// then scales the image by s = sigma f / H between 3/4 and 3/2, and neither side is blurred by the other.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "common/config/config.h"
#include "common/geo/enu_frame.h"
#include "services/registration/map/tile_store.h"
#include "services/registration/types.h"

namespace orthonav::registration {

struct MapClientOptions {
  int64_t memory = 300'000'000;    // bytes, of features held by the client
  int max_outstanding_tiles = 64;  // asked for and not yet here
  int64_t retry_after = 250'000;   // microseconds after which what is missing is asked for again
  double radius = 1500;            // m around the aircraft, of a map larger than the memory
  double prefetch = 60;            // s of flight ahead, likewise
  std::optional<Geodetic> start;   // where to begin, likewise

  // Reads `map` of registration.yaml. Throws ConfigError.
  static MapClientOptions from_config(ConfigNode& map);
};

// A level of a map that a server offers.
struct MapLevel {
  std::string map_fingerprint;  // the same for all levels of a map
  int level = 0;
  int num_levels = 1;
  Geodetic anchor;
  MapGeometry geometry;
  MapLayout layout;
};

// Tiles within `radius` (m) of the way from `place` to `place` + `ahead`, the nearest to `place` first;
// radius and way no longer than 200 tiles.
std::vector<int> tiles_along(const MapLayout& layout, const Eigen::Vector2d& place, const Eigen::Vector2d& ahead,
                             double radius);

// Index of the level for pixels of `ground_pixel` m on the ground. `current` (-1: none) is kept while it is nearly as
// good, so that a climb changes it once.
int level_for(double ground_pixel, const std::vector<double>& metres_per_pixel, int current);

class MapClient {
 public:
  explicit MapClient(const MapClientOptions& options) : options_(options) {}

  // A level on offer, of this map or another. True when it is of a map that was not on offer before.
  bool offer(const MapLevel& level);
  void clear();

  // The level being fetched or in use; null while there is none, or none can be chosen.
  const MapLevel* level() const;
  const TileStore& store() const { return store_; }

  // Width on the ground of the camera's pixels, m: H / f.
  void see(double ground_pixel);
  // Where the aircraft is in G and where it goes, m and m/s.
  void move(const Eigen::Vector2d& en, const Eigen::Vector2d& velocity, double stddev);

  std::vector<TileRequest> requests(int64_t utime);
  TileStore::Outcome add(const TilePart& part, int64_t utime);

  // The features to register with, once all that is wanted has come, and each time they are others. A whole map that
  // has another number of features than announced is not given but fetched again.
  std::optional<MapFeatures> take_ready();
  int64_t num_mismatched() const { return num_mismatched_; }

  // For people: what it waits for; empty when it has what it wants.
  std::string waiting_for() const;

 private:
  bool fits() const;
  void choose_level();
  void begin();

  MapClientOptions options_;
  std::map<int, MapLevel> levels_;
  int chosen_ = -1;
  double ground_pixel_ = 0;
  TileStore store_;
  bool planned_ = false;
  bool delivered_ = false;
  int64_t num_mismatched_ = 0;
  Eigen::Vector2d planned_place_ = Eigen::Vector2d::Zero();
  Eigen::Vector2d planned_ahead_ = Eigen::Vector2d::Zero();
};

}  // namespace orthonav::registration
