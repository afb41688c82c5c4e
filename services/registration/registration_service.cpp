#include "services/registration/registration_service.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <utility>

#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include "common/bus/channels.h"
#include "common/camera/aircraft.h"
#include "common/math/so3.h"
#include "common/math/stamps.h"
#include "services/registration/keyframe_message.h"
#include "services/registration/map/map_message.h"
#include "services/registration/place_message.h"

namespace orthonav::registration {
namespace {

constexpr double kLargestHeading = 13;  // rad, two turns: whatever range headings are given in
constexpr double kRadian = M_PI / 180.0;
// How long what is missing of a keyframe's image may still come, microseconds of data: it is sent again within 100 ms.
constexpr int64_t kLongestWait = 500'000;
// Keyframes without a compass sample after them, waiting: more mean that the compass has stopped.
constexpr size_t kMaxPending = 16;
// Raw images of which all parts may wait.
constexpr size_t kImagesWaiting = 4;
// Positions kept for keyframes to come, and how far from a keyframe's time one still says where it was, s.
constexpr size_t kNavStates = 100;
constexpr double kMaxNavAge = 60;
// Standard deviations of a horizontal error that its protection level stands for (services/fusion/protection.h).
constexpr double kStddevsOfLevel = 4.29;
constexpr int64_t kHypothesesPeriod = 500'000;  // microseconds between PLACE_HYPOTHESES, at least
constexpr double kNavSpeedStddev = 2;  // m/s by which a position gets worse until the keyframe's time, if it goes
                                       // on as it did: for some seconds; then by its speed
constexpr double kGoesOnFor = 5;       // s

}  // namespace

RegistrationService::Setup RegistrationService::read(const std::filesystem::path& config_folder) {
  ServiceOptions options;
  ConfigNode node = ConfigNode::load(config_folder / "registration.yaml");
  options.method = MethodOptions::from_config(node);
  double stddev_deg = options.default_heading_stddev / kRadian;
  node.read("default_heading_stddev_deg", stddev_deg, 0, 180);
  options.default_heading_stddev = stddev_deg * kRadian;
  node.read("max_compass_gap", options.max_compass_gap, 0, 60);
  node.read("image_buffer", options.image_buffer, 1, 10000);
  ConfigNode map = node.child_or_empty("map");
  map.read("request_period_ms", options.request_period_ms, 1, 60'000);
  options.map = MapClientOptions::from_config(map);
  map.finish();
  node.finish();
  // aircraft.yaml has parts that are other services' to read, so not every key of it is known here.
  ConfigNode aircraft = load_aircraft(config_folder);
  ConfigNode camera = aircraft.child("camera");
  double declination_deg = 0;
  aircraft.require("magnetic_declination_deg", declination_deg);
  options.declination = declination_deg * kRadian;
  return {options, CameraModel::from_config(camera)};
}

RegistrationService::RegistrationService(Node& node, const std::filesystem::path& config_folder)
    : RegistrationService(node, read(config_folder)) {}

RegistrationService::RegistrationService(Node& node, const Setup& setup)
    : node_(node),
      options_(setup.options),
      camera_(setup.camera),
      method_(make_method(setup.options.method, setup.camera)),
      keyframe_images_(setup.camera.width(), setup.camera.height()),
      headings_(static_cast<int64_t>(setup.options.max_compass_gap * 1e6)),
      map_client_(setup.options.map) {
  node_.subscribe<image_t>(
      channel::kCamera, Delivery::kLatest, [this](const image_t& image) { handle(image); }, 30);
  const auto raw = static_cast<size_t>(camera_.width() * camera_.height() / keyframe_image_t::PART_BYTES + 1);
  node_.subscribe<keyframe_image_t>(
      channel::kKeyframeImage, Delivery::kLatest, [this](const keyframe_image_t& part) { handle(part); },
      kImagesWaiting * raw);
  node_.subscribe<compass_t>(channel::kCompass, Delivery::kAll, [this](const compass_t& compass) { handle(compass); });
  // A fix is worth more fresh than complete: whoever is behind goes on with the newest keyframe, which comes twice.
  node_.subscribe<vio_keyframe_t>(
      channel::kVioKeyframe, Delivery::kLatest, [this](const vio_keyframe_t& keyframe) { handle(keyframe); }, 2);
  node_.subscribe<map_info_t>(channel::kMapInfo, Delivery::kReplace, [this](const map_info_t& info) { handle(info); });
  node_.subscribe<map_tile_t>(channel::kMapTile, Delivery::kAll, [this](const map_tile_t& tile) { handle(tile); });
  node_.subscribe<nav_state_t>(channel::kNavState, Delivery::kReplace,
                               [this](const nav_state_t& state) { handle(state); });
  node_.subscribe<position_hint_t>(channel::kPositionHint, Delivery::kAll,
                                   [this](const position_hint_t& hint) { handle(hint); });
  node_.expect(
      channel::kCompass);  // of CAMERA few images come where packets are lost, and keyframes as the flight has it
  node_.every(std::chrono::milliseconds(options_.request_period_ms), [this] { request_tiles(); });
  node_.every(std::chrono::seconds(1), [this] { report_state(); });
  report_state();
}

void RegistrationService::see_time(int64_t utime) {
  newest_data_ = of_another_time(newest_data_, utime) ? utime : std::max(newest_data_, utime);
}

void RegistrationService::handle(const image_t& image) {
  node_.health().add("camera.received");
  if (image.width != camera_.width() || image.height != camera_.height()) {
    node_.health().reject("camera", fmt::format("images of {} x {} pixels, the camera has {} x {}", image.width,
                                                image.height, camera_.width(), camera_.height()));
    return;
  }
  see_time(image.utime);
  std::erase_if(images_, [&](const auto& old) { return of_another_time(old.first, image.utime); });
  // Decoded only when a keyframe asks for it: most frames are none.
  images_.insert_or_assign(image.utime, image);
  while (static_cast<int>(images_.size()) > options_.image_buffer) images_.erase(images_.begin());
  process_pending();
}

void RegistrationService::handle(const keyframe_image_t& part) {
  if (!keyframe_images_.add(part)) {
    node_.health().reject(
        "keyframe_image",
        fmt::format("part {} of {} bytes, of an image of {} x {} pixels and {} bytes; the camera has {} x {}",
                    part.part, part.num_bytes, part.width, part.height, part.size, camera_.width(), camera_.height()));
    return;
  }
  see_time(part.utime);
  if (keyframe_images_.has(part.utime)) process_pending();
}

void RegistrationService::handle(const compass_t& compass) {
  node_.health().add("compass.received");
  Heading heading;
  heading.value = true_heading(compass.heading, options_.declination);
  heading.stddev = std::isfinite(compass.heading_stddev) && compass.heading_stddev > 0
                       ? compass.heading_stddev
                       : options_.default_heading_stddev;
  const bool is_heading = std::abs(compass.heading) <= kLargestHeading && !(heading.stddev > kLargestHeading);
  if (!is_heading || !headings_.add(compass.utime, heading)) {
    node_.health().reject("compass", is_heading ? "compass samples are out of order" : "compass heading is not one");
    return;
  }
  see_time(compass.utime);
  process_pending();
}

void RegistrationService::handle(const map_info_t& info) {
  if (info.fingerprint == problem_fingerprint_) return;
  const MapLevel level = level_of(info);
  std::string problem = problem_of(info);
  const char* wanted = features_for(options_.method.registrar.method);
  if (problem.empty() && info.features != wanted) {
    problem = fmt::format("method {} needs a map with features: {} (map_server.yaml), this one has {}",
                          name_of(options_.method.registrar.method), wanted, info.features);
  }
  // What is no use does not displace a map that is: the server goes on serving it, or it is all here.
  if (!problem.empty() && (method_->has_map() || map_client_.store().num_complete() > 0)) {
    node_.health().add("map.rejected");
    node_.health().reject("map_info", problem);
    return;
  }
  if (problem.empty() ? map_client_.offer(level) : problem != map_problem_) {
    // Another map than before, of use or not.
    method_->clear_map();
    map_fingerprint_.clear();
    if (!problem.empty()) map_client_.clear();
  }
  map_problem_ = problem;
  problem_fingerprint_ = problem.empty() ? "" : info.fingerprint;
  if (problem.empty()) {
    frame_ = EnuFrame(level.anchor);
  } else {
    node_.health().add("map.rejected");
  }
  report_state();
}

void RegistrationService::handle(const nav_state_t& state) {
  if (const char* why = nav_guard_.refusal(state)) {
    node_.health().reject(fmt::format("nav.{}", why), "NAV_STATE refused: is there a second publisher?");
    return;
  }
  if (std::isnan(state.latitude_deg)) return;
  const Eigen::Vector3d p_G = frame_.to_enu({state.latitude_deg, state.longitude_deg, state.ellipsoidal_height});
  map_client_.move(p_G.head<2>(), {state.v_G_B[0], state.v_G_B[1]},
                   std::sqrt(state.covariance[0] + state.covariance[7]));
  if (!nav_states_.empty() && state.utime <= nav_states_.back().utime) nav_states_.clear();  // another flight
  nav_states_.push_back(state);
  if (nav_states_.size() > kNavStates) nav_states_.pop_front();
}

void RegistrationService::handle(const position_hint_t& hint) {
  node_.health().add("hints.received");
  const std::string problem = area_of(hint, frame_).problem;
  if (!problem.empty()) {
    node_.health().reject("hint", "POSITION_HINT refused: " + problem);
    return;
  }
  hint_ = hint;
}

std::optional<PositionPrior> RegistrationService::expected_position(int64_t utime) const {
  if (nav_states_.empty()) return std::nullopt;
  const nav_state_t* nearest = &nav_states_.front();
  for (const nav_state_t& nav : nav_states_) {
    if (std::abs(nav.utime - utime) < std::abs(nearest->utime - utime)) nearest = &nav;
  }
  const double seconds = 1e-6 * static_cast<double>(utime - nearest->utime);
  if (!(std::abs(seconds) < kMaxNavAge)) return std::nullopt;
  const Eigen::Vector3d p_G =
      frame_.to_enu({nearest->latitude_deg, nearest->longitude_deg, nearest->ellipsoidal_height});
  const Eigen::Vector2d velocity(nearest->v_G_B[0], nearest->v_G_B[1]);
  const double variance = std::max(nearest->covariance[0], nearest->covariance[7]);
  PositionPrior prior;
  prior.en = p_G.head<2>();
  prior.stddev = std::sqrt(variance);
  // Where the fusion reckons with another place, too, its level reaches there.
  prior.stddev = std::fmax(prior.stddev, nearest->horizontal_protection_level / kStddevsOfLevel);
  if (velocity.allFinite()) prior.en += std::clamp(seconds, -kGoesOnFor, kGoesOnFor) * velocity;
  const double speed = velocity.allFinite() ? velocity.norm() : 0.0;
  const double goes_on = std::min(std::abs(seconds), kGoesOnFor);
  prior.stddev += kNavSpeedStddev * goes_on + std::max(kNavSpeedStddev, speed) * (std::abs(seconds) - goes_on);
  if (!prior.en.allFinite() || !std::isfinite(prior.stddev)) return std::nullopt;
  return prior;
}

void RegistrationService::request_tiles() {
  if (auto request = next_request(map_client_, "registration", node_.steady_now())) {
    request->utime = node_.now();
    node_.publish(channel::kMapTileRequest, *request);
  }
  const TileStore& store = map_client_.store();
  Health& health = node_.health();
  health.set("map.tiles_asked_again", static_cast<double>(store.num_asked_again()));
  health.set("map.parts_asked_again", static_cast<double>(store.num_parts_again()));
  health.set("map.tiles_given_up", static_cast<double>(store.num_given_up()));
  health.set("map.tiles_beyond_memory", static_cast<double>(store.num_beyond_budget()));
  health.set("map.memory_mb", static_cast<double>(store.memory_used()) * 1e-6);
}

void RegistrationService::handle(const map_tile_t& tile) {
  const MapLevel* level = map_client_.level();
  if (level == nullptr) return;  // for another client
  if (tile.fingerprint != level->layout.fingerprint) {
    node_.health().add("map.parts_of_another_map");
    return;
  }
  switch (add_tile(map_client_, tile, node_.steady_now())) {
    case TileStore::Outcome::kAccepted:
      node_.health().add("map.parts_received");
      break;
    case TileStore::Outcome::kDuplicate:
      node_.health().add("map.parts_repeated");
      break;
    case TileStore::Outcome::kUnwanted:
      node_.health().add("map.parts_unwanted");
      break;
    case TileStore::Outcome::kRefused:
      node_.health().reject("map_tile_refused", fmt::format("the map server has no tile {} to give", tile.tile));
      break;
    case TileStore::Outcome::kMalformed:
      node_.health().reject("map_tile", fmt::format("part {} of map tile {} is malformed", tile.part, tile.tile));
      break;
  }
  take_map();
}

void RegistrationService::take_map() {
  const int64_t mismatched = map_client_.num_mismatched();
  std::optional<MapFeatures> features = map_client_.take_ready();
  if (map_client_.num_mismatched() > mismatched) {
    node_.health().reject("map", "map has another number of features in its tiles than announced: fetching it again");
  }
  if (!features) return;
  const MapLevel& level = *map_client_.level();
  const auto count = features->positions.size();
  try {
    method_->set_map(std::move(*features), level.geometry);
  } catch (const std::invalid_argument& error) {
    map_problem_ = error.what();
    problem_fingerprint_ = level.layout.fingerprint;
    map_client_.clear();
    node_.health().add("map.rejected");
    report_state();
    return;
  }
  map_fingerprint_ = level.layout.fingerprint;
  spdlog::info("map {} is here: {} of {} features at {:.2f} m/px", map_fingerprint_, count, level.layout.num_features,
               level.geometry.metres_per_pixel);
  node_.health().set("map.features", static_cast<double>(count));
  report_state();
}

void RegistrationService::handle(const vio_keyframe_t& keyframe) {
  if (repeats_.add(keyframe)) return;
  node_.health().add("keyframes.received");
  map_client_.see(keyframe.height_above_ground / camera_.focal());
  if (!method_->has_map()) {
    node_.health().add("keyframes.before_map");
    return;
  }
  pending_.push_back(keyframe);
  process_pending();
}

void RegistrationService::process_pending() {
  const auto max_gap = static_cast<int64_t>(options_.max_compass_gap * 1e6);
  while (!pending_.empty()) {
    const int64_t utime = pending_.front().utime;
    if (newest_data_ != 0 && of_another_time(utime, newest_data_)) {
      node_.health().reject("keyframe.of_another_time", "a keyframe of a time of which there are no images");
      pending_.pop_front();
      continue;
    }
    const bool waited_enough = pending_.size() > kMaxPending;
    if (!waited_enough && !headings_.covers(utime) && newest_data_ - utime <= max_gap) return;
    const Stopwatch decoding(node_);
    const DecodedImage image = image_of(utime);
    if (!waited_enough && !image.ok() && newest_data_ - utime <= kLongestWait) return;
    const double decoding_ms = decoding.ms();
    const vio_keyframe_t keyframe = std::move(pending_.front());
    pending_.pop_front();
    if (method_->has_map()) register_keyframe(keyframe, image, decoding_ms);
  }
}

DecodedImage RegistrationService::image_of(int64_t keyframe) const {
  std::vector<image_t> images = keyframe_images_.find(keyframe);
  if (const auto whole = images_.find(keyframe); whole != images_.end()) images.insert(images.begin(), whole->second);
  DecodedImage decoded;
  decoded.error = fmt::format("no image of the keyframe's time: {}", keyframe_images_.describe(keyframe));
  for (const image_t& image : images) {
    decoded = decode_image(image, camera_.width(), camera_.height());
    if (decoded.ok()) break;
  }
  return decoded;
}

void RegistrationService::register_keyframe(const vio_keyframe_t& message, const DecodedImage& image,
                                            double decoding_ms) {
  const Stopwatch total(node_);
  map_fix_t out{};
  Fix fix;
  const Heading heading = headings_.at(message.utime).value_or(Heading{});
  if (!heading.known()) node_.health().add("keyframes.without_heading");
  if (!image.ok()) {
    fix.reason = image.error;
    node_.health().reject("keyframe.no_image", "a keyframe without its image: " + image.error);
  } else {
    out.describe_ms = decoding_ms;
    fix = register_image(message, image.grey, heading, out);
  }
  out.total_ms = decoding_ms + total.ms();
  publish(message, fix, heading, out);
}

Fix RegistrationService::register_image(const vio_keyframe_t& message, const cv::Mat& image, const Heading& heading,
                                        map_fix_t& out) {
  const Keyframe keyframe = keyframe_of(message);
  const Stopwatch describing(node_);
  if (hint_) method_->hint(area_of(*hint_, frame_).area);
  hint_.reset();
  method_->describe(keyframe, message.session, image, heading);
  out.describe_ms += describing.ms();
  const Stopwatch searching(node_);
  method_->search(expected_position(message.utime));
  out.match_ms = searching.ms();
  const Stopwatch solving(node_);
  Fix fix = method_->solve();
  out.solve_ms = solving.ms();
  return fix;
}

void RegistrationService::publish(const vio_keyframe_t& keyframe, const Fix& fix, const Heading& heading,
                                  map_fix_t& out) {
  fill_fix(fix, frame_, out);
  out.utime = keyframe.utime;
  out.session = keyframe.session;
  out.keyframe_id = keyframe.id;
  out.method = name_of(options_.method.registrar.method);
  out.map_fingerprint = map_fingerprint_;
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double full_turn = 2 * M_PI;
  const bool corrected = std::isfinite(fix.heading_correction);
  const double of_the_compass = heading.known() ? heading.value : nan;
  const double used = corrected ? heading.value + fix.heading_correction : of_the_compass;
  out.heading = used - full_turn * std::floor(used / full_turn);
  out.heading_stddev = corrected ? fix.heading_correction_stddev : heading.known() ? heading.stddev : nan;
  if (!heading.known()) out.heading_correction = nan;
  node_.publish(channel::kMapFix, out);
  const bool searched = !std::isnan(fix.search_radius);  // else the belief is of an earlier keyframe
  if (searched) publish_hypotheses(keyframe);
  ++num_tried_;
  if (fix.valid) ++num_fixes_;
  node_.health().add("points.contradicted", fix.num_contradicted);
  node_.health().set("fixes.tried", static_cast<double>(num_tried_));
  node_.health().set("fixes.valid", static_cast<double>(num_fixes_));
}

void RegistrationService::publish_hypotheses(const vio_keyframe_t& keyframe) {
  const PlaceBelief& belief = method_->belief();
  const auto& places = belief.hypotheses();
  node_.health().set("place.hypotheses", static_cast<double>(places.size()));
  node_.health().set("place.probability", places.empty() ? 0 : belief.probability(places.front().id));
  if (std::abs(keyframe.utime - hypotheses_utime_) < kHypothesesPeriod) return;
  hypotheses_utime_ = keyframe.utime;
  node_.publish(channel::kPlaceHypotheses, hypotheses_message(belief, keyframe, frame_));
}

void RegistrationService::report_state() {
  Health& health = node_.health();
  if (!map_problem_.empty()) {
    health.set_state(Health::State::kFailed, map_problem_);
  } else if (!method_->has_map()) {
    health.set_state(Health::State::kStarting, map_client_.waiting_for());
  } else if (health.counter("compass.received") == 0) {
    health.set_state(Health::State::kStarting, "waiting for COMPASS");
  } else if (health.counter("camera.received") == 0) {
    health.set_state(Health::State::kStarting, "waiting for CAMERA");
  } else if (num_tried_ == 0) {
    health.set_state(Health::State::kStarting, "waiting for VIO_KEYFRAME: has the odometry initialised?");
  } else {
    health.set_state(Health::State::kOk);
  }
}

}  // namespace orthonav::registration
