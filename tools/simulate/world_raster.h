// A world made of real orthophotos.
#pragma once

#include <filesystem>

#include "tools/simulate/world.h"
#include "tools/simulate/world_options.h"

namespace orthonav::simulate {

// The camera sees `ortho` over `surface` (flat without one); the map is `map` resampled. The map's error against the
// orthophoto is whatever it is: map_offset answers NaN, unknown. Throws std::runtime_error naming a file.
World make_raster_world(const WorldOptions& options, const RasterOptions& rasters,
                        const std::filesystem::path& map_file);

}  // namespace orthonav::simulate
