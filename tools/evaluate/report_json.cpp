#include "tools/evaluate/report_json.h"

#include <cmath>

#include <fmt/format.h>

#include "tools/evaluate/figures.h"

namespace orthonav::evaluate {
namespace {

using nlohmann::ordered_json;

void put(ordered_json& into, const PositionErrors& errors) {
  into["rmse_m"] = errors.rmse;
  into["horizontal_rmse_m"] = errors.horizontal_rmse;
  into["vertical_rmse_m"] = errors.vertical_rmse;
  into["median_m"] = errors.median;
  into["p95_m"] = errors.p95;
  into["max_m"] = errors.largest;
  into["samples"] = errors.samples;
}

ordered_json short_form(const PositionErrors& errors) {
  return {{"rmse_m", errors.rmse},
          {"horizontal_rmse_m", errors.horizontal_rmse},
          {"vertical_rmse_m", errors.vertical_rmse},
          {"samples", errors.samples}};
}

ordered_json to_json(const Times& times) {
  return {{"median", times.median}, {"p99", times.p99}, {"samples", times.samples}};
}

ordered_json to_json(const std::optional<ScaleError>& scale) {
  if (!scale) return nullptr;
  return {{"error", scale->error}, {"stddev", scale->stddev}};
}

ordered_json vio_json(const VioMetrics& vio) {
  ordered_json json;
  put(json, vio.truth);
  json["vs_gnss"] = short_form(vio.gnss);
  json["yaw_aligned"] = short_form(vio.yaw_only);
  json["scale"] = vio.scale;
  json["scale_errors"] = {{"start", to_json(vio.scale_at_start)},
                          {"after_30s", to_json(vio.scale_after_30s)},
                          {"end", to_json(vio.scale_at_end)}};
  json["heading_rmse_deg"] = vio.heading_rmse * kDegPerRad;
  json["drift_m_per_100m"] = vio.drift_per_100m;
  json["restarts"] = vio.restarts;
  json["tracking_share"] = vio.tracking_share;
  json["time_ms"] = to_json(vio.time);
  return json;
}

ordered_json to_json(const ExplainedError& explained) {
  return {{"slope", explained.slope}, {"left_m", explained.left}};
}

ordered_json regression_json(const ErrorRegression& regression) {
  ordered_json json;
  json["fixes"] = regression.fixes;
  json["horizontal_m"] = regression.horizontal;
  json["tilt_height"] = to_json(regression.tilt_height);
  json["heading"] = to_json(regression.heading);
  json["scale"] = to_json(regression.scale);
  json["offset"] = {
      {"east_m", regression.offset_en.x()}, {"north_m", regression.offset_en.y()}, {"left_m", regression.offset_left}};
  json["together"] = nullptr;
  if (const Eigen::VectorXd& slopes = regression.together; slopes.size() == 5) {
    json["together"] = {{"tilt_height", slopes[0]}, {"heading", slopes[1]}, {"scale", slopes[2]},
                        {"east_m", slopes[3]},      {"north_m", slopes[4]}, {"left_m", regression.together_left}};
  }
  json["vertical_m"] = regression.vertical;
  json["scale_height"] = to_json(regression.scale_height);
  json["vertical_offset"] = to_json(regression.vertical_offset);
  json["vertical_together_left_m"] = regression.vertical_together_left;
  return json;
}

ordered_json registration_json(const RegistrationMetrics& registration) {
  ordered_json json;
  put(json, registration.truth);
  json["vs_gnss"] = short_form(registration.gnss);
  json["within_30m"] = short_form(registration.truth_correct);
  json["relative_to_map"] = short_form(registration.to_map);
  json["heading_rmse_deg"] = registration.heading_rmse * kDegPerRad;
  json["keyframes_tried"] = registration.tried;
  json["fixes"] = registration.valid;
  json["true_matches"] = registration.true_matches;
  json["true_match_rate"] = registration.true_match_rate;
  json["false_fixes"] = registration.false_fixes;
  json["true_match_inliers_median"] = registration.inliers_median;
  json["time_ms"] = to_json(registration.time);
  json["describe_ms"] = to_json(registration.describe);
  json["match_ms"] = to_json(registration.match);
  json["solve_ms"] = to_json(registration.solve);
  json["regression"] = regression_json(registration.regression);
  return json;
}

ordered_json protection_json(const ProtectionStatistics& protection) {
  ordered_json json;
  json["epochs"] = protection.epochs;
  json["bounded"] = protection.bounded;
  json["bounded_share"] = protection.bounded_share;
  json["misleading_horizontal"] = protection.misleading_horizontal;
  json["misleading_vertical"] = protection.misleading_vertical;
  json["horizontal_median_m"] = protection.horizontal_median;
  json["vertical_median_m"] = protection.vertical_median;
  json["largest_horizontal_part"] = protection.largest_horizontal_part;
  json["largest_vertical_part"] = protection.largest_vertical_part;
  return json;
}

ordered_json fusion_json(const FusionMetrics& fusion) {
  ordered_json json;
  put(json, fusion.truth);
  json["vs_gnss"] = short_form(fusion.gnss);
  json["relative_to_map"] = short_form(fusion.to_map);
  json["heading_rmse_deg"] = fusion.heading_rmse * kDegPerRad;
  json["velocity_rmse_m_s"] = fusion.velocity_rmse;
  json["nees"] = {{"position", fusion.nees.position},
                  {"horizontal", fusion.nees.horizontal},
                  {"velocity", fusion.nees.velocity},
                  {"attitude", fusion.nees.attitude},
                  {"pose", fusion.nees.pose}};
  json["protection"] = protection_json(fusion.protection);
  json["outages"] = ordered_json::array();
  for (const Outage& outage : fusion.outages) {
    json["outages"].push_back({{"begin_s", outage.begin},
                               {"duration_s", outage.duration},
                               {"without_position_s", outage.without_position},
                               {"largest_horizontal_error_m", outage.largest_error},
                               {"reacquired", outage.ended}});
  }
  json["inertial"] = short_form(fusion.inertial.errors);
  json["inertial"]["rate_hz"] = fusion.inertial.rate_hz;
  json["within_3_sigma"] = fusion.within_3_sigma;
  json["time_to_first_fix_s"] = fusion.time_to_first_fix;
  json["time_to_first_fix_from_start_s"] = fusion.time_to_first_fix_from_start;
  json["coasting_share"] = fusion.coasting_share;
  json["located_share"] = fusion.located_share;
  json["resets"] = fusion.resets;
  json["time_ms"] = to_json(fusion.time);
  return json;
}

ordered_json health_json(const FlightRecord& record) {
  static const char* const kStates[] = {"starting", "ok", "degraded", "failed"};
  const auto name_of = [](int8_t state) { return state >= 0 && state < 4 ? kStates[state] : "unknown"; };
  ordered_json json = ordered_json::object();
  for (const auto& [service, health] : record.health) {
    ordered_json entry;
    entry["state"] = name_of(health.state);
    entry["message"] = health.message;
    entry["counters"] = ordered_json::object();
    for (const auto& counter : health.counters) entry["counters"][counter.name] = counter.value;
    entry["said"] = ordered_json::array();
    for (const HealthWords& words : record.health_words.at(service)) {
      entry["said"].push_back({{"message", words.message},
                               {"state", name_of(words.state)},
                               {"first_s", record.seconds(words.first)},
                               {"heartbeats", words.heartbeats}});
    }
    json[service] = entry;
  }
  return json;
}

std::string row(const std::string& name, const PositionErrors& errors, double heading, double rural, double zone) {
  return fmt::format("{:<26} {:>9} {:>11} {:>9} {:>9} {:>9} {:>9}\n", name, figure(errors.rmse),
                     figure(errors.horizontal_rmse), figure(errors.vertical_rmse), figure(heading * kDegPerRad),
                     figure(rural), figure(zone));
}

}  // namespace

std::string figure(double value, int decimals) {
  return std::isfinite(value) ? fmt::format("{:.{}f}", value, decimals) : "-";
}

nlohmann::ordered_json to_json(const FlightRecord& record, const Metrics& metrics) {
  ordered_json json;
  json["reference"] = metrics.has_truth ? "truth" : metrics.has_gnss ? "gnss" : "none";
  json["flight"] = {{"duration_s", metrics.duration},
                    {"distance_m", metrics.distance},
                    {"mean_tilt_deg", metrics.mean_tilt * kDegPerRad},
                    {"images", record.images.size()}};
  json["vio"] = vio_json(metrics.vio);
  json["registration"] = registration_json(metrics.registration);
  json["fusion"] = fusion_json(metrics.fusion);
  const TransportMetrics& transport = metrics.transport;
  json["latency_ms"] = transport.latency ? to_json(*transport.latency) : ordered_json(nullptr);
  json["lost"] = {{"images_without_vio_state", transport.images_without_vio},
                  {"vio_states_without_nav_state", transport.vio_without_nav},
                  {"keyframe_ids_missing", transport.keyframe_gaps},
                  {"keyframes_without_map_fix", transport.keyframes_without_fix_message},
                  {"undecodable_messages", transport.undecodable},
                  {"damaged_log_bytes", record.skipped_bytes}};
  json["health"] = health_json(record);
  json["notes"] = metrics.notes;
  return json;
}

std::string to_table(const Metrics& metrics) {
  const bool truth = metrics.has_truth;
  const VioMetrics& vio = metrics.vio;
  const RegistrationMetrics& registration = metrics.registration;
  const FusionMetrics& fusion = metrics.fusion;
  const double nan = std::nan("");
  std::string text = fmt::format("Position error against {}, RMSE in metres {:>32}\n",
                                 truth ? "the truth" : "the GNSS reference", "paper, 3D");
  text += fmt::format("{:<26} {:>9} {:>11} {:>9} {:>9} {:>9} {:>9}\n", "", "3D", "horizontal", "vertical", "head. deg",
                      kPaperRural.scenario, "Test.Zone");
  text += row("VIO, aligned with scale", truth ? vio.truth : vio.gnss, vio.heading_rmse, kPaperRural.vio,
              kPaperTestingZone.vio);
  text += row("VIO, aligned in yaw", vio.yaw_only, nan, nan, nan);
  text += row("registration, valid fixes", truth ? registration.truth : registration.gnss, registration.heading_rmse,
              kPaperRural.registration, kPaperTestingZone.registration);
  text += row("fusion, from first fix", truth ? fusion.truth : fusion.gnss, fusion.heading_rmse, kPaperRural.fusion,
              kPaperTestingZone.fusion);
  if (truth && metrics.has_gnss) text += row("fusion against GNSS", fusion.gnss, nan, nan, nan);
  text += fmt::format("keyframes tried {}, true matches {} ({} %), fixes {}, of them wrong {}\n", registration.tried,
                      registration.true_matches, figure(100.0 * registration.true_match_rate, 1), registration.valid,
                      registration.false_fixes);
  text += fmt::format("first fix {} s after the odometry began; odometry restarts {}; NEES {}\n",
                      figure(fusion.time_to_first_fix, 1), vio.restarts, figure(fusion.nees.position));
  const ProtectionStatistics& protection = fusion.protection;
  text += fmt::format(
      "protection levels, median {} / {} m; {} of {} epochs bounded, misleading {} horizontally, {} vertically\n",
      figure(protection.horizontal_median, 1), figure(protection.vertical_median, 1), protection.bounded,
      protection.epochs, protection.misleading_horizontal, protection.misleading_vertical);
  if (const ErrorRegression& causes = registration.regression; std::isfinite(causes.horizontal)) {
    text += fmt::format(
        "fixes err by {} m an axis horizontally; less {} of tilt x height {}, less heading {}, less scale {}, less a "
        "constant {}, less all {}\n",
        figure(causes.horizontal), figure(causes.tilt_height.slope), figure(causes.tilt_height.left),
        figure(causes.heading.left), figure(causes.scale.left), figure(causes.offset_left),
        figure(causes.together_left));
    text +=
        fmt::format("fixes err by {} m vertically; less {} of scale x height {}, less a constant {}, less both {}\n",
                    figure(causes.vertical), figure(causes.scale_height.slope), figure(causes.scale_height.left),
                    figure(causes.vertical_offset.left), figure(causes.vertical_together_left));
  }
  for (const Outage& outage : fusion.outages) {
    text += fmt::format("without the map from {} s for {} s, at most {} m off\n", figure(outage.begin, 1),
                        figure(outage.duration, 1), figure(outage.largest_error, 1));
  }
  text += fmt::format("ms per frame, median / p99: vio {} / {}, registration {} / {}, fusion {} / {}\n",
                      figure(vio.time.median, 1), figure(vio.time.p99, 1), figure(registration.time.median, 1),
                      figure(registration.time.p99, 1), figure(fusion.time.median, 1), figure(fusion.time.p99, 1));
  if (const auto& latency = metrics.transport.latency) {
    text += fmt::format("image to NAV_STATE: {} / {} ms\n", figure(latency->median, 1), figure(latency->p99, 1));
  }
  for (const std::string& note : metrics.notes) text += "note: " + note + "\n";
  return text;
}

}  // namespace orthonav::evaluate
