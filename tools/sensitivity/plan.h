// Which flights, maps and runs the sensitivity benchmark is made of: levels of the table over scenarios and seeds.
//
// Flights that differ only in what the navigator believes are one flight, and so are maps. Even seeds start on the
// ground, odd ones in the air.
#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include <yaml-cpp/yaml.h>

#include "tools/sensitivity/rows.h"

namespace orthonav::sensitivity {

struct PlanOptions {
  std::filesystem::path configs;       // config/ of the repository: a folder for each scenario
  std::filesystem::path folder;        // where the folders of configuration will be
  std::vector<std::string> scenarios;  // those of the levels' that are flown; empty: all
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

// A folder with the files of a scenario, some of them with other values laid over.
struct Config {
  std::filesystem::path scenario, folder;
  std::map<std::string, YAML::Node> overlays;  // by the files' names without ending
};

struct Plan {
  std::vector<Simulation> simulations;
  std::vector<Run> runs;
  std::vector<Config> configs;  // of both
};

// Reads the scenarios' aircraft.yaml and writes nothing. Throws std::runtime_error for a row or scenario that is not in
// the table, and for a level that is wrong about a calibration and replaces it as well.
Plan make_plan(const Table& table, const PlanOptions& options);

// Throws std::runtime_error for a file that cannot be written, and for a scenario without the file that something is to
// be laid over.
void write_configs(const Plan& plan);

}  // namespace orthonav::sensitivity
