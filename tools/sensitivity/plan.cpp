#include "tools/sensitivity/plan.h"

#include <algorithm>
#include <fstream>
#include <map>
#include <set>
#include <stdexcept>

#include <fmt/format.h>

namespace orthonav::sensitivity {
namespace {

namespace fs = std::filesystem;

void write_file(const fs::path& file, const std::string& text) {
  std::ofstream out(file, std::ios::binary);
  out << text;
  out.close();
  if (!out) throw std::runtime_error(fmt::format("{}: cannot write", file.string()));
}

// Each file of the scenario, extended by what is laid over it.
void write_config(const Config& config) {
  for (const auto& [name, overlay] : config.overlays) {
    const fs::path file = config.scenario / (name + ".yaml");
    if (!fs::exists(file)) {
      throw std::runtime_error(fmt::format("{}: no such file, and '{}' is to be laid over it", file.string(), name));
    }
  }
  fs::create_directories(config.folder);
  for (const auto& entry : fs::directory_iterator(config.scenario)) {
    if (entry.path().extension() != ".yaml") continue;
    std::string text = fmt::format("extends: {}\n", fs::absolute(entry.path()).lexically_normal().string());
    const auto overlay = config.overlays.find(entry.path().stem().string());
    if (overlay != config.overlays.end() && overlay->second.IsMap() && overlay->second.size() > 0) {
      text += YAML::Dump(overlay->second) + "\n";
    }
    write_file(config.folder / entry.path().filename(), text);
  }
}

class Planner {
 public:
  Planner(const Table& table, const PlanOptions& options) : table_(table), options_(options) {}

  void fly(size_t index, const std::string& scenario, uint64_t seed) {
    const Level& level = table_.levels[index];
    const ScenarioStarts& starts = table_.scenarios.at(scenario);
    const Start& start = seed % 2 == 0 ? starts.on_ground : starts.in_air;
    const std::string prefix = fmt::format("{}-{}{}", scenario, seed, seed % 2 == 0 ? "-take-off" : "");

    Simulation flight{.name = prefix, .config = {}, .seed = seed, .seconds = start.seconds};
    const YAML::Node flown = merged(start.simulate, level.simulate);
    if (level.seconds > 0) flight.seconds = level.seconds;
    const std::string slug = first_with(flown, flight.seconds, start, scenario);
    if (!slug.empty()) flight.name += "-" + slug;
    simulate(flight, scenario, flown);

    std::string map = flight.name;
    if (level.map && !level.map.IsNull()) {
      map = prefix + "-" + level.slug();
      simulate({.name = map, .config = {}, .seed = seed, .seconds = 0}, scenario, merged(flown, level.map));
    }

    const Run run{.level = index,
                  .scenario = scenario,
                  .seed = seed,
                  .name = prefix + "-" + level.slug(),
                  .flight = flight.name,
                  .map = map,
                  .config = options_.folder / scenario / level.slug()};
    if (folders_.insert(run.config).second) {
      plan_.configs.push_back({options_.configs / scenario, run.config, believed(level, scenario)});
    }
    plan_.runs.push_back(run);
  }

  Plan finished() { return std::move(plan_); }

 private:
  // What the navigator is told. Nodes are references: the table's are copied into a map of their own, not assigned to.
  std::map<std::string, YAML::Node> believed(const Level& level, const std::string& scenario) const {
    std::map<std::string, YAML::Node> files;
    const YAML::Node wrong = aircraft_overlay(options_.configs / scenario, level.calibration);
    const auto aircraft = level.believed.find("aircraft");
    if (wrong.size() > 0 && aircraft != level.believed.end() &&
        (aircraft->second["kalibr"] || aircraft->second["camera"] || aircraft->second["extrinsics"])) {
      throw std::runtime_error(fmt::format(
          "{} {}: 'calibration' falsifies the scenario's, and 'aircraft' replaces it: say one", level.row, level.name));
    }
    for (const auto& [file, overlay] : level.believed) {
      files.emplace(file, merged(file == "aircraft" ? wrong : YAML::Node(), overlay));
    }
    if (wrong.size() > 0) files.emplace("aircraft", wrong);
    return files;
  }

  // Slug of the first level of the table that flies the same; empty when that is the nominal one.
  std::string first_with(const YAML::Node& flown, double seconds, const Start& start,
                         const std::string& scenario) const {
    const std::string text = YAML::Dump(flown);
    for (const Level& level : table_.levels) {
      if (std::find(level.scenarios.begin(), level.scenarios.end(), scenario) == level.scenarios.end()) continue;
      if ((level.seconds > 0 ? level.seconds : start.seconds) != seconds) continue;
      if (YAML::Dump(merged(start.simulate, level.simulate)) != text) continue;
      return &level == &table_.levels.front() ? "" : level.slug();
    }
    return "";
  }

  // Remembers that a flight or a map is to be made, once.
  void simulate(Simulation simulation, const std::string& scenario, const YAML::Node& overlay) {
    simulation.config = options_.folder / "flights" / simulation.name;
    if (!folders_.insert(simulation.config).second) return;
    std::map<std::string, YAML::Node> overlays;
    if (overlay.IsMap()) overlays.emplace("simulate", overlay);
    plan_.configs.push_back({options_.configs / scenario, simulation.config, std::move(overlays)});
    plan_.simulations.push_back(std::move(simulation));
  }

  const Table& table_;
  const PlanOptions& options_;
  Plan plan_;
  std::set<fs::path> folders_;  // that have a configuration
};

}  // namespace

Plan make_plan(const Table& table, const PlanOptions& options) {
  const auto asked = [](const std::vector<std::string>& all, const std::string& one) {
    return std::find(all.begin(), all.end(), one) != all.end();
  };
  for (const std::string& row : options.rows) {
    if (std::none_of(table.levels.begin(), table.levels.end(), [&](const Level& level) { return level.row == row; })) {
      throw std::runtime_error(fmt::format("there is no row '{}' in the table", row));
    }
  }
  for (const std::string& scenario : options.scenarios) {
    if (table.scenarios.count(scenario) == 0) {
      throw std::runtime_error(fmt::format("there is no scenario '{}' in the table", scenario));
    }
  }
  Planner planner(table, options);
  for (size_t i = 0; i < table.levels.size(); ++i) {
    const Level& level = table.levels[i];
    if (i > 0 && !options.rows.empty() && !asked(options.rows, level.row)) continue;
    for (const std::string& scenario : level.scenarios) {
      if (!options.scenarios.empty() && !asked(options.scenarios, scenario)) continue;
      for (const uint64_t seed : options.seeds) planner.fly(i, scenario, seed);
    }
  }
  return planner.finished();
}

void write_configs(const Plan& plan) {
  for (const Config& config : plan.configs) write_config(config);
}

}  // namespace orthonav::sensitivity
