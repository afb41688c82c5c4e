// Puts the fusion on the bus: VIO_STATE, VIO_KEYFRAME, MAP_FIX, COMPASS and IMU in, NAV_STATE out.
#pragma once

#include <filesystem>
#include <optional>

#include "common/bus/keyframe_repeats.h"
#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "services/fusion/fusion.h"

namespace orthonav::fusion {

class FusionService final : public Service {
 public:
  // Reads fusion.yaml and aircraft.yaml of the folder. Throws ConfigError with file and line. `memory_file` is where
  // the service keeps what it goes on with after it was killed (memory.h); empty: nowhere.
  FusionService(Node& node, const std::filesystem::path& config_folder, std::filesystem::path memory_file = {});

 private:
  void on_state(const vio_state_t& message);
  void on_keyframe(const vio_keyframe_t& message);
  void on_fix(const map_fix_t& message);
  void on_compass(const compass_t& message);
  void on_imu(const imu_t& message);
  void publish(const Solution& solution);
  void send(const Solution& solution);
  void report_mode(const Solution& solution);
  void watch();
  void remember();

  Node& node_;
  Fusion fusion_;
  std::filesystem::path memory_file_;
  int64_t newest_state_utime_ = 0;         // of those accepted
  int64_t newest_imu_utime_ = 0;           // likewise
  double height_above_ground_ = kUnknown;  // of the newest odometry state
  int last_keyframe_session_ = 0;
  KeyframeRepeats repeats_;
  int last_keyframe_id_ = -1;
  double solve_ms_ = 0.0;
  std::optional<Solution> last_;  // published
  bool ever_located_ = false;
  bool quiet_ = false;       // nothing was published since watch() last looked
  int64_t looked_at_ = 0;    // steady time of that look
  int64_t quiet_since_ = 0;  // of the first that found nothing
};

}  // namespace orthonav::fusion
