// The table of the sensitivity benchmark (tools/benchmark/sensitivity.yaml, which says what its keys mean).
#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include <yaml-cpp/yaml.h>

#include "tools/sensitivity/miscalibration.h"

namespace orthonav::sensitivity {

// One level of one row.
struct Level {
  std::string row, name;                       // name: of the level; empty when the row has but one
  std::vector<std::string> scenarios;          // in which it is flown; the table's first, if the row names none
  double seconds = 0;                          // of flight recorded; 0: as the scenario says
  YAML::Node simulate, map;                    // on simulate.yaml: of the flight, and of its map alone
  std::map<std::string, YAML::Node> believed;  // on the navigator's files, by their names without ending
  Miscalibration calibration;
  // Lowest and highest of a run's figure, by its key in the JSON.
  std::map<std::string, std::pair<double, double>> bands;

  // Row and level as a part of a file's name.
  std::string slug() const;
};

// How flights of a scenario begin.
struct Start {
  double seconds = 90;  // of flight recorded
  YAML::Node simulate;
};

struct ScenarioStarts {
  Start in_air, on_ground;
};

struct Table {
  std::map<std::string, ScenarioStarts> scenarios;
  std::vector<Level> levels;  // the nominal one first

  // Throws std::runtime_error with file and line: for a key that is not known anywhere in the table, a level twice, or
  // a table whose first row is not `nominal`.
  static Table load(const std::filesystem::path& file);
};

// `over` laid over `under`: maps are merged key by key, everything else is replaced. A tree of its own, that shares
// nothing with either: a yaml-cpp node is a reference, and so is an alias to its anchor.
YAML::Node merged(const YAML::Node& under, const YAML::Node& over);

}  // namespace orthonav::sensitivity
