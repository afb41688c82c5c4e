// The report's HTML: complete in one file, and safe with whatever a log holds.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/evaluate/made_up_log.h"
#include "tools/evaluate/chart.h"
#include "tools/evaluate/report_html.h"

namespace orthonav::evaluate {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;
using ::testing::Not;

std::string report_of(const LogContent& content, bool with_map = false) {
  const fs::path log = fs::path(::testing::TempDir()) / "report_test.lcm";
  write_log(log, content);
  const FlightRecord record = FlightRecord::read(log);
  const Metrics metrics = evaluate(record);
  std::optional<MapPicture> map;
  if (with_map) {
    const fs::path raster = fs::path(::testing::TempDir()) / "report_test.tif";
    const double degree = 1.0 / 111000.0;
    write_geotiff(raster, cv::Mat(400, 500, CV_8UC1, cv::Scalar(90)),
                  {"EPSG:4326", {kAnchor.longitude_deg, degree, 0, kAnchor.latitude_deg, 0, -degree}});
    map.emplace(raster);
  }
  const MapPicture* shown = map ? &*map : nullptr;
  return to_html("a <flight>", record, metrics, draw_tracks(record, metrics, shown),
                 draw_matches(log, record, metrics.registration, shown));
}

// A page less the bytes of its pictures, which may spell anything.
std::string without_pictures(const std::string& html) {
  std::string text;
  size_t from = 0;
  for (size_t at; (at = html.find(";base64,", from)) != std::string::npos; from = html.find('\'', at)) {
    text += html.substr(from, at + 8 - from);
  }
  return text + html.substr(from);
}

TEST(Report, NeedsNothingFromOutside) {
  const std::string html = without_pictures(report_of({}, true));
  EXPECT_THAT(html, Not(HasSubstr("http")));
  EXPECT_THAT(html, Not(HasSubstr("<script")));
  EXPECT_THAT(html, Not(HasSubstr("nan")));
  EXPECT_THAT(html, HasSubstr("data:image/jpeg;base64,"));
  EXPECT_THAT(html, HasSubstr("class='wrong'")) << "the false fix is marked";
}

TEST(Report, EscapesWhatTheLogSays) {
  const std::string html = report_of({});
  EXPECT_THAT(html, HasSubstr("a &lt;flight&gt;"));
  EXPECT_THAT(html, HasSubstr("a &lt;b&gt;message&lt;/b&gt; &amp; more"));
}

TEST(Report, IsMadeOfWhatThereIs) {
  for (const LogContent& content : {LogContent{.truth = false}, LogContent{.truth = false, .gnss = false},
                                    LogContent{.vio = false, .keyframes = false}, LogContent{.fixes = false},
                                    LogContent{.nav = false}, LogContent{.images = false}}) {
    const std::string html = without_pictures(report_of(content));
    EXPECT_THAT(html, HasSubstr("What is missing"));
    EXPECT_THAT(html, HasSubstr("</html>"));
    EXPECT_THAT(html, Not(HasSubstr("nan")));
  }
}

TEST(Chart, SurvivesNaNAndEmptyAxes) {
  Chart chart({"x", 0, 0}, {"y", 1, std::nan("")});
  const double nan = std::nan("");
  chart.line({0, 1, 2, 3}, {nan, 1, nan, 2}, "fusion");
  chart.band({0, 1, 2}, {nan, 0, 0}, {1, nan, 1}, "fusion");
  chart.dots({0, 1}, {nan, nan}, "fix");
  const std::string svg = chart.svg();
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  EXPECT_THAT(svg, HasSubstr("</svg>"));
}

}  // namespace
}  // namespace orthonav::evaluate
