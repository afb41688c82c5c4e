// Match rates of the registration's methods on real image pairs of two dates, without an odometry: corners of an image
// are taken as points on a plane, with the true scale and rotation plus errors. Not run by ctest (it needs
// ../shared/data and minutes):
//
//   build/release/bin/registration-match-rate arroio --seeds 3 --size 8
//   build/release/bin/registration-match-rate port --seeds 1 --size 16
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <random>
#include <sstream>

#include <CLI/CLI.hpp>
#include <GeographicLib/UTMUPS.hpp>
#include <fmt/format.h>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "common/features/fixed_sift.h"
#include "common/geo/raster.h"
#include "common/math/statistics.h"
#include "services/registration/registrar.h"

namespace {

using namespace orthonav;
using namespace orthonav::registration;

// p_map = centre + scale R(rotation) (p_image - middle of the image), pixels, rotation clockwise.
struct View {
  cv::Mat image;
  Eigen::Vector2d centre;
  double scale = 1;
  double rotation = 0;  // rad
};

struct Scene {
  cv::Mat map;
  double metres_per_pixel = 0;
  std::vector<View> views;
};

Scene arroio(const std::filesystem::path& folder, int step) {
  Scene scene;
  scene.map = cv::imread((folder / "map.jpg").string(), cv::IMREAD_GRAYSCALE);
  scene.metres_per_pixel = 0.243;
  std::ifstream truth(folder / "truth.csv");
  std::string line;
  std::getline(truth, line);
  for (int i = 0; std::getline(truth, line); ++i) {
    if (i % step != 0) continue;
    std::replace(line.begin(), line.end(), ',', ' ');
    std::istringstream fields(line);
    std::string name;
    View view;
    double degrees = 0;
    fields >> name >> view.centre.x() >> view.centre.y() >> view.scale >> degrees;
    view.rotation = degrees * M_PI / 180;
    view.image = cv::imread((folder / "frames" / name).string(), cv::IMREAD_GRAYSCALE);
    scene.views.push_back(view);
  }
  return scene;
}

// Views of 640 x 480 px at 0.1285 m/px (41 degrees from 110 m) out of the 2019 orthophoto of the river port, on the
// 2020 one at 0.3 m/px.
Scene port(const std::filesystem::path& folder, int num_views) {
  constexpr double kEast = 263149.35, kNorth = 9881376.0, kWidth = 655.5, kHeight = 453.0;  // both cover this, UTM 50S
  const auto crop = [&](const char* name, double metres_per_pixel) {
    const Raster raster(folder / name);
    Geodetic corner;
    GeographicLib::UTMUPS::Reverse(50, false, kEast, kNorth, corner.latitude_deg, corner.longitude_deg);
    const Eigen::Vector2d pixel = raster.geodetic_to_pixel(corner) + Eigen::Vector2d(0.5, 0.5);
    const cv::Mat grey =
        raster.read_grey(cv::Rect(cvRound(pixel.x()), cvRound(pixel.y()), cvRound(kWidth / metres_per_pixel),
                                  cvRound(kHeight / metres_per_pixel)));
    return grey;
  };
  constexpr double kCamera = 0.075, kMap = 0.3, kView = 0.1285;
  const cv::Mat ground = crop("PORT_1908_0.075m_utm50s.tif", kCamera);
  Scene scene;
  scene.metres_per_pixel = kMap;
  cv::resize(crop("PORT_2007_0.15m_utm50s.tif", 0.15), scene.map, {}, 0.5, 0.5, cv::INTER_AREA);
  cv::Mat smooth;
  cv::GaussianBlur(ground, smooth, {}, 0.7);
  std::mt19937 random(7);
  std::uniform_real_distribution<double> part(0.15, 0.85);
  std::uniform_real_distribution<double> turn(-M_PI, M_PI);
  for (int i = 0; i < num_views; ++i) {
    View view;
    view.centre = {part(random) * scene.map.cols, part(random) * scene.map.rows};
    view.scale = kView / kMap;
    view.rotation = turn(random);
    const double s = kView / kCamera;
    const Eigen::Matrix2d A = s * Eigen::Rotation2Dd(view.rotation).toRotationMatrix();
    const Eigen::Vector2d b = view.centre * (kMap / kCamera) - A * Eigen::Vector2d(320, 240);
    const cv::Matx23d affine(A(0, 0), A(0, 1), b.x(), A(1, 0), A(1, 1), b.y());
    cv::warpAffine(smooth, view.image, affine, {640, 480}, cv::INTER_LINEAR | cv::WARP_INVERSE_MAP);
    scene.views.push_back(view);
  }
  return scene;
}

MapFeatures describe_map(const Scene& scene, const MapGeometry& geometry) {
  MapFeatures features;
  std::vector<cv::Point2f> points;
  if (geometry.keypoint_size > 0) {
    const int stride = static_cast<int>(geometry.keypoint_stride);
    for (int v = stride / 2; v < scene.map.rows; v += stride) {
      for (int u = stride / 2; u < scene.map.cols; u += stride) {
        points.emplace_back(static_cast<float>(u), static_cast<float>(v));
      }
    }
    features.descriptors = FixedSift(geometry.keypoint_size).describe(scene.map, points);
  } else {
    DetectedSift detected = detect_sift(scene.map);
    points = std::move(detected.points);
    features.descriptors = detected.descriptors;
  }
  for (const cv::Point2f& point : points) {
    features.positions.emplace_back(static_cast<float>(point.x * scene.metres_per_pixel),
                                    static_cast<float>(-point.y * scene.metres_per_pixel), 0.0F);
  }
  return features;
}

// A body whose x axis is the image's up, looking straight down from the height the view's scale means.
Keyframe keyframe_of(const View& view, const CameraModel& camera, double metres_per_pixel, double scale_error,
                     int num_corners) {
  Keyframe keyframe;
  keyframe.height_above_ground = view.scale * metres_per_pixel * camera.focal() * scale_error;
  keyframe.p_W_B = {0, 0, keyframe.height_above_ground};
  keyframe.extrinsics.R_B_C << 0, -1, 0, -1, 0, 0, 0, 0, -1;
  std::vector<cv::Point2f> corners;
  cv::goodFeaturesToTrack(view.image, corners, num_corners, 0.01, 20);
  for (size_t i = 0; i < corners.size(); ++i) {
    TrackedPoint point;
    point.id = static_cast<int64_t>(i);
    point.pixel = {corners[i].x, corners[i].y};
    point.ray_C = *camera.unproject(point.pixel);
    point.p_W = keyframe.p_W_B + keyframe.height_above_ground * (keyframe.extrinsics.R_B_C * point.ray_C);
    keyframe.points.push_back(point);
  }
  return keyframe;
}

struct Arguments {
  std::string scene;
  std::string method = "paper";
  std::filesystem::path data;
  int seeds = 3;
  int step = 15;
  int corners = 150;
  double size = 8;
  double stride = 10;
  double heading_sigma_deg = 3;
  double scale_sigma = 0.03;
  int checks = 32;
};

void run(const Arguments& arguments) {
  const Scene scene = arguments.scene == "arroio" ? arroio(arguments.data / "arroio_do_meio", arguments.step)
                                                  : port(arguments.data / "port_kalimantan", 60);
  if (scene.map.empty() || scene.views.empty()) throw std::runtime_error("no data in " + arguments.data.string());
  RegistrarOptions options;
  options.matcher.checks = arguments.checks;
  if (arguments.method == "m1") options.method = Method::kM1;
  if (arguments.method == "m2") options.method = Method::kM2;
  MapGeometry geometry{scene.metres_per_pixel, arguments.size, arguments.stride};
  if (options.method == Method::kM2) geometry.keypoint_size = geometry.keypoint_stride = 0;
  const MapFeatures features = describe_map(scene, geometry);
  fmt::print("{}: {} features, {} views\n", arguments.scene, features.positions.size(), scene.views.size());
  for (int seed = 1; seed <= arguments.seeds; ++seed) {
    CameraParameters parameters;
    parameters.width = scene.views.front().image.cols;
    parameters.height = scene.views.front().image.rows;
    parameters.fx = parameters.fy = 1.3 * parameters.width;
    parameters.cx = 0.5 * parameters.width;
    parameters.cy = 0.5 * parameters.height;
    const CameraModel camera(parameters);
    options.matcher.seed = seed;
    Registrar registrar(options, camera);
    registrar.set_map(features, geometry);
    std::mt19937 random(static_cast<unsigned>(seed));
    std::normal_distribution<double> normal;
    int near = 0, accepted = 0, false_fixes = 0;
    std::vector<double> true_inliers, false_inliers, errors;
    for (const View& view : scene.views) {
      const double scale_error = 1 + arguments.scale_sigma * normal(random);
      const double heading_error = arguments.heading_sigma_deg * M_PI / 180 * normal(random);
      const Keyframe keyframe = keyframe_of(view, camera, scene.metres_per_pixel, scale_error, arguments.corners);
      const Heading heading{view.rotation + heading_error, arguments.heading_sigma_deg * M_PI / 180};
      const Query query = registrar.describe(keyframe, view.image, heading);
      const Fix fix = registrar.solve(keyframe, query, registrar.match(query), heading);
      const Eigen::Vector2d truth(view.centre.x() * scene.metres_per_pixel, -view.centre.y() * scene.metres_per_pixel);
      // The body stands over the origin of W, and the image's centre lies below it.
      const double error = (fix.translation - truth).norm();
      const bool is_near = error < 30;
      near += is_near ? 1 : 0;
      (is_near ? true_inliers : false_inliers).push_back(fix.num_inliers);
      if (fix.valid) {
        ++accepted;
        false_fixes += is_near ? 0 : 1;
        if (is_near) errors.push_back(((fix.p_G_B.head<2>()) - truth).norm());
      }
    }
    fmt::print(
        "seed {}: within 30 m {:.1f} %, inliers of those (median) {:.0f}, of the others at most {:.0f}, accepted {}, "
        "false {}, median error {:.2f} m\n",
        seed, 100.0 * near / static_cast<double>(scene.views.size()), median(true_inliers),
        quantile(false_inliers, 1.0), accepted, false_fixes, median(errors));
  }
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  const char* folder = std::getenv("ORTHONAV_DATA");
  arguments.data = folder != nullptr ? folder : "../shared/data";
  CLI::App app{"Match rates on real image pairs of two dates."};
  app.add_option("scene", arguments.scene, "arroio | port")->required()->check(CLI::IsMember({"arroio", "port"}));
  app.add_option("--data", arguments.data, "folder of the data (default: ORTHONAV_DATA, else ../shared/data)");
  app.add_option("--method", arguments.method)->check(CLI::IsMember({"paper", "m1", "m2"}));
  app.add_option("--seeds", arguments.seeds);
  app.add_option("--step", arguments.step, "every so many frames");
  app.add_option("--corners", arguments.corners);
  app.add_option("--size", arguments.size, "keypoint size, map pixels");
  app.add_option("--stride", arguments.stride, "map pixels between interest points");
  app.add_option("--heading-sigma-deg", arguments.heading_sigma_deg);
  app.add_option("--scale-sigma", arguments.scale_sigma);
  app.add_option("--checks", arguments.checks);
  CLI11_PARSE(app, argc, argv);
  try {
    run(arguments);
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}\n", error.what());
    return 1;
  }
  return 0;
}
