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

// A folder with the scenario's files, each extended by what is laid over it.
void write_config(const fs::path& scenario, const fs::path& folder, const std::map<std::string, YAML::Node>& overlays) {
  fs::create_directories(folder);
  for (const auto& entry : fs::directory_iterator(scenario)) {
    if (entry.path().extension() != ".yaml") continue;
    std::string text = fmt::format("extends: {}\n", fs::absolute(entry.path()).lexically_normal().string());
    const auto overlay = overlays.find(entry.path().stem().string());
    if (overlay != overlays.end() && overlay->second.IsMap() && overlay->second.size() > 0) {
      YAML::Node top = YAML::Clone(overlay->second);
      top.SetStyle(YAML::EmitterStyle::Block);  // one map with `extends`
      text += YAML::Dump(top) + "\n";
    }
    write_file(folder / entry.path().filename(), text);
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
    flight.config = simulate(flight.name, scenario, flown, flight);

    std::string map = flight.name;
    if (level.map && !level.map.IsNull()) {
      Simulation other{.name = prefix + "-" + level.slug(), .config = {}, .seed = seed, .seconds = 0};
      map = other.name;
      simulate(other.name, scenario, merged(flown, level.map), other);
    }

    Run run{.level = index,
            .scenario = scenario,
            .seed = seed,
            .name = prefix + "-" + level.slug(),
            .flight = flight.name,
            .map = map,
            .config = options_.folder / scenario / level.slug()};
    std::map<std::string, YAML::Node> believed = level.believed;
    believed["aircraft"] =
        merged(aircraft_overlay(options_.configs / scenario, level.calibration), believed["aircraft"]);
    write_config(options_.configs / scenario, run.config, believed);
    plan_.runs.push_back(run);
  }

  Plan finished() { return std::move(plan_); }

 private:
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

  // Writes the flight's configuration, once, and remembers that it is to be made.
  fs::path simulate(const std::string& name, const std::string& scenario, const YAML::Node& overlay,
                    Simulation& simulation) {
    simulation.config = options_.folder / "flights" / name;
    if (names_.insert(name).second) {
      write_config(options_.configs / scenario, simulation.config, {{"simulate", overlay}});
      plan_.simulations.push_back(simulation);
    }
    return simulation.config;
  }

  const Table& table_;
  const PlanOptions& options_;
  Plan plan_;
  std::set<std::string> names_;
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
      if (!asked(options.scenarios, scenario)) continue;
      for (const uint64_t seed : options.seeds) planner.fly(i, scenario, seed);
    }
  }
  return planner.finished();
}

}  // namespace orthonav::sensitivity
