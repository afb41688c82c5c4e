#include "tools/evaluate/flight_record.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/bus/keyframe_repeats.h"
#include "common/bus/wording.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/map_info_t.hpp"
#include "orthonav/truth_t.hpp"

namespace orthonav::evaluate {
namespace {

constexpr int64_t kLargestGap = 500'000;  // microseconds that a reference is interpolated over

// Collects the messages of one channel as they come; positions wait until the frame is known.
struct Collected {
  FlightRecord record;
  std::vector<truth_t> truth;
  std::vector<gnss_reference_t> gnss;
  std::optional<Geodetic> map_anchor;
  KeyframeRepeats repeats;
};

bool is_place(double latitude_deg, double longitude_deg, double height) {
  return std::isfinite(latitude_deg) && std::isfinite(longitude_deg) && std::isfinite(height);
}

template <class Msg, class Keep>
void take(const LogEvent& event, Collected& collected, Keep keep) {
  ChannelCount& count = collected.record.channels[event.channel];
  ++count.messages;
  if (const auto message = event.decode<Msg>()) {
    keep(*message);
  } else {
    ++count.undecodable;
  }
}

void remember_words(const health_t& health, std::vector<HealthWords>& said) {
  if (health.message.empty()) return;
  auto words = std::find_if(said.begin(), said.end(),
                            [&](const HealthWords& w) { return wording(w.message) == wording(health.message); });
  if (words == said.end()) words = said.insert(said.end(), {health.message, health.state, health.utime, 0});
  ++words->heartbeats;
  words->state = std::max(words->state, health.state);
}

void sort_in(const LogEvent& event, Collected& collected) {
  FlightRecord& record = collected.record;
  if (event.channel == channel::kTruth) {
    take<truth_t>(event, collected, [&](const truth_t& m) {
      if (is_place(m.latitude_deg, m.longitude_deg, m.ellipsoidal_height)) collected.truth.push_back(m);
    });
  } else if (event.channel == channel::kGnssReference) {
    take<gnss_reference_t>(event, collected, [&](const gnss_reference_t& m) {
      if (is_place(m.latitude_deg, m.longitude_deg, m.ellipsoidal_height)) collected.gnss.push_back(m);
    });
  } else if (event.channel == channel::kCamera) {
    take<image_t>(event, collected, [&](const image_t& m) { record.images.emplace(m.utime, event.utime); });
  } else if (event.channel == channel::kVioState) {
    take<vio_state_t>(event, collected, [&](const vio_state_t& m) { record.vio.push_back({event.utime, m}); });
  } else if (event.channel == channel::kVioKeyframe) {
    take<vio_keyframe_t>(event, collected, [&](vio_keyframe_t m) {
      if (collected.repeats.add(m)) return;
      m.features.clear();
      m.features.shrink_to_fit();
      record.keyframes.push_back(std::move(m));
    });
  } else if (event.channel == channel::kMapFix) {
    take<map_fix_t>(event, collected, [&](const map_fix_t& m) {
      record.fixes.push_back(m);
      if (!collected.map_anchor && is_place(m.anchor_latitude_deg, m.anchor_longitude_deg, m.anchor_height)) {
        collected.map_anchor = {m.anchor_latitude_deg, m.anchor_longitude_deg, m.anchor_height};
      }
    });
  } else if (event.channel == channel::kMapInfo) {
    take<map_info_t>(event, collected, [&](const map_info_t& m) {
      if (!collected.map_anchor) {
        collected.map_anchor = {m.anchor_latitude_deg, m.anchor_longitude_deg, m.anchor_height};
      }
    });
  } else if (event.channel == channel::kNavState) {
    take<nav_state_t>(event, collected, [&](const nav_state_t& m) {
      (m.source == nav_state_t::INERTIAL ? record.nav_inertial : record.nav).push_back({event.utime, m});
    });
  } else if (event.channel == channel::kHealth) {
    take<health_t>(event, collected, [&](const health_t& m) {
      record.health[m.service] = m;
      remember_words(m, record.health_words[m.service]);
    });
  } else {
    ++record.channels[event.channel].messages;
  }
}

void choose_frame(Collected& collected) {
  if (collected.map_anchor) {
    collected.record.frame.emplace(*collected.map_anchor);
  } else if (!collected.truth.empty()) {
    const truth_t& first = collected.truth.front();
    collected.record.frame.emplace(Geodetic{first.latitude_deg, first.longitude_deg, first.ellipsoidal_height});
  } else if (!collected.gnss.empty()) {
    const gnss_reference_t& first = collected.gnss.front();
    collected.record.frame.emplace(Geodetic{first.latitude_deg, first.longitude_deg, first.ellipsoidal_height});
  }
}

void place_references(Collected& collected) {
  FlightRecord& record = collected.record;
  if (!record.frame) return;
  for (const truth_t& m : collected.truth) {
    ReferenceSample sample;
    sample.utime = m.utime;
    sample.p_G_B = record.frame->to_enu({m.latitude_deg, m.longitude_deg, m.ellipsoidal_height});
    const Eigen::Quaterniond q_G_local(Eigen::Matrix3d(record.frame->R_local_G(sample.p_G_B).transpose()));
    sample.q_G_B = (q_G_local * quaternion_of(m.q_ENU_B)).normalized();
    sample.map_offset_en = Eigen::Vector2d(m.map_offset_en[0], m.map_offset_en[1]);
    sample.height_above_ground = m.height_above_ground;
    record.truth.add(sample);
  }
  for (const gnss_reference_t& m : collected.gnss) {
    ReferenceSample sample;
    sample.utime = m.utime;
    sample.p_G_B = record.frame->to_enu({m.latitude_deg, m.longitude_deg, m.ellipsoidal_height});
    sample.height_above_ground = std::nan("");
    record.gnss.add(sample);
  }
  record.truth.finish();
  record.gnss.finish();
}

void find_span(FlightRecord& record) {
  std::vector<int64_t> times;
  auto add_ends = [&](const auto& samples, auto utime_of) {
    if (samples.empty()) return;
    times.push_back(utime_of(*samples.begin()));
    times.push_back(utime_of(*samples.rbegin()));
  };
  add_ends(record.images, [](const auto& image) { return image.first; });
  if (times.empty()) {
    add_ends(record.truth.samples(), [](const auto& s) { return s.utime; });
    add_ends(record.gnss.samples(), [](const auto& s) { return s.utime; });
    add_ends(record.vio, [](const auto& s) { return s.message.utime; });
    add_ends(record.nav, [](const auto& s) { return s.message.utime; });
  }
  if (times.empty()) return;
  record.begin = *std::min_element(times.begin(), times.end());
  record.end = *std::max_element(times.begin(), times.end());
}

}  // namespace

void Reference::finish() {
  std::stable_sort(samples_.begin(), samples_.end(),
                   [](const ReferenceSample& a, const ReferenceSample& b) { return a.utime < b.utime; });
}

std::optional<ReferenceSample> Reference::at(int64_t utime) const {
  const auto after = std::lower_bound(samples_.begin(), samples_.end(), utime,
                                      [](const ReferenceSample& s, int64_t wanted) { return s.utime < wanted; });
  if (after == samples_.end()) return std::nullopt;
  if (after->utime == utime) return *after;
  if (after == samples_.begin()) return std::nullopt;
  const ReferenceSample& before = *(after - 1);
  const int64_t gap = after->utime - before.utime;
  if (gap > kLargestGap) return std::nullopt;
  const double t = static_cast<double>(utime - before.utime) / static_cast<double>(gap);
  ReferenceSample sample;
  sample.utime = utime;
  sample.p_G_B = (1.0 - t) * before.p_G_B + t * after->p_G_B;
  sample.q_G_B = before.q_G_B.slerp(t, after->q_G_B);
  sample.map_offset_en = (1.0 - t) * before.map_offset_en + t * after->map_offset_en;
  sample.height_above_ground = (1.0 - t) * before.height_above_ground + t * after->height_above_ground;
  return sample;
}

FlightRecord FlightRecord::read(const std::filesystem::path& log) {
  LogReader reader(log);
  Collected collected;
  while (const auto event = reader.next()) sort_in(*event, collected);
  collected.record.skipped_bytes = reader.skipped_bytes();
  choose_frame(collected);
  place_references(collected);
  find_span(collected.record);
  if (collected.record.begin == 0) {
    throw std::runtime_error(
        fmt::format("{}: the log holds no image, odometry, navigation state or reference", log.string()));
  }
  return std::move(collected.record);
}

Eigen::Vector3d vector_of(const double (&v)[3]) {
  return Eigen::Vector3d(v[0], v[1], v[2]);
}
Eigen::Quaterniond quaternion_of(const double (&q)[4]) {
  return Eigen::Quaterniond(q[0], q[1], q[2], q[3]);
}

std::optional<Eigen::Vector3d> position_of(const EnuFrame& frame, const map_fix_t& fix) {
  if (!fix.valid || !is_place(fix.latitude_deg, fix.longitude_deg, fix.ellipsoidal_height)) return std::nullopt;
  return frame.to_enu({fix.latitude_deg, fix.longitude_deg, fix.ellipsoidal_height});
}

std::optional<Eigen::Vector3d> position_of(const EnuFrame& frame, const nav_state_t& nav) {
  if (!is_place(nav.latitude_deg, nav.longitude_deg, nav.ellipsoidal_height)) return std::nullopt;
  return frame.to_enu({nav.latitude_deg, nav.longitude_deg, nav.ellipsoidal_height});
}

}  // namespace orthonav::evaluate
