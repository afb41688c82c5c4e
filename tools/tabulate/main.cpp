// Puts report.json files of orthonav-evaluate into one Markdown table, with their medians.
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <limits>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "common/math/statistics.h"

namespace {

struct Column {
  const char* title;
  const char* pointer;  // JSON pointer into report.json
  int decimals;
  double factor = 1.0;
};

constexpr Column kColumns[] = {
    {"VIO RMSE (m)", "/vio/rmse_m", 2},
    {"restarts", "/vio/restarts", 0},
    {"registration RMSE (m)", "/registration/rmse_m", 2},
    {"true matches (%)", "/registration/true_match_rate", 1, 100.0},
    {"false fixes", "/registration/false_fixes", 0},
    {"fixes", "/registration/fixes", 0},
    {"fusion RMSE (m)", "/fusion/rmse_m", 2},
    {"horizontal (m)", "/fusion/horizontal_rmse_m", 2},
    {"vertical (m)", "/fusion/vertical_rmse_m", 2},
    {"heading (deg)", "/fusion/heading_rmse_deg", 2},
    {"first fix (s)", "/fusion/time_to_first_fix_s", 1},
};

double value_of(const nlohmann::json& report, const Column& column) {
  const nlohmann::json::json_pointer pointer(column.pointer);
  if (!report.contains(pointer) || !report[pointer].is_number()) return std::numeric_limits<double>::quiet_NaN();
  return column.factor * report[pointer].get<double>();
}

std::string cell(double value, int decimals) {
  return std::isnan(value) ? "–" : fmt::format("{:.{}f}", value, decimals);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Puts report.json files of orthonav-evaluate into one Markdown table, with their medians."};
  std::vector<std::filesystem::path> files;
  app.add_option("reports", files, "report.json files")->required()->check(CLI::ExistingFile);
  CLI11_PARSE(app, argc, argv);

  std::string head = "| flight |", rule = "|---|";
  for (const Column& column : kColumns) {
    head += fmt::format(" {} |", column.title);
    rule += "---|";
  }
  fmt::print("{}\n{}\n", head, rule);
  std::vector<std::vector<double>> values(std::size(kColumns));
  for (const auto& file : files) {
    try {
      const auto report = nlohmann::json::parse(std::ifstream(file));
      fmt::print("| {} |", file.stem().string());
      for (size_t i = 0; i < std::size(kColumns); ++i) {
        const double value = value_of(report, kColumns[i]);
        // A flight without the figure counts as the worst, not as absent.
        values[i].push_back(std::isnan(value) ? std::numeric_limits<double>::infinity() : value);
        fmt::print(" {} |", cell(value, kColumns[i].decimals));
      }
      fmt::print("\n");
    } catch (const nlohmann::json::exception& error) {
      fmt::print(stderr, "orthonav-tabulate: {}: {}\n", file.string(), error.what());
      return 1;
    }
  }
  fmt::print("| **median** |");
  for (size_t i = 0; i < std::size(kColumns); ++i) {
    const double middle = orthonav::median(values[i]);
    fmt::print(" {} |",
               cell(std::isfinite(middle) ? middle : std::numeric_limits<double>::quiet_NaN(), kColumns[i].decimals));
  }
  fmt::print("\n");
  return 0;
}
