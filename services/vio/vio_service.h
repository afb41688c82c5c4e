// vio on the bus: IMU, CAMERA, ALTITUDE and VIO_RESET in, VIO_STATE, VIO_KEYFRAME and KEYFRAME_IMAGE out.
#pragma once

#include <deque>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/keyframe_image_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_reset_t.hpp"
#include "services/vio/missed_images.h"
#include "services/vio/scale_hint.h"
#include "services/vio/vio.h"

namespace orthonav::vio {

class VioService final : public Service {
 public:
  // Reads `config`/vio.yaml and `config`/aircraft.yaml and subscribes on `node`, which outlives the service.
  // `memory_file` is where the service keeps what it goes on with after it was killed (memory.h); empty: nowhere.
  // Throws ConfigError.
  VioService(Node& node, const std::filesystem::path& config, std::filesystem::path memory_file = {});
  // The same with a setup from elsewhere.
  VioService(Node& node, const VioSetup& setup, std::filesystem::path memory_file = {});

 private:
  struct KeyframeMessages {
    vio_keyframe_t keyframe;
    std::vector<keyframe_image_t> image;
    bool waited = false;
  };

  void on_imu(const imu_t& message);
  void on_image(const image_t& message);
  void on_nav(const nav_state_t& message);
  void on_reset(const vio_reset_t& message);
  void drain();
  void remember();
  void publish_state(const VioOutput& output, double processing_ms);
  void publish_keyframe(const VioOutput& output);
  void publish(const KeyframeMessages& messages);
  void repeat_keyframes();
  void update_health(const VioOutput& output);
  void report_rejects();

  Node& node_;
  VioSetup setup_;
  Vio vio_;
  ScaleHinter hinter_;
  MissedImages missed_images_;
  std::deque<image_t> images_;              // until the odometry has said whether they are of keyframes
  std::deque<KeyframeMessages> to_repeat_;  // once more, for who missed them
  std::filesystem::path memory_file_;
  std::map<std::string, double> reported_;  // rejects already shown in the health
  int announced_session_ = 0;
  bool was_flying_ = false;
};

}  // namespace orthonav::vio
