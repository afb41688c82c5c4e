// From a place on the map to a pose: the points' matches, aligned to a fraction of a pixel, and what fits them best.
//
// First in two dimensions: translation, a small turn and scale put the submap's points onto the map's features nearest
// in looks, robustly and with what is known beforehand of heading and scale. Each match is then aligned: the point's
// descriptor, shifted by fractions of a map pixel in its own image, is compared with that of the map features around
// it, which puts the point between them. Last the pose of the newest body, (10), from the points' rays: PnP with the
// direction of gravity, the heading, the odometry's scale and the map's heights as priors.
#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "services/registration/fix.h"
#include "services/registration/map/map_index.h"
#include "services/registration/submap/ground_level.h"
#include "services/registration/submap/place_search.h"
#include "services/registration/submap/view.h"

namespace orthonav::registration {

struct FitOptions {
  // m over the height: by how much all that a keyframe sees is stretched together on the map. Patches show what stands
  // on the ground leaning outward, the map does not.
  double lean = 2.0;
  double tilt_stddev = 0.3 * M_PI / 180;  // rad per axis, of the odometry's vertical
  double map_stddev = 0.35;             // m, each of east and north: georeferencing error of the map (0.5 in the plane)
  double ground_height_stddev = 0.7;    // m, of the map's heights, averaged along the way
  double matches_per_observation = 30;  // so many matches of a keyframe count as one, and so do those of the same point
  double min_excess = 2.0;              // standard deviations of similarity a match has at least
};

// What is known of the alignment before points are compared with the map.
struct FitPrior {
  Alignment alignment;           // against what the newest view was described with
  double heading_stddev = 0.05;  // rad
  double scale_stddev = 0.025;   // relative
  // What all matches err by together in turn, rad: a patch described under another fits best where that puts it.
  double common_stddev = 0.01;
};

// A point and the place on the map it was matched with.
struct PlacedPoint {
  int view = 0;   // 0 is the newest
  int point = 0;  // in View::points
  int feature = -1;
  Eigen::Vector2d en = Eigen::Vector2d::Zero();        // m
  double ground = 0;                                   // m, the map's height there
  double weight = 1;                                   // of the robust fit, 0 ... 1
  Eigen::Vector2d residual = Eigen::Vector2d::Zero();  // m
};

struct PlaceFit {
  bool ok = false;
  Eigen::Vector2d en = Eigen::Vector2d::Zero();  // m in G, of the newest body
  Alignment alignment;
  double turn_stddev = 0;
  // What the matches alone say, of the true scale: `alignment` has that which the map is seen under.
  ScaleBelief scale;
  std::vector<PlacedPoint> points;
  double inliers = 0;  // sum of the weights
  double rms = 0;      // m, of the inliers
};

// `views` with the newest first, whose yaw alignments refer to. `place` and `alignment` are where to begin.
PlaceFit fit_place(const std::vector<const View*>& views, const MapIndex& index, double metres_per_pixel,
                   const Eigen::Vector2d& place, const Alignment& alignment, const FitPrior& prior,
                   const FitOptions& options);

struct FittedPose {
  bool ok = false;
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_G_B = Eigen::Quaterniond::Identity();
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // m^2
  double scale = 1, scale_stddev = 0;
  double yaw = 0, yaw_stddev = 0;  // rad, of W in G
  Upright upright;
};

// What the views before the newest say of the height over the map's ground, all their points put where the fit has
// them: who finds its place over a wood may have flown over its edge before. `views`: newest first.
GroundLevel ground_along(const std::vector<const View*>& views, const PlaceFit& fit, const ScaleBelief& scale,
                         const MapIndex& index, const FitOptions& options);

// `scale` is all that is known of it, the fit's matches included, and `ground` what the keyframes before said of the
// height. Throws nothing; ok is false when the equations cannot be solved.
FittedPose fit_pose(const std::vector<const View*>& views, const PlaceFit& fit, const FitPrior& prior,
                    const ScaleBelief& scale, const FitOptions& options, GroundLevel& ground);

}  // namespace orthonav::registration
