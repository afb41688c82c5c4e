#include "tools/simulate/world_options.h"

#include <algorithm>
#include <numbers>

#include <fmt/format.h>
#include <fmt/ranges.h>

namespace orthonav::simulate {

namespace {

constexpr double kShareMax = 1e6;
constexpr double kLowestSun = 10 * std::numbers::pi / 180;  // shadows of all things would cover everything

void read_map(ConfigNode&& node, MapOptions& map) {
  node.read("crs", map.crs);
  node.read("resolution", map.resolution, 0.05, 5.0);
  node.read("colour", map.colour);
  node.read("jpeg_quality", map.jpeg_quality, 0, 100);
  node.read("offset_rms", map.offset_rms, 0.0, 50.0);
  node.read("bias_share", map.bias_share, 0.0, 1.0);
  node.read("warp_wavelength", map.warp_wavelength, 50.0, 1e5);
  node.read("dem_resolution", map.dem_resolution, 1.0, 1000.0);
  node.read("dem_error_rms", map.dem_error_rms, 0.0, 50.0);
  node.finish();
}

void read_land(ConfigNode&& node, LandOptions& land) {
  node.read("arable", land.arable, 0.0, kShareMax);
  node.read("meadow", land.meadow, 0.0, kShareMax);
  node.read("pasture", land.pasture, 0.0, kShareMax);
  node.read("wood", land.wood, 0.0, kShareMax);
  node.read("orchard", land.orchard, 0.0, kShareMax);
  node.read("settlement", land.settlement, 0.0, kShareMax);
  node.read("industrial", land.industrial, 0.0, kShareMax);
  node.read("farmstead", land.farmstead, 0.0, kShareMax);
  node.read("pond", land.pond, 0.0, kShareMax);
  node.read("parcel_area", land.parcel_area, 500.0, 1e6);
  node.read("border_bend", land.border_bend, 0.0, 30.0);
  node.read("border_wavelength", land.border_wavelength, 100.0, 1e4);
  node.read("scatter", land.scatter, 0.0, 200.0);
  if (land.arable + land.meadow + land.pasture + land.wood + land.orchard + land.settlement + land.industrial +
          land.farmstead + land.pond <=
      0)
    node.fail("arable", "at least one use of the land must have a positive share");
  node.finish();
}

DifferencePreset read_preset(ConfigNode& node) {
  DifferencePreset preset;
  Difference& change = preset.change;
  node.read("days_min", change.days_min, 0.0, 365.0);
  node.read("days_max", change.days_max, change.days_min, 365.0);
  node.read("day_first", change.day_first, 1.0, 365.0);
  node.read("day_last", change.day_last, change.day_first, 365.0);
  node.read("hour_min", change.hour_min, 5.0, 19.0);
  node.read("hour_max", change.hour_max, change.hour_min, 19.0);
  node.read("pattern_change", change.pattern_change, 0.0, 1.0);
  node.read("crop_change", change.crop_change, 0.0, 1.0);
  node.read("tillage_change", change.tillage_change, 0.0, 1.0);
  node.read("tree_change", change.tree_change, 0.0, 1.0);
  node.read("growth", change.growth, 0.0, 0.5);
  node.read("crown_shift", change.crown_shift, 0.0, 3.0);
  node.read("building_change", change.building_change, 0.0, 1.0);
  node.read("roof_change", change.roof_change, 0.0, 1.0);
  node.read("ground_change", change.ground_change, 0.0, 1.0);
  ConfigNode sensor_node = node.child_or_empty("sensor");
  MapSensor& sensor = preset.sensor;
  sensor_node.read("blur", sensor.blur, 0.0, 3.0);
  sensor_node.read("lean_deg", sensor.lean_deg, 0.0, 40.0);
  sensor_node.read("lean_wavelength", sensor.lean_wavelength, 0.0, 1e5);
  sensor_node.read("gamma", sensor.gamma, 0.2, 5.0);
  sensor_node.read("contrast", sensor.contrast, 0.1, 5.0);
  sensor_node.read("brightness", sensor.brightness, -128.0, 128.0);
  sensor_node.read("tint", sensor.tint, 0.0, 0.5);
  sensor_node.read("noise", sensor.noise, 0.0, 50.0);
  sensor_node.read("sharpening", sensor.sharpening, 0.0, 5.0);
  sensor_node.finish();
  node.finish();
  return preset;
}

// Nothing when the world is procedural.
std::optional<RasterOptions> read_raster(ConfigNode& world) {
  RasterOptions raster;
  world.read_path("ortho", raster.ortho);
  world.read_path("map", raster.map);
  world.read_path("surface", raster.surface);
  world.read("surface_offset", raster.surface_offset, -1000.0, 1000.0);
  world.read("area", raster.area);
  if (raster.ortho.empty()) {
    for (const char* key : {"map", "surface", "surface_offset", "area"})
      if (world.has(key)) world.fail(key, "has no meaning without 'ortho'");
    return std::nullopt;
  }
  if (raster.map.empty()) world.fail("ortho", "a world of rasters needs a 'map' as well");
  if (raster.area.size() != 4 || raster.area[0] >= raster.area[2] || raster.area[1] >= raster.area[3])
    world.fail("area", "must be west, south, east, north in map_product.crs");
  return raster;
}

}  // namespace

WorldOptions read_world(ConfigNode& world, const std::string& difference, std::optional<RasterOptions>& raster) {
  WorldOptions options;
  ConfigNode anchor = world.child_or_empty("anchor");
  anchor.read("latitude_deg", options.anchor.latitude_deg, -80.0, 80.0);
  anchor.read("longitude_deg", options.anchor.longitude_deg, -180.0, 180.0);
  anchor.read("height", options.anchor.height, -500.0, 9000.0);
  anchor.finish();
  world.read("east", options.east, 30.0, 5000.0);
  world.read("north", options.north, 30.0, 5000.0);
  world.read("margin", options.margin, 0.0, 1000.0);
  world.read("resolution", options.resolution, 0.05, 1.0);
  world.read("map_detail", options.map_detail, 0.05, 1.0);
  world.read("relief_rms", options.relief_rms, 0.0, 100.0);
  world.read("relief_wavelength", options.relief_wavelength, 50.0, 1e4);
  world.read("day_min", options.day_min, 1.0, 365.0);
  world.read("day_max", options.day_max, options.day_min, 365.0);
  world.read("snow", options.snow, 0.0, 1.0);
  world.read("hour_min", options.hour_min, 5.0, 19.0);
  world.read("hour_max", options.hour_max, options.hour_min, 19.0);
  for (const double day : {options.day_min, options.day_max})
    for (const double hour : {options.hour_min, options.hour_max})
      if (sun_at(options.anchor.latitude_deg, day, hour).elevation < kLowestSun)
        world.fail("hour_min", "the sun of the flight must stand at least 10 degrees high");
  ConfigNode light = world.child_or_empty("light");
  light.read("sky", options.light.sky, 0.02, 2.0);
  light.read("mean_level", options.light.mean_level, 20.0, 220.0);
  light.finish();
  read_land(world.child_or_empty("land"), options.land);
  read_map(world.child_or_empty("map_product"), options.map);
  ConfigNode differences = world.child("differences");
  std::vector<std::string> names;
  differences.require("names", names);
  for (const std::string& name : names) {
    ConfigNode node = differences.child(name);
    const DifferencePreset preset = read_preset(node);
    for (const double day : {preset.change.day_first, preset.change.day_last})
      for (const double hour : {preset.change.hour_min, preset.change.hour_max})
        if (sun_at(options.anchor.latitude_deg, day, hour).elevation < kLowestSun)
          node.fail("hour_min", "the sun of the map must stand at least 10 degrees high");
    if (name == difference) options.difference = preset;
  }
  if (std::find(names.begin(), names.end(), difference) == names.end())
    differences.fail("names",
                     fmt::format("no difference is called '{}'; there are: {}", difference, fmt::join(names, ", ")));
  differences.finish();
  raster = read_raster(world);
  world.finish();
  return options;
}

}  // namespace orthonav::simulate
