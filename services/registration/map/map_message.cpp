#include "services/registration/map/map_message.h"

#include <cmath>
#include <vector>

#include <fmt/format.h>

#include "common/features/fixed_sift.h"

namespace orthonav::registration {

std::string problem_of(const map_info_t& info) {
  std::string problem = level_of(info).layout.problem();
  if (!problem.empty()) return problem;
  if (info.descriptor_size != kSiftBytes) return fmt::format("map has descriptors of {} bytes", info.descriptor_size);
  const bool detected = info.keypoint_size == 0;
  if (!(info.metres_per_pixel > 0 && std::isfinite(info.metres_per_pixel) &&
        (detected || (info.keypoint_size >= 2 && info.keypoint_size <= 128)) && info.level >= 0 &&
        info.level < info.num_levels && std::abs(info.anchor_latitude_deg) <= 90 &&
        std::abs(info.anchor_longitude_deg) <= 360 && std::abs(info.anchor_height) <= 1e5)) {
    return "map's pixel size, keypoint size, level or anchor is out of range";
  }
  return {};
}

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

std::optional<map_tile_request_t> next_request(MapClient& client, const std::string& name, int64_t steady_utime) {
  if (client.level() == nullptr) return std::nullopt;
  map_tile_request_t request{};
  request.client = name;
  request.fingerprint = client.level()->layout.fingerprint;
  for (const TileRequest& wanted : client.requests(steady_utime)) {
    request.tile.push_back(wanted.tile);
    request.part.push_back(wanted.part);
  }
  request.num_tiles = static_cast<int32_t>(request.tile.size());
  if (request.num_tiles == 0) return std::nullopt;
  return request;
}

}  // namespace orthonav::registration
