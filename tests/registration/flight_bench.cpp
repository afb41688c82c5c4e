// Registration's methods along a flight, without the rest of the chain: the keyframes of a replayed log (images,
// compass, odometry, truth) against a map, one row of CSV a keyframe and a summary. Not run by ctest.
//
//   orthonav-replay --config config/rural --log flight.lcm --out odometry.lcm
//   registration-flight-bench odometry.lcm flight.map.tif --config config/rural --method submap --prior-sigma 3
#include <cmath>
#include <cstdio>
#include <ctime>
#include <filesystem>
#include <map>
#include <random>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/bus/keyframe_repeats.h"
#include "common/camera/image_decode.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/truth_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "services/map_server/map_builder.h"
#include "services/registration/heading_buffer.h"
#include "services/registration/keyframe_message.h"
#include "services/registration/registrar.h"
#include "services/registration/submap.h"

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
};

struct Truth {
  Eigen::Vector3d p_G;
  Eigen::Vector2d map_offset;
  double heading;
};

// Of the processor, for other programs may be running.
double now_ms() {
  return 1e3 * static_cast<double>(std::clock()) / CLOCKS_PER_SEC;
}

MapFeatures features_of(const map_server::MapDatabase& database) {
  map_server::TileFeatures all = database.all_tiles(0);
  MapFeatures features;
  features.descriptors =
      cv::Mat(static_cast<int>(all.positions.size()), kSiftBytes, CV_8U, all.descriptors.data()).clone();
  features.positions = std::move(all.positions);
  return features;
}

void run(const Arguments& arguments) {
  map_server::BuildOptions build = map_server::ServerOptions::from_config(arguments.config).build;
  build.features = arguments.method == "submap" ? map_server::FeatureKind::kRootSift
                   : arguments.method == "m2"   ? map_server::FeatureKind::kSift
                                                : map_server::FeatureKind::kGrid;
  if (arguments.size > 0) build.keypoint_size = arguments.size;
  const map_server::MapDatabase database(map_server::prepare_map(arguments.map, build, {}));
  const auto& description = database.levels().front();
  const EnuFrame frame(description.anchor);
  const MapGeometry geometry{description.metres_per_pixel, description.keypoint_size, description.keypoint_stride};

  ConfigNode aircraft = ConfigNode::load(arguments.config / "aircraft.yaml");
  ConfigNode camera_node = aircraft.child("camera");
  const CameraModel camera = CameraModel::from_config(camera_node);
  double declination_deg = 0;
  aircraft.require("magnetic_declination_deg", declination_deg);

  ConfigNode node = ConfigNode::load(arguments.config / "registration.yaml");
  SubmapOptions submap_options = SubmapOptions::from_config(node);
  if (arguments.max_keyframes > 0) submap_options.max_keyframes = arguments.max_keyframes;
  const bool bounded = arguments.prior_sigma > 0;
  // Cold: nothing is ever accepted, so that nothing is known for the next keyframe. Whether it would be is judged here.
  submap_options.evidence = arguments.evidence;
  submap_options.coarse_places = arguments.coarse_places;
  SubmapRegistrar submap(submap_options, camera);
  RegistrarOptions options;
  for (const Method method : {Method::kSubmap, Method::kPaper, Method::kM1, Method::kM2}) {
    if (arguments.method == name_of(method)) options.method = method;
  }
  Registrar registrar(options, camera);
  if (arguments.method == "submap") {
    submap.set_map(features_of(database), geometry);
  } else {
    registrar.set_map(features_of(database), geometry);
  }

  std::FILE* csv = arguments.csv.empty() ? nullptr : std::fopen(arguments.csv.c_str(), "w");
  std::map<int64_t, image_t> images;
  std::map<int64_t, Truth> truths;
  HeadingBuffer headings(300'000);
  std::mt19937_64 random(static_cast<uint64_t>(arguments.seed));
  std::normal_distribution<double> normal;
  int tried = 0, near = 0, accepted = 0, false_fixes = 0, keyframe_count = 0;
  std::vector<double> errors, horizontal, vertical, nees, nees_horizontal, nees_vertical, times, describe_times,
      search_times, biases;
  const auto judge = [&](const vio_keyframe_t& message) {
    if (keyframe_count++ % arguments.every != 0 || tried >= arguments.limit) return;
    const auto image = images.find(message.utime);
    const auto truth = truths.find(message.utime);
    const auto heading = headings.at(message.utime);
    if (image == images.end() || truth == truths.end() || !heading) return;
    const Keyframe keyframe = keyframe_of(message);
    const DecodedImage decoded = decode_image(image->second, camera.width(), camera.height());
    const Truth& is = truth->second;
    const double start = now_ms();
    double described = start, searched = start;
    Fix fix;
    if (arguments.method == "submap") {
      std::optional<PositionPrior> prior;
      if (bounded) {
        prior =
            PositionPrior{is.p_G.head<2>() + arguments.prior_sigma * Eigen::Vector2d(normal(random), normal(random)),
                          arguments.prior_sigma};
      }
      submap.describe(keyframe, message.session, decoded.grey, *heading);
      described = now_ms();
      submap.search(prior);
      searched = now_ms();
      fix = submap.solve();
    } else {
      const Query query = registrar.describe(keyframe, decoded.grey, *heading);
      described = now_ms();
      const auto matches = registrar.match(query);
      searched = now_ms();
      fix = registrar.solve(keyframe, query, matches, *heading);
    }
    const double end = now_ms();
    map_fix_t out;
    fill_fix(fix, frame, out);
    double used = heading->value + (std::isfinite(fix.heading_correction) ? fix.heading_correction : 0);
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
                 180 / M_PI * wrap_angle(used - is.heading), 180 / M_PI * wrap_angle(heading->value - is.heading),
                 end - start, is.map_offset.x(), is.map_offset.y(), fix.evidence, fix.reason);
    }
  };
  KeyframeRepeats repeats;
  LogReader reader(arguments.log);
  while (const auto event = reader.next()) {
    if (event->channel == channel::kCamera) {
      if (const auto image = event->decode<image_t>()) images[image->utime] = *image;
      while (images.size() > 150) images.erase(images.begin());
    } else if (event->channel == channel::kCompass) {
      const auto compass = event->decode<compass_t>();
      if (!compass) continue;
      headings.add(compass->utime, {true_heading(compass->heading, declination_deg * M_PI / 180),
                                    compass->heading_stddev > 0 ? compass->heading_stddev : M_PI / 60});
    } else if (event->channel == channel::kTruth) {
      const auto truth = event->decode<truth_t>();
      if (!truth) continue;
      Truth sample;
      sample.p_G = frame.to_enu({truth->latitude_deg, truth->longitude_deg, truth->ellipsoidal_height});
      sample.map_offset = {truth->map_offset_en[0], truth->map_offset_en[1]};
      sample.heading =
          heading_of(Eigen::Quaterniond(truth->q_ENU_B[0], truth->q_ENU_B[1], truth->q_ENU_B[2], truth->q_ENU_B[3]));
      truths[truth->utime] = sample;
    } else if (event->channel == channel::kVioKeyframe) {
      const auto keyframe = event->decode<vio_keyframe_t>();
      if (keyframe && !repeats.add(*keyframe)) judge(*keyframe);
    }
  }
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
      tried, description.num_features, 100.0 * near / tried, 100.0 * accepted / tried, false_fixes, median(errors),
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
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);
  try {
    run(arguments);
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}\n", error.what());
    return 1;
  }
  return 0;
}
