// What the ground that a submap has seen says for a place of the map, against ground of no relation.
//
// A keyframe looks like a place by the sum of what its points say there (place_search.h). How much that tells depends
// on what the same points look like elsewhere: a field of one texture looks like every such field, and a hundred points
// of it say nothing. So a keyframe's likeness counts less the logarithm of the mean of its exponential over places
// drawn evenly over the map: over places of no relation the expectation of what is left, as a likelihood, is one,
// whatever the ground, and nothing that was chosen by chance becomes likelier than there are places to choose from.
//
// Witnesses are counted by ground, not by points. Of those within one cell of the map one counts, whichever keyframe
// saw it first; those whose patches overlap share what one of them would count. What is left, that neighbours err
// together, is tempered.
//
// Immutable after construction; refers to the views and the index.
#pragma once

#include <vector>

#include <Eigen/Core>

#include "services/registration/map/map_index.h"
#include "services/registration/submap/place_search.h"
#include "services/registration/submap/view.h"

namespace orthonav::registration {

// A point of a view, and what it counts.
struct Witness {
  const ViewPoint* point;
  float weight;
};

// Of one keyframe.
class PlaceEvidence {
 public:
  // G_W takes horizontal offsets in W to G, scale included, as the view is held against the map. `temperature`: by
  // which what points say is divided.
  PlaceEvidence(const View& view, std::vector<Witness> witnesses, const Eigen::Matrix2d& G_W, const MapIndex& index,
                double temperature, const EvidenceOptions& options);

  // How much likelier what was seen is with the view's body above `en` (m in G) than anywhere: a logarithm.
  double log_likelihood_ratio(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W) const;

 private:
  // Tempered; a cell to either side is the same place.
  double likeness(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W) const;

  const View* view_;
  std::vector<Witness> witnesses_;
  const MapIndex* index_;
  double temperature_;
  EvidenceOptions options_;
  double anywhere_ = 0;  // logarithm of the mean exponential of the likeness
};

// Of all keyframes of a submap, held together by the odometry.
class SubmapEvidence {
 public:
  // `views`: newest first, their keyframes in one W.
  SubmapEvidence(const std::vector<const View*>& views, const Eigen::Matrix2d& G_W, const MapIndex& index,
                 double temperature, const EvidenceOptions& options);

  // `en`: of the newest body, m in G.
  double log_likelihood_ratio(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W) const;

 private:
  struct Seen {
    Eigen::Vector2d way;  // m in W, from the newest body
    PlaceEvidence evidence;
  };
  std::vector<Seen> seen_;
};

}  // namespace orthonav::registration
