// Where on the map a submap can be: the likelihood of places, and the best of them.
//
// Equation (8) lets each match vote a translation. Here every map feature is a match, weighted by how much its
// similarity stands out from what chance gives the point: the votes of all points with all features add up to the
// likelihood of each place. A place is where the newest keyframe's body is above. What a wrong heading or scale would
// do to the votes is covered by trying several of them.
//
// Over large areas the search works on the index' coarse grid first; the best places there are then compared at full
// resolution. Around an expected place it works at full resolution at once.
#pragma once

#include <limits>
#include <optional>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "services/registration/map/map_index.h"
#include "services/registration/submap/dot_products.h"
#include "services/registration/submap/view.h"

namespace orthonav::registration {

// How the odometry's world may lie on the map other than assumed.
struct Alignment {
  double turn = 0;   // rad about z, counter-clockwise, on top of View::yaw
  double scale = 1;  // true size over the odometry's

  // Takes horizontal offsets in W to G.
  Eigen::Matrix2d from_W(double yaw) const { return scale * Eigen::Rotation2Dd(yaw + turn).toRotationMatrix(); }
};

// Alignments two standard deviations to both sides, so close that points at a distance `lever` (m) move by no more than
// `step` (m) between neighbours. The first is the expected one.
std::vector<Alignment> alignments(const Alignment& expected, double turn_stddev, double scale_stddev, double lever,
                                  double step);

// Part of the map that is searched: a square around a place, m.
struct SearchArea {
  Eigen::Vector2d centre = Eigen::Vector2d::Zero();
  double radius = std::numeric_limits<double>::infinity();
};

struct EvidenceOptions {
  double threshold = 1;  // standard deviations above the mean from which a likeness counts
  double limit = 16;     // the most that one point can say
};

// What a point of this background says by its product with a feature.
EvidenceLine line_of(const Background& background, const EvidenceOptions& options);

// Likelihood of places on the coarse grid as one keyframe sees it, one picture for each alignment.
struct CoarseLikelihood {
  std::vector<Alignment> alignments;
  int first_row = 0, first_column = 0, rows = 0, columns = 0;  // cells of the coarse grid
  float unit = 1;                                              // log-likelihood of one count
  std::vector<std::vector<uint16_t>> sums;                     // rows x columns each, in units
};

CoarseLikelihood coarse_likelihood(const View& view, const MapIndex& index, const std::vector<Alignment>& candidates,
                                   const SearchArea& area, const EvidenceOptions& options);

struct PlaceCandidate {
  Eigen::Vector2d en = Eigen::Vector2d::Zero();  // m in G, of the newest body
  size_t alignment = 0;                          // index
  double likelihood = 0;
};

// Adds up the likelihoods of keyframes, the newest first, each shifted to where it says the newest is, and gives the
// best places, the best first, each at least `separation` (m) from those before it. `candidates` refer to the newest's
// yaw; of each keyframe the picture counts whose alignment is closest.
struct ShiftedLikelihood {
  const CoarseLikelihood* likelihood;
  Eigen::Vector3d p_W_B;  // of its keyframe
  double yaw;             // rad, that its alignments refer to
};
std::vector<PlaceCandidate> best_coarse_places(const std::vector<ShiftedLikelihood>& keyframes, const MapIndex& index,
                                               const std::vector<Alignment>& candidates, double separation, int count);

// Best places at full resolution within `radius` of `centre`, the best first and at least `separation` apart.
std::vector<PlaceCandidate> best_fine_places(const std::vector<const View*>& views, const MapIndex& index,
                                             const std::vector<Alignment>& candidates, const Eigen::Vector2d& centre,
                                             double radius, double separation, int count,
                                             const EvidenceOptions& options);

// The place within `radius` of `centre` that the keyframes look most like, all of them where the odometry has them.
Eigen::Vector2d likeliest_place(const std::vector<const View*>& views, const MapIndex& index,
                                const Alignment& alignment, const Eigen::Vector2d& centre, double radius,
                                const EvidenceOptions& options);

// The same between cells; nothing where it looks likeliest at the border, which is no peak.
std::optional<Eigen::Vector2d> peak_near(const std::vector<const View*>& views, const MapIndex& index,
                                         const Alignment& alignment, const Eigen::Vector2d& centre, double radius,
                                         const EvidenceOptions& options);

}  // namespace orthonav::registration
