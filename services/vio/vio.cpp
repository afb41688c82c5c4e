#include "services/vio/vio.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

constexpr size_t kMostPendingImages = 20;     // 2 s without IMU: older ones will never be used
constexpr int64_t kProvenAfter = 20'000'000;  // microseconds of flight
constexpr int64_t kStampProof = 500'000;      // microseconds, in which stamps prove themselves against others
constexpr int64_t kLongestPause = 2'000'000;  // microseconds, of camera and altimeter, after which they have to
constexpr int64_t kResetPause = 5'000'000;    // microseconds between resets that are asked for
constexpr int64_t kImuKept = 10'000'000;      // microseconds: no session outlives a camera that is away for so long
constexpr int64_t kStepBack = 200'000;        // microseconds: more than the time offset may move

ImuSample interpolate(const ImuSample& a, const ImuSample& b, int64_t utime) {
  const double s = static_cast<double>(utime - a.utime) / static_cast<double>(b.utime - a.utime);
  ImuSample result;
  result.utime = utime;
  result.gyro = (1 - s) * a.gyro + s * b.gyro;
  result.accel = (1 - s) * a.accel + s * b.accel;
  return result;
}

}  // namespace

Vio::Vio(const VioOptions& options, const CameraModel& camera, const Extrinsics& extrinsics)
    : options_(options),
      camera_(camera),
      extrinsics_(extrinsics),
      tracker_(camera, options.tracker),
      estimator_(options.estimator, extrinsics, options.imu, camera.focal()),
      calibration_(options.calibration, extrinsics, options.estimator.gravity, camera.focal()),
      imu_order_(static_cast<int64_t>(1e6 * options.max_imu_gap), kStampProof),
      image_order_(kLongestPause, kStampProof),
      altitude_order_(kLongestPause, kStampProof) {}

template <class Sample>
void Vio::count(const char* sensor, const typename SampleOrder<Sample>::Taken& taken) {
  const std::string name = sensor;
  if (taken.out_of_order > 0) counters_[name + ".rejected.order"] += taken.out_of_order;
  if (taken.in_future > 0) counters_[name + ".rejected.future"] += taken.in_future;
  if (taken.stepped_back) ++counters_[name + ".stepped_back"];
}

void Vio::feed_imu(const ImuSample& sample) {
  ++counters_["imu.received"];
  constexpr double kMostRate = 100, kMostForce = 1000;  // rad/s, m/s^2: no sensor of this kind measures more
  if (!sample.gyro.allFinite() || !sample.accel.allFinite()) {
    ++counters_["imu.rejected.not_finite"];
    return;
  }
  if (sample.gyro.norm() > kMostRate || sample.accel.norm() > kMostForce) {
    ++counters_["imu.rejected.implausible"];
    return;
  }
  ImuSample marked = sample;
  if (sample.gyro.cwiseAbs().maxCoeff() >= options_.gyro_range ||
      sample.accel.cwiseAbs().maxCoeff() >= options_.accel_range) {
    marked.saturated = true;
    ++counters_["imu.saturated"];
  }
  const auto taken = imu_order_.add(marked);
  count<ImuSample>("imu", taken);
  if (taken.stepped_back) {
    std::erase_if(imu_, [&](const ImuSample& old) { return old.utime >= taken.samples.front().utime; });
  }
  imu_.insert(imu_.end(), taken.samples.begin(), taken.samples.end());
  while (!imu_.empty() && imu_.back().utime - imu_.front().utime > kImuKept) imu_.pop_front();
}

void Vio::feed_altitude(int64_t utime, double height, double stddev) {
  constexpr double kUsualStddev = 1.0;  // m, where the sensor does not say
  constexpr size_t kMostAltitudes = 100;
  ++counters_["altitude.received"];
  if (!std::isfinite(height) || height < 0 || height > 1e5 || stddev <= 0) {
    ++counters_["altitude.rejected.implausible"];
    return;
  }
  const auto taken = altitude_order_.add({utime, height, std::isfinite(stddev) ? stddev : kUsualStddev});
  count<Altitude>("altitude", taken);
  if (taken.stepped_back) {
    std::erase_if(altitudes_, [&](const Altitude& old) { return old.utime >= taken.samples.front().utime; });
  }
  altitudes_.insert(altitudes_.end(), taken.samples.begin(), taken.samples.end());
  while (altitudes_.size() > kMostAltitudes) altitudes_.pop_front();
}

// Between the measurements before and after, which must be near.
std::optional<HeightMeasurement> Vio::height_at(int64_t utime) const {
  constexpr int64_t kNear = 500'000;  // microseconds
  for (size_t k = altitudes_.size(); k-- > 0;) {
    const Altitude& before = altitudes_[k];
    if (before.utime > utime) continue;
    if (utime - before.utime > kNear) return std::nullopt;
    if (k + 1 == altitudes_.size()) return HeightMeasurement{before.height, before.stddev};
    const Altitude& after = altitudes_[k + 1];
    const double s = static_cast<double>(utime - before.utime) / static_cast<double>(after.utime - before.utime);
    return HeightMeasurement{(1 - s) * before.height + s * after.height, std::max(before.stddev, after.stddev)};
  }
  return std::nullopt;
}

void Vio::hint_scale(double ratio, double stddev) {
  ++counters_["hints"];
  finish_start();
  estimator_.hint_scale(ratio, stddev);
}

void Vio::finish_start() {
  if (start_.valid()) start_.get();
}

bool Vio::reset(const std::string& reason) {
  finish_start();
  if (reset_at_ != 0 && std::abs(last_state_ - reset_at_) < kResetPause) {
    ++counters_["reset.rejected.too_soon"];
    return false;
  }
  ++counters_["resets"];
  reset_at_ = last_state_;
  restart(reason);
  return true;
}

const std::vector<TrackedFeature>& Vio::with_row_delays(const std::vector<TrackedFeature>& features) {
  if (options_.readout_time == 0) return features;
  delayed_ = features;
  for (TrackedFeature& feature : delayed_) {
    feature.row_delay = options_.readout_time * (feature.pixel.y() / (camera_.height() - 1) - 0.5);
  }
  return delayed_;
}

void Vio::feed_image(int64_t utime, const cv::Mat& grey) {
  ++counters_["camera.received"];
  if (grey.type() != CV_8UC1 || grey.cols != camera_.width() || grey.rows != camera_.height()) {
    ++counters_["camera.rejected.size"];
    return;
  }
  if (session_ == 0) session_ = static_cast<int>(utime / 1'000'000);
  const auto taken = image_order_.add({utime, grey});
  count<PendingImage>("camera", taken);
  if (taken.stepped_back) {
    std::erase_if(images_, [&](const PendingImage& old) { return old.utime >= taken.samples.front().utime; });
  }
  images_.insert(images_.end(), taken.samples.begin(), taken.samples.end());
  while (images_.size() > kMostPendingImages) {
    images_.pop_front();
    ++counters_["camera.rejected.no_imu"];
  }
}

// Samples from `from` to `to` with both ends interpolated, in IMU time.
std::vector<ImuSample> Vio::take_imu(int64_t from, int64_t to, bool* gap) {
  *gap = false;
  while (imu_.size() >= 2 && imu_[1].utime <= from) imu_.pop_front();
  std::vector<ImuSample> result;
  if (imu_.empty() || imu_.front().utime > from) {
    *gap = true;
    return result;
  }
  for (size_t k = 0; k + 1 < imu_.size(); ++k) {
    const ImuSample& a = imu_[k];
    const ImuSample& b = imu_[k + 1];
    if (a.utime >= to) break;
    if (1e-6 * static_cast<double>(b.utime - a.utime) > options_.max_imu_gap) *gap = true;
    if (result.empty()) result.push_back(a.utime < from ? interpolate(a, b, from) : a);
    result.push_back(b.utime > to ? interpolate(a, b, to) : b);
  }
  return result;
}

void Vio::restart(const std::string& reason) {
  // A session that has not begun needs no successor.
  if (estimator_.status() != Estimator::Status::kInitialising) {
    ++session_;
    ++counters_["restarts"];
    restart_reason_ = reason;
  }
  estimator_.reset();
}

std::optional<VioOutput> Vio::next() {
  while (!images_.empty()) {
    finish_start();
    const auto offset = static_cast<int64_t>(std::llround(1e6 * estimator_.time_offset()));
    const PendingImage image = images_.front();
    if (last_state_ - (image.utime + offset) > kStepBack) {
      // What was flown after this image was not its time.
      restart("the sensors' clock was set back");
      last_state_ = 0;
    }
    // By the IMU's clock; never before the last one, however the estimated offset has moved.
    const int64_t now = std::max(image.utime + offset, last_state_ + 1);
    if (imu_.empty() || imu_.back().utime < now) break;
    images_.pop_front();
    if (imu_.front().utime > now) {
      ++counters_["camera.rejected.no_imu"];
      continue;
    }
    ++counters_["camera.processed"];
    Eigen::Matrix3d R_cur_prev = Eigen::Matrix3d::Identity();
    std::vector<ImuSample> samples;
    if (last_state_ != 0) {
      bool gap = false;
      samples = take_imu(last_state_, now, &gap);
      if (gap) {
        ++counters_["imu.gaps"];
        restart("a gap in the IMU");
        samples.clear();
      }
      Preintegration turn(Eigen::Vector3d::Zero(), estimator_.gyro_bias(), options_.imu);
      for (const ImuSample& sample : samples) turn.add(sample);
      const Eigen::Matrix3d R_prev_cur = turn.gamma().toRotationMatrix();
      R_cur_prev = extrinsics_.R_B_C.transpose() * R_prev_cur.transpose() * extrinsics_.R_B_C;
    }
    last_state_ = now;

    const auto& tracked = tracker_.track(image.grey, R_cur_prev, estimator_.gyro_bias_known());
    const auto& features = with_row_delays(tracked);
    calibration_.add(features, samples);
    VioOutput output;
    output.utime = image.utime;
    output.num_tracked = static_cast<int>(features.size());
    auto status = Estimator::Status::kInitialising;
    // What has flown well for a while proves its calibration better than the check can disprove it.
    const bool flying = estimator_.status() != Estimator::Status::kInitialising;
    const bool proven = flying && now - session_began_ > kProvenAfter;
    if (calibration_.complaint().empty() || proven) {
      status = estimator_.process(now, features, samples, height_at(now));
      if (status == Estimator::Status::kFailed) restart(estimator_.reason());
      if (estimator_.rescaled()) {
        ++session_;
        ++counters_["rescales"];
      }
    } else if (flying) {
      restart(calibration_.complaint());
    } else {
      estimator_.reset();  // not flown, not even begun, for as long as this is so
    }
    if (!flying) session_began_ = now;
    counters_["features.noise_px"] = estimator_.pixel_sigma();
    counters_["imu.gyro_noise_over_sheet"] = std::sqrt(estimator_.imu_variances().gyro);
    counters_["imu.accel_noise_over_sheet"] = std::sqrt(estimator_.imu_variances().accel);
    counters_["calibration.wrong"] = calibration_.complaint().empty() ? 0 : 1;
    output.session = session_;
    output.status = estimator_.status();
    output.reason = estimator_.reason();
    output.notice = notice_of(estimator_.imu_variances());
    if (!calibration_.complaint().empty()) {
      output.reason = "calibration: " + calibration_.complaint();
    } else if (output.status == Estimator::Status::kInitialising && !restart_reason_.empty()) {
      output.reason = fmt::format("restarted ({}): {}", restart_reason_, estimator_.reason());
    }
    output.height_above_ground = estimator_.height_above_ground();
    output.pose_covariance = estimator_.pose_covariance();
    output.velocity_covariance = estimator_.velocity_covariance();
    output.scale_stddev = estimator_.scale_stddev();
    output.time_offset = estimator_.time_offset();
    output.extrinsics = estimator_.extrinsics();
    output.last_keyframe_id = estimator_.last_keyframe_id();
    if (output.status != Estimator::Status::kInitialising) {
      restart_reason_.clear();
      output.state = estimator_.newest();
      output.levelled = estimator_.levelled();
      output.keyframe = estimator_.keyframe();
      if (output.keyframe) output.keyframe->utime = image.utime;
      tracker_.drop(estimator_.outliers());
    }
    // Frames keep their pace: a start is solved by the time of the next image, whatever the machine, so that a
    // replay repeats the flight.
    if (estimator_.start_due()) start_ = std::async(std::launch::async, [this] { estimator_.try_start(); });
    return output;
  }
  return std::nullopt;
}

}  // namespace orthonav::vio
