// orthonav-evaluate-registration: how often a method of registration finds photos on a map, and how well.
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <opencv2/core.hpp>

#include "common/features/fixed_sift.h"
#include "common/math/statistics.h"
#include "services/map_server/map_builder.h"
#include "services/registration/map/map_client.h"
#include "tools/evaluate_registration/evaluation.h"

namespace {

using namespace orthonav;
using namespace orthonav::evaluate_registration;
using registration::MethodName;

constexpr double kRadian = M_PI / 180.0;

struct Arguments {
  std::filesystem::path photos, map, config, csv;
  std::string method = "submap";
  int seeds = 3;
  double heading_stddev_deg = 3;
  EvaluationOptions options;
};

map_server::FeatureKind kind_for(const std::string& method) {
  if (method == "submap") return map_server::FeatureKind::kRootSift;
  return method == "m2" ? map_server::FeatureKind::kSift : map_server::FeatureKind::kGrid;
}

size_t level_for_photos(const PhotoFolder& folder, const std::vector<map_server::MapDescription>& levels) {
  std::vector<double> heights, widths;
  for (const Photo& photo : folder.photos) {
    if (photo.problem.empty()) heights.push_back(photo.height);
  }
  if (heights.empty()) throw std::runtime_error("no photo has a usable position, height and heading");
  for (const auto& level : levels) widths.push_back(level.metres_per_pixel);
  return static_cast<size_t>(registration::level_for(median(heights) / folder.camera.focal(), widths, -1));
}

void print_table(const std::vector<Outcome>& outcomes, const Arguments& arguments, int seed) {
  int near = 0, accepted = 0, wrong = 0, unusable = 0;
  std::vector<double> errors, times;
  for (const Outcome& outcome : outcomes) {
    if (outcome.milliseconds == 0) {
      ++unusable;
      continue;
    }
    const bool is_near = outcome.error < arguments.options.match_distance;
    near += is_near ? 1 : 0;
    accepted += outcome.accepted ? 1 : 0;
    wrong += outcome.accepted && !is_near ? 1 : 0;
    times.push_back(outcome.milliseconds);
    if (outcome.accepted && is_near) errors.push_back(outcome.error);
  }
  const auto tried = static_cast<double>(outcomes.size()) - unusable;
  fmt::print(
      "seed {}: {} photos ({} unusable), within {:.0f} m {:.1f} %, accepted {} ({} false), error of accepted true ones "
      "50 % {:.2f} m, 90 % {:.2f} m, 100 % {:.2f} m, time {:.1f} ms (median), {:.1f} ms (95 %)\n",
      seed, outcomes.size(), unusable, arguments.options.match_distance, 100 * near / std::max(tried, 1.0), accepted,
      wrong, quantile(errors, 0.5), quantile(errors, 0.9), quantile(errors, 1.0), quantile(times, 0.5),
      quantile(times, 0.95));
}

void run(Arguments& arguments) {
  ConfigNode node = ConfigNode::load(arguments.config / "registration.yaml");
  EvaluationOptions& options = arguments.options;
  options.registrar = registration::RegistrarOptions::from_config(node);
  options.submaps = registration::SubmapOptions::from_config(node);
  options.submaps.max_keyframes = options.keyframes;
  options.submap = arguments.method == "submap";
  for (const MethodName method : {MethodName::kPaper, MethodName::kM1, MethodName::kM2}) {
    if (arguments.method == registration::name_of(method)) options.registrar.method = method;
  }
  options.heading_stddev = arguments.heading_stddev_deg * kRadian;

  map_server::BuildOptions build = map_server::ServerOptions::from_config(arguments.config).build;
  build.features = kind_for(arguments.method);
  const map_server::MapDatabase database(map_server::prepare_map(arguments.map, build, nullptr));
  const bool is_database = arguments.map.extension() == ".onmap";
  std::optional<Raster> raster;
  if (!is_database) raster.emplace(arguments.map);
  const PhotoFolder folder =
      read_photos(arguments.photos, EnuFrame(database.levels().front().anchor), raster ? &*raster : nullptr);
  const size_t chosen = level_for_photos(folder, database.levels());
  const map_server::MapDescription& level = database.levels()[chosen];
  if (level.features != build.features) {
    throw std::runtime_error(fmt::format("{} has features: {}, method {} needs {}", arguments.map.string(),
                                         name_of(level.features), arguments.method, name_of(build.features)));
  }
  map_server::TileFeatures tiles = database.all_tiles(static_cast<int>(chosen));
  const registration::MapFeatures map{
      std::move(tiles.positions),
      cv::Mat(static_cast<int>(tiles.descriptors.size() / kSiftBytes), kSiftBytes, CV_8U, tiles.descriptors.data())};
  fmt::print("{}: {} photos, method {}, map of {} features at {:.3f} m/px\n", arguments.photos.string(),
             folder.photos.size(), arguments.method, map.positions.size(), level.metres_per_pixel);

  std::ofstream csv;
  if (!arguments.csv.empty()) {
    csv.open(arguments.csv);
    csv << "seed,image,accepted,error_m,inliers,milliseconds,refused\n";
  }
  for (int seed = 1; seed <= arguments.seeds; ++seed) {
    options.seed = static_cast<unsigned>(seed);
    options.registrar.matcher.seed = seed;
    const auto outcomes =
        evaluate(folder, map, {level.metres_per_pixel, level.keypoint_size, level.keypoint_stride}, options);
    print_table(outcomes, arguments, seed);
    for (const Outcome& outcome : outcomes) {
      csv << fmt::format("{},{},{},{:.2f},{},{:.1f},{}\n", seed, outcome.image, outcome.accepted ? 1 : 0, outcome.error,
                         outcome.num_inliers, outcome.milliseconds, outcome.refused);
    }
  }
  if (!arguments.csv.empty() && !csv) throw std::runtime_error("cannot write " + arguments.csv.string());
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  EvaluationOptions& options = arguments.options;
  CLI::App app{
      "Registers a folder of georeferenced photos to a map, each without any prior position, and says how "
      "often and how well a method finds them. Format: tools/evaluate_registration/README.md."};
  app.add_option("--photos", arguments.photos, "folder with metadata.csv and camera.yaml")
      ->required()
      ->check(CLI::ExistingDirectory);
  app.add_option("--map", arguments.map, "orthophoto (any raster GDAL reads) or its database (.onmap)")
      ->required()
      ->check(CLI::ExistingFile);
  app.add_option("--config", arguments.config, "folder with registration.yaml and map_server.yaml")
      ->required()
      ->check(CLI::ExistingDirectory);
  app.add_option("--method", arguments.method)->check(CLI::IsMember({"submap", "paper", "m1", "m2"}));
  app.add_option("--keyframes", options.keyframes, "photos of a submap")->check(CLI::Range(1, 1000));
  app.add_option("--spacing", options.spacing, "photos from one of a submap to the next")->check(CLI::Range(1, 10000));
  app.add_option("--every", options.every, "evaluate every so many photos")->check(CLI::Range(1, 100000));
  app.add_option("--corners", options.corners, "points of a photo")->check(CLI::Range(1, 10000));
  app.add_option("--seeds", arguments.seeds, "repetitions with other errors")->check(CLI::Range(1, 1000));
  app.add_option("--heading-stddev-deg", arguments.heading_stddev_deg, "degrees, error given to the true heading")
      ->check(CLI::Range(0.0, 180.0));
  app.add_option("--scale-stddev", options.scale_stddev, "error given to the true scale")->check(CLI::Range(0.0, 0.5));
  app.add_option("--csv", arguments.csv, "file for one row a photo");
  options.scale_stddev = 0.03;
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);  // the times are those of one core
  try {
    run(arguments);
    return 0;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-evaluate-registration: %s\n", error.what());
    return 1;
  }
}
