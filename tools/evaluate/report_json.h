// report.json and the table on standard output.
#pragma once

#include <string>

#include <nlohmann/json.hpp>

#include "tools/evaluate/metrics.h"

namespace orthonav::evaluate {

// Every key is documented in README.md. Unknown figures are null.
nlohmann::ordered_json to_json(const FlightRecord& record, const Metrics& metrics);

// The accuracy table with the paper's figures beside, for a terminal of 100 columns.
std::string to_table(const Metrics& metrics);

// "1.23" or "-" when unknown.
std::string figure(double value, int decimals = 2);

// The paper's figures, which a report shows beside its own.
struct PaperFigures {
  const char* scenario;
  double vio, registration, fusion;  // m, position RMSE
  double registration_ms;            // per frame, on an i7-6700HQ
};
inline constexpr PaperFigures kPaperRural{"Rural", 18.58, 7.41, 3.76, 15.6};
inline constexpr PaperFigures kPaperTestingZone{"Testing Zone", 69.70, 10.70, 8.75, 216.3};

}  // namespace orthonav::evaluate
