// The hand that lays out the land: shared by the countryside (world_layout.cpp) and the built-up parts
// (world_builtup.cpp). Works in straight coordinates; everything placed is bent by one smooth field, so that
// borders, roads and rows follow each other as they do on old land.
#pragma once

#include "tools/simulate/world_layout.h"
#include "tools/simulate/world_polygon.h"
#include "tools/simulate/world_random.h"

namespace orthonav::simulate {

class LayoutBuilder {
 public:
  LayoutBuilder(const LandOptions& options, const Bounds& bounds, uint64_t seed);
  Layout build();

 private:
  // Placing, with the bend applied.
  void patch(const Outline& outline, Cover cover, uint64_t field, double row_angle);
  void strip(const Segment& segment, double offset, double width, Cover cover);
  void blob(const Eigen::Vector2d& centre, double radius, Cover cover);
  void wander(const Eigen::Vector2d& from, const Eigen::Vector2d& to, double width, Cover cover);
  void tree(const Eigen::Vector2d& position, double radius, double height, Plant plant);
  void building(const Eigen::Vector2d& centre, double angle, double length, double width, double eave, double pitch,
                Roof roof, bool hall);
  void slot(const Eigen::Vector2d& position, double angle, double length, double width, double height,
            double occupancy);
  void dashes(const Segment& segment, double offset, double width, double dash, double gap);
  Outline bend(const Outline& outline, double step) const;
  double bend_angle(const Eigen::Vector2d& position, double angle) const;
  bool outside(const Outline& outline) const;
  Eigen::Vector2d point_in(const Outline& polygon);

  // Countryside.
  void border(const Segment& segment, int depth);
  void road(const Segment& segment, double width, bool marked);
  void track(const Segment& segment);
  void hedge(const Segment& segment, double offset);
  void scatter(const Outline& polygon, double per_hectare);
  void arable(const Outline& polygon);
  void grassland(const Outline& polygon, Cover cover);
  void wood(const Outline& polygon);
  void orchard(const Outline& polygon);
  void pond(const Outline& polygon);

  // Built-up parts.
  void farmstead(const Outline& polygon);
  void settlement(const Outline& polygon);
  void house_lot(const Outline& lot);
  void industrial(const Outline& polygon);
  void works(const Outline& lot);
  void parking(const Eigen::Vector2d& centre, double angle, double length, double width);

  LandOptions options_;
  Bounds bounds_;
  uint64_t seed_;
  Random random_;
  SmoothField bend_;
  Layout layout_;
  std::vector<Patch> roads_;     // painted after the land
  std::vector<Patch> markings_;  // painted after the roads
  uint64_t next_id_ = 1;
};

}  // namespace orthonav::simulate
