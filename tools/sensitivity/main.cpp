// orthonav-sensitivity: what tools/benchmark/sensitivity flies, and what came of it.
#include <cstdio>
#include <exception>
#include <fstream>
#include <string>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "tools/sensitivity/plan.h"
#include "tools/sensitivity/results.h"
#include "tools/sensitivity/rows.h"

namespace {

using namespace orthonav::sensitivity;

// What is to be made, a line each, fields separated by tabs.
void print(const Plan& plan) {
  for (const Simulation& s : plan.simulations) {
    fmt::print("{}\t{}\t{}\t{}\t{}\n", s.seconds > 0 ? "flight" : "map", s.name, s.config.string(), s.seed, s.seconds);
  }
  for (const Run& run : plan.runs) {
    fmt::print("run\t{}\t{}\t{}\t{}\n", run.name, run.config.string(), run.flight, run.map);
  }
}

int run(int argc, char** argv) {
  CLI::App app("What the sensitivity benchmark flies, and what came of it");
  std::filesystem::path file, results_folder, json_file;
  PlanOptions options;
  app.add_option("--table", file, "rows and levels")->required()->check(CLI::ExistingFile);
  app.add_option("--configs", options.configs, "folder of the scenarios' configurations")->required();
  app.add_option("--folder", options.folder, "where configurations are written")->required();
  app.add_option("--scenarios", options.scenarios, "all of the table, if none");
  app.add_option("--seeds", options.seeds)->required();
  app.add_option("--rows", options.rows, "by their names; all, if none");
  app.add_option("--results", results_folder,
                 "print the table of the runs whose report.json files are here, and fail when one "
                 "leaves a band");
  app.add_option("--json", json_file, "with --results: write the figures of every run here");
  CLI11_PARSE(app, argc, argv);

  const Table table = Table::load(file);
  const Plan plan = make_plan(table, options);
  if (results_folder.empty()) {
    write_configs(plan);
    print(plan);
    return 0;
  }
  const std::vector<Result> results = read_results(plan, results_folder);
  std::fputs(to_table(table, results).c_str(), stdout);
  if (!json_file.empty()) {
    std::ofstream out(json_file);
    out << to_json(table, results).dump(2) << '\n';
    if (!out) throw std::runtime_error(fmt::format("{}: cannot write", json_file.string()));
  }
  const std::vector<std::string> faults = outside_bands(table, plan, results);
  for (const std::string& fault : faults) fmt::print(stderr, "outside its band: {}\n", fault);
  return faults.empty() ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
  try {
    return run(argc, argv);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-sensitivity: %s\n", error.what());
    return 2;
  }
}
