// Where everything in the procedural world is, whatever the season: a list of ground patches, buildings, plants
// and places for vehicles. What is really there on a given day, and how it looks, is the epoch's business.
//
// All coordinates are m in G, (east, north); angles are rad, counter-clockwise from east.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace orthonav::simulate {

using Outline = std::vector<Eigen::Vector2d>;

enum class Cover : uint8_t {
  kArable,
  kHeadland,
  kMeadow,
  kPasture,
  kForestFloor,
  kOrchard,
  kVerge,
  kGarden,
  kBed,
  kWornGrass,
  kReed,
  kDirt,
  kGravel,
  kTrack,
  kAsphalt,
  kRepair,
  kConcrete,
  kPaving,
  kMarking,
  kWater,
  kPool,
};

// Ground of one kind. Painted in order: later patches lie over earlier ones.
struct Patch {
  Outline outline;
  Cover cover;
  uint64_t id;       // of its own
  uint64_t field;    // patches with the same `field` are tilled alike
  double row_angle;  // direction of rows, of mowing
};

enum class Roof : uint8_t { kGable, kHip, kFlat, kShed };

struct Building {
  Eigen::Vector2d centre;
  double angle;          // of its length
  double length, width;  // m
  double eave;           // m above the ground
  double pitch;          // rise per metre
  Roof roof;
  bool hall;  // industrial: sheet metal, skylights
  uint64_t id;
};

enum class Plant : uint8_t { kDeciduous, kConifer, kFruit, kShrub };

struct Tree {
  Eigen::Vector2d position;
  double radius;  // m, of the crown
  double height;  // m
  Plant plant;
  uint64_t id;
};

// A place where a vehicle or container may stand.
struct Slot {
  Eigen::Vector2d position;
  double angle;
  double length, width, height;  // m
  uint64_t id;
  double occupancy;  // probability that something stands there
};

// Thin upright things: their shadows are what one sees of them.
struct Pole {
  Eigen::Vector2d position;
  double height;  // m
};

struct Layout {
  std::vector<Patch> patches;
  std::vector<Building> buildings;
  std::vector<Tree> trees;
  std::vector<Slot> slots;
  std::vector<Pole> poles;
};

// What the land is used for, by share of the area (any positive numbers; they are normalised).
struct LandOptions {
  double arable = 0.45, meadow = 0.22, pasture = 0.1, wood = 0.12, orchard = 0.04, settlement = 0.0, industrial = 0.0,
         farmstead = 0.05, pond = 0.02;
  double parcel_area = 9000;       // m2, median
  double border_bend = 5.0;        // m rms: how far roads and borders stray from straight lines
  double border_wavelength = 260;  // m
  double scatter = 6.0;            // shrubs and small trees per hectare of grassland
};

struct Bounds {
  double east_min, east_max, north_min, north_max;  // m in G
};

// Deterministic in its arguments.
Layout make_layout(const LandOptions& options, const Bounds& bounds, uint64_t seed);

}  // namespace orthonav::simulate
