// The flight that make_flight.sh left, and what evaluation says of a log flown from it.
#pragma once

#include <chrono>
#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>

#include <nlohmann/json.hpp>

#include "tests/support/child_process.h"

namespace orthonav::test {

inline std::filesystem::path flight_folder() {
  return ORTHONAV_FLIGHT;
}
inline std::filesystem::path flight_log() {
  return flight_folder() / "flight.lcm";
}
inline std::filesystem::path flight_map() {
  return flight_folder() / "flight.onmap";
}
inline std::filesystem::path flight_config() {
  return source_tree() / "config" / "quick";
}

// The report.json of orthonav-evaluate.
inline nlohmann::json evaluate(const std::filesystem::path& log) {
  const auto report = std::filesystem::path(log).replace_extension(".json");
  ChildProcess process({program("orthonav-evaluate"), log, "--json", report},
                       std::filesystem::path(log).replace_extension(".evaluate.txt"));
  if (process.wait_exit(std::chrono::minutes(2)) != 0)
    throw std::runtime_error("orthonav-evaluate failed on " + log.string());
  return nlohmann::json::parse(std::ifstream(report));
}

}  // namespace orthonav::test
