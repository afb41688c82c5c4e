// Methods "paper", "m1" and "m2" as the service sees them: the registrar's places, put to the belief about place.
//
// A place speaks for itself by how many of a keyframe's matches vote for it. Over ground of no relation votes fall
// anywhere on the map, of a right place some stay within the radius, so n of N votes are a likelihood ratio
// of (q/p)^n ((1-q)/(1-p))^(N-n) with p the radius' share of the map and q that of the votes. As wrong votes come in
// clumps, it is tempered. What was believed before is asked again of each keyframe.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "services/registration/method.h"
#include "services/registration/paper/registrar.h"

namespace orthonav::registration {

class PaperMethod : public Method {
 public:
  // `temperature`: by which what votes say is divided.
  PaperMethod(const RegistrarOptions& options, const CameraModel& camera, double temperature);

  bool has_map() const override { return registrar_.has_map(); }
  // Builds the search trees.
  void set_map(MapFeatures features, const MapGeometry& geometry) override;
  void clear_map() override;
  void hint(const ExpectedArea& area) override { expectations_.hint(area); }
  // Needs a heading of the compass.
  bool describe(const Keyframe& keyframe, int session, const cv::Mat& image, const Heading& heading) override;
  void search(const std::optional<PositionPrior>& prior) override;
  Fix solve() override;
  const PlaceBelief& belief() const override { return belief_; }

 private:
  // How much likelier the votes within the radius of `vote` are there than anywhere: a logarithm.
  double evidence(const Eigen::Vector2d& vote) const;

  RegistrarOptions options_;
  Registrar registrar_;
  double temperature_;
  double map_area_ = 0;
  PlaceBelief belief_;
  Expectations expectations_;
  int session_ = -1;
  std::optional<Eigen::Vector2d> p_W_;  // m, of the session's newest keyframe

  // Of the newest keyframe.
  Keyframe keyframe_;
  Heading heading_;
  std::string refused_;
  Query query_;
  std::vector<DescriptorMatch> matches_;
  std::vector<Eigen::Vector2d> votes_;
};

}  // namespace orthonav::registration
