// Which fixes agree with each other about the motion that the odometry saw between them.
//
// Wrong fixes come in runs (the same field looks like the next one), so that a single fix proves nothing and a robust
// loss is not enough. But a wrong place seldom moves with the aircraft for long. This is the evidence for a first lock,
// and for leaving a wrong one.
#pragma once

#include <limits>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "common/geo/enu_frame.h"
#include "services/fusion/agreement.h"
#include "services/fusion/factors.h"
#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// A fix beside the odometry's pose at the same keyframe.
struct Sighting {
  Keyframe keyframe;
  Fix fix;
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();           // the fix in the graph's G, under the odometry's vertical
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();  // of what it does not share with its neighbours
  Lever lever = Lever::Zero();                               // by which p_G_B moves with that vertical
  double yaw_G_W = 0.0;                                      // rad, from the fix's heading
  double yaw_stddev = 0.0;                                   // rad
  double scale_stddev = 0.0;                                 // of the odometry's scale there, as a fraction

  // Fills in p_G_B.
  void place_in(const EnuFrame& frame);
};

// m: fixes no further apart than this speak for one place, and disagree on where in it (registration: second_distance).
inline constexpr double kPlaceSize = 15.0;

// Square of the Mahalanobis distance between the motion of the fixes and that of the odometry, from a to b.
double disagreement(const Sighting& a, const Sighting& b, const FusionOptions& options);

struct Consensus {
  std::vector<size_t> members;  // indices, growing; the newest sighting is among them
  Agreement agreement;
  // Of the likeliest set that agrees among the others, on a place further than a place is wide.
  double rival_log_odds = -std::numeric_limits<double>::infinity();

  // That it is this place and none of the others.
  double log_odds(const FusionOptions& options) const;
};

// The likeliest set of sightings that all agree with the last one and with one of them; nullopt where even all that
// agree with the last one together are less sure than `at_least`. Linear in their number then, quadratic otherwise.
std::optional<Consensus> find_consensus(const std::vector<Sighting>& sightings, double at_least,
                                        const FusionOptions& options);

// Rotation about z and translation from W to G that fits the members best: their mean.
struct Placement {
  double yaw_G_W = 0.0;
  Eigen::Vector3d p_G_W = Eigen::Vector3d::Zero();
};
Placement place(const std::vector<Sighting>& members);

}  // namespace orthonav::fusion
