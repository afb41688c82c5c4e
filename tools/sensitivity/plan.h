// Which flights, maps and runs the sensitivity benchmark is made of: levels of the table over scenarios and seeds.
//
// Flights that differ only in what the navigator believes are one flight, and so are maps. Even seeds start on the
// ground, odd ones in the air.
#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "tools/sensitivity/rows.h"

namespace orthonav::sensitivity {

struct PlanOptions {
  std::filesystem::path configs;       // config/ of the repository: a folder for each scenario
  std::filesystem::path folder;        // where the folders of configuration are written
  std::vector<std::string> scenarios;  // those of the levels' that are flown
  std::vector<uint64_t> seeds;
  std::vector<std::string> rows;  // names of rows; empty: all. The nominal one is always flown
};

// A flight to be simulated, or, without `seconds`, a map alone.
struct Simulation {
  std::string name;
  std::filesystem::path config;
  uint64_t seed = 0;
  double seconds = 0;  // 0: the map alone
};

struct Run {
  size_t level = 0;  // in the table
  std::string scenario;
  uint64_t seed = 0;
  std::string name, flight, map;
  std::filesystem::path config;  // what the navigator is told
};

struct Plan {
  std::vector<Simulation> simulations;
  std::vector<Run> runs;
};

// Writes the folders of configuration. Throws std::runtime_error for a row or scenario that is not in the table.
Plan make_plan(const Table& table, const PlanOptions& options);

}  // namespace orthonav::sensitivity
