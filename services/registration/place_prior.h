// What is known of the place before a keyframe is compared with the map: any place of it, all alike, and what the
// fusion expects and a person hints at on top.
//
// Values; not thread-safe.
#pragma once

#include <cmath>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>

namespace orthonav::registration {

// Where the body is expected, in G: within an area (m, its corners in their order around it), beyond which it falls off
// as a normal distribution does; one corner is the middle of such. True with the probability `trust`.
struct ExpectedArea {
  std::vector<Eigen::Vector2d> corners;
  double stddev = 0;  // m on each axis
  double trust = 0;

  // 1/m^2, if it is true.
  double density(const Eigen::Vector2d& en) const;
};

// Where the fusion expects the body, horizontally in G.
struct PositionPrior {
  Eigen::Vector2d en = Eigen::Vector2d::Zero();  // m
  double stddev = 0;                             // m, of the worse direction

  bool is_known() const { return en.allFinite() && std::isfinite(stddev); }
};

class PlacePrior {
 public:
  // `cell` and `map`: m^2 of a place and of all of them; each may be seen under so many alignments.
  PlacePrior(double cell, double map, double alignments)
      : cell_(cell / alignments), anywhere_(cell / map / alignments) {}

  void expect(ExpectedArea area) { expectations_.push_back(std::move(area)); }

  // Of the place `en` under one alignment: a logarithm.
  double log_probability(const Eigen::Vector2d& en) const;

 private:
  double cell_, anywhere_;
  std::vector<ExpectedArea> expectations_;
};

// The fusion's expectation for this keyframe, and a person's hint, which the odometry carries along until a fix.
class Expectations {
 public:
  void hint(const ExpectedArea& area) { hint_ = area; }
  void forget_hint() { hint_.reset(); }
  // To the newest keyframe: `way`, m in G, known to `way_stddev`, relative.
  void carry(const Eigen::Vector2d& way, double way_stddev);
  void expect(const std::optional<PositionPrior>& prior) { prior_ = prior; }

  // Adds them to what is known of places `pitch` m wide.
  void add_to(PlacePrior& prior, double pitch) const;

 private:
  std::optional<ExpectedArea> hint_;
  std::optional<PositionPrior> prior_;
};

}  // namespace orthonav::registration
