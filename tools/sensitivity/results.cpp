#include "tools/sensitivity/results.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <limits>
#include <map>
#include <set>
#include <stdexcept>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "common/bus/wording.h"
#include "common/math/statistics.h"
#include "tools/tabulate/report_figures.h"

namespace orthonav::sensitivity {
namespace {

using nlohmann::json;
using nlohmann::ordered_json;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kRightUpTo = 2.0;      // times the nominal RMSE
constexpr double kHonestNees = 6.0;     // of 3 freedoms
constexpr size_t kLongestHealth = 110;  // characters of the table's last column

bool is_honest(const Figures& figures) {
  return figures.nees <= kHonestNees && figures.beyond_horizontal + figures.beyond_vertical == 0;
}

// The nominal run is no yardstick for itself: it is right when it is honest.
Verdict judge(const Figures& figures, const Figures& nominal, bool is_nominal) {
  if (!(figures.epochs > 0)) return Verdict::kSilent;
  if (is_nominal) return is_honest(figures) ? Verdict::kRight : Verdict::kWrong;
  if (figures.rmse <= kRightUpTo * nominal.rmse) return Verdict::kRight;
  return is_honest(figures) ? Verdict::kWide : Verdict::kWrong;
}

// Results of one level in one scenario.
using Group = std::vector<const Result*>;

template <class Get>
std::vector<double> values(const Group& group, Get get) {
  std::vector<double> all;
  for (const Result* result : group) all.push_back(get(result->figures));
  return all;
}

template <class Get>
std::string median_and_worst(const Group& group, int decimals, Get get) {
  const Spread spread = Spread::of(values(group, get));
  const std::string worst = cell(spread.worst, decimals);
  return group.size() == 1 ? worst : cell(spread.middle, decimals) + " / " + worst;
}

template <class Get>
double sum(const Group& group, Get get) {
  double total = 0;
  for (const double value : values(group, get)) total += std::isnan(value) ? 0.0 : value;
  return total;
}

// The error furthest from zero, %.
template <class Get>
std::string furthest(const Group& group, Get get) {
  double most = kNan;
  for (const double value : values(group, get)) {
    if (!std::isnan(value) && !(std::abs(value) <= std::abs(most))) most = value;
  }
  return std::isnan(most) ? "–" : fmt::format("{:+.1f}", 100 * most);
}

std::string verdicts(const Group& group) {
  std::vector<const char*> names;
  for (const Result* result : group) names.push_back(name_of(result->verdict));
  return fmt::format("{}", fmt::join(names, " "));
}

std::string words(const Group& group) {
  std::set<std::string> said;
  for (const Result* result : group) said.insert(result->health.begin(), result->health.end());
  std::string text = fmt::format("{}", fmt::join(said, "; "));
  std::replace(text.begin(), text.end(), '|', '/');
  if (text.size() > kLongestHealth) text.replace(kLongestHealth, std::string::npos, "...");
  return text;
}

std::vector<Group> grouped(const Table& table, const std::vector<Result>& results) {
  std::map<std::pair<size_t, std::string>, Group> groups;
  for (const Result& result : results) groups[{result.run->level, result.run->scenario}].push_back(&result);
  std::vector<Group> ordered;
  for (size_t level = 0; level < table.levels.size(); ++level) {
    for (const std::string& scenario : table.levels[level].scenarios) {
      const auto group = groups.find({level, scenario});
      if (group != groups.end()) ordered.push_back(group->second);
    }
  }
  return ordered;
}

std::string summary(const std::vector<Result>& results) {
  int counts[4] = {}, lying = 0;
  double bounded = 0, horizontal = 0, vertical = 0;
  std::map<std::string, int> commits;
  for (const Result& result : results) {
    const Figures& f = result.figures;
    ++counts[static_cast<int>(result.verdict)];
    ++commits[result.flown_by.empty() ? "unknown" : result.flown_by];
    if (!(f.epochs > 0)) continue;
    bounded += f.bounded;
    horizontal += f.beyond_horizontal;
    vertical += f.beyond_vertical;
    lying += f.beyond_horizontal + f.beyond_vertical > 0 ? 1 : 0;
  }
  std::string text = fmt::format("\n{} runs: {} right, {} wide, {} WRONG, {} silent\n", results.size(), counts[0],
                                 counts[1], counts[2], counts[3]);
  text += fmt::format(
      "beyond their protection level: {:.0f} epochs horizontally, {:.0f} vertically, of {:.0f} bounded, in {} runs\n",
      horizontal, vertical, bounded, lying);
  for (const auto& [commit, runs] : commits) text += fmt::format("flown by {}: {} runs\n", commit, runs);
  return text;
}

ordered_json run_json(const Table& table, const Result& result) {
  const Figures& f = result.figures;
  const Level& level = table.levels[result.run->level];
  return {{"row", level.row},
          {"level", level.name},
          {"scenario", result.run->scenario},
          {"seed", result.run->seed},
          {"name", result.run->name},
          {"commit", result.flown_by},
          {"verdict", name_of(result.verdict)},
          {"rmse_m", f.rmse},
          {"horizontal_m", f.horizontal},
          {"vertical_m", f.vertical},
          {"nees", f.nees},
          {"epochs", f.epochs},
          {"bounded", f.bounded},
          {"beyond_horizontal", f.beyond_horizontal},
          {"beyond_vertical", f.beyond_vertical},
          {"located_share", f.located_share},
          {"bounded_share", f.bounded_share},
          {"fixes", f.fixes},
          {"false_fixes", f.false_fixes},
          {"first_position_s", f.first_position},
          {"scale_error_start", f.scale_start},
          {"scale_claim_start", f.claim_start},
          {"scale_error_30s", f.scale_30s},
          {"scale_claim_30s", f.claim_30s},
          {"scale_error_end", f.scale_end},
          {"scale_claim_end", f.claim_end},
          {"health", result.health}};
}

}  // namespace

const char* name_of(Verdict verdict) {
  switch (verdict) {
    case Verdict::kRight:
      return "right";
    case Verdict::kWide:
      return "wide";
    case Verdict::kWrong:
      return "WRONG";
    case Verdict::kSilent:
      break;
  }
  return "silent";
}

Figures Figures::of(const json& report) {
  Figures f;
  f.rmse = figure_of(report, "/fusion/rmse_m");
  f.horizontal = figure_of(report, "/fusion/horizontal_rmse_m");
  f.vertical = figure_of(report, "/fusion/vertical_rmse_m");
  f.nees = 3 * figure_of(report, "/fusion/nees/position");
  f.epochs = figure_of(report, "/fusion/protection/epochs");
  f.bounded = figure_of(report, "/fusion/protection/bounded");
  f.beyond_horizontal = figure_of(report, "/fusion/protection/misleading_horizontal");
  f.beyond_vertical = figure_of(report, "/fusion/protection/misleading_vertical");
  f.located_share = figure_of(report, "/fusion/located_share");
  f.bounded_share = figure_of(report, "/fusion/protection/bounded_share");
  f.fixes = figure_of(report, "/registration/fixes");
  f.false_fixes = figure_of(report, "/registration/false_fixes");
  f.first_position = figure_of(report, "/fusion/time_to_first_fix_from_start_s");
  f.scale_start = figure_of(report, "/vio/scale_errors/start/error");
  f.scale_30s = figure_of(report, "/vio/scale_errors/after_30s/error");
  f.scale_end = figure_of(report, "/vio/scale_errors/end/error");
  f.claim_start = figure_of(report, "/vio/scale_errors/start/stddev");
  f.claim_30s = figure_of(report, "/vio/scale_errors/after_30s/stddev");
  f.claim_end = figure_of(report, "/vio/scale_errors/end/stddev");
  if (report.contains("health")) {
    for (const auto& [service, health] : report["health"].items()) {
      if (!health.contains("said")) continue;
      for (const json& said : health["said"]) {
        const auto state = said.value("state", std::string());
        if (state != "degraded" && state != "failed") continue;
        f.health.push_back(service + ": " + said.value("message", std::string()));
      }
    }
  }
  return f;
}

std::vector<Result> read_results(const Plan& plan, const std::filesystem::path& folder) {
  std::vector<Result> results;
  std::map<std::pair<std::string, uint64_t>, Figures> nominal;
  for (const Run& run : plan.runs) {
    const std::filesystem::path file = folder / (run.name + ".json");
    if (!std::filesystem::exists(file)) continue;
    Result result{.run = &run, .figures = {}, .verdict = Verdict::kSilent, .health = {}, .flown_by = {}};
    std::ifstream flown_by(folder / (run.name + ".flown-by"));
    flown_by >> result.flown_by;
    try {
      result.figures = Figures::of(json::parse(std::ifstream(file)));
    } catch (const json::exception& error) {
      throw std::runtime_error(fmt::format("{}: {}", file.string(), error.what()));
    }
    if (run.level == 0) nominal[{run.scenario, run.seed}] = result.figures;
    results.push_back(result);
  }
  for (Result& result : results) {
    const auto compared = nominal.find({result.run->scenario, result.run->seed});
    if (compared == nominal.end()) {
      throw std::invalid_argument(fmt::format("{}: its nominal run is missing", result.run->name));
    }
    const bool is_nominal = result.run->level == 0;
    result.verdict = judge(result.figures, compared->second, is_nominal);
    const auto& usual = compared->second.health;
    for (const std::string& said : result.figures.health) {
      const bool news = is_nominal || std::none_of(usual.begin(), usual.end(), [&](const std::string& other) {
                          return wording(other) == wording(said);
                        });
      if (news) result.health.push_back(said);
    }
  }
  return results;
}

std::string to_table(const Table& table, const std::vector<Result>& results) {
  std::string text =
      "| row | level | scenario | verdict, by seed | RMSE (m) | horizontal (m) | NEES of 3 | beyond its bound, "
      "horizontally / "
      "vertically | of bounded epochs | with position (%) | bounded (%) | false fixes | first position (s) | "
      "odometry's "
      "scale off at start / 30 s / end (%) | health said |\n"
      "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n";
  for (const Group& group : grouped(table, results)) {
    const Run& run = *group.front()->run;
    const Level& level = table.levels[run.level];
    text += fmt::format("| {} | {} | {} | {} |", level.row, level.name, run.scenario, verdicts(group));
    text += fmt::format(" {} | {} | {} |", median_and_worst(group, 2, [](const Figures& f) { return f.rmse; }),
                        median_and_worst(group, 2, [](const Figures& f) { return f.horizontal; }),
                        median_and_worst(group, 1, [](const Figures& f) { return f.nees; }));
    text += fmt::format(" {:.0f} / {:.0f} | {:.0f} |", sum(group, [](const Figures& f) { return f.beyond_horizontal; }),
                        sum(group, [](const Figures& f) { return f.beyond_vertical; }),
                        sum(group, [](const Figures& f) { return f.bounded; }));
    text += fmt::format(" {} | {} |",
                        cell(100 * median(values(group, [](const Figures& f) { return f.located_share; })), 0),
                        cell(100 * median(values(group, [](const Figures& f) { return f.bounded_share; })), 0));
    text += fmt::format(" {:.0f} of {:.0f} | {} |", sum(group, [](const Figures& f) { return f.false_fixes; }),
                        sum(group, [](const Figures& f) { return f.fixes; }),
                        median_and_worst(group, 1, [](const Figures& f) { return f.first_position; }));
    text += fmt::format(" {} / {} / {} | {} |\n", furthest(group, [](const Figures& f) { return f.scale_start; }),
                        furthest(group, [](const Figures& f) { return f.scale_30s; }),
                        furthest(group, [](const Figures& f) { return f.scale_end; }), words(group));
  }
  return text + summary(results);
}

ordered_json to_json(const Table& table, const std::vector<Result>& results) {
  ordered_json top;
  top["runs"] = ordered_json::array();
  for (const Result& result : results) top["runs"].push_back(run_json(table, result));
  return top;
}

std::vector<std::string> outside_bands(const Table& table, const Plan& plan, const std::vector<Result>& results) {
  std::vector<std::string> faults;
  for (const Run& run : plan.runs) {
    const bool flown = std::any_of(results.begin(), results.end(), [&](const Result& r) { return r.run == &run; });
    if (!table.levels[run.level].bands.empty() && !flown) faults.push_back(run.name + ": was not flown");
  }
  for (const Result& result : results) {
    const ordered_json json = run_json(table, result);
    for (const auto& [figure, band] : table.levels[result.run->level].bands) {
      const double value = json.contains(figure) && json[figure].is_number() ? json[figure].get<double>() : kNan;
      if (value >= band.first && value <= band.second) continue;
      faults.push_back(fmt::format("{}: {} is {}, not within {} to {}", result.run->name, figure, cell(value, 3),
                                   band.first, band.second));
    }
  }
  return faults;
}

}  // namespace orthonav::sensitivity
