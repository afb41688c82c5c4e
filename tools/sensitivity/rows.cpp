#include "tools/sensitivity/rows.h"

#include <cctype>
#include <set>
#include <stdexcept>

#include <fmt/format.h>
#include <fmt/ranges.h>

namespace orthonav::sensitivity {
namespace {

const std::set<std::string> kBelieved = {"aircraft", "vio", "registration", "map_server", "fusion"};

class Reader {
 public:
  explicit Reader(std::filesystem::path file) : file_(std::move(file)) {}

  Table table() {
    const YAML::Node top = YAML::LoadFile(file_.string());
    only(top, {"scenarios", "rows"}, "the table");
    for (const auto& entry : required(top, "scenarios")) {
      only(entry.second, {"in_air", "on_ground"}, "a scenario");
      const auto name = entry.first.as<std::string>();
      if (default_scenario_.empty()) default_scenario_ = name;
      const ScenarioStarts starts{start(required(entry.second, "in_air")), start(required(entry.second, "on_ground"))};
      table_.scenarios.emplace(name, starts);
    }
    for (const YAML::Node& row : required(top, "rows")) {
      only(row, {"row", "scenarios", "levels"}, "a row");
      for (const YAML::Node& node : required(row, "levels")) add_level(row, node);
    }
    if (table_.levels.empty() || table_.levels.front().row != "nominal") fail(top, "the first row must be 'nominal'");
    return std::move(table_);
  }

 private:
  [[noreturn]] void fail(const YAML::Node& node, const std::string& what) const {
    throw std::runtime_error(fmt::format("{}:{}: {}", file_.string(), node.Mark().line + 1, what));
  }

  // A misspelt key must not pass silently.
  void only(const YAML::Node& map, const std::set<std::string>& known, const std::string& of) const {
    if (!map.IsMap()) fail(map, of + " must be a map of keys to values");
    for (const auto& entry : map) {
      const auto key = entry.first.as<std::string>();
      if (known.count(key) > 0) continue;
      fail(entry.first, fmt::format("unknown key '{}'; {} has: {}", key, of, fmt::join(known, ", ")));
    }
  }

  YAML::Node required(const YAML::Node& map, const std::string& key) const {
    const YAML::Node value = map[key];
    if (!value.IsDefined() || value.IsNull()) fail(map, "key '" + key + "' is missing");
    return value;
  }

  // What is laid over a file of configuration. Merge keys are YAML 1.1's, which yaml-cpp takes for keys like others.
  YAML::Node overlay(const YAML::Node& node) const {
    if (node.IsNull()) return node;
    if (!node.IsMap()) fail(node, "must be a map of keys to values");
    refuse_merge_keys(node);
    return merged({}, node);
  }
  void refuse_merge_keys(const YAML::Node& node) const {
    if (!node.IsMap()) return;
    for (const auto& entry : node) {
      if (entry.first.as<std::string>() == "<<") fail(entry.first, "key '<<' is not understood: write its keys out");
      refuse_merge_keys(entry.second);
    }
  }

  Start start(const YAML::Node& node) const {
    only(node, {"seconds", "simulate"}, "a start");
    Start start;
    if (node["seconds"]) start.seconds = node["seconds"].as<double>();
    if (node["simulate"]) start.simulate = overlay(node["simulate"]);
    return start;
  }

  void add_level(const YAML::Node& row, const YAML::Node& node) {
    Level level = this->level(node);
    level.row = required(row, "row").as<std::string>();
    level.scenarios = {default_scenario_};
    if (row["scenarios"]) level.scenarios = row["scenarios"].as<std::vector<std::string>>();
    for (const std::string& scenario : level.scenarios) {
      if (table_.scenarios.count(scenario) == 0) fail(row, "there is no scenario '" + scenario + "' in the table");
    }
    if (!slugs_.insert(level.slug()).second) fail(node, "the level is there twice: " + level.slug());
    table_.levels.push_back(std::move(level));
  }

  Level level(const YAML::Node& node) const {
    std::set<std::string> known = kBelieved;
    known.insert({"level", "seconds", "simulate", "map", "calibration", "bands"});
    only(node, known, "a level");
    Level level;
    level.name = required(node, "level").as<std::string>();
    if (node["seconds"]) level.seconds = node["seconds"].as<double>();
    if (node["simulate"]) level.simulate = overlay(node["simulate"]);
    if (node["map"]) level.map = overlay(node["map"]);
    if (node["calibration"]) level.calibration = calibration(node["calibration"]);
    for (const auto& band : node["bands"]) {
      level.bands[band.first.as<std::string>()] = {band.second[0].as<double>(), band.second[1].as<double>()};
    }
    for (const std::string& file : kBelieved) {
      if (node[file]) level.believed.emplace(file, overlay(node[file]));
    }
    return level;
  }

  Miscalibration calibration(const YAML::Node& node) const {
    only(node, {"focal", "principal", "distortion", "roll_deg", "pitch_deg", "yaw_deg"}, "a calibration");
    Miscalibration wrong;
    const auto read = [&](const char* key, double& value) {
      if (node[key]) value = node[key].as<double>();
    };
    read("focal", wrong.focal);
    read("distortion", wrong.distortion);
    read("roll_deg", wrong.roll_deg);
    read("pitch_deg", wrong.pitch_deg);
    read("yaw_deg", wrong.yaw_deg);
    if (node["principal"]) {
      wrong.principal_u = node["principal"][0].as<double>();
      wrong.principal_v = node["principal"][1].as<double>();
    }
    return wrong;
  }

  std::filesystem::path file_;
  Table table_;
  std::string default_scenario_;
  std::set<std::string> slugs_;
};

}  // namespace

std::string Level::slug() const {
  std::string slug;
  bool gap = false;
  const std::string text = name.empty() ? row : row + " " + name;
  for (const char c : text) {
    const bool sign = (c == '-' || c == '+') && gap;  // of a number, not within a word
    if (std::isalnum(static_cast<unsigned char>(c)) == 0 && c != '.' && !sign) {
      gap = true;
      continue;
    }
    if (gap && !slug.empty()) slug += '-';
    gap = false;
    if (sign) {
      slug += c == '+' ? "plus" : "minus";
    } else {
      slug += static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
    }
  }
  return slug;
}

Table Table::load(const std::filesystem::path& file) {
  try {
    return Reader(file).table();
  } catch (const YAML::Exception& error) {
    throw std::runtime_error(fmt::format("{}:{}: {}", file.string(), error.mark.line + 1, error.msg));
  }
}

YAML::Node merged(const YAML::Node& under, const YAML::Node& over) {
  const bool nothing_over = !over || over.IsNull();
  if (nothing_over && (!under || !under.IsMap())) return under ? YAML::Clone(under) : YAML::Node();
  if (!nothing_over && !over.IsMap()) return YAML::Clone(over);
  // Built anew key by key: assigning to a key of a clone would change what an alias within it stands for, too.
  YAML::Node result(YAML::NodeType::Map);
  if (under && under.IsMap()) {
    for (const auto& entry : under) {
      const auto key = entry.first.as<std::string>();
      result[key] = merged(entry.second, nothing_over ? YAML::Node() : over[key]);
    }
  }
  if (nothing_over) return result;
  for (const auto& entry : over) {
    const auto key = entry.first.as<std::string>();
    if (!result[key]) result[key] = merged({}, entry.second);
  }
  return result;
}

}  // namespace orthonav::sensitivity
