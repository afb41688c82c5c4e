// A log whose every figure is known beforehand.
#pragma once

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <functional>
#include <limits>
#include <numbers>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "common/math/so3.h"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/health_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/truth_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_state_t.hpp"

namespace orthonav::evaluate {

inline constexpr int64_t kStart = 1'700'000'000'000'000;
inline constexpr int kImages = 600;       // 10 Hz
inline constexpr double kHeight = 110.0;  // m above ground
inline const Geodetic kAnchor{47.5, 8.7, 400.0};

struct LogContent {
  bool truth = true, gnss = true, images = true, vio = true, keyframes = true, fixes = true, nav = true;
  double vio_scale = 0.8;    // odometry's size over the true one, at the start
  double scale_change = 0;   // of the size of each step from then on, per s
  double scale_stddev = 0;   // what the odometry says of its scale; 0: nothing
  double vio_noise = 0.0;    // m, alternating east error
  int64_t logger_delay = 0;  // microseconds from an image to its NAV_STATE in the log; 0: a replay
  Eigen::Vector3d fix_error{3.0, 4.0, 0.0};
  Eigen::Vector3d nav_error{1.0, 2.0, 2.0};
  double nav_stddev = 3.0;       // m, per axis
  double nav_level = 0.0;        // m, of protection, both
  double lean = 0.0;             // rad, of the odometry's "down", to changing sides
  double fix_leans = 0.0;        // times the height times the lean is added to the fixes' errors
  double map_offset_east = 0.5;  // m
  int false_fix = 20;            // this keyframe's fix is 100 m off; -1: none
};

inline Eigen::Vector3d true_position(double t) {
  return Eigen::Vector3d(100.0 + 5.0 * t, -200.0 + 40.0 * std::sin(0.1 * t), 110.0 + 3.0 * std::sin(0.2 * t));
}
inline Eigen::Quaterniond true_attitude(double t) {
  return so3_exp(Eigen::Vector3d(0, 0, 0.3 + 0.5 * std::sin(0.1 * t)));
}

template <class Array>
void put(const Eigen::Vector3d& v, Array& out) {
  for (int k = 0; k < 3; ++k) out[k] = v(k);
}
template <class Array>
void put(const Eigen::Quaterniond& q, Array& out) {
  out[0] = q.w();
  out[1] = q.x();
  out[2] = q.y();
  out[3] = q.z();
}

// Where the odometry's "down" leans to, of unit size at most: east, north.
inline Eigen::Vector2d lean_direction(double t) {
  return Eigen::Vector2d(std::sin(0.31 * t), std::cos(0.17 * t));
}

inline void write_log(const std::filesystem::path& file, const LogContent& content) {
  const double unknown = std::numeric_limits<double>::quiet_NaN();
  const EnuFrame frame(kAnchor);
  LogWriter writer(file);
  // W is turned by half a radian and moved against G.
  const Eigen::Quaterniond q_W_G = so3_exp(Eigen::Vector3d(0, 0, 0.5));
  Eigen::Vector3d flown = content.vio_scale * true_position(0);
  for (int k = 0; k < kImages; ++k) {
    const double t = 0.1 * k;
    const int64_t utime = kStart + 100'000 * k;
    const int64_t logged = utime + (content.logger_delay > 0 ? 1000 : 0);
    const Eigen::Vector3d p_G_B = true_position(t);
    const Eigen::Quaterniond q_G_B = true_attitude(t);
    const Geodetic place = frame.to_geodetic(p_G_B);
    if (content.truth) {
      truth_t truth{};
      truth.utime = utime;
      truth.height_above_ground = kHeight;
      truth.latitude_deg = place.latitude_deg;
      truth.longitude_deg = place.longitude_deg;
      truth.ellipsoidal_height = place.height;
      put(Eigen::Quaterniond(frame.R_local_G(p_G_B) * q_G_B.toRotationMatrix()), truth.q_ENU_B);
      truth.map_offset_en[0] = content.map_offset_east;
      writer.write(logged, channel::kTruth, truth);
    }
    if (content.gnss) {
      const Geodetic measured = frame.to_geodetic(p_G_B + Eigen::Vector3d(0.0, 0.0, 2.0));
      gnss_reference_t gnss{};
      gnss.utime = utime;
      gnss.latitude_deg = measured.latitude_deg;
      gnss.longitude_deg = measured.longitude_deg;
      gnss.ellipsoidal_height = measured.height;
      writer.write(logged, channel::kGnssReference, gnss);
    }
    if (content.images) {
      image_t image{};
      image.utime = utime;
      image.width = image.row_stride = 8;
      image.height = 8;
      image.pixelformat = image_t::PIXEL_FORMAT_GRAY;
      image.data.assign(64, 128);
      image.size = 64;
      writer.write(logged, channel::kCamera, image);
    }
    flown += (content.vio_scale + content.scale_change * t) * (p_G_B - true_position(std::max(0.0, t - 0.1)));
    Eigen::Vector3d p_W_B = q_W_G * flown + Eigen::Vector3d(7.0, -3.0, 2.0);
    p_W_B.x() += k % 2 == 0 ? content.vio_noise : -content.vio_noise;
    const Eigen::Vector2d lean_en = content.lean * lean_direction(t);
    const Eigen::Quaterniond q_W_B = q_W_G * so3_exp(Eigen::Vector3d(-lean_en.y(), lean_en.x(), 0)) * q_G_B;
    if (content.vio && k >= 5) {
      vio_state_t state{};
      state.utime = utime;
      state.session = 1;
      state.scale_stddev = content.scale_stddev;
      state.status = k < 20 ? vio_state_t::INITIALISING : vio_state_t::TRACKING;
      put(p_W_B, state.p_W_B);
      put(q_W_B, state.q_W_B);
      state.processing_ms = k % 100 == 0 ? 50.0 : 10.0;
      writer.write(logged, channel::kVioState, state);
    }
    const bool is_keyframe = k >= 20 && k % 10 == 0;
    const int id = k / 10 - 2;
    if (is_keyframe && content.keyframes) {
      vio_keyframe_t keyframe{};
      keyframe.utime = utime;
      keyframe.session = 1;
      keyframe.id = id;
      put(p_W_B, keyframe.p_W_B);
      put(q_W_B, keyframe.q_W_B);
      put(Eigen::Quaterniond(0, 1, 0, 0), keyframe.q_B_C);  // looking down
      keyframe.height_above_ground = 110.0;
      writer.write(logged, channel::kVioKeyframe, keyframe);
    }
    if (is_keyframe && content.fixes) {
      map_fix_t fix{};
      fix.utime = utime;
      fix.session = 1;
      fix.keyframe_id = id;
      fix.method = "paper";
      fix.valid = id % 2 == 0;
      Eigen::Vector3d found = p_G_B + content.fix_error;
      found.head<2>() += content.fix_leans * kHeight * lean_en;
      if (id == content.false_fix) found.x() += 100.0;
      // Refused ones: every fourth implies a place far away.
      if (!fix.valid && id % 4 == 1) found.y() += 300.0;
      const Geodetic there = frame.to_geodetic(found);
      fix.latitude_deg = fix.valid ? there.latitude_deg : unknown;
      fix.longitude_deg = fix.valid ? there.longitude_deg : unknown;
      fix.ellipsoidal_height = fix.valid ? there.height : unknown;
      put(q_G_B, fix.q_G_B);
      fix.anchor_latitude_deg = kAnchor.latitude_deg;
      fix.anchor_longitude_deg = kAnchor.longitude_deg;
      fix.anchor_height = kAnchor.height;
      fix.heading = heading_of(q_G_B);
      const Eigen::Vector3d turned = q_W_G.conjugate() * p_W_B;
      fix.translation[0] = found.x() - turned.x();
      fix.translation[1] = found.y() - turned.y();
      fix.num_inliers = fix.valid ? 20 : 10;
      fix.total_ms = 5.0;
      writer.write(logged, channel::kMapFix, fix);
    }
    if (content.nav && k >= 5) {
      nav_state_t nav{};
      nav.utime = utime;
      nav.session = 1;
      nav.mode = k < 20 ? nav_state_t::WAITING_FOR_VIO : k < 50 ? nav_state_t::DEAD_RECKONING : nav_state_t::MAP_AIDED;
      nav.reset_counter = k < 50 ? 0 : 1;
      nav.horizontal_protection_level = nav.vertical_protection_level = content.nav_level;
      const Geodetic there = frame.to_geodetic(p_G_B + content.nav_error);
      nav.latitude_deg = k < 50 ? unknown : there.latitude_deg;
      nav.longitude_deg = k < 50 ? unknown : there.longitude_deg;
      nav.ellipsoidal_height = k < 50 ? unknown : there.height;
      put(so3_exp(Eigen::Vector3d(0, 0, -std::numbers::pi / 180.0)) * q_G_B, nav.q_G_B);
      const double variances[6] = {content.nav_stddev, content.nav_stddev, content.nav_stddev, 0.1, 0.1, 0.1};
      for (int i = 0; i < 6; ++i) nav.covariance[7 * i] = variances[i] * variances[i];
      const int hundreds = k / 100;
      nav.processing_ms = k < 50 ? 0.0 : 2.0 + hundreds;
      writer.write(logged + content.logger_delay, channel::kNavState, nav);
    }
  }
  health_t health{};
  health.service = "fusion";
  health.state = health_t::DEGRADED;
  health.message = "a <b>message</b> & more";
  writer.write(kStart + 60'000'000, channel::kHealth, health);
}

}  // namespace orthonav::evaluate
