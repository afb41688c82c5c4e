// Builds the feature database from an orthophoto: map preprocessing, equations (3) and (4).
//
// The raster, in whatever coordinate system, is first resampled to pixels of sigma metres that are aligned with east
// and north of G. Interest points, descriptors and positions are then those of G itself, the same from a UTM, a
// Web Mercator or a WGS84 raster: grid north is not true north, and degrees are not square.
//
// Pixel (i, j) of that picture has its centre at east = (i + 0.5) sigma, north = -(j + 0.5) sigma, G's origin being the
// raster's upper-left corner (the outer corner of its first pixel). So for a raster that is north-up already, these are
// the raster's own pixels.
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>

#include "services/map_server/map_database.h"
#include "services/map_server/options.h"

namespace orthonav::map_server {

// Elevation model that the options mean for this raster.
std::optional<std::filesystem::path> elevation_model(const std::filesystem::path& raster, const BuildOptions& options);

// What the map's content depends on: the bytes of the raster's file and of the elevation model's, the options and the
// format. 16 hexadecimal digits. Throws MapDatabaseError when a file cannot be read.
std::string build_fingerprint(const std::filesystem::path& raster, const BuildOptions& options);

struct BuildResult {
  MapDescription description;
  int64_t skipped_nodata = 0;   // interest points without data in the raster or the elevation model
  int64_t skipped_texture = 0;  // interest points without any gradient around
};

// Builds `out`. Works through blocks of tiles in bounded memory; the output does not depend on the number of cores.
// `progress` is called with the fraction done, 0..1. Throws MapDatabaseError or std::runtime_error naming the file
// (no raster, no georeference, no data at all, disk full).
BuildResult build_map(const std::filesystem::path& raster, const BuildOptions& options,
                      const std::filesystem::path& out, const std::function<void(double)>& progress);

// A database of this raster and these options: `raster` itself when it is an .onmap file; else the one kept beside the
// raster (<raster>.<features>.onmap), built first when it is missing, unreadable or of another
// fingerprint. Returns the database's file. Throws as build_map does.
std::filesystem::path prepare_map(const std::filesystem::path& map, const BuildOptions& options,
                                  const std::function<void(double)>& progress);

}  // namespace orthonav::map_server
