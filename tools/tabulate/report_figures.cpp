#include "tools/tabulate/report_figures.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

namespace orthonav {

double figure_of(const nlohmann::json& report, const char* json_pointer) {
  const nlohmann::json::json_pointer at(json_pointer);
  const bool known = report.contains(at) && report[at].is_number();
  return known ? report[at].get<double>() : std::numeric_limits<double>::quiet_NaN();
}

std::string cell(double value, int decimals) {
  return std::isfinite(value) ? fmt::format("{:.{}f}", value, decimals) : "–";
}

Spread Spread::of(std::vector<double> values) {
  if (values.empty()) return {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::quiet_NaN()};
  for (double& value : values) {
    if (std::isnan(value)) value = std::numeric_limits<double>::infinity();
  }
  std::sort(values.begin(), values.end());
  // Not by interpolation: nothing of what is infinite is no number.
  return {0.5 * (values[(values.size() - 1) / 2] + values[values.size() / 2]), values.back()};
}

}  // namespace orthonav
