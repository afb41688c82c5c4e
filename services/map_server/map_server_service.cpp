#include "services/map_server/map_server_service.h"

#include <algorithm>
#include <chrono>

#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include "common/bus/channels.h"
#include "common/bus/packet.h"
#include "common/features/fixed_sift.h"
#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "services/map_server/map_builder.h"

namespace orthonav::map_server {
namespace {

constexpr int kPacketOverhead = 114;  // a part's other fields, the channel's name and a seal
constexpr int kFeaturesPerPart = (kPacketBytes - kPacketOverhead) / (3 * static_cast<int>(sizeof(float)) + kSiftBytes);
constexpr size_t kMaxRequests = 100'000;

int parts_of(const TileFeatures& tile) {
  const int count = static_cast<int>(tile.positions.size());
  return std::max(1, (count + kFeaturesPerPart - 1) / kFeaturesPerPart);
}

}  // namespace

MapServerService::MapServerService(Node& node, const std::filesystem::path& config_folder,
                                   const std::filesystem::path& map)
    : node_(node), options_(ServerOptions::from_config(config_folder)), queue_(kMaxRequests) {
  const std::filesystem::path& file = map.empty() ? options_.file : map;
  if (file.empty()) {
    throw ConfigError(
        fmt::format("{}: no map: set `file` or give --map", (config_folder / "map_server.yaml").string()));
  }
  int64_t reported = -1;
  database_ = std::make_unique<MapDatabase>(prepare_map(file, options_.build, [&](const BuildProgress& progress) {
    const int64_t tenth = 10 * progress.done / progress.total;
    if (tenth != reported) spdlog::info("building the database of {}: {} %", file.string(), tenth * 10);
    reported = tenth;
  }));
  int64_t num_tiles = 0;
  for (const MapDescription& level : database_->levels()) {
    num_tiles += level.num_tiles();
    spdlog::info("serving {}: {} features at {:.2f} m/px in {} tiles, fingerprint {}", database_->file().string(),
                 level.num_features, level.metres_per_pixel, level.num_tiles(), level.fingerprint);
  }
  node_.health().set_state(Health::State::kOk);
  node_.health().set("map.features", static_cast<double>(database_->num_features()));
  node_.health().set("map.tiles", static_cast<double>(num_tiles));

  node_.subscribe<map_tile_request_t>(channel::kMapTileRequest, Delivery::kAll,
                                      [this](const map_tile_request_t& request) { handle(request); });
  node_.every(std::chrono::seconds(1), [this] { publish_info(); });
  node_.every(std::chrono::microseconds(options_.part_period_us), [this] { send_parts(); });
}

void MapServerService::publish_info() {
  const auto& levels = database_->levels();
  for (size_t i = 0; i < levels.size(); ++i) {
    const MapDescription& level = levels[i];
    map_info_t info;
    info.utime = node_.now();
    info.map_name = database_->file().filename().string();
    info.fingerprint = level.fingerprint;
    info.anchor_latitude_deg = level.anchor.latitude_deg;
    info.anchor_longitude_deg = level.anchor.longitude_deg;
    info.anchor_height = level.anchor.height;
    info.metres_per_pixel = level.metres_per_pixel;
    info.east_min = level.east_min;
    info.east_max = level.east_max;
    info.north_min = level.north_min;
    info.north_max = level.north_max;
    info.num_features = level.num_features;
    info.descriptor_size = kSiftBytes;
    info.keypoint_size = level.keypoint_size;
    info.keypoint_stride = level.keypoint_stride;
    info.tile_size = level.tile_size;
    info.tile_columns = level.tile_columns;
    info.tile_rows = level.tile_rows;
    info.has_surface = level.has_surface ? 1 : 0;
    info.features = name_of(level.features);
    info.level = static_cast<int32_t>(i);
    info.num_levels = static_cast<int32_t>(levels.size());
    info.map_fingerprint = levels.front().fingerprint;
    node_.publish(channel::kMapInfo, info);
  }
}

void MapServerService::handle(const map_tile_request_t& request) {
  Health& health = node_.health();
  health.add("requests.received");
  const auto& levels = database_->levels();
  const auto level = std::find_if(levels.begin(), levels.end(), [&](const MapDescription& candidate) {
    return candidate.fingerprint == request.fingerprint;
  });
  if (level == levels.end()) {
    health.reject("request.other_map", fmt::format("{} asked for tiles of map {}, this one is {}", request.client,
                                                   request.fingerprint, levels.front().fingerprint));
    return;
  }
  for (size_t i = 0; i < request.tile.size(); ++i) {
    ask_for(request.client, {static_cast<int>(level - levels.begin()), request.tile[i], std::max(request.part[i], -1)});
  }
}

void MapServerService::ask_for(const std::string& client, const TileRequest& request) {
  Health& health = node_.health();
  const MapDescription& level = database_->levels()[static_cast<size_t>(request.level)];
  if (request.tile < 0 || request.tile >= level.num_tiles()) {
    health.reject("request.no_such_tile",
                  fmt::format("{} asked for tile {} of {}", client, request.tile, level.num_tiles()));
    refuse(request);
    return;
  }
  switch (queue_.add(request)) {
    case TileQueue::Outcome::kQueued:
      break;
    case TileQueue::Outcome::kCoalesced:
      health.add("tiles.coalesced");
      break;
    case TileQueue::Outcome::kFull:
      health.reject("request.queue_full", fmt::format("{} requests wait: the rest is refused", queue_.size()));
      break;
  }
}

void MapServerService::refuse(const TileRequest& request) {
  map_tile_t answer{};
  answer.utime = node_.now();
  answer.fingerprint = database_->levels()[static_cast<size_t>(request.level)].fingerprint;
  answer.tile = request.tile;
  answer.descriptor_size = kSiftBytes;
  node_.publish(channel::kMapTile, answer);
}

// Reads the tile at the front of the queue. False when there is none to send.
bool MapServerService::start_next() {
  while (!sending_ && !queue_.empty()) {
    const TileRequest request = queue_.front();
    try {
      Sending next{request, database_->tile(request.level, request.tile), 0, 0, 0};
      next.num_parts = parts_of(next.features);
      next.next_part = std::max(request.part, 0);
      next.end_part = request.part < 0 ? next.num_parts : request.part + 1;
      if (next.end_part <= next.num_parts) {
        sending_ = std::move(next);
        return true;
      }
      node_.health().reject("request.no_such_part", fmt::format("tile {} has {} parts, part {} was asked for",
                                                                request.tile, next.num_parts, request.part));
    } catch (const MapDatabaseError& error) {
      node_.health().reject("tile.damaged", error.what());
      refuse(request);
    }
    queue_.pop();
  }
  return sending_.has_value();
}

void MapServerService::send_parts() {
  for (int sent = 0; sent < options_.parts_per_period && start_next(); ++sent) send_part(*sending_);
}

void MapServerService::send_part(Sending& sending) {
  const size_t begin = static_cast<size_t>(sending.next_part) * kFeaturesPerPart;
  const size_t end = std::min(sending.features.positions.size(), begin + kFeaturesPerPart);
  map_tile_t part;
  part.utime = node_.now();
  part.fingerprint = database_->levels()[static_cast<size_t>(sending.request.level)].fingerprint;
  part.tile = sending.request.tile;
  part.part = sending.next_part;
  part.num_parts = sending.num_parts;
  part.num_features = static_cast<int32_t>(end - begin);
  part.descriptor_size = kSiftBytes;
  part.num_bytes = part.num_features * kSiftBytes;
  part.position.reserve(end - begin);
  for (size_t i = begin; i < end; ++i) {
    const Eigen::Vector3f& p = sending.features.positions[i];
    part.position.push_back({p.x(), p.y(), p.z()});
  }
  const auto first = sending.features.descriptors.begin();
  part.descriptors.assign(first + static_cast<std::ptrdiff_t>(begin * kSiftBytes),
                          first + static_cast<std::ptrdiff_t>(end * kSiftBytes));
  node_.publish(channel::kMapTile, part);
  node_.health().add("tiles.parts_sent");
  if (++sending.next_part == sending.end_part) {
    sending_.reset();
    queue_.pop();
  }
}

}  // namespace orthonav::map_server
