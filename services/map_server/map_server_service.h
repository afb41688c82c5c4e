// The map server on the bus: says which map there is (MAP_INFO) and sends its tiles (MAP_TILE) to whoever asks
// (MAP_TILE_REQUEST), a few parts per millisecond, so that receivers' buffers never overflow.
#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <string>

#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "orthonav/map_tile_request_t.hpp"
#include "services/map_server/map_database.h"
#include "services/map_server/options.h"
#include "services/map_server/tile_queue.h"

namespace orthonav::map_server {

class MapServerService : public Service {
 public:
  // Opens the map, building its database first when that is needed (a raster without an up-to-date .onmap beside it).
  // `map`, a raster or an .onmap file, takes the place of the configuration's `file` unless it is empty. Throws
  // ConfigError, MapDatabaseError or std::runtime_error naming the file.
  MapServerService(Node& node, const std::filesystem::path& config_folder, const std::filesystem::path& map = {});

  const MapDatabase& database() const { return *database_; }

 private:
  // A tile that is being sent.
  struct Sending {
    TileRequest request;
    TileFeatures features;
    int num_parts = 0;
    int next_part = 0;
    int end_part = 0;
  };
  void handle(const map_tile_request_t& request);
  void ask_for(const std::string& client, const TileRequest& request);
  bool start_next();
  void send_parts();
  void send_part(Sending& sending);
  void refuse(const TileRequest& request);
  void publish_info();

  Node& node_;
  ServerOptions options_;
  std::unique_ptr<MapDatabase> database_;
  TileQueue queue_;
  std::optional<Sending> sending_;  // of the request at the front
};

}  // namespace orthonav::map_server
