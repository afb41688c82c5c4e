#include "services/output/output_service.h"

#include <cmath>

#include <fmt/format.h>

#include "common/bus/channels.h"

namespace orthonav::output {

Report report_of(const nav_state_t& nav) {
  Report report;
  report.utime = nav.utime;
  report.latitude_deg = nav.latitude_deg;
  report.longitude_deg = nav.longitude_deg;
  report.ellipsoidal_height = nav.ellipsoidal_height;
  report.velocity_enu = Eigen::Vector3d(nav.v_G_B[0], nav.v_G_B[1], nav.v_G_B[2]);
  using RowMajor6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;
  report.covariance = Eigen::Map<const RowMajor6>(nav.covariance).topLeftCorner<3, 3>();
  report.num_fixes = nav.num_fixes;
  const bool located = std::isfinite(nav.latitude_deg) && std::isfinite(nav.longitude_deg) &&
                       std::isfinite(nav.ellipsoidal_height) && report.covariance.allFinite();
  if (located && (nav.mode == nav_state_t::MAP_AIDED || nav.mode == nav_state_t::REACQUIRED)) {
    report.quality = Quality::kAided;
  } else if (located && nav.mode == nav_state_t::COASTING) {
    report.quality = Quality::kEstimated;
  }
  return report;
}

OutputService::OutputService(Node& node, const std::filesystem::path& config_folder)
    : node_(node), options_(OutputOptions::load(config_folder / "output.yaml")) {
  if (options_.udp.enabled) {
    outputs_.push_back({"udp", std::make_unique<UdpSink>(options_.udp.host, options_.udp.port)});
  }
  if (options_.serial.enabled) {
    outputs_.push_back({"serial", std::make_unique<SerialSink>(options_.serial.device, options_.serial.baud)});
  }
  if (outputs_.empty()) {
    node_.health().set_state(Health::State::kOk, "every output is switched off (output.yaml)");
    return;
  }
  node_.health().set_state(Health::State::kStarting, "waiting for NAV_STATE");
  node_.subscribe<nav_state_t>(channel::kNavState, Delivery::kAll, [this](const nav_state_t& nav) { on_nav(nav); });
  node_.expect(channel::kNavState);
}

void OutputService::on_nav(const nav_state_t& nav) {
  if (const char* why = guard_.refusal(nav)) {
    node_.health().reject(fmt::format("nav.{}", why), "NAV_STATE refused: is there a second publisher?");
    return;
  }
  // States at the images' times come late among those of the inertial sensor: a reader wants time to move forward.
  const auto period = static_cast<int64_t>(1e6 / options_.rate_hz);
  const bool restarted = nav.utime < newest_ - 10'000'000;
  if (!restarted && nav.utime < newest_ + period) return;
  newest_ = nav.utime;
  const Report report = report_of(nav);
  if (report.quality == Quality::kNone) {
    node_.health().set_state(Health::State::kDegraded, "NAV_STATE has no position, and the sentences say so");
  } else {
    node_.health().set_state(Health::State::kOk);
  }
  const std::string text = rmc(report, options_.nmea) + gga(report, options_.nmea) + gst(report, options_.nmea);
  for (const Output& output : outputs_) {
    if (output.sink->write(text)) {
      node_.health().add(fmt::format("{}.sent", output.name));
    } else {
      node_.health().reject(output.name, output.sink->error());
    }
  }
}

}  // namespace orthonav::output
