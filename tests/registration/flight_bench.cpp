// Registration's methods along a flight, without the rest of the chain: the keyframes of a replayed log (images,
// compass, odometry, truth) against a map, one row of CSV a keyframe and a summary. Not run by ctest.
//
//   orthonav-replay --config config/rural --log flight.lcm --out odometry.lcm
//   registration-flight-bench odometry.lcm flight.map.tif --config config/rural --method submap --prior-sigma 3
//
// With factors, how far fits follow an odometry whose world is that much too long or short (scale_bench.h):
//
//   registration-flight-bench odometry.lcm flight.map.tif --config config/rural --factors 0.85 0.9 1.1 1.15
#include <cmath>
#include <cstdio>
#include <ctime>
#include <filesystem>
#include <random>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "common/camera/image_decode.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/registration/keyframe_message.h"
#include "services/registration/methods.h"
#include "tests/registration/recorded_flight.h"
#include "tests/registration/scale_bench.h"

namespace {

using namespace orthonav;
using namespace orthonav::registration;

struct Arguments {
  EvidenceOptions evidence;
  int coarse_places = SubmapOptions().coarse_places;
  std::filesystem::path log, map, config, csv;
  std::string method = "submap";
  double prior_sigma = 0;
  int max_keyframes = 0, every = 1, seed = 1, limit = 1 << 30;
  double size = 0;
  ScaleBench scale;
};

// Of the processor, for other programs may be running.
double now_ms() {
  return 1e3 * static_cast<double>(std::clock()) / CLOCKS_PER_SEC;
}

void run(const Arguments& arguments) {
  const map_server::FeatureKind kind = arguments.method == "submap" ? map_server::FeatureKind::kRootSift
                                       : arguments.method == "m2"   ? map_server::FeatureKind::kSift
                                                                    : map_server::FeatureKind::kGrid;
  BenchMap map = load_map(arguments.map, arguments.config, kind, arguments.size);
  const BenchAircraft aircraft = load_bench_aircraft(arguments.config);
  const CameraModel& camera = aircraft.camera;

  ConfigNode node = ConfigNode::load(arguments.config / "registration.yaml");
  MethodOptions options = MethodOptions::from_config(node);
  if (arguments.max_keyframes > 0) options.submap.max_keyframes = arguments.max_keyframes;
  const bool bounded = arguments.prior_sigma > 0;
  // Cold: nothing is ever accepted, so that nothing is known for the next keyframe. Whether it would be is judged here.
  options.submap.evidence = arguments.evidence;
  options.submap.coarse_places = arguments.coarse_places;
  for (const MethodName each : {MethodName::kSubmap, MethodName::kPaper, MethodName::kM1, MethodName::kM2}) {
    if (arguments.method == name_of(each)) options.registrar.method = each;
  }
  const std::unique_ptr<Method> method = make_method(options, camera);
  method->set_map(std::move(map.features), map.geometry);

  std::FILE* csv = arguments.csv.empty() ? nullptr : std::fopen(arguments.csv.c_str(), "w");
  std::mt19937_64 random(static_cast<uint64_t>(arguments.seed));
  std::normal_distribution<double> normal;
  int tried = 0, near = 0, accepted = 0, false_fixes = 0, keyframe_count = 0;
  std::vector<double> errors, horizontal, vertical, nees, nees_horizontal, nees_vertical, times, describe_times,
      search_times, biases;
  const auto judge = [&](const BenchKeyframe& each) {
    if (keyframe_count++ % arguments.every != 0 || tried >= arguments.limit) return;
    const vio_keyframe_t& message = each.message;
    const Heading& heading = each.heading;
    const Keyframe keyframe = keyframe_of(message);
    const DecodedImage decoded = decode_image(*each.image, camera.width(), camera.height());
    const Truth& is = each.truth;
    const double start = now_ms();
    std::optional<PositionPrior> prior;
    if (bounded) {
      prior = PositionPrior{is.p_G.head<2>() + arguments.prior_sigma * Eigen::Vector2d(normal(random), normal(random)),
                            arguments.prior_sigma};
    }
    method->describe(keyframe, message.session, decoded.grey, heading);
    const double described = now_ms();
    method->search(prior);
    const double searched = now_ms();
    const Fix fix = method->solve();
    const double end = now_ms();
    map_fix_t out;
    fill_fix(fix, map.frame, out);
    double used = heading.value + (std::isfinite(fix.heading_correction) ? fix.heading_correction : 0);
    Eigen::Vector2d implied(NAN, NAN);
    if (arguments.method == "submap" || arguments.method == "paper") {
      implied = (rotation_G_W(keyframe.q_W_B, used) * keyframe.p_W_B).head<2>() + fix.translation;
    } else {
      implied = fix.translation;
    }
    const double miss = (implied - is.p_G.head<2>()).norm();
    const Eigen::Vector3d error = fix.p_G_B - is.p_G;
    ++tried;
    const bool is_near = fix.num_query > 0 && miss < 30;
    near += is_near ? 1 : 0;
    times.push_back(end - start);
    describe_times.push_back(described - start);
    search_times.push_back(searched - described);
    if (fix.valid) {
      ++accepted;
      if (error.norm() > 30) {
        ++false_fixes;
      } else {
        errors.push_back(error.norm());
        horizontal.push_back(error.head<2>().norm());
        vertical.push_back(std::abs(error.z()));
        biases.push_back(error.z());
        nees.push_back(error.dot(fix.covariance.inverse() * error));
        nees_horizontal.push_back(
            error.head<2>().dot(fix.covariance.topLeftCorner<2, 2>().inverse() * error.head<2>()));
        nees_vertical.push_back(error.z() * error.z() / fix.covariance(2, 2));
      }
    }
    if (csv != nullptr) {
      fmt::print(csv,
                 "{},{},{:.2f},{:.1f},{:.1f},{},{},{},{},{:.2f},{:.2f},{:.2f},{:.3f},{:.3f},{:.4f},{:.4f},{:.2f},{:.2f}"
                 ",{:.2f},{:.2f},{:.2f},{:.3f},{}\n",
                 message.utime, fix.num_keyframes, miss, fix.log_likelihood, fix.log_likelihood_ratio, fix.num_inliers,
                 fix.num_query, fix.num_second_inliers, fix.valid ? 1 : 0, error.x(), error.y(), error.z(),
                 std::sqrt(fix.covariance(0, 0)), std::sqrt(fix.covariance(2, 2)), fix.scale, fix.scale_stddev,
                 180 / M_PI * wrap_angle(used - is.heading), 180 / M_PI * wrap_angle(heading.value - is.heading),
                 end - start, is.map_offset.x(), is.map_offset.y(), fix.log_odds, fix.reason);
    }
  };
  for_each_keyframe(arguments.log, map.frame, aircraft.declination, true, judge);
  if (csv != nullptr) std::fclose(csv);
  const auto mean = [](const std::vector<double>& values) {
    double sum = 0;
    for (const double value : values) sum += value;
    return sum / std::max<double>(1, static_cast<double>(values.size()));
  };
  fmt::print(
      "{} {} {} {}: {} keyframes, {} features; true matches {:.1f} %, fixes {:.1f} %, false {}; error median {:.2f} m, "
      "horizontal {:.2f}, vertical {:.2f} (bias {:.2f}); nees {:.2f} (3), horizontal {:.2f} (2), vertical {:.2f} (1); "
      "time median {:.2f} ms, describe {:.2f}, search {:.2f}, p95 {:.2f}\n",
      arguments.log.stem().string(), arguments.map.filename().string(), arguments.method, bounded ? "bounded" : "cold",
      tried, map.num_features, 100.0 * near / tried, 100.0 * accepted / tried, false_fixes, median(errors),
      median(horizontal), median(vertical), median(biases), mean(nees), mean(nees_horizontal), mean(nees_vertical),
      median(times), median(describe_times), median(search_times), quantile(times, 0.95));
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  CLI::App app{"Registers the keyframes of a replayed flight."};
  app.add_option("log", arguments.log, "log with images, compass, truth and keyframes")->required();
  app.add_option("map", arguments.map, "orthophoto")->required();
  app.add_option("--config", arguments.config, "folder of the scenario")->required();
  app.add_option("--method", arguments.method)->check(CLI::IsMember({"submap", "paper", "m1", "m2"}));
  app.add_option("--prior-sigma", arguments.prior_sigma, "m, of a made-up prior position; 0: cold");
  app.add_option("--keyframes", arguments.max_keyframes, "of a submap");
  app.add_option("--every", arguments.every, "use every so many keyframes");
  app.add_option("--limit", arguments.limit, "keyframes at most");
  app.add_option("--size", arguments.size, "keypoint size, map pixels");
  app.add_option("--seed", arguments.seed, "of the made-up prior");
  app.add_option("--csv", arguments.csv,
                 "each keyframe: its distance from the truth, likelihood, inliers, errors and more");
  app.add_option("--evidence-threshold", arguments.evidence.threshold);
  app.add_option("--evidence-limit", arguments.evidence.limit);
  app.add_option("--coarse-places", arguments.coarse_places);
  app.add_option("--factors", arguments.scale.factors, "of the odometry's world: prints how far fits follow each");
  app.add_option("--factor-seconds", arguments.scale.seconds, "of the flight that the factors apply to; 0: all of it");
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);
  try {
    if (arguments.scale.factors.empty()) {
      run(arguments);
    } else {
      arguments.scale.log = arguments.log;
      arguments.scale.map = arguments.map;
      arguments.scale.config = arguments.config;
      arguments.scale.csv = arguments.csv;
      if (arguments.prior_sigma > 0) arguments.scale.prior_stddev = arguments.prior_sigma;
      arguments.scale.seed = arguments.seed;
      run(arguments.scale);
    }
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}\n", error.what());
    return 1;
  }
  return 0;
}
