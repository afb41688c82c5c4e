// The map server on the bus: says which map there is (MAP_INFO) and sends its tiles (MAP_TILE) to whoever asks
// (MAP_TILE_REQUEST), a few parts per millisecond, so that receivers' buffers never overflow.
#pragma once

#include <chrono>
#include <deque>
#include <filesystem>
#include <memory>
#include <vector>

#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "orthonav/map_tile_request_t.hpp"
#include "services/map_server/map_database.h"
#include "services/map_server/options.h"

namespace orthonav::map_server {

class MapServerService : public Service {
 public:
  // Opens the map, building its database first when that is needed (a raster without an up-to-date .onmap beside it).
  // `map`, a raster or an .onmap file, takes the place of the configuration's `file` unless it is empty. Throws
  // ConfigError, MapDatabaseError or std::runtime_error naming the file.
  MapServerService(Node& node, const std::filesystem::path& config_folder, const std::filesystem::path& map = {});

  const MapDatabase& database() const { return *database_; }

 private:
  void handle(const map_tile_request_t& request);
  void send_parts();
  void publish_info();

  Node& node_;
  ServerOptions options_;
  std::unique_ptr<MapDatabase> database_;
  std::deque<int> queue_;     // tiles to send, in order of request
  std::vector<char> queued_;  // by tile: whether it is in queue_
  int next_part_ = 0;         // of the tile at the front
};

}  // namespace orthonav::map_server
