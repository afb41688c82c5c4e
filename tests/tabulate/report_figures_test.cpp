// How tables show what reports know and what they do not.
#include "tools/tabulate/report_figures.h"

#include <cmath>

#include <gtest/gtest.h>

namespace orthonav {
namespace {

TEST(ReportFigures, AreTakenByTheirPlaceAndUnknownElsewhere) {
  const auto report = nlohmann::json::parse(R"({"fusion": {"rmse_m": 1.25, "nees": null}})");
  EXPECT_EQ(figure_of(report, "/fusion/rmse_m"), 1.25);
  EXPECT_TRUE(std::isnan(figure_of(report, "/fusion/nees")));
  EXPECT_TRUE(std::isnan(figure_of(report, "/fusion/nees/position")));
  EXPECT_TRUE(std::isnan(figure_of(report, "/vio/rmse_m")));
}

TEST(ReportFigures, AreCellsOrDashes) {
  EXPECT_EQ(cell(1.256, 2), "1.26");
  EXPECT_EQ(cell(std::nan(""), 2), "–");
  EXPECT_EQ(cell(INFINITY, 0), "–");
}

TEST(ReportFigures, AFlightWithoutTheFigureIsTheWorst) {
  const Spread odd = Spread::of({3, std::nan(""), 1});
  EXPECT_EQ(odd.middle, 3);
  EXPECT_EQ(odd.worst, INFINITY);
  EXPECT_EQ(Spread::of({4, 1, 2, 9}).middle, 3);
  EXPECT_EQ(Spread::of({4, 1, 2, 9}).worst, 9);
  EXPECT_EQ(Spread::of({std::nan(""), 1}).middle, INFINITY);
  EXPECT_TRUE(std::isnan(Spread::of({}).middle));
}

}  // namespace
}  // namespace orthonav
