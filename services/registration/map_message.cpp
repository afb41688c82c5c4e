#include "services/registration/map_message.h"

#include <vector>

namespace orthonav::registration {

MapLevel level_of(const map_info_t& info) {
  MapLevel level;
  level.map_fingerprint = info.map_fingerprint;
  level.level = info.level;
  level.num_levels = info.num_levels;
  level.anchor = {info.anchor_latitude_deg, info.anchor_longitude_deg, info.anchor_height};
  level.geometry = {info.metres_per_pixel, info.keypoint_size, info.keypoint_stride};
  level.layout = {info.fingerprint, info.tile_columns, info.tile_rows, info.num_features,
                  info.tile_size,   info.east_min,     info.north_min};
  return level;
}

TileStore::Outcome add_tile(MapClient& client, const map_tile_t& tile, int64_t utime) {
  std::vector<float> positions;
  positions.reserve(3 * tile.position.size());
  for (const auto& position : tile.position) positions.insert(positions.end(), position.begin(), position.end());
  return client.add(
      {tile.tile, tile.part, tile.num_parts, positions, {tile.descriptors.data(), tile.descriptors.size()}}, utime);
}

std::optional<map_tile_request_t> next_request(MapClient& client, const std::string& name, int64_t utime) {
  if (client.level() == nullptr) return std::nullopt;
  map_tile_request_t request;
  request.utime = utime;
  request.client = name;
  request.fingerprint = client.level()->layout.fingerprint;
  for (const TileRequest& wanted : client.requests(utime)) {
    request.tile.push_back(wanted.tile);
    request.part.push_back(wanted.part);
  }
  request.num_tiles = static_cast<int32_t>(request.tile.size());
  if (request.num_tiles == 0) return std::nullopt;
  return request;
}

}  // namespace orthonav::registration
