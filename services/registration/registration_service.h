// Registration on the bus: fetches the map from the map server, keeps the images and compass headings of the last
// seconds, registers every keyframe of the odometry and says where it is (MAP_FIX), or why it does not know. A
// keyframe's image comes on CAMERA, and in parts with the keyframe, for where packets are lost.
#pragma once

#include <cmath>
#include <deque>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "common/bus/image_parts.h"
#include "common/bus/keyframe_repeats.h"
#include "common/bus/nav_guard.h"
#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "common/camera/image_decode.h"
#include "common/geo/enu_frame.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/keyframe_image_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/position_hint_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "services/registration/heading_buffer.h"
#include "services/registration/map/map_client.h"
#include "services/registration/methods.h"

namespace orthonav::registration {

struct ServiceOptions {
  MethodOptions method;
  double declination = 0;                     // rad, east positive, of aircraft.yaml
  double default_heading_stddev = M_PI / 60;  // rad, where the compass does not say
  double max_compass_gap = 0.3;               // s between a keyframe and the compass samples used for it
  int image_buffer = 100;                     // images kept for keyframes to come
  MapClientOptions map;
  int request_period_ms = 50;
};

class RegistrationService : public Service {
 public:
  struct Setup {
    ServiceOptions options;
    CameraModel camera;
  };
  // Reads registration.yaml and, of aircraft.yaml, `camera` and `magnetic_declination_deg`. Throws ConfigError.
  static Setup read(const std::filesystem::path& config_folder);
  RegistrationService(Node& node, const std::filesystem::path& config_folder);

 private:
  RegistrationService(Node& node, const Setup& setup);

  void handle(const image_t& image);
  void handle(const keyframe_image_t& part);
  void handle(const compass_t& compass);
  void handle(const map_info_t& info);
  void handle(const map_tile_t& tile);
  void handle(const nav_state_t& state);
  void handle(const position_hint_t& hint);
  void handle(const vio_keyframe_t& keyframe);
  void see_time(int64_t utime);
  void request_tiles();
  void take_map();
  void process_pending();
  DecodedImage image_of(int64_t keyframe) const;
  void register_keyframe(const vio_keyframe_t& keyframe, const DecodedImage& image, double decoding_ms);
  Fix register_image(const vio_keyframe_t& message, const cv::Mat& image, const Heading& heading, map_fix_t& out);
  std::optional<PositionPrior> expected_position(int64_t utime) const;
  void publish(const vio_keyframe_t& keyframe, const Fix& fix, const Heading& heading, map_fix_t& out);
  void publish_hypotheses(const vio_keyframe_t& keyframe);
  void report_state();

  Node& node_;
  ServiceOptions options_;
  CameraModel camera_;
  std::unique_ptr<Method> method_;
  NavGuard nav_guard_;
  std::deque<nav_state_t> nav_states_;  // of the last seconds, those with a position

  std::map<int64_t, image_t> images_;  // of CAMERA, by utime
  ImageAssembler keyframe_images_;
  HeadingBuffer headings_;
  KeyframeRepeats repeats_;
  std::deque<vio_keyframe_t> pending_;  // waiting for the compass sample after them, or for their images
  int64_t newest_data_ = 0;             // utime of the newest image or compass sample

  MapClient map_client_;
  std::string map_fingerprint_;  // of the level in use; empty: none yet
  std::string map_problem_;      // why the map on offer cannot be used
  std::string problem_fingerprint_;
  EnuFrame frame_{Geodetic{}};
  std::optional<position_hint_t> hint_;  // for the next keyframe
  int64_t hypotheses_utime_ = 0;         // of the newest PLACE_HYPOTHESES
  int64_t num_fixes_ = 0;
  int64_t num_tried_ = 0;
};

}  // namespace orthonav::registration
