#include "tools/evaluate/report_html.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "common/math/statistics.h"
#include "tools/evaluate/chart.h"
#include "tools/evaluate/figures.h"
#include "tools/evaluate/report_json.h"
#include "tools/evaluate/report_style.h"

namespace orthonav::evaluate {
namespace {

std::string tile(const std::string& value, const std::string& unit, const std::string& what, bool first = false) {
  return fmt::format("<div class='tile{}'><b>{} <small>{}</small></b><span>{}</span></div>", first ? " first" : "",
                     value, unit, what);
}

std::string tiles(const Metrics& metrics) {
  const FusionMetrics& fusion = metrics.fusion;
  const PositionErrors& errors = metrics.has_truth ? fusion.truth : fusion.gnss;
  std::string html = "<div class='tiles'>";
  html += tile(figure(errors.rmse), "m", "position RMSE of the fusion, 3D", true);
  html += tile(figure(errors.horizontal_rmse), "m", "of it horizontal");
  html += tile(figure(fusion.time_to_first_fix, 1), "s", "from odometry to first position");
  html += tile(figure(100.0 * metrics.registration.true_match_rate, 0), "%", "keyframes matched truly");
  html += tile(fmt::format("{}", metrics.registration.false_fixes), fmt::format("of {}", metrics.registration.valid),
               "fixes were wrong");
  html += tile(figure(fusion.heading_rmse * kDegPerRad), "\u00b0", "heading RMSE");
  return html + "</div>";
}

std::string notes(const Metrics& metrics) {
  if (metrics.notes.empty()) return "";
  std::string html = "<section class='notes'><h2>What is missing</h2><ul>";
  for (const std::string& note : metrics.notes) html += "<li>" + escaped(note) + "</li>";
  return html + "</ul></section>";
}

std::string accuracy_row(const std::string& name, const PositionErrors& errors, double heading, double rural,
                         double zone, bool strong = false) {
  return fmt::format(
      "<tr><td>{}</td><td{}>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td class='paper'>{}</td>"
      "<td class='paper'>{}</td></tr>",
      name, strong ? " class='strong'" : "", figure(errors.rmse), figure(errors.horizontal_rmse),
      figure(errors.vertical_rmse), figure(errors.p95), figure(errors.largest), figure(heading * kDegPerRad),
      figure(rural), figure(zone));
}

std::string accuracy(const Metrics& metrics) {
  const bool truth = metrics.has_truth;
  const VioMetrics& vio = metrics.vio;
  const RegistrationMetrics& registration = metrics.registration;
  const FusionMetrics& fusion = metrics.fusion;
  std::string html = fmt::format(
      "<section><h2>Accuracy against {}</h2><div class='scroll'><table><thead><tr><th></th><th>3D RMSE<br>m</th>"
      "<th>horizontal<br>m</th><th>vertical<br>m</th><th>95 %<br>m</th><th>largest<br>m</th><th>heading<br>\u00b0</th>"
      "<th class='paper'>paper, {}<br>m</th><th class='paper'>paper, {}<br>m</th></tr></thead><tbody>",
      truth ? "the truth" : "the GNSS reference", kPaperRural.scenario, kPaperTestingZone.scenario);
  html += accuracy_row("Odometry, aligned with scale", truth ? vio.truth : vio.gnss, vio.heading_rmse, kPaperRural.vio,
                       kPaperTestingZone.vio);
  html += accuracy_row("Odometry, aligned in yaw and position only", vio.yaw_only, kNan, kNan, kNan);
  html += accuracy_row("Registration, all valid fixes", truth ? registration.truth : registration.gnss,
                       registration.heading_rmse, kPaperRural.registration, kPaperTestingZone.registration);
  if (truth) html += accuracy_row("Registration, fixes within 30 m", registration.truth_correct, kNan, kNan, kNan);
  html += accuracy_row("<b>Fusion</b>, from the first position on", truth ? fusion.truth : fusion.gnss,
                       fusion.heading_rmse, kPaperRural.fusion, kPaperTestingZone.fusion, true);
  if (truth && metrics.has_gnss)
    html += accuracy_row("Fusion against the GNSS reference", fusion.gnss, kNan, kNan, kNan);
  if (truth && fusion.to_map.samples > 0) {
    html += accuracy_row("Fusion without the map's own error", fusion.to_map, kNan, kNan, kNan);
  }
  html += "</tbody></table></div><p class='caption'>";
  html += fmt::format(
      "{} keyframes were tried, {} matched truly (at least 8 inliers and within 30 m), {} gave a fix, {} of these were "
      "wrong (more than 30 m off). Odometry: scale {}, {} m of drift per 100 m, {} restarts. Reported uncertainty of "
      "the "
      "fusion: NEES {} in 3D and {} horizontally (1 is honest, more is overconfident), {} % of the time within "
      "3\u03c3; "
      "{} jumps of the position; {} % of the time without a recent fix.",
      registration.tried, registration.true_matches, registration.valid, registration.false_fixes, figure(vio.scale, 3),
      figure(vio.drift_per_100m), vio.restarts, figure(fusion.nees.position), figure(fusion.nees.horizontal),
      figure(100.0 * fusion.within_3_sigma, 1), fusion.resets, figure(100.0 * fusion.coasting_share, 1));
  return html + "</p></section>";
}

std::string map_section(const Metrics& metrics, const std::string& tracks) {
  std::string html = "<section><h2>The flight on the map</h2>" + tracks;
  html += fmt::format(
      "<p class='legend'><span><i style='background:var(--truth)'></i>{}</span>"
      "<span><i style='background:var(--fusion)'></i>fusion</span>"
      "<span><i style='background:var(--vio)'></i>odometry, aligned</span>"
      "<span><i class='dot' style='background:var(--fix)'></i>fix</span>"
      "<span><i class='dot' style='background:var(--wrong)'></i>wrong fix (\u2715), with a line to where "
      "the aircraft was</span></p></section>",
      metrics.has_truth ? "truth" : "GNSS reference");
  return html;
}

// At most a sample per pixel of a chart, so that the file stays small.
std::vector<ErrorSample> thinned(const std::vector<ErrorSample>& track) {
  const size_t step = std::max<size_t>(1, track.size() / 1600);
  std::vector<ErrorSample> samples;
  for (size_t k = 0; k < track.size(); k += step) samples.push_back(track[k]);
  return samples;
}

struct FixErrors {
  std::vector<double> time, horizontal, vertical;
  std::vector<double> wrong_time, wrong_horizontal;
};

FixErrors fix_errors(const FlightRecord& record, const RegistrationMetrics& registration) {
  FixErrors errors;
  for (const JudgedFix& fix : registration.fixes) {
    if (!fix.p_G_B || !fix.reference) continue;
    const Eigen::Vector3d e = *fix.p_G_B - fix.reference->p_G_B;
    if (fix.false_fix) {
      errors.wrong_time.push_back(record.seconds(fix.fix->utime));
      errors.wrong_horizontal.push_back(e.head<2>().norm());
    } else {
      errors.time.push_back(record.seconds(fix.fix->utime));
      errors.horizontal.push_back(e.head<2>().norm());
      errors.vertical.push_back(e.z());
    }
  }
  return errors;
}

// Wide enough for the errors and for most of the band, whatever a moment of it does.
double reach(const std::vector<double>& errors, const std::vector<double>& band) {
  std::vector<double> sizes;
  for (const double error : errors) {
    if (std::isfinite(error)) sizes.push_back(std::abs(error));
  }
  std::vector<double> known;
  for (const double value : band) {
    if (std::isfinite(value)) known.push_back(value);
  }
  const double of_errors = sizes.empty() ? 0.0 : 1.15 * quantile(sizes, 0.995);
  const double of_band = known.empty() ? 0.0 : 1.3 * quantile(known, 0.9);
  return std::max({of_errors, of_band, 1e-3});
}

std::string error_charts(const FlightRecord& record, const Metrics& metrics) {
  if (metrics.fusion.track.empty() && metrics.vio.track.empty()) return "";
  const double end = record.seconds(record.end);
  const Axis time{"time, s", 0, end};
  std::vector<double> t, horizontal, horizontal_band, vertical, band_up, band_down, heading, heading_up, heading_down;
  int64_t last = 0;
  for (const ErrorSample& sample : thinned(metrics.fusion.track)) {
    const bool gap = last != 0 && sample.utime - last > 3'000'000;
    last = sample.utime;
    t.push_back(record.seconds(sample.utime));
    horizontal.push_back(gap ? kNan : sample.error.head<2>().norm());
    horizontal_band.push_back(3.0 * sample.stddev.head<2>().norm());
    vertical.push_back(gap ? kNan : sample.error.z());
    band_up.push_back(3.0 * sample.stddev.z());
    band_down.push_back(-3.0 * sample.stddev.z());
    heading.push_back(gap ? kNan : sample.heading_error * kDegPerRad);
    heading_up.push_back(3.0 * sample.heading_stddev * kDegPerRad);
    heading_down.push_back(-heading_up.back());
  }
  std::vector<double> t_vio, vio;
  for (const ErrorSample& sample : thinned(metrics.vio.track)) {
    t_vio.push_back(record.seconds(sample.utime));
    vio.push_back(sample.error.head<2>().norm());
  }
  const FixErrors fixes = fix_errors(record, metrics.registration);
  const std::vector<double> zero(t.size(), 0.0);

  double top = reach(horizontal, horizontal_band);
  if (t.empty()) top = reach(vio, {});
  Chart h(time, {"horizontal error, m", 0, top}, 270);
  h.band(t, zero, horizontal_band, "fusion");
  h.line(t_vio, vio, "vio");
  h.dots(fixes.time, fixes.horizontal, "fix", 2.2);
  h.line(t, horizontal, "fusion");
  // A wrong fix is far beyond the plot: it is shown at its upper edge.
  h.dots(fixes.wrong_time, std::vector<double>(fixes.wrong_time.size(), 0.985 * top), "wrong", 3.5);
  h.legend("fusion", "fusion");
  h.legend("band", "3\u03c3");
  h.legend("vio", "odometry, aligned");
  h.legend("fix", "fix");
  if (!fixes.wrong_time.empty()) h.legend("wrong", "wrong fix, beyond");
  std::string html = "<section><h2>Error over time</h2>" + h.svg();

  if (!t.empty()) {
    const double up = reach(vertical, band_up);
    Chart v(time, {"vertical error, m", -up, up}, 220);
    v.band(t, band_down, band_up, "fusion");
    v.dots(fixes.time, fixes.vertical, "fix", 2.2);
    v.line(t, vertical, "fusion");
    v.legend("fusion", "fusion");
    v.legend("band", "\u00b13\u03c3");
    v.legend("fix", "fix");
    html += v.svg();
    if (metrics.has_truth) {
      const double widest = reach(heading, heading_up);
      Chart y(time, {"heading error, \u00b0", -widest, widest}, 200);
      y.band(t, heading_down, heading_up, "fusion");
      y.line(t, heading, "fusion");
      y.legend("fusion", "fusion");
      y.legend("band", "\u00b13\u03c3");
      html += y.svg();
    }
  }
  return html +
         "<p class='caption'>The band is what the fusion itself reports as three standard deviations. The odometry is "
         "aligned to the whole reference afterwards and would not know its place by itself.</p></section>";
}

std::string inlier_histogram(const RegistrationMetrics& registration) {
  if (registration.fixes.empty()) return "";
  int most = 20;
  for (const JudgedFix& fix : registration.fixes) most = std::max(most, fix.fix->num_inliers);
  const int width = std::max(1, (most + 40) / 40);
  const auto bins = static_cast<size_t>(most / width + 1);
  std::vector<int> right(bins, 0), other(bins, 0), wrong(bins, 0);
  for (const JudgedFix& fix : registration.fixes) {
    const auto bin = static_cast<size_t>(std::max(0, fix.fix->num_inliers) / width);
    ++(fix.false_fix ? wrong : fix.true_match ? right : other)[bin];
  }
  int highest = 1;
  for (size_t k = 0; k < bins; ++k) highest = std::max(highest, right[k] + other[k] + wrong[k]);
  Chart chart({"inliers of the best translation", 0, static_cast<double>(bins) * width},
              {"keyframes", 0, 1.1 * highest}, 230);
  for (size_t k = 0; k < bins; ++k) {
    const double from = static_cast<double>(k) * width;
    double level = 0;
    for (const auto& [count, css] : {std::pair{right[k], "fix"}, {other[k], "other"}, {wrong[k], "wrong"}}) {
      if (count > 0) chart.bar(from, from + width, level, level + count, css);
      level += count;
    }
  }
  chart.upright(8, "8");
  chart.legend("fix", "true match");
  chart.legend("other", "no true match");
  chart.legend("wrong", "wrong fix");
  return "<section><h2>How many matches agreed</h2>" + chart.svg() +
         fmt::format(
             "<p class='caption'>Inliers of the best translation at each of the {} keyframes tried, refused ones "
             "included. A true match has at least 8 and lies within 30 m of the reference; these have {} in the "
             "median.</p></section>",
             registration.tried, figure(registration.inliers_median, 0));
}

std::string match_section(const FlightRecord& record, const std::vector<MatchPicture>& matches) {
  if (matches.empty()) return "";
  std::string html =
      "<section><h2>Matches between camera and map</h2><p class='caption'>Left the camera's image, right "
      "the map, turned to lie as the image does; a colour is a pair.</p>";
  for (const MatchPicture& match : matches) {
    const map_fix_t& fix = *match.fix->fix;
    std::string off = "no reference at this moment";
    if (match.fix->reference && match.fix->p_G_B) {
      off = fmt::format("{:.1f} m off", (*match.fix->p_G_B - match.fix->reference->p_G_B).norm());
    } else if (match.fix->reference && match.fix->implied_en) {
      off = fmt::format("{:.0f} m off horizontally, refused: {}",
                        (*match.fix->implied_en - match.fix->reference->p_G_B.head<2>()).norm(), escaped(fix.reason));
    }
    html +=
        fmt::format("<h3>{} s: {}, {} inliers of {} candidates, {}</h3><div class='pair'><img alt='camera' src='{}'>",
                    figure(record.seconds(fix.utime), 1), escaped(match.why), fix.num_inliers, fix.num_candidates, off,
                    as_data_uri(match.camera, 75));
    if (!match.map.empty()) html += fmt::format("<img alt='map' src='{}'>", as_data_uri(match.map, 75));
    html += "</div>";
  }
  return html + "</section>";
}

std::string time_row(const std::string& name, const Times& times, const std::string& paper) {
  return fmt::format("<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td class='paper'>{}</td></tr>", name,
                     figure(times.median, 1), figure(times.p99, 1), times.samples, paper);
}

std::string timing_section(const Metrics& metrics) {
  const TransportMetrics& transport = metrics.transport;
  std::string html =
      "<section><h2>Time and losses</h2><div class='scroll'><table><thead><tr><th>wall time</th><th>median, ms</th>"
      "<th>99 %, ms</th><th>samples</th><th class='paper'>paper, ms</th></tr></thead><tbody>";
  html += time_row("Odometry, per image", metrics.vio.time, "");
  html += time_row("Registration, per keyframe", metrics.registration.time,
                   fmt::format("{} / {}", kPaperRural.registration_ms, kPaperTestingZone.registration_ms));
  html += time_row("&emsp;describing", metrics.registration.describe, "");
  html += time_row("&emsp;matching", metrics.registration.match, "");
  html += time_row("&emsp;voting and pose", metrics.registration.solve, "");
  html += time_row("Fusion, per solution", metrics.fusion.time, "");
  if (transport.latency) html += time_row("Image to NAV_STATE, on the bus", *transport.latency, "");
  html += "</tbody></table></div>";
  if (!transport.latency) html += "<p class='caption'>A replay: latency on the bus is not defined.</p>";
  html += fmt::format(
      "<p class='caption'>Lost: {} images without an odometry state, {} odometry states without a navigation state, {} "
      "keyframes missing by number, {} keyframes without an answer of the registration, {} undecodable messages.</p>",
      transport.images_without_vio, transport.vio_without_nav, transport.keyframe_gaps,
      transport.keyframes_without_fix_message, transport.undecodable);
  return html + "</section>";
}

std::string health_section(const FlightRecord& record) {
  if (record.health.empty()) return "";
  static const char* const kStates[] = {"starting", "ok", "degraded", "failed"};
  std::string html = "<section><h2>Health at the end</h2>";
  for (const auto& [service, health] : record.health) {
    const std::string state = health.state >= 0 && health.state < 4 ? kStates[health.state] : "failed";
    html += fmt::format("<details><summary><span class='state {0}'>{0}</span> <b>{1}</b> {2}</summary><table><tbody>",
                        state, escaped(service), escaped(health.message));
    for (const auto& counter : health.counters) {
      html += fmt::format("<tr><td>{}</td><td>{:.6g}</td></tr>", escaped(counter.name), counter.value);
    }
    html += "</tbody></table></details>";
  }
  return html + "</section>";
}

}  // namespace

std::string to_html(const std::string& title, const FlightRecord& record, const Metrics& metrics,
                    const std::string& tracks, const std::vector<MatchPicture>& matches) {
  std::string html = fmt::format(
      "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><meta name='viewport' content='width=device-width, "
      "initial-scale=1'><title>orthonav: {0}</title><style>{1}</style></head><body><main><header><h1>Flight report: "
      "{0}</h1><p>{2} s, {3} m flown, {4} images{5}</p></header>",
      escaped(title), kStyle, figure(metrics.duration, 1), figure(metrics.distance, 0), record.images.size(),
      std::isfinite(metrics.mean_tilt) ? fmt::format(", mean tilt {}\u00b0", figure(metrics.mean_tilt * kDegPerRad))
                                       : "");
  html += tiles(metrics);
  html += notes(metrics);
  html += accuracy(metrics);
  html += map_section(metrics, tracks);
  html += error_charts(record, metrics);
  html += inlier_histogram(metrics.registration);
  html += match_section(record, matches);
  html += timing_section(metrics);
  html += health_section(record);
  html +=
      "<footer>Made by orthonav-evaluate. Every figure is in report.json under the key that tools/evaluate/README.md "
      "documents.</footer></main></body></html>\n";
  return html;
}

}  // namespace orthonav::evaluate
