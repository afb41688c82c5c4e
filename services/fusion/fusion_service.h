// Puts the fusion on the bus: VIO_STATE, VIO_KEYFRAME and MAP_FIX in, NAV_STATE out.
#pragma once

#include <filesystem>

#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "services/fusion/fusion.h"

namespace orthonav {

class FusionService final : public Service {
 public:
  // Reads fusion.yaml of the folder. Throws ConfigError with file and line.
  FusionService(Node& node, const std::filesystem::path& config_folder);

 private:
  void on_state(const vio_state_t& message);
  void on_keyframe(const vio_keyframe_t& message);
  void on_fix(const map_fix_t& message);
  void report_mode(const fusion::Solution& solution);

  Node& node_;
  fusion::Fusion fusion_;
  int last_keyframe_session_ = 0;
  int last_keyframe_id_ = -1;
  double solve_ms_ = 0.0;
};

}  // namespace orthonav
