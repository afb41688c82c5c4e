// Between the map's messages and the map client.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_request_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "services/registration/map/map_client.h"

namespace orthonav::registration {

// Why a map on offer is of no use to anybody; empty when it may be of some.
std::string problem_of(const map_info_t& info);

// Of an offer without a problem.
MapLevel level_of(const map_info_t& info);

TileStore::Outcome add_tile(MapClient& client, const map_tile_t& tile, int64_t utime);

// What the client wants asked for now, by a clock that nobody sets; nothing when it waits or has all. The request is
// stamped by who sends it.
std::optional<map_tile_request_t> next_request(MapClient& client, const std::string& name, int64_t steady_utime);

}  // namespace orthonav::registration
