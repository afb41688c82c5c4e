#include "services/vio/vio_service.h"

#include <algorithm>
#include <cctype>
#include <chrono>
#include <cmath>
#include <limits>
#include <utility>

#include <spdlog/spdlog.h>

#include "common/bus/channels.h"
#include "common/bus/image_parts.h"
#include "common/camera/image_decode.h"
#include "orthonav/altitude_t.hpp"
#include "orthonav/vio_state_t.hpp"

namespace orthonav::vio {
namespace {

constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();
// Images that may wait: one in work and a few that arrived while it was, so that a slow frame costs no track.
constexpr size_t kImageQueue = 4;
// Images kept for keyframes: more than the odometry has waiting for their order and for inertial samples.
constexpr size_t kImagesKept = 64;
// A keyframe is sent again between once and twice this after it: what loses one packet may lose its neighbours.
constexpr std::chrono::milliseconds kRepeatKeyframe{50};

void put(const Eigen::Vector3d& from, double* to) {
  std::copy_n(from.data(), 3, to);
}

void put(const Eigen::Quaterniond& from, double* to) {
  to[0] = from.w();
  to[1] = from.x();
  to[2] = from.y();
  to[3] = from.z();
}

void put(const Eigen::Matrix<double, 6, 6>& from, double* to) {
  Eigen::Map<Eigen::Matrix<double, 6, 6, Eigen::RowMajor>>{to} = from;
}

}  // namespace

VioService::VioService(Node& node, const std::filesystem::path& config, std::filesystem::path memory_file)
    : VioService(node, load_setup(config), std::move(memory_file)) {}

VioService::VioService(Node& node, const VioSetup& setup, std::filesystem::path memory_file)
    : node_(node),
      setup_(setup),
      vio_(setup_.options, setup_.camera, setup_.extrinsics),
      hinter_(setup_.options.hint_distance),
      memory_file_(std::move(memory_file)) {
  if (!memory_file_.empty()) {
    const auto memory = read_memory(memory_file_);
    if (memory && vio_.resume(*memory)) node_.health().add("memory.read");
  }
  node_.subscribe<imu_t>(channel::kImu, Delivery::kAll, [this](const imu_t& message) { on_imu(message); });
  node_.subscribe<image_t>(
      channel::kCamera, Delivery::kLatest, [this](const image_t& message) { on_image(message); }, kImageQueue);
  node_.subscribe<altitude_t>(channel::kAltitude, Delivery::kAll, [this](const altitude_t& message) {
    vio_.feed_altitude(message.utime, message.height_above_ground, message.stddev);
  });
  node_.subscribe<vio_reset_t>(channel::kVioReset, Delivery::kAll,
                               [this](const vio_reset_t& message) { on_reset(message); });
  if (setup_.options.fusion_hint) {
    node_.subscribe<nav_state_t>(channel::kNavState, Delivery::kAll,
                                 [this](const nav_state_t& message) { on_nav(message); });
  }
  node_.every(kRepeatKeyframe, [this] { repeat_keyframes(); });
  for (const char* channel : {channel::kImu, channel::kCamera}) node_.expect(channel);
  node_.health().set_state(Health::State::kStarting, "waiting for IMU and CAMERA");
}

void VioService::on_imu(const imu_t& message) {
  ImuSample sample;
  sample.utime = message.utime;
  sample.gyro = Eigen::Map<const Eigen::Vector3d>(message.angular_rate);
  sample.accel = Eigen::Map<const Eigen::Vector3d>(message.specific_force);
  vio_.feed_imu(sample);
  drain();
}

void VioService::on_image(const image_t& message) {
  const DecodedImage image = decode_image(message, setup_.camera.width(), setup_.camera.height());
  if (!image.ok()) {
    node_.health().reject("camera", image.error);
    return;
  }
  if (const int missing = missed_images_.add(message.utime); missing > 0) {
    node_.health().reject("camera.missed", "images did not come in time: are packets lost, or is this board too slow?",
                          missing);
  }
  images_.push_back(message);
  if (images_.size() > kImagesKept) images_.pop_front();
  vio_.feed_image(message.utime, image.grey);
  drain();
}

void VioService::on_nav(const nav_state_t& message) {
  const Eigen::Map<const Eigen::Matrix<double, 6, 6, Eigen::RowMajor>> covariance(message.covariance);
  const double stddev = std::sqrt(0.5 * covariance.topLeftCorner<2, 2>().trace());
  const auto hint = hinter_.add_fused(message.utime, message.session, message.mode == nav_state_t::MAP_AIDED,
                                      message.reset_counter, Eigen::Map<const Eigen::Vector3d>(message.p_G_B), stddev);
  if (hint) vio_.hint_scale(hint->ratio, hint->stddev);
}

void VioService::on_reset(const vio_reset_t& message) {
  constexpr size_t kLongestReason = 100;
  std::string reason = message.reason.substr(0, kLongestReason);
  std::replace_if(
      reason.begin(), reason.end(), [](unsigned char c) { return std::iscntrl(c) != 0; }, ' ');
  vio_.reset("asked for by " + reason);
  report_rejects();
}

void VioService::drain() {
  while (true) {
    const Stopwatch watch(node_);
    const auto output = vio_.next();
    if (!output) break;
    if (output->status != Estimator::Status::kInitialising) {
      hinter_.add_odometry(output->utime, output->session, output->state.p());
    }
    publish_state(*output, watch.ms());
    if (output->keyframe) {
      publish_keyframe(*output);
      remember();
    }
    std::erase_if(images_, [&](const image_t& image) { return image.utime <= output->utime; });
    update_health(*output);
  }
  report_rejects();
}

void VioService::remember() {
  if (memory_file_.empty() || !vio_.memory()) return;
  if (!write_memory(memory_file_, *vio_.memory())) node_.health().add("memory.not_written");
}

void VioService::publish_state(const VioOutput& output, double processing_ms) {
  using Status = Estimator::Status;
  vio_state_t message{};
  message.utime = output.utime;
  message.session = output.session;
  message.num_tracked = output.num_tracked;
  message.last_keyframe_id = output.last_keyframe_id;
  message.processing_ms = processing_ms;
  message.camera_time_offset = output.time_offset;
  if (output.status == Status::kInitialising) {
    message.status = vio_state_t::INITIALISING;
    for (double* field : {message.p_W_B, message.v_W_B, message.gyro_bias, message.accel_bias}) {
      std::fill_n(field, 3, kUnknown);
    }
    std::fill_n(message.q_W_B, 4, kUnknown);
    std::fill_n(message.levelled, 2, kUnknown);
    std::fill_n(message.pose_covariance, 36, kUnknown);
    std::fill_n(message.velocity_covariance, 9, kUnknown);
    message.scale_stddev = kUnknown;
    message.height_above_ground = kUnknown;
  } else {
    message.status = output.status == Status::kDegraded ? vio_state_t::DEGRADED : vio_state_t::TRACKING;
    put(Eigen::Vector3d(output.state.p()), message.p_W_B);
    put(Eigen::Quaterniond(output.state.q()), message.q_W_B);
    put(Eigen::Vector3d(output.state.v()), message.v_W_B);
    put(Eigen::Vector3d(output.state.bg()), message.gyro_bias);
    put(Eigen::Vector3d(output.state.ba()), message.accel_bias);
    Eigen::Map<Eigen::Vector2d>{message.levelled} = output.levelled;
    put(output.pose_covariance, message.pose_covariance);
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>{message.velocity_covariance} = output.velocity_covariance;
    message.scale_stddev = output.scale_stddev;
    message.height_above_ground = output.height_above_ground;
  }
  node_.publish(channel::kVioState, message);
}

void VioService::publish_keyframe(const VioOutput& output) {
  const Keyframe& keyframe = *output.keyframe;
  vio_keyframe_t message{};
  message.utime = keyframe.utime;
  message.session = output.session;
  message.id = keyframe.id;
  put(Eigen::Vector3d(keyframe.state.p()), message.p_W_B);
  put(Eigen::Quaterniond(keyframe.state.q()), message.q_W_B);
  put(Eigen::Vector3d(keyframe.state.v()), message.v_W_B);
  Eigen::Map<Eigen::Vector2d>{message.levelled} = keyframe.levelled;
  put(output.extrinsics.p_B_C, message.p_B_C);
  put(Eigen::Quaterniond(output.extrinsics.R_B_C), message.q_B_C);
  message.height_above_ground = keyframe.height_above_ground;
  put(keyframe.relative_covariance, message.relative_covariance);
  message.scale_stddev = keyframe.scale_stddev;
  for (const KeyframeFeature& feature : keyframe.features) {
    vio_feature_t entry{};
    entry.id = feature.id;
    entry.pixel[0] = static_cast<float>(feature.pixel.x());
    entry.pixel[1] = static_cast<float>(feature.pixel.y());
    put(feature.ray_C, entry.ray_C);
    put(feature.p_W, entry.p_W);
    entry.reprojection_error = static_cast<float>(feature.reprojection_error);
    entry.depth_stddev = static_cast<float>(feature.depth_stddev);
    message.features.push_back(entry);
  }
  message.num_features = static_cast<int32_t>(message.features.size());
  const auto is_its_own = [&](const image_t& image) { return image.utime == keyframe.utime; };
  const auto image = std::find_if(images_.begin(), images_.end(), is_its_own);
  if (image == images_.end()) node_.health().add("keyframes.without_image");
  KeyframeMessages messages{std::move(message),
                            image == images_.end() ? std::vector<keyframe_image_t>{} : parts_of(*image)};
  publish(messages);
  if (node_.live()) to_repeat_.push_back(std::move(messages));  // a replay loses nothing
}

void VioService::publish(const KeyframeMessages& messages) {
  node_.publish(channel::kVioKeyframe, messages.keyframe);
  for (const keyframe_image_t& part : messages.image) node_.publish(channel::kKeyframeImage, part);
}

void VioService::repeat_keyframes() {
  while (!to_repeat_.empty() && to_repeat_.front().waited) {
    publish(to_repeat_.front());
    to_repeat_.pop_front();
  }
  for (KeyframeMessages& messages : to_repeat_) messages.waited = true;
}

void VioService::update_health(const VioOutput& output) {
  using Status = Estimator::Status;
  Health& health = node_.health();
  health.set("session", output.session);
  health.set("features.tracked", output.num_tracked);
  health.set("keyframes", output.last_keyframe_id + 1);
  health.set("camera.time_offset_ms", 1e3 * output.time_offset);
  const bool flying = output.status != Status::kInitialising;
  if (output.session != announced_session_ && flying) spdlog::info("started session {}", output.session);
  if (flying) announced_session_ = output.session;
  if (was_flying_ && !flying) spdlog::warn("session {} ended: {}", announced_session_, output.reason);
  was_flying_ = flying;
  switch (output.status) {
    case Status::kInitialising:
      health.set_state(Health::State::kStarting, "initialising: " + output.reason);
      break;
    case Status::kTracking:
      if (output.reason.empty()) {
        health.set_state(Health::State::kOk, output.notice);
      } else {
        health.set_state(Health::State::kDegraded, output.reason);
      }
      break;
    case Status::kDegraded:
    case Status::kFailed:
      health.set_state(Health::State::kDegraded, output.reason);
      break;
  }
}

void VioService::report_rejects() {
  for (const auto& [name, value] : vio_.counters()) {
    const auto at = name.find("rejected.");
    if (at == std::string::npos) {
      node_.health().set(name, value);
      continue;
    }
    // Vio counts "imu.rejected.order"; Health keeps its own count under "rejected.imu.order".
    const std::string what = name.substr(0, at) + name.substr(at + 9);
    double& shown = reported_[name];
    if (value > shown) node_.health().reject(what, "rejected input: " + what, value - shown);
    shown = std::max(shown, value);
  }
}

}  // namespace orthonav::vio
