// Method "submap": registers the points of the last several keyframes together, the one orthonav ships with.
//
// A keyframe's points are described in its own image (view.h). The place of the newest keyframe is where the points of
// all of them, held together by the odometry, look most like the map (place_search.h): around the expected position
// where the fusion has one, over the whole map where it has none, and over ever more of it while no place convinces.
// Over the whole map the submap is as long as it can be: of the older keyframes those are kept that see new ground.
// There, until a fix has told the heading, and where the compass's heading leads to no clear place, the submap is
// described and searched for under headings further off too, out to 4.5 of the compass's standard deviations; without a
// compass under all. submap.cpp and submap_search.cpp have this much, submap_fix.cpp what
// follows: a fit of translation, turn and scale and a pose with priors (place_fit.h). What each place has to say for
// itself is place_evidence.h's, which of them is believed place_belief.h's, what is known of the odometry's scale
// known_scale.h's.
//
// Not thread-safe; deterministic.
#pragma once

#include <cmath>
#include <deque>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "common/camera/camera_model.h"
#include "common/config/config.h"
#include "services/registration/fix.h"
#include "services/registration/method.h"
#include "services/registration/submap/known_scale.h"
#include "services/registration/submap/place_evidence.h"
#include "services/registration/submap/place_fit.h"
#include "services/registration/submap/place_search.h"
#include "services/registration/submap/view.h"

namespace orthonav::registration {

struct SubmapOptions {
  QueryOptions query;
  int max_keyframes = 16;         // of a submap that is searched for everywhere
  double keyframe_spacing = 0.2;  // between those that no poses are made of, share of the height above ground
  int pose_keyframes = 4;         // the newest of them, of which poses are made, and that are searched for nearby
  bool search_heading = false;    // true: the compass is not asked
  double bound_stddevs = 4;       // the search covers so many standard deviations of the expected position
  double min_radius = 15;         // m, and at least this
  double widening = 1.5;          // factor of the radius for each keyframe without a fix
  double second_distance = 15;    // m: places further from the best are other places
  double scale_stddev = 0.025;    // of the odometry's scale: sought on the whole map, and where it does not say
  double probability = 0.999;     // of a place that is believed
  double temperature = 6.5;       // by which what points say of a place is divided: neighbours err together
  int min_inliers = 8;            // of a fix
  int coarse_places = 12;         // of the coarse grid that are compared at full resolution
  EvidenceOptions evidence;
  FitOptions fit;

  // Reads `query` and `submap` of registration.yaml. Throws ConfigError.
  static SubmapOptions from_config(ConfigNode& node);
};

class SubmapRegistrar : public Method {
 public:
  SubmapRegistrar(const SubmapOptions& options, const CameraModel& camera);

  bool has_map() const override { return index_ != nullptr; }
  // The submap goes on where it can be compared with the map. Throws std::invalid_argument as MapIndex does, and for a
  // map without a keypoint size.
  void set_map(MapFeatures features, const MapGeometry& geometry) override;
  void clear_map() override;
  void hint(const ExpectedArea& area) override { expectations_.hint(area); }
  bool describe(const Keyframe& keyframe, int session, const cv::Mat& image, const Heading& heading) override;
  void search(const std::optional<PositionPrior>& prior) override;
  Fix solve() override;
  const PlaceBelief& belief() const override { return belief_; }

 private:
  static constexpr int kTaught = 4;
  static constexpr double kFineRadius = 32;  // m, the largest that is searched at full resolution at once
  // Between the headings that a place is looked for under where nothing is known of it, rad: a descriptor stands half
  // of it.
  static constexpr double kHeadingStep = 15 * M_PI / 180;
  // Between the headings that are tried beside the compass's, or beside one that a place was found under, rad.
  static constexpr double kTurnStep = 9 * M_PI / 180;
  // What is described under another one than so near to the compass's, in its standard deviations, is not its word.
  static constexpr double kOfTheCompass = 2;

  // A keyframe as described under one assumption on the heading, and what it says of every place.
  struct Variant {
    std::unique_ptr<View> view;
    std::optional<CoarseLikelihood> everywhere;
  };
  struct Remembered {
    cv::Mat image;
    std::vector<Variant> variants;  // one for each heading tried so far; after a search as many for all keyframes

    const Keyframe& keyframe() const { return variants.front().view->keyframe; }
  };
  // A place, the heading it was found under, and the hypothesis that it is.
  struct Place {
    Eigen::Vector2d en;
    Alignment alignment;
    double likelihood = 0;
    size_t variant = 0;
    std::optional<double>
        evidence;  // log-likelihood ratio of the submap against ground of no relation; unset: not weighed
  };
  struct Candidate {
    Place place;
    PlaceFit fit;
  };
  // Headings to be tried, less what is known of it (`yaw`), by variant: counter-clockwise, rad, the first 0.
  std::vector<double> turns() const;
  // Rotation about z that takes W to G, as fixes have it or else the compass.
  double yaw() const { return fitted_yaw_.value_or(compass_yaw_); }
  bool follow_points(const Keyframe& keyframe);
  // With what comes: of what was seen before nothing is known any more.
  void begin_anew();
  // How far from the newest body (m) a turn counts, for alignments that are to miss nothing.
  static double lever_of(const std::vector<const View*>& views) { return 1.5 * spread_of(views); }
  Variant described(const Keyframe& keyframe, const cv::Mat& image, double turn) const;
  // Describes the keyframes under those of the turns under which they are not yet.
  void describe_turned(const std::vector<double>& turns);
  // Of keyframes that no poses are made of any more.
  void drop_old_fields();
  // Leaves out of the older keyframes those that see little new ground.
  void thin_out();
  std::vector<const View*> views(size_t variant, int count) const;
  Alignment expected(const View& view, size_t variant) const;
  // How well the heading is known that a variant was described under, rad.
  double turn_stddev(size_t variant) const;
  std::vector<Alignment> alignments_for(size_t variant, const View& view, double lever, double step) const;
  // Under all headings that are to be tried, as wide as radius_ says.
  void search_as_wide();
  // With the newest keyframes, at full resolution, within radius_ of where the aircraft is expected.
  void search_nearby(size_t variant);
  // With the whole submap, on the coarse grid first, within radius_ of there or everywhere.
  void search_widely(size_t variant);
  void compare_at_full_resolution(const std::vector<PlaceCandidate>& coarse, const std::vector<Alignment>& candidates,
                                  size_t variant);
  void sort_places();
  // Log-likelihood of a place less that of the best one elsewhere: neither where it was found nor where it was fitted.
  double likelihood_ratio(const Place& place, const Eigen::Vector2d& fitted) const;
  // What is believed, and what was hinted at, to where the odometry has come.
  void carry_places(const Eigen::Vector2d& p_W);
  // Turns and scales what is in W under this alignment.
  Eigen::Matrix2d G_W(const Place& place) const;
  // What is known of the place beside what is seen.
  PlacePrior place_prior() const;
  // Leaves of the places found in one spot the likeliest, and says of each what speaks for it.
  void weigh();
  // What the belief makes of the places weighed.
  PlaceBelief supposed() const;
  // Whether one of the places found, or known, is sure.
  bool is_clear();
  // Where a hypothesis is taken to be, as a place.
  Place place_of(const PlaceHypothesis& hypothesis) const;
  // Where a hypothesis was found, or where it was carried to.
  Place found_or_carried(const PlaceHypothesis& hypothesis) const;
  // The hypothesis that is sure and was so firmly, if the best place found is where it is.
  const PlaceHypothesis* confirmed() const;
  // Puts what was found to what is believed.
  void believe();
  // What earlier fixes or else the compass, and the odometry, say.
  FitPrior fit_prior(size_t variant) const;
  // Of the newest keyframes; without inliers where that fails.
  PlaceFit fit_at(const Eigen::Vector2d& en, const Alignment& alignment, size_t variant) const;
  // Whether the search was for a place where the aircraft is expected closely.
  bool is_nearby() const;
  // Whether a place is where the aircraft is expected, as far as cells tell.
  bool is_expected(const Eigen::Vector2d& en) const;
  // Neither fixes nor the compass have said anything of it.
  bool is_heading_unknown() const;
  // Whether fixes were enough for what they taught to be believed.
  bool is_taught() const { return num_fixes_ >= kTaught; }
  // What the newest keyframe alone says for where it was fitted: a log-likelihood ratio.
  double own_evidence(const PlaceFit& fit, size_t variant) const;
  // Of the points, how many stay where they are aligned to the map.
  double aligned_share(const Candidate& place) const;
  // A patch described under a heading that is off fits best where that heading puts it, and the fit believes it.
  // Describes what poses are made of under the headings to either side of what was fitted, further while the place
  // looks more like itself, and fits again. Not under the scale: few points of a first fix tell it badly, and the next
  // ones would be fitted under it (`testing_zone` 2 `years` was lost for it).
  void find_heading(Candidate& candidate);
  // How far (m) from a fit the whole submap may have its place: it goes by cells, and its odometry errs.
  double submap_give() const;
  // Where few of the newest points stay aligned, asks the whole submap, and fits again where it says. How far (m) the
  // fit is from there if that does not help, 0 if they agree.
  double agree_with_submap(Candidate& candidate) const;
  void miss();
  void learn_from(const PlaceFit& fit, const FittedPose& pose, size_t variant);

  SubmapOptions options_;
  CameraModel camera_;
  MapGeometry geometry_;
  std::unique_ptr<MapIndex> index_;

  std::deque<Remembered> keyframes_;  // the newest first
  int session_ = -1;
  int last_id_ = -1;            // of the keyframe before,
  std::set<int64_t> last_ids_;  // and of its points
  Heading heading_;
  // Compass less odometry: the yaw of W in G by the mean of the session's headings, and what the fixes made of it.
  double compass_yaw_ = 0;
  int num_headings_ = 0;
  double compass_stddev_ = 0;  // rad, of its newest heading
  std::optional<double> fitted_yaw_;
  KnownScale scale_;
  GroundLevel ground_;                  // of the session's fixes
  std::optional<Eigen::Vector2d> p_W_;  // m, of the newest keyframe of the session
  Expectations expectations_;
  PlaceBelief belief_;    // of the session
  bool is_firm_ = false;  // of the newest fix's points so many stayed that no other place has to be asked for

  int without_fix_ = 0;  // keyframes since the last fix
  int widened_ = 0;      // those since the last fix where the aircraft was expected
  int num_fixes_ = 0;    // of the session

  std::string refused_;
  int num_contradicted_ = 0;  // points of the newest keyframe
  std::vector<Place> places_;
  double radius_ = 0;
  // Where the aircraft is expected, m: the search is widened beyond that where it was not found there of late.
  Eigen::Vector2d expected_ = Eigen::Vector2d::Zero();
  double expected_radius_ = 0;
};

}  // namespace orthonav::registration
