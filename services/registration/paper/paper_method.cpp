#include "services/registration/paper/paper_method.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace orthonav::registration {
namespace {

// Of the votes of a right place, the share that lies within the radius, at least.
constexpr double kLeastShare = 0.02;

}  // namespace

PaperMethod::PaperMethod(const RegistrarOptions& options, const CameraModel& camera, double temperature)
    : options_(options), registrar_(options, camera), temperature_(temperature) {}

void PaperMethod::set_map(MapFeatures features, const MapGeometry& geometry) {
  registrar_.set_map(std::move(features), geometry);
  map_area_ = registrar_.map_area();
}

void PaperMethod::clear_map() {
  registrar_.clear_map();
  belief_.clear();
  expectations_ = {};
}

bool PaperMethod::describe(const Keyframe& keyframe, int session, const cv::Mat& image, const Heading& heading) {
  if (session != session_) {
    session_ = session;
    belief_.clear();
    p_W_.reset();
  }
  keyframe_ = keyframe;
  heading_ = heading;
  query_ = {};
  matches_.clear();
  votes_.clear();
  refused_ = heading.known() ? "" : "no compass heading near the keyframe's time";
  if (!refused_.empty()) return false;
  query_ = registrar_.describe(keyframe, image, heading);
  refused_ = query_.refused;
  if (!refused_.empty()) return false;
  const Eigen::Vector2d p_W = keyframe.p_W_B.head<2>();
  const double way_stddev = std::hypot(heading.stddev, options_.errors.scale_stddev);
  belief_.carry(p_W, way_stddev);
  if (p_W_) expectations_.carry(query_.R_G_W.topLeftCorner<2, 2>() * (p_W - *p_W_), way_stddev);
  p_W_ = p_W;
  return true;
}

double PaperMethod::evidence(const Eigen::Vector2d& vote) const {
  const double radius = options_.voting.inlier_radius;
  const auto near = [&](const Eigen::Vector2d& other) { return (other - vote).norm() <= radius; };
  const auto all = static_cast<double>(votes_.size());
  const auto count = static_cast<double>(std::count_if(votes_.begin(), votes_.end(), near));
  const double by_chance = std::min(0.5 * kLeastShare, M_PI * radius * radius / map_area_);
  const double share = std::clamp(count / all, kLeastShare, 1 - kLeastShare);
  const double log_ratio =
      count * std::log(share / by_chance) + (all - count) * std::log((1 - share) / (1 - by_chance));
  return log_ratio / temperature_;
}

void PaperMethod::search(const std::optional<PositionPrior>& prior) {
  if (!refused_.empty()) return;
  expectations_.expect(prior);
  matches_ = registrar_.match(query_);
  votes_ = registrar_.votes(keyframe_, query_, matches_);
  if (votes_.empty()) return;
  const double radius = options_.voting.inlier_radius;
  PlacePrior known(M_PI * radius * radius, map_area_, 1);
  expectations_.add_to(known, radius);
  const Eigen::Vector2d body = registrar_.body_from_vote(keyframe_, query_);
  // What was believed, then what is found now: the same place says the same twice.
  std::vector<Eigen::Vector2d> places;
  for (const PlaceHypothesis& each : belief_.hypotheses()) places.push_back(each.en);
  places.push_back(body + vote(votes_, options_.voting).translation);
  for (const Eigen::Vector2d& en : places) {
    belief_.suppose(en, query_.R_G_W.topLeftCorner<2, 2>(), radius, known.log_probability(en) + evidence(en - body));
  }
  belief_.settle();
}

Fix PaperMethod::solve() {
  Fix fix;
  fix.reason = refused_;
  if (!refused_.empty()) return fix;
  fix = registrar_.solve(keyframe_, query_, matches_, votes_, heading_);
  fix.search_radius = std::numeric_limits<double>::infinity();
  fix.num_hypotheses = static_cast<int>(belief_.hypotheses().size());
  const Eigen::Vector2d en = fix.translation + registrar_.body_from_vote(keyframe_, query_);
  fix.log_odds = belief_.log_odds_at(en, options_.voting.inlier_radius);
  if (fix.valid) expectations_.forget_hint();
  return fix;
}

}  // namespace orthonav::registration
