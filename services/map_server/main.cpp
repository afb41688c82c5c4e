#include <CLI/CLI.hpp>

#include "services/map_server/map_server_service.h"

int main(int argc, char** argv) {
  std::filesystem::path map;
  return orthonav::service_main(
      argc, argv, "map_server", "Serves the map's feature database over LCM.",
      [&](CLI::App& app) {
        app.add_option("--map", map,
                       "orthophoto (any raster GDAL reads) or database (.onmap), instead of the "
                       "configuration's `file`")
            ->check(CLI::ExistingFile);
      },
      [&](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::map_server::MapServerService>(node, config, map);
      });
}
