// Where the aircraft is on Earth, from an odometry that drifts, fixes that are sometimes wrong, a compass and an
// inertial sensor.
//
// Feed everything as it comes; ask for a solution at every odometry state and at every inertial sample.
//
// Before the first lock, poses are in W and there is no geodetic position. A lock needs fixes that agree about the
// motion between them and are sure together (agreement.h): one that is sure by itself, or several over some way; then
// the trajectory jumps onto the map. After it, each fix is tested against the graph's own prediction. Fixes that are
// not believed are remembered: the place that they agree on stands against the solution's by the same odds. While it
// may be right the protection level reaches there, when it is likelier the mode says LOST, and when it is sure the
// segment is placed anew. A fix belongs to its own keyframe, however late it comes.
//
// A new session of the odometry is a new W and a new segment of the graph. If the inertial sensor has carried the
// position across, the segment begins there with the sensor's uncertainty, and is COASTING until a fix agrees, or two
// where it is wide; else it has to find its place again.
//
// A fusion that was killed leaves a Memory. Another one goes on from it when the odometry's session is still the same,
// has moved on plausibly and the memory is not too old. Its position is COASTING until one fix agrees with it. To move
// it elsewhere takes what it would have taken without the kill: a run of wrong fixes is likelier than a wrong memory.
//
// A fix of a map with another anchor is converted: G stays where the segment was locked.
//
// Deterministic, no clock, not thread-safe. Bad input is reported by its Outcome and changes nothing.
#pragma once

#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "common/geo/enu_frame.h"
#include "services/fusion/consensus.h"
#include "services/fusion/inertial.h"
#include "services/fusion/memory.h"
#include "services/fusion/mode.h"
#include "services/fusion/options.h"
#include "services/fusion/pose_graph.h"
#include "services/fusion/protection.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

class Fusion {
 public:
  explicit Fusion(const FusionOptions& options);

  // kUsed, kJump (a new segment starts here), kBadNumber, kOldSession or kDuplicate.
  Outcome add_keyframe(const Keyframe& keyframe);

  // Any outcome but kJump. kUsed, kLocked and kRelocked have solved the graph.
  Outcome add_fix(const Fix& fix);

  // kUsed, kBadNumber or kOutOfOrder. It counts with the next keyframe near it, if it passes the innovation test.
  Outcome add_compass(const CompassReading& reading);

  struct Propagated {
    Outcome outcome = Outcome::kUsed;  // kUsed, kBadNumber, kOutOfOrder, kJump or kOldSession
    Solution solution;                 // unless kUsed with a pose: all unknown
  };
  // The solution at an odometry state: the newest node moved on by the odometry.
  Propagated propagate(const OdometryState& state);

  struct Carried {
    Outcome outcome = Outcome::kUsed;  // kUsed, kBadNumber or kOutOfOrder
    std::optional<Solution> solution;  // only with a position on the map
  };
  // The solution at an inertial sample: the newest odometry state moved on by the inertial sensor.
  Carried add_imu(const ImuSample& sample);

  // What another one needs to go on; nullopt without a position on the map.
  std::optional<Memory> memory() const;
  // To be called before anything else. What comes next decides whether it is gone on with: if not, this is a fusion
  // that knows nothing, but the reset counter. False for a memory of impossible numbers, which is forgotten.
  bool resume(const Memory& memory);
  // Whether the position was carried across a restart, and fixes have yet to confirm it.
  bool unconfirmed() const { return to_confirm_ > 0; }

  bool locked() const { return graph_ != nullptr; }
  int graph_size() const { return graph_ ? graph_->size() : 0; }
  int compass_rejected() const { return compass_rejected_; }
  // True displacement over the odometry's at the newest node; NaN before the lock.
  double scale() const;

 private:
  // A keyframe with the compass's reading near it.
  struct Waypoint {
    Keyframe keyframe;
    std::optional<CompassReading> compass;  // heading: true
  };

  void start_segment(int session);
  void go_on(int session, int64_t utime, const Eigen::Vector3d& p_W_B);
  void leave_map();
  std::optional<CompassReading> compass_near(int64_t utime) const;
  double compass_noise(const CompassReading& reading) const;
  void append(const Waypoint& waypoint);
  double scale_stddev_at(const Keyframe& keyframe) const;
  std::optional<Sighting> sight(const Fix& fix, Outcome& refused) const;
  bool try_lock();
  bool try_relock();
  void lock(const std::vector<Sighting>& members);
  bool within_gate(const Sighting& sighting) const;
  void add_tilt(const Sighting& sighting);
  void use(const Sighting& sighting);
  void believe(const Sighting& sighting);
  std::vector<Sighting> those_of(const Consensus& consensus) const;
  void forget_rival();
  void reckon_with(const Located& rival, int64_t utime, double log_odds);
  void solve_and_watch_for_jump();
  void update_newest();
  void doubt_way(int64_t utime);
  // m^2 per axis, by which a position may be off that is said to move at `v` (m/s) now; 0 where nothing is astray.
  double astray_variance(int64_t utime, const Eigen::Vector3d& v) const;
  void start_bridge(const OdometryState& state);
  void try_bridge();
  Solution located(const OdometryState& state, Solution solution);
  Solution carried(const InertialState& state);
  void judge(Solution& solution, bool odometry, bool blind);

  FusionOptions options_;
  int session_ = 0;
  int reset_counter_ = 0;
  bool is_loss_counted_ = false;  // by the reset counter: the next lock is the same jump
  int moves_ = 0;
  bool has_output_ = false;  // a pose has been given out
  int compass_rejected_ = 0;
  int64_t session_utime_ = 0;  // of the session's first keyframe
  std::optional<OdometryState> last_state_;
  std::deque<CompassReading> compass_;  // headings: true
  Inertial inertial_;
  int64_t odometry_utime_ = 0;  // of the newest odometry state with a position on the map
  ModeMachine modes_;

  // The segment.
  std::map<int, Waypoint> waypoints_;  // by keyframe id; as many as the window holds
  std::map<int, int64_t> fixed_;       // keyframes that a fix has been seen of, with its time
  std::optional<EnuFrame> frame_;      // G, once locked
  std::unique_ptr<PoseGraph> graph_;   // once locked
  std::vector<Sighting> waiting_;      // before the lock: the newest fixes; after it: those not believed
  std::optional<Located> rival_;       // where those agree to be, moved on to the newest node
  int64_t rival_utime_ = 0;
  double rival_log_odds_ = 0.0;  // of their place, by themselves
  bool rival_is_likelier_ = false;
  Agreement believed_;                          // of the fixes since the lock
  Agreement confirming_;                        // of those of them that this very fusion has seen
  std::optional<Eigen::Vector3d> tilted_from_;  // p_W_B of the newest whose tilt is in the graph
  int num_fixes_ = 0;
  int64_t newest_fix_utime_ = 0;
  Estimate newest_;   // of the newest node
  Protection level_;  // there
  std::optional<Solution> last_located_;

  // After a restart of the fusion.
  std::optional<Memory> memory_;  // to be gone on with
  int to_confirm_ = 0;            // fixes to be believed before a position that was carried across counts as map-aided
  // Where the odometry lost sight of all that it had seen, until a fix agrees: from then on the aircraft may have flown
  // elsewhere than the odometry says.
  struct Astray {
    int64_t utime = 0;
    double speed = 0.0;     // m/s, before
    double in_graph = 0.0;  // m^2 per axis, of what it may be off by, that the graph's keyframes have
    bool turn_in_graph = false;
  };
  std::optional<Astray> astray_;

  // While the odometry restarts.
  std::optional<Estimate> before_;  // newest node of the segment before
  std::optional<Estimate> bridge_;  // where the new session's first state stands: state with p_G_B, yaw of its W
  Eigen::Vector3d bridge_p_W_B_ = Eigen::Vector3d::Zero();
};

}  // namespace orthonav::fusion
