// What the runs of the sensitivity benchmark came to: figures, verdicts, the table, the JSON and the bands.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "tools/sensitivity/plan.h"

namespace orthonav::sensitivity {

// right: the fusion's RMSE is at most twice that of the nominal run of the same scenario and seed; wide: it is not, but
// it is honest: the NEES is at most 6 of 3 freedoms and no epoch lies beyond its protection level; wrong: neither;
// silent: no position. The nominal run itself is right when it is honest, else wrong.
enum class Verdict { kRight, kWide, kWrong, kSilent };
const char* name_of(Verdict verdict);

// The figures of one run, from its report.json (tools/evaluate/README.md). NaN: unknown.
struct Figures {
  double rmse = 0, horizontal = 0, vertical = 0;      // m, of the fusion
  double nees = 0;                                    // of the position, 3 when honest
  double epochs = 0, bounded = 0;                     // located ones, and those with protection levels
  double beyond_horizontal = 0, beyond_vertical = 0;  // epochs beyond their level
  double located_share = 0, bounded_share = 0;        // of the images
  double fixes = 0, false_fixes = 0;
  double first_position = 0;                             // s from the first image
  double scale_start = 0, scale_30s = 0, scale_end = 0;  // odometry's size over the true one, less 1
  double claim_start = 0, claim_30s = 0, claim_end = 0;  // 1 sigma of it, as the odometry says
  std::vector<std::string> health;                       // "service: what it said while not OK"

  static Figures of(const nlohmann::json& report);
};

struct Result {
  const Run* run = nullptr;
  Figures figures;
  Verdict verdict = Verdict::kSilent;
  std::vector<std::string> health;  // what the nominal run did not say, numbers aside
  std::string flown_by;             // commit of the programs; empty: unknown
};

// Reads FOLDER/NAME.json of every run that is there, and its commit, the first word of NAME.flown-by. Throws
// std::runtime_error naming a file that cannot be read, and std::invalid_argument when a run's nominal one is missing.
std::vector<Result> read_results(const Plan& plan, const std::filesystem::path& folder);

// One row a level and scenario: medians and worst over its seeds; below them verdicts, epochs beyond their level and
// commits, counted. Markdown.
std::string to_table(const Table& table, const std::vector<Result>& results);
nlohmann::ordered_json to_json(const Table& table, const std::vector<Result>& results);

// What leaves the bands of its level, and runs of the plan with bands that are missing: one text each.
std::vector<std::string> outside_bands(const Table& table, const Plan& plan, const std::vector<Result>& results);

}  // namespace orthonav::sensitivity
