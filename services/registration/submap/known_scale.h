// What is known of the odometry's scale from fix to fix: true length over the odometry's.
//
// Three say something: the odometry of itself, the newest fix's matches, and the way over the map (scale_of_way.h),
// which tells it best. What the matches say is kept apart until a fit is done: drawn to a scale they are sought, and
// found, where that has them. Nothing outlives what it was learnt under: each keyframe without a fix makes it as
// doubtful as the place, and where the points that stay aligned have become few, the scale may have changed. Not
// thread-safe; a value.
#pragma once

#include <optional>
#include <vector>

#include "services/registration/submap/place_fit.h"
#include "services/registration/submap/place_search.h"
#include "services/registration/submap/view.h"
#include "services/registration/types.h"

namespace orthonav::registration {

// What a measurement of the scale and the odometry, which says that its own is right to `odometry_stddev`, say
// together: mean and deviation of the product of a Gaussian and, for whoever states a deviation may be wrong in that, a
// Cauchy distribution. Where the two contradict each other it is as wide as they are apart, until the measurement
// outweighs.
ScaleBelief with_odometry(const ScaleBelief& measured, double odometry_stddev);

class KnownScale {
 public:
  // `usual_stddev`: of the odometry's scale where it does not say, and for which it is sought on the whole map. A fix's
  // deviation grows by `widening` with each keyframe without one, `most_misses` times at most.
  KnownScale(double usual_stddev, double widening, int most_misses);

  // A new session of the odometry: another scale.
  void forget();
  // What fixes taught, but not what the points' alignment was like.
  void forget_fixes();
  // The odometry's own word, with each keyframe; NaN: it has none.
  void hear(double odometry_stddev);
  // Of the points, how many stayed aligned at the place found.
  void saw(double aligned_share);
  void missed();
  void learn(const PlaceFit& fit);
  // Asks the way over the map to the fit, where `spacing` (m in W) was flown since it was asked last or the fit
  // contradicts what it said. `views`: newest first, of which the first `fitted` are those of the fit.
  void ask_the_way(const std::vector<const View*>& views, size_t fitted, double spacing, const PlaceFit& fit,
                   const MapIndex& index, const EvidenceOptions& evidence, const FitOptions& options);

  bool is_fitted() const { return fitted_.has_value(); }
  // Under which a keyframe is described and looked for.
  const ScaleBelief& expected() const { return expected_; }
  // How far from it, 1 sigma. `everywhere`: on the whole map; `taught`: by so many fixes that they are believed.
  double searched_stddev(bool everywhere, bool taught) const;
  // To begin a fit with, and after it, with what its matches say.
  ScaleBelief before_fit() const;
  ScaleBelief after_fit(const PlaceFit& fit) const;

  // How fast the scale may change, at least, 1 sigma.
  static constexpr double kLeastStddev = 0.01;

 private:
  // Of the map alone.
  ScaleBelief measured(const PlaceFit& fit) const { return way_ ? both(*way_, fit.scale) : fit.scale; }
  bool may_have_changed() const;
  double odometry_stddev() const;
  void expect();

  double usual_stddev_, widening_;
  int most_misses_;
  double odometry_stddev_;                    // as heard; NaN: unknown
  std::optional<ScaleBelief> fitted_;         // by the newest fix, without the odometry's word
  std::optional<ScaleBelief> way_;            // by the way to it
  std::optional<Eigen::Vector2d> way_asked_;  // m in W, where it was, since the last keyframe without a fix
  double aligned_of_late_ = 0, aligned_ = 0;  // shares of the points, at the place found last and in the mean
  int misses_ = 0;                            // since the last fix
  ScaleBelief expected_;                      // of the others: it is asked for every view of a search
};

}  // namespace orthonav::registration
