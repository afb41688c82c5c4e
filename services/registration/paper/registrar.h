// Registers keyframes to the map: the method of the paper, equations (5)-(10), and its two comparison methods.
//
//   paper  matches the descriptors of tracked corners; each match votes a translation of the odometry's points (8);
//          the winner's inliers are shifted onto the map (9) and PnP gives the camera's pose (10).
//   m1     registers the image, not the points: the same descriptors, but a match votes the translation of the turned
//          and scaled image, as if it were a map of flat ground seen from above. What the image's centre lies on,
//          the camera's attitude and its height give the position. Relief and perspective stay in the votes.
//   m2     is m1 with the SIFT detector choosing points, orientations and sizes in the image and in the map
//          (a map with features: sift).
//
// The stages are separate calls so that the caller can time them.
#pragma once

#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/camera/camera_model.h"
#include "common/config/config.h"
#include "services/registration/fix.h"
#include "services/registration/method.h"
#include "services/registration/paper/matcher.h"
#include "services/registration/paper/query.h"
#include "services/registration/paper/voting.h"
#include "services/registration/types.h"

namespace orthonav::registration {

// Standard deviations that the covariance of a fix is made of, beside the scatter of its matches.
struct ErrorModel {
  double map_stddev = 0.5;            // m, each of east and north: georeferencing error of the map
  double ground_height_stddev = 2.0;  // m: of the map's heights
  double scale_stddev = 0.02;         // of the odometry's scale, relative
  // Matches of one keyframe do not err independently: patches overlap, and a season moves shadows all one way. So
  // many count as one. Over the fixes of three simulated flights the squared normalised horizontal error then has the
  // mean 2.1 (2 degrees of freedom); with 3 it was 3.3.
  double matches_per_observation = 5;
};

struct RegistrarOptions {
  MethodName method = MethodName::kSubmap;
  QueryOptions query;
  MatcherOptions matcher;
  VotingOptions voting;
  int min_inliers = 15;                    // a fix has at least so many
  double max_tilt_difference = M_PI / 30;  // rad, between PnP's vertical and the odometry's
  ErrorModel errors;

  // Reads `method`, `query`, `matcher`, `voting`, `pose` and `errors` of registration.yaml. Throws ConfigError.
  static RegistrarOptions from_config(ConfigNode& node);
};

class Registrar {
 public:
  Registrar(const RegistrarOptions& options, const CameraModel& camera);

  const RegistrarOptions& options() const { return options_; }
  bool has_map() const { return matcher_.has_value(); }

  // Takes a map and builds its search trees. Throws std::invalid_argument when it is empty or its features are of
  // the other kind than the method needs.
  void set_map(MapFeatures features, const MapGeometry& geometry);
  void clear_map();

  // (5), (6). As make_query. Throws std::logic_error without a map, as match and solve do.
  Query describe(const Keyframe& keyframe, const cv::Mat& image, const Heading& heading) const;

  // Nearest map feature of each query point. Empty for a refused query.
  std::vector<DescriptorMatch> match(const Query& query);

  // (7), (8): where each match says that W's origin lies, or with m1 and m2 the image's centre, m in G.
  std::vector<Eigen::Vector2d> votes(const Keyframe& keyframe, const Query& query,
                                     const std::vector<DescriptorMatch>& matches) const;

  // (9), (10). `votes`: of the matches. A refused query gives a fix with its reason.
  Fix solve(const Keyframe& keyframe, const Query& query, const std::vector<DescriptorMatch>& matches,
            const std::vector<Eigen::Vector2d>& votes, const Heading& heading) const;

  Fix solve(const Keyframe& keyframe, const Query& query, const std::vector<DescriptorMatch>& matches,
            const Heading& heading) const {
    return solve(keyframe, query, matches, votes(keyframe, query, matches), heading);
  }

  // Where the body is, horizontally in G, less the place that its keyframe's votes say.
  Eigen::Vector2d body_from_vote(const Keyframe& keyframe, const Query& query) const;

  // m^2 that the map's features lie in.
  double map_area() const;

 private:
  void place_by_points(const Keyframe& keyframe, const Query& query, const std::vector<DescriptorMatch>& inliers,
                       const Heading& heading, const Eigen::Matrix2d& scatter, Fix& fix) const;
  void place_by_image(const Keyframe& keyframe, const Query& query, const std::vector<DescriptorMatch>& inliers,
                      const Heading& heading, const Eigen::Matrix2d& scatter, Fix& fix) const;
  Eigen::Vector2d vote_of(const Keyframe& keyframe, const Query& query, const DescriptorMatch& match) const;
  Eigen::Matrix3d covariance(const Eigen::Vector3d& lever, const Heading& heading, const Eigen::Matrix2d& scatter,
                             size_t num_inliers) const;
  const Eigen::Vector3f& map_position(const DescriptorMatch& match) const;

  RegistrarOptions options_;
  CameraModel camera_;
  MapGeometry geometry_;
  std::vector<Eigen::Vector3f> positions_;
  std::optional<FlannMatcher> matcher_;
};

}  // namespace orthonav::registration
