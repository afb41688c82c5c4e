#include "tools/sensitivity/rows.h"

#include <cctype>
#include <set>
#include <stdexcept>

#include <fmt/format.h>

namespace orthonav::sensitivity {
namespace {

const std::set<std::string> kBelieved = {"aircraft", "vio", "registration", "map_server", "fusion", "ingest"};

class Reader {
 public:
  explicit Reader(std::filesystem::path file) : file_(std::move(file)) {}

  Table table() const {
    const YAML::Node top = YAML::LoadFile(file_.string());
    Table table;
    for (const auto& entry : top["scenarios"]) {
      ScenarioStarts starts;
      starts.in_air = start(entry.second["in_air"]);
      starts.on_ground = start(entry.second["on_ground"]);
      table.scenarios[entry.first.as<std::string>()] = starts;
    }
    std::set<std::string> slugs;
    for (const YAML::Node& row : top["rows"]) {
      for (const YAML::Node& node : row["levels"]) {
        const Level level = this->level(row, node);
        for (const std::string& scenario : level.scenarios) {
          if (table.scenarios.count(scenario) == 0) fail(row, "there is no scenario '" + scenario + "' in the table");
        }
        if (!slugs.insert(level.slug()).second) fail(node, "the level is there twice: " + level.slug());
        table.levels.push_back(level);
      }
    }
    if (table.levels.empty() || table.levels.front().row != "nominal") fail(top, "the first row must be 'nominal'");
    return table;
  }

 private:
  [[noreturn]] void fail(const YAML::Node& node, const std::string& what) const {
    throw std::runtime_error(fmt::format("{}:{}: {}", file_.string(), node.Mark().line + 1, what));
  }

  Start start(const YAML::Node& node) const {
    Start start;
    for (const auto& entry : node) {
      const auto key = entry.first.as<std::string>();
      if (key == "seconds") {
        start.seconds = entry.second.as<double>();
      } else if (key == "simulate") {
        start.simulate = entry.second;
      } else {
        fail(entry.first, "unknown key '" + key + "'");
      }
    }
    return start;
  }

  Level level(const YAML::Node& row, const YAML::Node& node) const {
    Level level;
    level.row = row["row"].as<std::string>();
    level.scenarios = {"rural"};
    if (row["scenarios"]) level.scenarios = row["scenarios"].as<std::vector<std::string>>();
    for (const auto& entry : node) {
      const auto key = entry.first.as<std::string>();
      if (key == "level") {
        level.name = entry.second.as<std::string>();
      } else if (key == "seconds") {
        level.seconds = entry.second.as<double>();
      } else if (key == "simulate") {
        level.simulate = entry.second;
      } else if (key == "map") {
        level.map = entry.second;
      } else if (key == "calibration") {
        level.calibration = calibration(entry.second);
      } else if (key == "bands") {
        for (const auto& band : entry.second) {
          level.bands[band.first.as<std::string>()] = {band.second[0].as<double>(), band.second[1].as<double>()};
        }
      } else if (kBelieved.count(key) > 0) {
        level.believed[key] = entry.second;
      } else {
        fail(entry.first, "unknown key '" + key + "'");
      }
    }
    return level;
  }

  Miscalibration calibration(const YAML::Node& node) const {
    Miscalibration wrong;
    for (const auto& entry : node) {
      const auto key = entry.first.as<std::string>();
      if (key == "principal") {
        wrong.principal_u = entry.second[0].as<double>();
        wrong.principal_v = entry.second[1].as<double>();
        continue;
      }
      const auto value = entry.second.as<double>();
      if (key == "focal") {
        wrong.focal = value;
      } else if (key == "distortion") {
        wrong.distortion = value;
      } else if (key == "roll_deg") {
        wrong.roll_deg = value;
      } else if (key == "pitch_deg") {
        wrong.pitch_deg = value;
      } else if (key == "yaw_deg") {
        wrong.yaw_deg = value;
      } else {
        fail(entry.first, "unknown key '" + key + "'");
      }
    }
    return wrong;
  }

  std::filesystem::path file_;
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
  if (!over || over.IsNull()) return under ? YAML::Clone(under) : YAML::Node();
  if (!under || !under.IsMap() || !over.IsMap()) return YAML::Clone(over);
  YAML::Node result = YAML::Clone(under);
  for (const auto& entry : over) {
    const auto key = entry.first.as<std::string>();
    result[key] = merged(under[key], entry.second);
  }
  return result;
}

}  // namespace orthonav::sensitivity
