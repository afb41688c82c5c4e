// Where the aircraft is on Earth, from an odometry that drifts and fixes that are sometimes wrong.
//
// Feed keyframes and fixes as they come and ask for a solution at every odometry state:
//
//        keyframes            fixes that agree          a fix within the gate
//   (new session)──► DEAD_RECKONING ──────────► MAP_AIDED ◄──────────────────┐
//                         ▲    first lock          │  no fix for a while  │
//                         └────────────────────────┤                      │
//                              new session         └─────► COASTING ──────┘
//
// Before the lock, poses are in W and there is no geodetic position. The first lock needs some fixes that agree about
// the motion between them; then the trajectory jumps onto the map. After it, each fix is tested against the graph's own
// prediction. Fixes are remembered whether believed or not, and when more of the newest ones agree on another place
// than are in the graph, it was the lock that was wrong: the segment is placed anew. A fix belongs to its own keyframe,
// however late it comes.
//
// A fix of a map with another anchor is converted: G stays where the segment was locked.
//
// Deterministic, no clock, not thread-safe. Bad input is reported by its Outcome and changes nothing.
#pragma once

#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "common/geo/enu_frame.h"
#include "services/fusion/consensus.h"
#include "services/fusion/options.h"
#include "services/fusion/pose_graph.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

class Fusion {
 public:
  explicit Fusion(const FusionOptions& options);

  // kUsed, kJump (a new segment starts here), kBadNumber, kOldSession or kDuplicate.
  Outcome add_keyframe(const Keyframe& keyframe);

  // Any outcome but kJump. kUsed, kLocked and kRelocked have solved the graph.
  Outcome add_fix(const Fix& fix);

  struct Propagated {
    Outcome outcome = Outcome::kUsed;  // kUsed, kBadNumber, kJump or kOldSession
    Solution solution;                 // in mode kWaitingForVio and all unknown unless kUsed with a pose
  };
  // The solution at an odometry state: the newest node moved on by the odometry.
  Propagated propagate(const OdometryState& state);

  bool locked() const { return graph_ != nullptr; }
  int graph_size() const { return graph_ ? graph_->size() : 0; }
  // True displacement over the odometry's at the newest node; NaN before the lock.
  double scale() const;

 private:
  void start_segment(int session);
  std::optional<Sighting> sight(const Fix& fix, Outcome& refused) const;
  void remember(const Sighting& sighting, bool accepted);
  bool try_lock();
  bool try_relock();
  bool lock_on_consensus(size_t needed);
  void lock(const std::vector<Sighting>& members);
  bool within_gate(const Sighting& sighting) const;
  void use(const Sighting& sighting);
  void solve_and_watch_for_jump();
  Solution located(const OdometryState& state, Solution solution) const;

  FusionOptions options_;
  int session_ = 0;
  int reset_counter_ = 0;
  bool has_output_ = false;  // a pose has been given out
  std::optional<OdometryState> last_state_;

  // The segment.
  std::map<int, Keyframe> keyframes_;  // by id; as many as the window holds
  std::map<int, int64_t> fixed_;       // keyframes that a fix has been seen of, with its time
  std::optional<EnuFrame> frame_;      // G, once locked
  std::unique_ptr<PoseGraph> graph_;   // once locked
  std::vector<Sighting> memory_;       // the newest fixes, believed or not
  std::vector<bool> accepted_;         // which of them are in the graph
  int num_fixes_ = 0;
  int64_t newest_fix_utime_ = 0;
};

}  // namespace orthonav::fusion
