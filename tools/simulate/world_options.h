// The `world:` part of simulate.yaml as typed values.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "common/config/config.h"
#include "common/geo/enu_frame.h"
#include "tools/simulate/world_epoch.h"
#include "tools/simulate/world_layout.h"
#include "tools/simulate/world_light.h"
#include "tools/simulate/world_map.h"

namespace orthonav::simulate {

struct DifferencePreset {
  Difference change;
  MapSensor sensor;
};

struct WorldOptions {
  Geodetic anchor{48.30, 12.98, 430.0};  // the map's upper-left corner
  double east = 510, north = 400;        // m, extent of the map
  double margin = 90;                    // m of world around the map
  double resolution = 0.1;               // m/px of what the camera sees
  double map_detail = 0.15;              // m/px at which the map's epoch is drawn before the map's sensor
  double relief_rms = 3.0;               // m
  double relief_wavelength = 400;        // m
  double day_min = 120, day_max = 240;   // of the year, of the flight
  double hour_min = 9, hour_max = 15.5;  // local solar time of the flight
  double snow = 0;                       // part of the ground's contrast that snow hides from the camera
  LandOptions land;
  LightOptions light;
  MapOptions map;
  DifferencePreset difference;
};

// A world of real rasters: these files stand for the procedural land and its epochs.
struct RasterOptions {
  std::filesystem::path ortho;    // what the camera sees
  std::filesystem::path map;      // what the map is made of; of another date
  std::filesystem::path surface;  // heights; empty: flat at the anchor's height
  double surface_offset = 0;      // m added to the surface's heights to make them ellipsoidal
  std::vector<double> area;       // west, south, east, north of the map in map_product.crs
};

// Reads all keys of `world`; `raster` is set when the world is made of rasters. Throws ConfigError for a key that is
// unknown, of the wrong type or out of range, and for a `difference` that is not among `differences.names`.
WorldOptions read_world(ConfigNode& world, const std::string& difference, std::optional<RasterOptions>& raster);

}  // namespace orthonav::simulate
