// Figures of orthonav-evaluate's report.json (tools/evaluate/README.md), and how tables show them.
#pragma once

#include <string>
#include <vector>

#include <nlohmann/json.hpp>

namespace orthonav {

// NaN: the report does not know it.
double figure_of(const nlohmann::json& report, const char* json_pointer);

// A dash for what is unknown.
std::string cell(double value, int decimals);

// Of several flights, one of which without the figure counts as the worst and not as absent: infinite. NaN: no flights.
struct Spread {
  double middle = 0, worst = 0;

  static Spread of(std::vector<double> values);
};

}  // namespace orthonav
