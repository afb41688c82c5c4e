#include "services/map_server/options.h"

namespace orthonav::map_server {

const char* name_of(FeatureKind kind) {
  switch (kind) {
    case FeatureKind::kSift:
      return "sift";
    case FeatureKind::kRootSift:
      return "rootsift";
    case FeatureKind::kGrid:
      break;
  }
  return "grid";
}

BuildOptions BuildOptions::from_config(ConfigNode& node) {
  BuildOptions options;
  std::string features = name_of(options.features);
  node.read("features", features);
  bool known = false;
  for (const FeatureKind kind : {FeatureKind::kRootSift, FeatureKind::kGrid, FeatureKind::kSift}) {
    if (features != name_of(kind)) continue;
    options.features = kind;
    known = true;
  }
  if (!known) node.fail("features", "must be rootsift, grid or sift");
  node.read("keypoint_stride", options.keypoint_stride, 1, 1000);
  node.read("keypoint_size", options.keypoint_size, 2, 128);
  node.read("metres_per_pixel", options.metres_per_pixel, 0, 100);
  node.read("tile_size_m", options.tile_size_m, 1, 10000);
  node.read("max_invalid_fraction", options.max_invalid_fraction, 0, 1);
  node.read("min_contrast", options.min_contrast, 0, 128);
  node.read("levels", options.levels, 1, 8);
  node.read("ground_height_m", options.ground_height_m, -1000, 10000);
  node.read("dem", options.dem);
  if (options.dem != "auto" && options.dem != "none") {
    std::filesystem::path model;
    node.read_path("dem", model);
    options.dem = model.string();
  }
  node.finish();
  return options;
}

ServerOptions ServerOptions::from_config(const std::filesystem::path& config_folder) {
  ConfigNode node = ConfigNode::load(config_folder / "map_server.yaml");
  ServerOptions options;
  ConfigNode build = node.child_or_empty("map");
  options.build = BuildOptions::from_config(build);
  node.read_path("file", options.file);
  node.read("part_period_us", options.part_period_us, 100, 1'000'000);
  node.read("parts_per_period", options.parts_per_period, 1, 1000);
  node.finish();
  return options;
}

}  // namespace orthonav::map_server
