// One day in the procedural world: where the sun stands, what grows, what is there, and how each ground looks.
#pragma once

#include <cstdint>
#include <map>
#include <utility>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "tools/simulate/world_layout.h"

namespace orthonav::simulate {

// How a surface looks. Colours are BGR as a camera would show them in full sun, 0..255. At each point the colour lies
// between `low` and `high` by the soil's and the vegetation's pattern, then grain, rows and wheel tracks modulate it.
struct Material {
  cv::Vec3f low{100, 100, 100}, high{130, 130, 130};
  float soil = 0.1F;        // weight of the soil's pattern, per standard deviation
  float vegetation = 0.1F;  // weight of the vegetation's pattern
  float grain = 0.08F;      // relative amplitude of the finest texture
  float clumps = 0.04F;     // the same of half-metre texture
  float rows = 0;           // relative amplitude of rows
  float row_period = 1;     // m
  float row_angle = 0;      // rad
  float wheels = 0;         // relative darkening of wheel tracks
  float wheel_period = 21;  // m between passes
  float wheel_phase = 0;    // m
  float height = 0;         // m, of the crop
};

struct Sun {
  double azimuth;    // rad clockwise from north, towards the sun
  double elevation;  // rad
};

// Position of the sun on day of year `day` at local solar time `hour`. (J. W. Spencer's declination, first term.)
Sun sun_at(double latitude_deg, double day, double hour);

// Levels of change between the camera's epoch and the map's; probabilities per object unless said otherwise.
struct Difference {
  double days_min = 60, days_max = 120;    // the map's day of the year is off by this much, to either side
  double day_first = 75, day_last = 290;   // the time of the year in which such maps are made
  double hour_min = 8.5, hour_max = 16.5;  // local solar time of the map's flight
  double pattern_change = 0.4;             // share of the variance of soil and vegetation patterns that is new
  double crop_change = 0.3;                // a field bears another crop
  double tillage_change = 0.5;             // a field's wheel tracks and rows are laid anew
  double tree_change = 0.03;               // a tree or shrub is felled or planted
  double growth = 0.05;                    // relative change of a crown's size, standard deviation
  double crown_shift = 0.2;                // m, by which a crown's apparent centre moves, standard deviation
  double building_change = 0.0;            // a building is pulled down or built
  double roof_change = 0.02;               // a roof is covered anew
  double ground_change = 0.1;              // a minor patch of ground (worn grass, repairs, beds, piles) comes or goes
};

struct EpochOptions {
  double day = 160;  // of the year
  double hour = 10;  // local solar time
  double latitude_deg = 48;
  uint64_t seed = 0;        // of the world: what is common to all epochs
  uint64_t epoch_seed = 0;  // of this epoch
  Difference change;        // against the base state; all zero in the camera's epoch
  bool base = true;         // the camera's epoch, which is the base state
  double snow = 0;          // part of everything's own colour and pattern that snow hides
};

class Epoch {
 public:
  explicit Epoch(const EpochOptions& options);

  const EpochOptions& options() const { return options_; }
  const Sun& sun() const { return sun_; }

  bool present(const Patch& patch) const;
  bool present(const Building& building) const;
  bool present(const Tree& tree) const;
  bool present(const Slot& slot) const;
  // Size and place of a crown now, and how much of it leaves fill (0..1).
  Tree grown(const Tree& tree) const;
  double leaves(const Tree& tree) const;
  // Centres of bales lying in a field, m in G.
  std::vector<Eigen::Vector2d> bales(const Patch& patch) const;

  Material ground(const Patch& patch) const;
  Material crown(const Tree& tree) const;
  Material roof(const Building& building) const;
  Material vehicle(const Slot& slot) const;
  // Materials that are alike carry the same key, so that there are few of them.
  static uint64_t key(const Patch& patch);
  static uint64_t key(const Tree& tree);

 private:
  struct Crop;
  // Whether `what` of object `id` differs from the base state, with the given probability.
  bool changed(uint64_t id, const char* what, double probability) const;
  // A draw in [0, 1) that is redrawn when `changed`.
  double draw(uint64_t id, const char* what, double probability) const;
  Material crop(const Patch& patch) const;
  Material grass(const Patch& patch) const;

  EpochOptions options_;
  Sun sun_;
};

}  // namespace orthonav::simulate
