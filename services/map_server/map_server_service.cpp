#include "services/map_server/map_server_service.h"

#include <algorithm>

#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include "common/bus/channels.h"
#include "common/features/fixed_sift.h"
#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "services/map_server/map_builder.h"

namespace orthonav::map_server {
namespace {

// A part with its strings and numbers stays below 32 kB.
constexpr int kPartBytes = 32 * 1024;
constexpr int kPartOverhead = 128;
constexpr int kFeaturesPerPart = (kPartBytes - kPartOverhead) / (3 * static_cast<int>(sizeof(float)) + kSiftBytes);

int parts_of(const TileView& tile) {
  const int count = static_cast<int>(tile.positions.size());
  return std::max(1, (count + kFeaturesPerPart - 1) / kFeaturesPerPart);
}

}  // namespace

MapServerService::MapServerService(Node& node, const std::filesystem::path& config_folder,
                                   const std::filesystem::path& map)
    : node_(node), options_(ServerOptions::from_config(config_folder)) {
  const std::filesystem::path& file = map.empty() ? options_.file : map;
  if (file.empty()) {
    throw ConfigError(
        fmt::format("{}: no map: set `file` or give --map", (config_folder / "map_server.yaml").string()));
  }
  int reported = -1;
  database_ = std::make_unique<MapDatabase>(prepare_map(file, options_.build, [&](double done) {
    const int tenth = static_cast<int>(done * 10);
    if (tenth != reported) spdlog::info("building the database of {}: {} %", file.string(), tenth * 10);
    reported = tenth;
  }));
  const MapDescription& description = database_->description();
  spdlog::info("serving {}: {} features in {} tiles, fingerprint {}", database_->file().string(),
               description.num_features, description.num_tiles(), description.fingerprint);
  queued_.assign(static_cast<size_t>(description.num_tiles()), 0);
  node_.health().set_state(Health::State::kOk);
  node_.health().set("map.features", static_cast<double>(description.num_features));
  node_.health().set("map.tiles", description.num_tiles());

  node_.subscribe<map_tile_request_t>(channel::kMapTileRequest, Delivery::kAll,
                                      [this](const map_tile_request_t& request) { handle(request); });
  node_.every(std::chrono::seconds(1), [this] { publish_info(); });
  node_.every(std::chrono::microseconds(options_.part_period_us), [this] { send_parts(); });
}

void MapServerService::publish_info() {
  const MapDescription& description = database_->description();
  map_info_t info;
  info.utime = node_.now();
  info.map_name = database_->file().filename().string();
  info.fingerprint = description.fingerprint;
  info.anchor_latitude_deg = description.anchor.latitude_deg;
  info.anchor_longitude_deg = description.anchor.longitude_deg;
  info.anchor_height = description.anchor.height;
  info.metres_per_pixel = description.metres_per_pixel;
  info.east_min = description.east_min;
  info.east_max = description.east_max;
  info.north_min = description.north_min;
  info.north_max = description.north_max;
  info.num_features = description.num_features;
  info.descriptor_size = kSiftBytes;
  info.keypoint_size = description.keypoint_size;
  info.keypoint_stride = description.keypoint_stride;
  info.tile_size = description.tile_size;
  info.tile_columns = description.tile_columns;
  info.tile_rows = description.tile_rows;
  info.has_surface = description.has_surface ? 1 : 0;
  info.features = name_of(description.features);
  node_.publish(channel::kMapInfo, info);
}

void MapServerService::handle(const map_tile_request_t& request) {
  Health& health = node_.health();
  health.add("requests.received");
  const MapDescription& description = database_->description();
  if (request.fingerprint != description.fingerprint) {
    health.reject("request.other_map", fmt::format("{} asked for tiles of map {}, this one is {}", request.client,
                                                   request.fingerprint, description.fingerprint));
    return;
  }
  for (const int tile : request.tile) {
    if (tile < 0 || tile >= description.num_tiles()) {
      health.reject("request.no_such_tile",
                    fmt::format("{} asked for tile {} of {}", request.client, tile, description.num_tiles()));
    } else if (queued_[static_cast<size_t>(tile)] != 0) {
      health.add("tiles.coalesced");
    } else {
      queued_[static_cast<size_t>(tile)] = 1;
      queue_.push_back(tile);
    }
  }
}

void MapServerService::send_parts() {
  for (int sent = 0; sent < options_.parts_per_period && !queue_.empty(); ++sent) {
    const int index = queue_.front();
    const TileView tile = database_->tile(index);
    const int num_parts = parts_of(tile);
    const size_t begin = static_cast<size_t>(next_part_) * kFeaturesPerPart;
    const size_t end = std::min(tile.positions.size(), begin + kFeaturesPerPart);

    map_tile_t part;
    part.utime = node_.now();
    part.fingerprint = database_->description().fingerprint;
    part.tile = index;
    part.part = next_part_;
    part.num_parts = num_parts;
    part.num_features = static_cast<int32_t>(end - begin);
    part.descriptor_size = kSiftBytes;
    part.num_bytes = part.num_features * kSiftBytes;
    part.position.reserve(end - begin);
    for (size_t i = begin; i < end; ++i) {
      const Eigen::Vector3f& p = tile.positions[i];
      part.position.push_back({p.x(), p.y(), p.z()});
    }
    const auto descriptors = tile.descriptors.subspan(begin * kSiftBytes, (end - begin) * kSiftBytes);
    part.descriptors.assign(descriptors.begin(), descriptors.end());
    node_.publish(channel::kMapTile, part);
    node_.health().add("tiles.parts_sent");

    if (++next_part_ == num_parts) {
      next_part_ = 0;
      queue_.pop_front();
      queued_[static_cast<size_t>(index)] = 0;
    }
  }
}

}  // namespace orthonav::map_server
