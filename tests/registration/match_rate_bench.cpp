// Match rates of the registration's methods on real image pairs of two dates, without an odometry: corners of an image
// are taken as points on a plane, with the true scale and rotation plus errors. Not run by ctest (it needs
// ../shared/data and minutes):
//
//   build/release/bin/registration-match-rate arroio --seeds 3 --method submap
//   build/release/bin/registration-match-rate arroio --seeds 3 --method paper --size 8
//   build/release/bin/registration-match-rate port --seeds 1 --method submap --keyframes 1
//   build/release/bin/registration-match-rate growth --features 116354,1000000,10000000
//
// growth times the cold search on ever larger maps: the real one in the corner of a plain of its patches in disorder.
//
// With method submap, a keyframe is registered together with those before it in the video. Their places relative to it
// come from the video, frame by frame, stretched by the scale's error: the truth, placed by hand, is off by up to 6 m
// in the 14 m from one keyframe to the next, which no odometry is. So does the scale of Arroio's frames, as an odometry
// has it from how far the aircraft went: that of truth.csv, to be had with --truth-scale, is 5-15 % too small from
// frame 120 on. Its rotation is 4-12 degrees off by the same measure; the method has to bear that.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <optional>
#include <random>
#include <sstream>

#include <CLI/CLI.hpp>
#include <GeographicLib/UTMUPS.hpp>
#include <fmt/format.h>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>
#include <sys/resource.h>

#include "common/bus/process_usage.h"
#include "common/features/fixed_sift.h"
#include "common/features/orientation_field.h"
#include "common/geo/raster.h"
#include "common/math/statistics.h"
#include "services/registration/paper/registrar.h"
#include "services/registration/submap/submap.h"
#include "tools/evaluate_registration/evaluation.h"

namespace {

using namespace orthonav;
using namespace orthonav::registration;

// p_map = centre + scale R(rotation) (p_image - middle of the image), pixels, rotation clockwise.
struct View {
  cv::Mat image;
  Eigen::Vector2d centre;
  double scale = 1;
  double rotation = 0;  // rad, clockwise: the heading of the image's top
};

struct Scene {
  cv::Mat map;
  double metres_per_pixel = 0;
  std::vector<View> views;
};

// What takes the pixels of one frame of a video to those of another near it.
cv::Matx33d motion_between(const cv::Mat& from, const cv::Mat& to) {
  std::vector<cv::Point2f> corners, tracked;
  cv::goodFeaturesToTrack(from, corners, 600, 0.005, 12);
  std::vector<uint8_t> found;
  cv::calcOpticalFlowPyrLK(from, to, corners, tracked, found, cv::noArray(), {21, 21}, 5);
  std::vector<cv::Point2f> before, after;
  for (size_t i = 0; i < corners.size(); ++i) {
    if (found[i] == 0) continue;
    before.push_back(corners[i]);
    after.push_back(tracked[i]);
  }
  cv::Mat inliers;
  const cv::Mat H = before.size() < 10 ? cv::Mat() : cv::findHomography(before, after, cv::RANSAC, 3, inliers);
  if (H.empty() || cv::countNonZero(inliers) < 30) throw std::runtime_error("two frames of the video do not overlap");
  return cv::Matx33d(H.ptr<double>());
}

Eigen::Vector2d middle_of(const View& view) {
  return {0.5 * view.image.cols, 0.5 * view.image.rows};
}

// Where a pixel of a frame of the video lies on another's plane, by the motions between the frames.
class Video {
 public:
  explicit Video(const Scene& scene) : scene_(scene) {
    for (size_t i = 1; i < scene.views.size(); ++i) {
      to_previous_.push_back(motion_between(scene.views[i].image, scene.views[i - 1].image));
    }
  }
  cv::Matx33d motion(size_t from, size_t to) const {
    cv::Matx33d H = cv::Matx33d::eye();
    for (size_t i = from; i > to; --i) H = to_previous_[i - 1] * H;
    for (size_t i = from; i < to; ++i) H = to_previous_[i].inv() * H;
    return H;
  }
  static Eigen::Vector2d apply(const cv::Matx33d& H, const Eigen::Vector2d& pixel) {
    const cv::Vec3d p = H * cv::Vec3d(pixel.x(), pixel.y(), 1);
    return {p[0] / p[2], p[1] / p[2]};
  }
  // Map pixels an image pixel of a frame is wide: how far the camera went, by its places, over how far by the images.
  double scale(size_t at) const {
    constexpr double kWay = 400;  // map pixels, to each side
    const Eigen::Vector2d middle = middle_of(scene_.views[at]);
    double on_map = 0, in_image = 0;
    const auto add = [&](size_t other) {
      const double way = (scene_.views[other].centre - scene_.views[at].centre).norm();
      on_map += way;
      in_image += (apply(motion(other, at), middle) - middle).norm();
      return way < kWay;
    };
    for (size_t i = at + 1; i < scene_.views.size() && add(i); ++i) {
    }
    for (size_t i = at; i > 0 && add(i - 1); --i) {
    }
    return on_map / in_image;
  }

 private:
  const Scene& scene_;
  std::vector<cv::Matx33d> to_previous_;
};

Scene arroio(const std::filesystem::path& folder) {
  Scene scene;
  scene.map = cv::imread((folder / "map.jpg").string(), cv::IMREAD_GRAYSCALE);
  scene.metres_per_pixel = 0.243;
  std::ifstream truth(folder / "truth.csv");
  std::string line;
  std::getline(truth, line);
  while (std::getline(truth, line)) {
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
    return raster.read_grey(cv::Rect(cvRound(pixel.x()), cvRound(pixel.y()), cvRound(kWidth / metres_per_pixel),
                                     cvRound(kHeight / metres_per_pixel)));
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

MapFeatures describe_map(const Scene& scene, const MapGeometry& geometry, MethodName method) {
  MapFeatures features;
  std::vector<cv::Point2f> points;
  if (geometry.keypoint_size > 0) {
    const int stride = static_cast<int>(geometry.keypoint_stride);
    for (int v = stride / 2; v < scene.map.rows; v += stride) {
      for (int u = stride / 2; u < scene.map.cols; u += stride) {
        points.emplace_back(static_cast<float>(u), static_cast<float>(v));
      }
    }
    features.descriptors = method == MethodName::kSubmap
                               ? OrientationField(scene.map, {.keypoint_size = geometry.keypoint_size}).describe(points)
                               : FixedSift(geometry.keypoint_size).describe(scene.map, points);
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

// A pinhole camera as wide as the scene's views are.
CameraModel camera_of(const Scene& scene) {
  CameraParameters parameters;
  parameters.width = scene.views.front().image.cols;
  parameters.height = scene.views.front().image.rows;
  parameters.fx = parameters.fy = 1.3 * parameters.width;
  parameters.cx = 0.5 * parameters.width;
  parameters.cy = 0.5 * parameters.height;
  return CameraModel(parameters);
}

// A body whose x axis is the image's up, looking straight down from the height the view's scale means, in an odometry's
// world that is the map's, stretched by `scale_error`.
Keyframe keyframe_of(const View& view, const CameraModel& camera, double metres_per_pixel, double scale_error,
                     int num_corners) {
  Keyframe keyframe;
  keyframe.height_above_ground = view.scale * metres_per_pixel * camera.focal() * scale_error;
  const Eigen::Vector2d en = scale_error * metres_per_pixel * Eigen::Vector2d(view.centre.x(), -view.centre.y());
  keyframe.p_W_B = {en.x(), en.y(), keyframe.height_above_ground};
  keyframe.q_W_B = Eigen::AngleAxisd(M_PI / 2 - view.rotation, Eigen::Vector3d::UnitZ());
  keyframe.extrinsics.R_B_C << 0, -1, 0, -1, 0, 0, 0, 0, -1;
  evaluate_registration::add_flat_ground(view.image, camera, num_corners, keyframe);
  return keyframe;
}

// Up to `count` frames before one of a video, `spacing` frames apart and the first first, as the video puts them
// relative to it. At the video's beginning the frames after it take the place of those before.
std::vector<View> views_before(const Scene& scene, const Video& video, const View& reference, int newest, int count,
                               int spacing) {
  const int step = newest - count * spacing >= 0 ? -spacing : spacing;
  const Eigen::Vector2d middle = middle_of(reference);
  std::vector<View> views;
  for (int k = count; k > 0; --k) {
    const auto at = static_cast<size_t>(newest + k * step);
    const cv::Matx33d H = video.motion(at, static_cast<size_t>(newest));
    const auto in_newest = [&](double x, double y) { return Video::apply(H, middle + Eigen::Vector2d(x, y)); };
    // The similarity nearest to how the newest frame would see this one's middle.
    const Eigen::Vector2d u = in_newest(1, 0) - in_newest(-1, 0);
    const Eigen::Vector2d v = in_newest(0, 1) - in_newest(0, -1);
    const double cosine = u.x() + v.y(), sine = u.y() - v.x();
    View view;
    view.image = scene.views[at].image;
    view.centre =
        reference.centre + reference.scale * (Eigen::Rotation2Dd(reference.rotation) * (in_newest(0, 0) - middle));
    view.scale = reference.scale * std::hypot(cosine, sine) / 4;
    view.rotation = reference.rotation + std::atan2(sine, cosine);
    views.push_back(view);
  }
  return views;
}

struct Arguments {
  EvidenceOptions evidence;
  int coarse_places = SubmapOptions().coarse_places;
  std::string scene;
  std::string method = "submap";
  std::filesystem::path data, csv;
  int seeds = 3;
  int step = 15, first = 0;
  int keyframes = SubmapOptions().max_keyframes, spacing = 3;
  int corners = 150;
  double size = 12;
  double stride = 10;
  double heading_sigma_deg = 3;
  double scale_sigma = 0.03;
  bool truth_scale = false;
  int checks = 32;
  std::vector<int64_t> features{116'354, 1'000'000, 10'000'000};
};

double now_ms() {
  return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void run(const Arguments& arguments) {
  const bool is_arroio = arguments.scene == "arroio";
  const Scene scene =
      is_arroio ? arroio(arguments.data / "arroio_do_meio") : port(arguments.data / "port_kalimantan", 60);
  if (scene.map.empty() || scene.views.empty()) throw std::runtime_error("no data in " + arguments.data.string());
  const int step = is_arroio ? arguments.step : 1;
  RegistrarOptions options;
  options.matcher.checks = arguments.checks;
  for (const MethodName method : {MethodName::kSubmap, MethodName::kPaper, MethodName::kM1, MethodName::kM2}) {
    if (arguments.method == name_of(method)) options.method = method;
  }
  const bool uses_submap = options.method == MethodName::kSubmap;
  std::optional<Video> video;
  if (is_arroio) video.emplace(scene);
  MapGeometry geometry{scene.metres_per_pixel, arguments.size, arguments.stride};
  if (options.method == MethodName::kM2) geometry.keypoint_size = geometry.keypoint_stride = 0;
  const double start = now_ms();
  const MapFeatures features = describe_map(scene, geometry, options.method);
  fmt::print("{}: {} features described in {:.2f} s\n", arguments.scene, features.positions.size(),
             1e-3 * (now_ms() - start));
  const CameraModel camera = camera_of(scene);
  std::FILE* csv = arguments.csv.empty() ? nullptr : std::fopen(arguments.csv.c_str(), "w");
  SubmapOptions submap_options;
  submap_options.max_keyframes = arguments.keyframes;
  submap_options.evidence = arguments.evidence;
  submap_options.coarse_places = arguments.coarse_places;
  SubmapRegistrar submap(submap_options, camera);
  if (uses_submap) submap.set_map({features.positions, features.descriptors.clone()}, geometry);
  int session = 0;
  for (int seed = 1; seed <= arguments.seeds; ++seed) {
    options.matcher.seed = seed;
    Registrar registrar(options, camera);
    if (!uses_submap) registrar.set_map(features, geometry);
    std::mt19937 random(static_cast<unsigned>(seed));
    std::normal_distribution<double> normal;
    int tried = 0, near = 0, accepted = 0, false_fixes = 0;
    std::vector<double> true_inliers, false_inliers, errors, times;
    for (int i = arguments.first; i < static_cast<int>(scene.views.size()); i += step) {
      View view = scene.views[static_cast<size_t>(i)];
      if (video && !arguments.truth_scale) view.scale = video->scale(static_cast<size_t>(i));
      const double scale_error = 1 + arguments.scale_sigma * normal(random);
      const double heading_error = arguments.heading_sigma_deg * M_PI / 180 * normal(random);
      const double heading_stddev = arguments.heading_sigma_deg * M_PI / 180;
      const auto keyframe_at = [&](const View& v) {
        return keyframe_of(v, camera, scene.metres_per_pixel, scale_error, arguments.corners);
      };
      const Keyframe keyframe = keyframe_at(view);
      const Heading heading{view.rotation + heading_error, heading_stddev};
      const Eigen::Vector2d truth(view.centre.x() * scene.metres_per_pixel, -view.centre.y() * scene.metres_per_pixel);
      Fix fix;
      Eigen::Vector2d found;
      double begin = now_ms();
      if (uses_submap) {
        ++session;
        std::vector<View> others;
        if (video) others = views_before(scene, *video, view, i, arguments.keyframes - 1, arguments.spacing);
        for (const View& other : others) {
          submap.describe(keyframe_at(other), session, other.image, {other.rotation + heading_error, heading_stddev});
        }
        begin = now_ms();
        submap.describe(keyframe, session, view.image, heading);
        submap.search(std::nullopt);
        fix = submap.solve();
        const double used = heading.value + (std::isfinite(fix.heading_correction) ? fix.heading_correction : 0);
        found = (rotation_G_W(keyframe.q_W_B, used) * keyframe.p_W_B).head<2>() + fix.translation;
      } else {
        const Query query = registrar.describe(keyframe, view.image, heading);
        fix = registrar.solve(keyframe, query, registrar.match(query), heading);
        const Eigen::Vector2d body = (query.R_G_W * keyframe.p_W_B).head<2>();
        const bool points = options.method == MethodName::kPaper;
        found = fix.translation + (points ? body : Eigen::Vector2d(0, 0));
      }
      times.push_back(now_ms() - begin);
      const double error = (found - truth).norm();
      const bool is_near = error < 30;
      ++tried;
      near += is_near ? 1 : 0;
      (is_near ? true_inliers : false_inliers).push_back(fix.num_inliers);
      if (fix.valid) {
        ++accepted;
        false_fixes += is_near ? 0 : 1;
        if (is_near) errors.push_back((fix.p_G_B.head<2>() - truth).norm());
      }
      if (csv != nullptr) {
        fmt::print(csv, "{},{},{:.1f},{:.1f},{:.1f},{:.1f},{:.1f},{},{},{:.4f},{:.4f},{:.2f},{:.2f}\n", seed, i, error,
                   found.x(), found.y(), fix.log_likelihood, fix.log_likelihood_ratio, fix.num_inliers, fix.num_query,
                   fix.scale, scale_error, 180 / M_PI * fix.heading_correction, 180 / M_PI * heading_error);
      }
    }
    fmt::print(
        "seed {}: within 30 m {:.1f} %, inliers of those (median) {:.0f}, of the others at most {:.0f}, accepted {}, "
        "false {}, median error {:.2f} m, {:.1f} ms a keyframe\n",
        seed, 100.0 * near / tried, median(true_inliers), quantile(false_inliers, 1.0), accepted, false_fixes,
        median(errors), median(times));
  }
  if (csv != nullptr) std::fclose(csv);
}

// The map's features in the upper-left corner of a square of `count`, the rest its descriptors in disorder.
MapFeatures plain_around(const MapFeatures& features, double pitch, int64_t count) {
  const auto side = static_cast<int64_t>(std::ceil(std::sqrt(static_cast<double>(count))));
  std::vector<int> at(static_cast<size_t>(side * side), -1);
  for (size_t i = 0; i < features.positions.size(); ++i) {
    const auto column = static_cast<int64_t>(features.positions[i].x() / pitch);
    const auto row = static_cast<int64_t>(-features.positions[i].y() / pitch);
    if (column < side && row < side) at[static_cast<size_t>(row * side + column)] = static_cast<int>(i);
  }
  MapFeatures plain;
  plain.descriptors.create(static_cast<int>(count), kSiftBytes, CV_8U);
  plain.positions.reserve(static_cast<size_t>(count));
  std::mt19937 random(1);
  for (int64_t i = 0; i < count; ++i) {
    const int here = at[static_cast<size_t>(i)];
    const int from = here >= 0 ? here : static_cast<int>(random() % features.positions.size());
    const int64_t row = i / side, column = i % side;
    plain.positions.emplace_back(static_cast<float>((0.5 + static_cast<double>(column)) * pitch),
                                 static_cast<float>(-(0.5 + static_cast<double>(row)) * pitch), 0.0F);
    features.descriptors.row(from).copyTo(plain.descriptors.row(static_cast<int>(i)));
  }
  return plain;
}

constexpr double kGib = 1 << 30;

double peak_memory_gib() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<double>(usage.ru_maxrss) / (1 << 20);
}

void run_growth(const Arguments& arguments) {
  const Scene scene = arroio(arguments.data / "arroio_do_meio");
  if (scene.map.empty() || scene.views.empty()) throw std::runtime_error("no data in " + arguments.data.string());
  const MapGeometry geometry{scene.metres_per_pixel, arguments.size, arguments.stride};
  const MethodName method = arguments.method == "paper" ? MethodName::kPaper : MethodName::kSubmap;
  const CameraModel camera = camera_of(scene);
  const MapFeatures real = describe_map(scene, geometry, method);
  const double of_the_scene = ProcessUsage::resident_bytes() / kGib;
  for (const int64_t count : arguments.features) {
    MapFeatures plain = plain_around(real, geometry.keypoint_stride * geometry.metres_per_pixel, count);
    SubmapOptions submap_options;
    submap_options.min_inliers = 1 << 30;  // never accepted: every search is over the whole map
    SubmapRegistrar submap(submap_options, camera);
    RegistrarOptions options;
    options.method = method;
    Registrar registrar(options, camera);
    double begin = now_ms();
    if (method == MethodName::kSubmap) {
      submap.set_map(std::move(plain), geometry);
    } else {
      registrar.set_map(std::move(plain), geometry);
    }
    const double load = now_ms() - begin;
    std::vector<double> times;
    int found = 0, tried = 0;
    const double side = std::sqrt(static_cast<double>(count)) * arguments.stride;
    for (size_t i = 0; i < scene.views.size() && tried < 12; i += 3) {
      const View& view = scene.views[i];
      if (view.centre.x() > side - 300 || view.centre.y() > side - 300) continue;
      const Keyframe keyframe = keyframe_of(view, camera, scene.metres_per_pixel, 1, arguments.corners);
      const Heading heading{view.rotation, 3 * M_PI / 180};
      begin = now_ms();
      Fix fix;
      if (method == MethodName::kSubmap) {
        submap.describe(keyframe, 1, view.image, heading);
        submap.search(std::nullopt);
        fix = submap.solve();
      } else {
        const Query query = registrar.describe(keyframe, view.image, heading);
        fix = registrar.solve(keyframe, query, registrar.match(query), heading);
      }
      times.push_back(now_ms() - begin);
      const double used = heading.value + (std::isfinite(fix.heading_correction) ? fix.heading_correction : 0);
      const Eigen::Vector2d truth(view.centre.x() * scene.metres_per_pixel, -view.centre.y() * scene.metres_per_pixel);
      const Eigen::Vector2d at =
          (rotation_G_W(keyframe.q_W_B, used) * keyframe.p_W_B).head<2>() + fix.translation - truth;
      found += at.norm() < 30 ? 1 : 0;
      ++tried;
    }
    const double memory = ProcessUsage::resident_bytes() / kGib - of_the_scene;
    fmt::print(
        "{} {} features: {:.1f} ms a keyframe (median), found {} of {}; ready after {:.1f} s, {:.2f} GiB beside the "
        "scene's pictures, peak of the process {:.2f} GiB\n",
        arguments.method, count, median(times), found, tried, 1e-3 * load, memory, peak_memory_gib());
    std::fflush(stdout);
  }
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  const char* folder = std::getenv("ORTHONAV_DATA");
  arguments.data = folder != nullptr ? folder : "../shared/data";
  CLI::App app{"Match rates on real image pairs of two dates."};
  app.add_option("scene", arguments.scene, "arroio | port | growth")
      ->required()
      ->check(CLI::IsMember({"arroio", "port", "growth"}));
  app.add_option("--features", arguments.features, "sizes of the maps of growth")->delimiter(',');
  app.add_option("--data", arguments.data, "folder of the data (default: ORTHONAV_DATA, else ../shared/data)");
  app.add_option("--method", arguments.method)->check(CLI::IsMember({"submap", "paper", "m1", "m2"}));
  app.add_option("--seeds", arguments.seeds);
  app.add_option("--step", arguments.step, "every so many frames");
  app.add_option("--first", arguments.first, "the first of them");
  app.add_option("--keyframes", arguments.keyframes, "of a submap");
  app.add_option("--spacing", arguments.spacing, "frames between keyframes of a submap");
  app.add_option("--csv", arguments.csv, "one row a keyframe");
  app.add_option("--corners", arguments.corners);
  app.add_option("--size", arguments.size, "keypoint size, map pixels");
  app.add_option("--stride", arguments.stride, "map pixels between interest points");
  app.add_option("--heading-sigma-deg", arguments.heading_sigma_deg);
  app.add_option("--scale-sigma", arguments.scale_sigma);
  app.add_flag("--truth-scale", arguments.truth_scale, "the scale of truth.csv instead of the video's");
  app.add_option("--checks", arguments.checks);
  app.add_option("--evidence-threshold", arguments.evidence.threshold);
  app.add_option("--evidence-limit", arguments.evidence.limit);
  app.add_option("--coarse-places", arguments.coarse_places);
  CLI11_PARSE(app, argc, argv);
  cv::setNumThreads(1);
  try {
    arguments.scene == "growth" ? run_growth(arguments) : run(arguments);
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}\n", error.what());
    return 1;
  }
  return 0;
}
