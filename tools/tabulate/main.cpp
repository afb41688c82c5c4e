// Puts report.json files of orthonav-evaluate into one Markdown table, with their medians.
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "tools/tabulate/report_figures.h"

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
        const double value = kColumns[i].factor * orthonav::figure_of(report, kColumns[i].pointer);
        values[i].push_back(value);
        fmt::print(" {} |", orthonav::cell(value, kColumns[i].decimals));
      }
      fmt::print("\n");
    } catch (const nlohmann::json::exception& error) {
      fmt::print(stderr, "orthonav-tabulate: {}: {}\n", file.string(), error.what());
      return 1;
    }
  }
  fmt::print("| **median** |");
  for (size_t i = 0; i < std::size(kColumns); ++i) {
    fmt::print(" {} |", orthonav::cell(orthonav::Spread::of(values[i]).middle, kColumns[i].decimals));
  }
  fmt::print("\n");
  return 0;
}
