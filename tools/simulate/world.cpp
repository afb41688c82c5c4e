#include "tools/simulate/world.h"

#include <algorithm>
#include <optional>

#include "common/config/config.h"
#include "tools/simulate/world_epoch.h"
#include "tools/simulate/world_layout.h"
#include "tools/simulate/world_light.h"
#include "tools/simulate/world_map.h"
#include "tools/simulate/world_options.h"
#include "tools/simulate/world_paint.h"
#include "tools/simulate/world_random.h"
#include "tools/simulate/world_raster.h"

namespace orthonav::simulate {

namespace {

Epoch camera_epoch(const WorldOptions& options, uint64_t seed) {
  EpochOptions epoch;
  epoch.seed = seed;
  epoch.epoch_seed = mix(seed, "camera");
  epoch.latitude_deg = options.anchor.latitude_deg;
  Random random(epoch.epoch_seed);
  epoch.day = random.uniform(options.day_min, options.day_max);
  epoch.hour = random.uniform(options.hour_min, options.hour_max);
  epoch.snow = options.snow;
  return Epoch(epoch);
}

Epoch map_epoch(const WorldOptions& options, const Epoch& camera, const std::string& difference) {
  EpochOptions epoch = camera.options();
  epoch.base = false;
  epoch.snow = 0;
  epoch.change = options.difference.change;
  epoch.epoch_seed = mix(mix(epoch.seed, "map"), difference);
  Random random(epoch.epoch_seed);
  // Earlier or later: whichever leaves more of the time in which such maps are made.
  const Difference& change = epoch.change;
  const auto part = [&](double from, double to) {
    return std::max(0.0, std::min(to, change.day_last) - std::max(from, change.day_first));
  };
  const double before = part(epoch.day - change.days_max, epoch.day - change.days_min);
  const double after = part(epoch.day + change.days_min, epoch.day + change.days_max);
  const double sign = random.uniform(0, before + after) < before ? -1.0 : 1.0;
  const double shifted = epoch.day + sign * random.uniform(change.days_min, change.days_max);
  epoch.day = std::clamp(shifted, change.day_first, change.day_last);
  epoch.hour = random.uniform(change.hour_min, change.hour_max);
  return Epoch(epoch);
}

World make_procedural(const WorldOptions& options, uint64_t seed, const std::string& difference,
                      const std::filesystem::path& map_file) {
  World world{.frame = EnuFrame(options.anchor), .surface = {}, .map_offset = {}};
  const Bounds map = map_bounds(options.map, world.frame, options.east, options.north);
  world.map_east_min = map.east_min;
  world.map_east_max = map.east_max;
  world.map_north_min = map.north_min;
  world.map_north_max = map.north_max;
  // The land does not depend on the map's coordinate system, whose grid may be turned against G by a few degrees.
  const double margin = options.margin + 0.04 * std::max(options.east, options.north);
  const Bounds land{-margin, options.east + margin, -options.north - margin, margin};
  const Layout layout = make_layout(options.land, land, seed);
  const Terrain terrain(land, options.relief_rms, options.relief_wavelength, seed);
  constexpr int kNodes = 200;
  for (int j = 0; j < kNodes; ++j)
    for (int i = 0; i < kNodes; ++i)
      world.ground_height +=
          terrain.height({options.east * (i + 0.5) / kNodes, -options.north * (j + 0.5) / kNodes}) / (kNodes * kNodes);

  const Epoch now = camera_epoch(options, seed);
  const uint64_t map_seed = mix(mix(seed, "map"), difference);
  world.map_offset = make_map_offset(options.map, map, map_seed);
  if (!map_file.empty()) {
    const Epoch then = map_epoch(options, now, difference);
    Canvas canvas = paint(layout, then, terrain, land, options.map_detail);
    Scene scene{canvas.east_min,
                canvas.north_max,
                canvas.resolution,
                render(canvas, then, options.light, options.map.colour),
                {}};
    canvas.label.release();
    for (int v = 0; v < canvas.height.rows; ++v) {
      float* row = canvas.height.ptr<float>(v);
      const double north = canvas.north_max - (v + 0.5) * canvas.resolution;
      for (int u = 0; u < canvas.height.cols; ++u)
        row[u] -= static_cast<float>(terrain.height({canvas.east_min + (u + 0.5) * canvas.resolution, north}));
    }
    scene.above_ground = canvas.height;
    write_map(map_file, options.map, options.difference.sensor, world.frame, options.east, options.north, scene,
              world.map_offset, map_seed);
    std::filesystem::path dem = map_file;
    write_dem(
        dem.replace_extension(".dem.tif"), options.map, world.frame, land,
        [&](const Eigen::Vector2d& p) { return terrain.height(p); }, seed);
  }
  Canvas canvas = paint(layout, now, terrain, land, options.resolution);
  world.surface.east_min = canvas.east_min;
  world.surface.north_max = canvas.north_max;
  world.surface.resolution = canvas.resolution;
  world.surface.luminance = render(canvas, now, options.light, false);
  world.surface.height = canvas.height;
  return world;
}

}  // namespace

World make_world(ConfigNode& world, uint64_t seed, const std::string& difference,
                 const std::filesystem::path& map_file) {
  std::optional<RasterOptions> rasters;
  const WorldOptions options = read_world(world, difference, rasters);
  if (rasters) return make_raster_world(options, *rasters, map_file);
  return make_procedural(options, seed, difference, map_file);
}

}  // namespace orthonav::simulate
