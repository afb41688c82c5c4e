// Calibrates the differences between the camera's epoch and the map's against the paper's matcher, which is written out
// here as plainly as can be, apart from the services. For each seed: single images from random places over the map,
// whose heading is off by 3 degrees and whose scale by 3 % (1 sigma), are put onto the whole map without any prior
// position.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <numbers>
#include <random>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <Eigen/Geometry>
#include <fmt/format.h>
#include <opencv2/features2d.hpp>
#include <opencv2/flann.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "common/camera/aircraft.h"
#include "common/camera/camera_model.h"
#include "common/config/config.h"
#include "common/geo/raster.h"
#include "common/math/angles.h"
#include "common/math/statistics.h"
#include "tools/simulate/height_field.h"
#include "tools/simulate/ray_caster.h"
#include "tools/simulate/world.h"

namespace {

using orthonav::simulate::CameraPose;
using orthonav::simulate::HeightField;
using orthonav::simulate::RayCaster;
using orthonav::simulate::World;

constexpr double kInlierRadius = 9, kTrueRadius = 30;  // m
constexpr size_t kTrueInliers = 8, kFixInliers = 15;

struct Arguments {
  std::filesystem::path scenario = "config/rural";
  std::filesystem::path scratch = std::filesystem::temp_directory_path();
  std::filesystem::path pictures;
  std::vector<std::string> differences{"season", "years"};
  std::vector<double> sizes{16};
  int seeds = 3, first_seed = 1, frames = 40;
};

struct Tally {
  int frames = 0, near = 0;
  std::vector<double> true_inliers, false_inliers;

  void add(size_t inliers, double error) {
    ++frames;
    if (error < kTrueRadius) ++near;
    if (inliers < kTrueInliers) return;
    (error < kTrueRadius ? true_inliers : false_inliers).push_back(static_cast<double>(inliers));
  }
  void print(const std::string& name) const {
    const auto share = [this](double count) { return 100.0 * count / std::max(1, frames); };
    const auto at_least = [](const std::vector<double>& values, size_t n) {
      return static_cast<double>(
          std::count_if(values.begin(), values.end(), [n](double v) { return v >= static_cast<double>(n); }));
    };
    fmt::print(
        "{:<34} {:4d} images: true {:5.1f} %, within 30 m {:5.1f} %; true ones have {:4.1f} inliers (median), {:5.1f} "
        "% of them >= 15; fixes {:5.1f} %, false fixes {:4.1f} %\n",
        name, frames, share(static_cast<double>(true_inliers.size())), share(near), orthonav::median(true_inliers),
        true_inliers.empty() ? 0.0
                             : 100 * at_least(true_inliers, kFixInliers) / static_cast<double>(true_inliers.size()),
        share(at_least(true_inliers, kFixInliers)), share(at_least(false_inliers, kFixInliers)));
    std::fflush(stdout);
  }
};

struct Map {
  cv::Mat grey, descriptors;
  std::vector<Eigen::Vector2d> places;  // m in G
  double resolution = 0;
};

cv::Mat describe(const cv::Mat& image, const std::vector<cv::Point2f>& points, double size) {
  std::vector<cv::KeyPoint> keypoints;
  keypoints.reserve(points.size());
  for (const cv::Point2f& p : points) keypoints.emplace_back(p, static_cast<float>(size), 0.0F);
  cv::Mat descriptors;
  cv::SIFT::create()->compute(image, keypoints, descriptors);
  if (keypoints.size() != points.size()) throw std::runtime_error("SIFT left out points");
  return descriptors;
}

Map load_map(const std::filesystem::path& file, const orthonav::EnuFrame& frame, double size) {
  constexpr int kStride = 10;
  const orthonav::Raster raster(file);
  Map map;
  map.grey = raster.read_grey({0, 0, raster.width(), raster.height()});
  map.resolution = raster.metres_per_pixel({raster.width() / 2.0, raster.height() / 2.0});
  std::vector<cv::Point2f> grid;
  for (int v = kStride / 2; v < raster.height(); v += kStride) {
    for (int u = kStride / 2; u < raster.width(); u += kStride) {
      grid.emplace_back(static_cast<float>(u), static_cast<float>(v));
      orthonav::Geodetic p = raster.pixel_to_geodetic({static_cast<double>(u), static_cast<double>(v)});
      p.height = frame.anchor().height;
      map.places.push_back(frame.to_enu(p).head<2>());
    }
  }
  map.descriptors = describe(map.grey, grid, size);
  return map;
}

struct Shot {
  CameraPose pose;
  double heading;  // rad
  cv::Mat image;
};

class Photographer {
 public:
  Photographer(const World& world, const orthonav::CameraModel& camera, double height, double margin, double tilt)
      : world_(world),
        field_(world.surface),
        caster_(field_, camera),
        camera_(camera),
        height_(height),
        margin_(margin),
        tilt_(tilt) {}

  const HeightField& field() const { return field_; }

  Shot shoot(std::mt19937_64& random) const {
    std::uniform_real_distribution<double> uniform(0, 1);
    std::normal_distribution<double> normal(0, 1);
    const auto between = [&](double low, double high) { return low + (high - low) * uniform(random); };
    Shot shot;
    shot.pose.p_G_C = {between(world_.map_east_min + margin_, world_.map_east_max - margin_),
                       between(world_.map_north_min + margin_, world_.map_north_max - margin_),
                       world_.ground_height + height_};
    shot.heading = between(0, 2 * std::numbers::pi);
    Eigen::Matrix3d R;
    R.col(0) = Eigen::Vector3d(std::cos(shot.heading), -std::sin(shot.heading), 0);
    R.col(1) = Eigen::Vector3d(-std::sin(shot.heading), -std::cos(shot.heading), 0);
    R.col(2) = -Eigen::Vector3d::UnitZ();
    // Each axis' deviation for the wanted mean of the tilt, a Rayleigh variable.
    const double deviation = tilt_ * std::sqrt(2 / std::numbers::pi);
    const Eigen::Vector3d turn(deviation * normal(random), deviation * normal(random), 0);
    shot.pose.R_G_C = Eigen::AngleAxisd(turn.norm(), turn.normalized()).toRotationMatrix() * R;
    cv::Mat image = caster_.render(shot.pose).luminance;
    cv::GaussianBlur(image, image, {}, 0.6);
    cv::Mat noise(image.size(), CV_32F);
    cv::RNG generator(random());
    generator.fill(noise, cv::RNG::NORMAL, 0, 3.0);
    image += noise;
    image.convertTo(shot.image, CV_8U);
    return shot;
  }

  // Surface point seen at a pixel, relative to the camera.
  Eigen::Vector3d point(const Shot& shot, const cv::Point2f& pixel) const {
    const Eigen::Vector3d ray = shot.pose.R_G_C * *camera_.unproject({pixel.x, pixel.y});
    double z = world_.ground_height;
    Eigen::Vector3d p;
    for (int i = 0; i < 6; ++i) {
      p = ray * ((z - shot.pose.p_G_C.z()) / ray.z());
      z = field_.height((shot.pose.p_G_C + p).head<2>());
    }
    return p;
  }

  double focal() const { return camera_.focal(); }

 private:
  const World& world_;
  HeightField field_;
  RayCaster caster_;
  const orthonav::CameraModel& camera_;
  double height_, margin_, tilt_;
};

void match(const Photographer& photographer, const Shot& shot, const Map& map, cv::FlannBasedMatcher& matcher,
           double size, double height, std::mt19937_64& random, Tally& tally) {
  std::normal_distribution<double> normal(0, 1);
  const double turn = 3 * orthonav::kDegree * normal(random), scale = 1 + 0.03 * normal(random);
  std::vector<cv::Point2f> corners;
  cv::goodFeaturesToTrack(shot.image, corners, 150, 0.01, 20);
  if (corners.size() < 8) return tally.add(0, 1e9);
  // The image as the map would show it: north up, at the map's resolution (5).
  const double s = height / photographer.focal() / map.resolution * scale, heading = shot.heading + turn;
  cv::Mat soft = shot.image, query;
  if (s < 1) cv::GaussianBlur(shot.image, soft, {}, 0.5 * std::sqrt(1 / (s * s) - 1));
  const double half = 0.5 * s * std::hypot(soft.cols, soft.rows);
  const double c = s * std::cos(heading), n = s * std::sin(heading);
  cv::Matx23d warp(c, -n, 0, n, c, 0);
  warp(0, 2) = half - c * soft.cols / 2 + n * soft.rows / 2;
  warp(1, 2) = half - n * soft.cols / 2 - c * soft.rows / 2;
  cv::warpAffine(soft, query, warp, cv::Size(static_cast<int>(2 * half), static_cast<int>(2 * half)), cv::INTER_LINEAR,
                 cv::BORDER_REPLICATE);
  std::vector<cv::Point2f> turned;
  cv::transform(corners, turned, warp);
  std::vector<cv::DMatch> matches;
  matcher.match(describe(query, turned, size), matches);
  // Votes (8), and the one that most agree with.
  std::vector<Eigen::Vector2d> votes;
  const Eigen::Rotation2D<double> off(-turn);
  for (const cv::DMatch& m : matches) {
    const Eigen::Vector2d p = photographer.point(shot, corners[static_cast<size_t>(m.queryIdx)]).head<2>();
    votes.push_back(map.places[static_cast<size_t>(m.trainIdx)] - scale * (off * p));
  }
  size_t best = 0;
  Eigen::Vector2d place(0, 0);
  for (const Eigen::Vector2d& vote : votes) {
    size_t count = 0;
    Eigen::Vector2d sum(0, 0);
    for (const Eigen::Vector2d& other : votes) {
      if ((other - vote).norm() > kInlierRadius) continue;
      ++count;
      sum += other;
    }
    if (count > best) {
      best = count;
      place = sum / static_cast<double>(count);
    }
  }
  tally.add(best, (place - shot.pose.p_G_C.head<2>()).norm());
}

void run(const Arguments& arguments) {
  orthonav::ConfigNode aircraft = orthonav::load_aircraft(arguments.scenario);
  orthonav::ConfigNode camera_node = aircraft.child("camera");
  const orthonav::CameraModel camera = orthonav::CameraModel::from_config(camera_node);
  for (const std::string& difference : arguments.differences) {
    std::vector<Tally> totals(arguments.sizes.size());
    for (int seed = arguments.first_seed; seed < arguments.first_seed + arguments.seeds; ++seed) {
      orthonav::ConfigNode simulate = orthonav::ConfigNode::load(arguments.scenario / "simulate.yaml");
      orthonav::ConfigNode flight = simulate.child("flight"), world_node = simulate.child("world");
      double height = 110, margin = 75, tilt_deg = 5.63;
      flight.read("height_m", height);
      flight.read("border_margin_m", margin);
      flight.read("mean_tilt_deg", tilt_deg);
      const std::string name =
          fmt::format("calibrate_{}_{}_{}", arguments.scenario.filename().string(), difference, seed);
      const std::filesystem::path map_file = arguments.scratch / (name + ".tif");
      const World world = orthonav::simulate::make_world(world_node, static_cast<uint64_t>(seed), difference, map_file);
      const Photographer photographer(world, camera, height, margin, tilt_deg * orthonav::kDegree);
      for (size_t i = 0; i < arguments.sizes.size(); ++i) {
        const double size = arguments.sizes[i];
        const Map map = load_map(map_file, world.frame, size);
        cv::setRNGSeed(1);
        cv::FlannBasedMatcher matcher(cv::makePtr<cv::flann::KDTreeIndexParams>(4),
                                      cv::makePtr<cv::flann::SearchParams>(32));
        matcher.add(std::vector<cv::Mat>{map.descriptors});
        matcher.train();
        std::mt19937_64 random(static_cast<uint64_t>(seed));
        Tally tally;
        for (int k = 0; k < arguments.frames; ++k) {
          const Shot shot = photographer.shoot(random);
          if (!arguments.pictures.empty())
            cv::imwrite((arguments.pictures / fmt::format("{}_{:03d}.png", name, k)).string(), shot.image);
          match(photographer, shot, map, matcher, size, height, random, tally);
        }
        tally.print(fmt::format("{} seed {} size {}", difference, seed, size));
        Tally& total = totals[i];
        total.frames += tally.frames;
        total.near += tally.near;
        total.true_inliers.insert(total.true_inliers.end(), tally.true_inliers.begin(), tally.true_inliers.end());
        total.false_inliers.insert(total.false_inliers.end(), tally.false_inliers.begin(), tally.false_inliers.end());
      }
    }
    for (size_t i = 0; i < totals.size(); ++i)
      totals[i].print(fmt::format("{} all seeds size {}", difference, arguments.sizes[i]));
  }
}

int run_with(int argc, char** argv) {
  CLI::App app(
      "How well the paper's matcher finds single images of the simulated world on its map, without a prior position");
  Arguments arguments;
  app.add_option("--scenario", arguments.scenario, "folder of the scenario");
  app.add_option("--difference", arguments.differences, "presets of simulate.yaml to try")->delimiter(',');
  app.add_option("--size", arguments.sizes, "keypoint sizes, map pixels")->delimiter(',');
  app.add_option("--seeds", arguments.seeds, "number of worlds");
  app.add_option("--first-seed", arguments.first_seed, "seed of the first");
  app.add_option("--frames", arguments.frames, "images per world");
  app.add_option("--scratch", arguments.scratch, "folder for the maps");
  app.add_option("--pictures", arguments.pictures, "folder to leave the images in");
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);
  run(arguments);
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  try {
    return run_with(argc, argv);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "calibrate-differences: %s\n", error.what());
    return 1;
  }
}
