// Time to build a map's database against OpenCV's SIFT at the same interest points, in one run. Not run by ctest (it
// takes minutes):
//
//   build/release/bin/map-build-bench ORTHOPHOTO
//
// Processor time is compared, since another program may be running: OpenCV's of the descriptors alone, from a picture
// in memory; ours of everything from the raster's file to the verified database.
#include <chrono>
#include <ctime>
#include <functional>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <opencv2/core.hpp>

#include "common/features/fixed_sift.h"
#include "common/geo/raster.h"
#include "services/map_server/map_builder.h"
#include "tests/support/temporary_folder.h"

namespace {

using namespace orthonav;

struct Cost {
  double seconds = 0, processor_seconds = 0;
};

Cost cost_of(const std::function<void()>& work) {
  const auto wall = std::chrono::steady_clock::now();
  const std::clock_t processor = std::clock();
  work();
  return {std::chrono::duration<double>(std::chrono::steady_clock::now() - wall).count(),
          static_cast<double>(std::clock() - processor) / CLOCKS_PER_SEC};
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Time to build a map's database against OpenCV's SIFT at the same points."};
  std::filesystem::path file;
  app.add_option("raster", file)->required()->check(CLI::ExistingFile);
  CLI11_PARSE(app, argc, argv);
  try {
    map_server::BuildOptions options;
    options.features = map_server::FeatureKind::kRootSift;
    const test::TemporaryFolder folder;
    std::vector<map_server::MapDescription> levels;
    const Cost ours = cost_of([&] { levels = map_server::build_map(file, options, folder / "map.onmap", nullptr); });
    const Raster raster(file);
    const cv::Mat grey = raster.read_grey({0, 0, raster.width(), raster.height()});
    std::vector<cv::Point2f> points;
    const int stride = static_cast<int>(options.keypoint_stride);
    for (int v = stride / 2; v < grey.rows; v += stride) {
      for (int u = stride / 2; u < grey.cols; u += stride) {
        points.emplace_back(static_cast<float>(u), static_cast<float>(v));
      }
    }
    const Cost opencv = cost_of([&] { FixedSift(options.keypoint_size).describe(grey, points); });
    fmt::print("{} x {} px: OpenCV {} points: {:.1f} s ({:.1f} s of processor)\n", grey.cols, grey.rows, points.size(),
               opencv.seconds, opencv.processor_seconds);
    fmt::print("database of {} features: {:.1f} s ({:.1f} s of processor): {:.1f} x faster ({:.1f} x of processor)\n",
               levels.front().num_features, ours.seconds, ours.processor_seconds, opencv.seconds / ours.seconds,
               opencv.processor_seconds / ours.processor_seconds);
    return 0;
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}\n", error.what());
    return 1;
  }
}
