#include "tests/registration/scale_bench.h"

#include <algorithm>
#include <cmath>
#include <complex>
#include <cstdio>
#include <ctime>
#include <map>
#include <memory>
#include <optional>
#include <random>

#include <fmt/format.h>

#include "common/camera/image_decode.h"
#include "common/math/statistics.h"
#include "services/registration/keyframe_message.h"
#include "services/registration/submap/submap.h"
#include "tests/registration/recorded_flight.h"

namespace orthonav::registration {
namespace {

constexpr double kReach = 40, kLeastSpread = 10;  // m of way that tell the true scale
constexpr double kRight = 30;                     // m
constexpr double kSettled = 5;                    // s after a change

struct Step {
  int64_t utime;
  int session;
  Eigen::Vector2d p_W, p_G;
};

// True displacement over the odometry's around each keyframe, by utime.
std::map<int64_t, double> true_scales(const std::vector<Step>& way) {
  std::map<int64_t, double> scales;
  for (const Step& at : way) {
    std::vector<const Step*> near;
    Eigen::Vector2d mean_W = Eigen::Vector2d::Zero(), mean_G = Eigen::Vector2d::Zero();
    for (const Step& each : way) {
      if (each.session != at.session || (each.p_G - at.p_G).norm() > kReach) continue;
      near.push_back(&each);
      mean_W += each.p_W;
      mean_G += each.p_G;
    }
    mean_W /= static_cast<double>(near.size());
    mean_G /= static_cast<double>(near.size());
    std::complex<double> turned = 0;
    double squares = 0;
    for (const Step* each : near) {
      const Eigen::Vector2d w = each->p_W - mean_W, g = each->p_G - mean_G;
      turned += std::conj(std::complex<double>(w.x(), w.y())) * std::complex<double>(g.x(), g.y());
      squares += w.squaredNorm();
    }
    if (squares < static_cast<double>(near.size()) * kLeastSpread * kLeastSpread) continue;
    scales[at.utime] = std::abs(turned) / squares;
  }
  return scales;
}

// The flight with another scale.
class Lane {
 public:
  Lane(double factor, double seconds, const BenchMap& map, const SubmapOptions& options, const CameraModel& camera)
      : factor_(factor), seconds_(seconds), registrar_(std::make_unique<SubmapRegistrar>(options, camera)) {
    registrar_->set_map(map.features, map.geometry);
  }

  double factor() const { return factor_; }
  double factor_at(double seconds) const { return seconds_ > 0 && seconds > seconds_ ? 1 : factor_; }

  Keyframe scaled(Keyframe keyframe, double seconds) {
    const double factor = factor_at(seconds);
    const Eigen::Vector3d was = keyframe.p_W_B;
    if (last_W_) p_W_ += factor * (was - *last_W_);
    last_W_ = was;
    keyframe.p_W_B = p_W_;
    keyframe.height_above_ground *= factor;
    for (TrackedPoint& point : keyframe.points) point.p_W = p_W_ + factor * (point.p_W - was);
    return keyframe;
  }

  SubmapRegistrar& registrar() { return *registrar_; }

  std::vector<double> scale_gains, height_gains;
  std::vector<double> scales, scale_stddevs, scale_nees, heights, height_stddevs, height_nees, across, across_nees,
      times;
  int tried = 0, near = 0, valid = 0, wrong = 0;

 private:
  double factor_, seconds_;
  std::unique_ptr<SubmapRegistrar> registrar_;
  std::optional<Eigen::Vector3d> last_W_;
  Eigen::Vector3d p_W_ = Eigen::Vector3d::Zero();
};

double mean(const std::vector<double>& values) {
  double sum = 0;
  for (const double value : values) sum += value;
  return sum / static_cast<double>(values.size());
}

double cpu_ms() {
  return 1e3 * static_cast<double>(std::clock()) / CLOCKS_PER_SEC;
}

}  // namespace

void run(const ScaleBench& bench) {
  const BenchMap map = load_map(bench.map, bench.config, map_server::FeatureKind::kRootSift, 0);
  const BenchAircraft aircraft = load_bench_aircraft(bench.config);
  ConfigNode node = ConfigNode::load(bench.config / "registration.yaml");
  const SubmapOptions options = SubmapOptions::from_config(node);
  std::vector<Step> way;
  for_each_keyframe(bench.log, map.frame, aircraft.declination, false, [&](const BenchKeyframe& each) {
    const Eigen::Vector3d p_W(each.message.p_W_B);
    way.push_back({each.message.utime, each.message.session, p_W.head<2>(), each.truth.p_G.head<2>()});
  });
  const std::map<int64_t, double> is = true_scales(way);

  std::vector<Lane> lanes;
  lanes.emplace_back(1, 0, map, options, aircraft.camera);
  for (const double factor : bench.factors) {
    if (factor != 1) lanes.emplace_back(factor, bench.seconds, map, options, aircraft.camera);
  }
  std::FILE* csv = bench.csv.empty() ? nullptr : std::fopen(bench.csv.c_str(), "w");
  if (csv != nullptr)
    fmt::print(csv, "factor,seconds,valid,miss,scale,scale_stddev,is,height,height_stddev,inliers,reason\n");
  std::mt19937_64 random(static_cast<uint64_t>(bench.seed));
  std::normal_distribution<double> normal;
  std::optional<int64_t> begin;
  for_each_keyframe(bench.log, map.frame, aircraft.declination, true, [&](const BenchKeyframe& each) {
    if (!begin) begin = each.message.utime;
    const double seconds = 1e-6 * static_cast<double>(each.message.utime - *begin);
    const DecodedImage decoded = decode_image(*each.image, aircraft.camera.width(), aircraft.camera.height());
    const PositionPrior prior{
        each.truth.p_G.head<2>() + bench.prior_stddev * Eigen::Vector2d(normal(random), normal(random)),
        bench.prior_stddev};
    const auto known = is.find(each.message.utime);
    Fix plain;
    Eigen::Vector3d plain_error(NAN, NAN, NAN);
    for (Lane& lane : lanes) {
      const Keyframe keyframe = lane.scaled(keyframe_of(each.message), seconds);
      const double start = cpu_ms();
      lane.registrar().describe(keyframe, each.message.session, decoded.grey, each.heading);
      lane.registrar().search(prior);
      const Fix fix = lane.registrar().solve();
      const double took = cpu_ms() - start;
      const Eigen::Vector3d error = fix.p_G_B - each.truth.p_G;
      const double factor = lane.factor_at(seconds);
      if (&lane == &lanes.front()) {
        plain = fix;
        plain_error = error;
      }
      if (csv != nullptr) {
        fmt::print(csv, "{},{:.2f},{},{:.2f},{:.4f},{:.4f},{:.4f},{:.2f},{:.2f},{},{}\n", lane.factor(), seconds,
                   fix.valid ? 1 : 0, error.head<2>().norm(), fix.scale, fix.scale_stddev,
                   known == is.end() ? NAN : known->second / factor, error.z(), std::sqrt(fix.covariance(2, 2)),
                   fix.num_inliers, fix.reason);
      }
      if (bench.seconds > 0 && seconds < bench.seconds + kSettled) continue;
      ++lane.tried;
      lane.times.push_back(took);
      const bool right = std::isfinite(fix.scale) && error.norm() < kRight;
      lane.near += right ? 1 : 0;
      lane.valid += fix.valid ? 1 : 0;
      lane.wrong += fix.valid && !right ? 1 : 0;
      if (!right || !fix.valid) continue;
      const bool plain_right = std::isfinite(plain.scale) && plain_error.norm() < kRight;
      if (factor != 1 && plain_right) {
        lane.scale_gains.push_back(-std::log(fix.scale / plain.scale) / std::log(factor));
        lane.height_gains.push_back(1 -
                                    (error.z() - plain_error.z()) / ((factor - 1) * each.message.height_above_ground));
      }
      if (known != is.end()) {
        const double off = std::log(fix.scale * factor / known->second);
        lane.scales.push_back(off);
        lane.scale_stddevs.push_back(fix.scale_stddev / fix.scale);
        lane.scale_nees.push_back(std::pow(off * fix.scale / fix.scale_stddev, 2));
      }
      lane.heights.push_back(error.z());
      lane.height_stddevs.push_back(std::sqrt(fix.covariance(2, 2)));
      lane.height_nees.push_back(error.z() * error.z() / fix.covariance(2, 2));
      lane.across.push_back(error.head<2>().norm());
      lane.across_nees.push_back(error.head<2>().dot(fix.covariance.topLeftCorner<2, 2>().inverse() * error.head<2>()));
    }
  });
  if (csv != nullptr) std::fclose(csv);
  fmt::print("{} {}\n", bench.log.filename().string(), bench.map.filename().string());
  fmt::print(
      "factor keyframes near fixes wrong | gain: scale  10 %..90 %   height | scale: median   rms  claims  nees "
      "| height: median  rms claims  nees | across: rms  nees | ms\n");
  for (const Lane& lane : lanes) {
    fmt::print(
        "{:6.3f} {:9d} {:4d} {:5d} {:5d} | {:11.3f} {:5.2f} {:5.2f} {:8.3f} | {:12.4f} {:.4f} {:.4f} {:6.2f} | "
        "{:13.2f} {:5.2f} {:5.2f} {:6.2f} | {:10.2f} {:5.2f} | {:.2f}\n",
        lane.factor(), lane.tried, lane.near, lane.valid, lane.wrong, mean(lane.scale_gains),
        quantile(lane.scale_gains, 0.1), quantile(lane.scale_gains, 0.9), mean(lane.height_gains), median(lane.scales),
        root_mean_square(lane.scales), median(lane.scale_stddevs), mean(lane.scale_nees), median(lane.heights),
        root_mean_square(lane.heights), median(lane.height_stddevs), mean(lane.height_nees),
        root_mean_square(lane.across), mean(lane.across_nees), median(lane.times));
  }
}

}  // namespace orthonav::registration
