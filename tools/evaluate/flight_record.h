// What the log of a flight holds, without its images: the input of every metric and plot.
//
// All positions are brought to one east-north-up frame, G of the first map in the log, or one at the first reference
// position when there was no map. Missing channels leave their vectors empty.
#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/geo/enu_frame.h"
#include "orthonav/health_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_state_t.hpp"

namespace orthonav::evaluate {

// The true pose, or a GNSS receiver's position (then without attitude).
struct ReferenceSample {
  int64_t utime = 0;
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_G_B = Eigen::Quaterniond::Identity();
  Eigen::Vector2d map_offset_en = Eigen::Vector2d::Zero();  // m, of the map's georeference; NaN: unknown
  double height_above_ground = 0;                           // m; NaN: unknown
};

// A reference over time.
class Reference {
 public:
  void add(const ReferenceSample& sample) { samples_.push_back(sample); }
  // Brings the samples into time order; call once after the last add().
  void finish();
  bool empty() const { return samples_.empty(); }
  const std::vector<ReferenceSample>& samples() const { return samples_; }
  // Interpolated between two samples at most half a second apart; nullopt elsewhere.
  std::optional<ReferenceSample> at(int64_t utime) const;

 private:
  std::vector<ReferenceSample> samples_;
};

template <class Msg>
struct Logged {
  int64_t logged_at = 0;  // microseconds: when the logger saw it
  Msg message;
};

struct ChannelCount {
  int64_t messages = 0;
  int64_t undecodable = 0;
};

// Something a service's health said, numbers in it aside.
struct HealthWords {
  std::string message;  // as it was first said
  int8_t state = 0;     // of health_t, the worst with it
  int64_t first = 0;    // utime
  int heartbeats = 0;   // that said it
};

struct FlightRecord {
  std::optional<EnuFrame> frame;  // none when the log holds no position at all
  Reference truth;
  Reference gnss;
  std::map<int64_t, int64_t> images;  // utime -> when the logger saw it
  std::vector<Logged<vio_state_t>> vio;
  std::vector<vio_keyframe_t> keyframes;  // without their features
  std::vector<map_fix_t> fixes;
  std::vector<Logged<nav_state_t>> nav;                          // at the images' times
  std::vector<Logged<nav_state_t>> nav_inertial;                 // between them, at the inertial sensor's rate
  std::map<std::string, health_t> health;                        // the last of each service
  std::map<std::string, std::vector<HealthWords>> health_words;  // in the order they were first said
  std::map<std::string, ChannelCount> channels;
  int64_t skipped_bytes = 0;  // of the log that are no event
  int64_t begin = 0;          // utime of the first measurement
  int64_t end = 0;

  // Seconds since `begin`.
  double seconds(int64_t utime) const { return 1e-6 * static_cast<double>(utime - begin); }
  bool has(const std::string& channel) const { return channels.count(channel) > 0; }

  // Throws std::runtime_error naming the file when it cannot be opened or holds nothing of a flight.
  static FlightRecord read(const std::filesystem::path& log);
};

Eigen::Vector3d vector_of(const double (&v)[3]);
Eigen::Quaterniond quaternion_of(const double (&q)[4]);

// Position of a valid fix or a located navigation state in the frame; nullopt when it has none.
std::optional<Eigen::Vector3d> position_of(const EnuFrame& frame, const map_fix_t& fix);
std::optional<Eigen::Vector3d> position_of(const EnuFrame& frame, const nav_state_t& nav);

}  // namespace orthonav::evaluate
