// Builds the feature database from an orthophoto: map preprocessing, equations (3) and (4).
//
// Works through blocks of tiles, so that the memory needed is that of a few blocks for each core, whatever the size of
// the raster; finished blocks survive a kill (MapDatabaseWriter).
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>

#include "services/map_server/block_builder.h"
#include "services/map_server/map_database.h"
#include "services/map_server/options.h"

namespace orthonav::map_server {

// What the map's content depends on: the bytes of the raster's files (a mosaic's too) and of the elevation model's,
// the options and the format. 16 hexadecimal digits. Throws MapDatabaseError when a file cannot be read.
std::string build_fingerprint(const std::filesystem::path& raster, const BuildOptions& options);

struct BuildProgress {
  int64_t done = 0;     // blocks, those of an earlier run included
  int64_t resumed = 0;  // of these, of an earlier run
  int64_t total = 0;
};

// Builds `out` and reads it back. The output depends neither on the number of cores nor on how often the build was
// broken off; an `out` of the same fingerprint is verified and kept. Says the levels of the database. Throws
// MapDatabaseError or std::runtime_error naming the file (no raster, no georeference, no data at all, disk full).
std::vector<MapDescription> build_map(const std::filesystem::path& raster, const BuildOptions& options,
                                      const std::filesystem::path& out,
                                      const std::function<void(const BuildProgress&)>& progress);

// A database of this raster and these options: `raster` itself when it is an .onmap file; else the one kept beside the
// raster (<raster>.<features>.onmap), built first when it is missing, unreadable or of another fingerprint. Returns
// the database's file. Throws as build_map does.
std::filesystem::path prepare_map(const std::filesystem::path& map, const BuildOptions& options,
                                  const std::function<void(const BuildProgress&)>& progress);

}  // namespace orthonav::map_server
