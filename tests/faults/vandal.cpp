#include "tests/faults/vandal.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "common/bus/channels.h"
#include "orthonav/altitude_t.hpp"
#include "orthonav/compass_t.hpp"
#include "orthonav/health_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/keyframe_image_t.hpp"
#include "orthonav/magnetometer_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_request_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/position_hint_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_reset_t.hpp"
#include "orthonav/vio_state_t.hpp"

namespace orthonav::faults {

namespace {

// A channel, and the eight bytes with which its messages begin.
struct Target {
  const char* channel;
  std::array<uint8_t, 8> fingerprint;
};

template <class Msg>
Target target(const char* channel) {
  const Msg message{};
  std::vector<uint8_t> bytes(static_cast<size_t>(message.getEncodedSize()));
  message.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  Target made{channel, {}};
  std::copy_n(bytes.begin(), made.fingerprint.size(), made.fingerprint.begin());
  return made;
}

const std::vector<Target>& targets() {
  static const std::vector<Target> all{target<imu_t>(channel::kImu),
                                       target<image_t>(channel::kCamera),
                                       target<compass_t>(channel::kCompass),
                                       target<magnetometer_t>(channel::kMagnetometer),
                                       target<altitude_t>(channel::kAltitude),
                                       target<vio_state_t>(channel::kVioState),
                                       target<vio_keyframe_t>(channel::kVioKeyframe),
                                       target<keyframe_image_t>(channel::kKeyframeImage),
                                       target<vio_reset_t>(channel::kVioReset),
                                       target<map_info_t>(channel::kMapInfo),
                                       target<map_tile_t>(channel::kMapTile),
                                       target<map_tile_request_t>(channel::kMapTileRequest),
                                       target<map_fix_t>(channel::kMapFix),
                                       target<position_hint_t>(channel::kPositionHint),
                                       target<nav_state_t>(channel::kNavState),
                                       target<health_t>(channel::kHealth)};
  return all;
}

// A number that no sensor reads.
double absurd(std::mt19937_64& random) {
  constexpr double kNumbers[] = {std::numeric_limits<double>::quiet_NaN(),
                                 std::numeric_limits<double>::infinity(),
                                 -std::numeric_limits<double>::infinity(),
                                 1e300,
                                 -1e12,
                                 1e7};
  return kNumbers[random() % std::size(kNumbers)];
}

void fill(double* values, size_t count, std::mt19937_64& random) {
  for (size_t i = 0; i < count; ++i) values[i] = absurd(random);
}

int64_t some_time(std::mt19937_64& random, int64_t now) {
  const int64_t times[] = {now,
                           now + 86'400'000'000,
                           now - 86'400'000'000,
                           -5,
                           0,
                           std::numeric_limits<int64_t>::max(),
                           std::numeric_limits<int64_t>::min()};
  return times[random() % std::size(times)];
}

}  // namespace

void publish_garbage(lcm::LCM& bus, std::mt19937_64& random) {
  std::vector<uint8_t> bytes(random() % 400);
  for (auto& byte : bytes) byte = static_cast<uint8_t>(random());
  const Target& target = targets()[random() % targets().size()];
  // A sound fingerprint first, every third time, so that the decoder goes on to the lengths that follow.
  if (random() % 3 == 0) {
    std::copy_n(target.fingerprint.begin(), std::min(target.fingerprint.size(), bytes.size()), bytes.begin());
  }
  bus.publish(target.channel, bytes.data(), static_cast<unsigned>(bytes.size()));
}

void publish_absurd(lcm::LCM& bus, std::mt19937_64& random, int64_t now, int32_t session, int32_t keyframe) {
  switch (random() % 14) {
    case 0: {
      imu_t m{};
      m.utime = some_time(random, now);
      fill(m.angular_rate, 3, random);
      fill(m.specific_force, 3, random);
      if (random() % 2 == 0 && m.utime != now) {
        // Only the time is wrong.
        std::fill_n(m.angular_rate, 3, 0.0);
        std::fill_n(m.specific_force, 3, 5.0);
      }
      bus.publish(channel::kImu, &m);
      break;
    }
    case 1: {
      image_t m{};
      m.utime = some_time(random, now);
      m.width = random() % 2 == 0 ? -1 : 1 << 30;
      m.height = 1 << 30;
      m.pixelformat = random() % 2 == 0 ? +image_t::PIXEL_FORMAT_GRAY : +image_t::PIXEL_FORMAT_MJPEG;
      m.data.resize(16);
      m.size = 16;
      bus.publish(channel::kCamera, &m);
      break;
    }
    case 2: {
      compass_t m{};
      m.utime = some_time(random, now);
      m.heading = absurd(random);
      m.heading_stddev = absurd(random);
      bus.publish(channel::kCompass, &m);
      break;
    }
    case 3: {
      altitude_t m{};
      m.utime = some_time(random, now);
      m.height_above_ground = absurd(random);
      m.stddev = absurd(random);
      bus.publish(channel::kAltitude, &m);
      break;
    }
    case 4: {
      vio_state_t m{};
      m.utime = some_time(random, now);
      m.session = session;
      m.status = static_cast<int8_t>(random());
      fill(m.p_W_B, 3, random);
      fill(m.q_W_B, 4, random);
      fill(m.v_W_B, 3, random);
      bus.publish(channel::kVioState, &m);
      break;
    }
    case 5: {
      vio_keyframe_t m{};
      m.utime = some_time(random, now);
      m.session = session;
      m.id = static_cast<int32_t>(random());
      fill(m.p_W_B, 3, random);
      fill(m.q_W_B, 4, random);
      m.features.resize(3);
      for (auto& feature : m.features) fill(feature.p_W, 3, random);
      m.num_features = 3;
      bus.publish(channel::kVioKeyframe, &m);
      break;
    }
    case 6: {
      map_fix_t m{};
      m.utime = some_time(random, now);
      m.session = session;
      m.keyframe_id = keyframe;
      m.valid = 1;
      // 100 km to the north, and sure of it; or nowhere.
      m.latitude_deg = random() % 2 == 0 ? 49.5 : absurd(random);
      m.longitude_deg = 8.5;
      m.anchor_latitude_deg = 48.6;
      m.anchor_longitude_deg = 8.5;
      for (double& c : m.position_covariance) c = 0;
      m.position_covariance[0] = m.position_covariance[4] = m.position_covariance[8] =
          random() % 2 == 0 ? 0.01 : absurd(random);
      m.q_G_B[0] = absurd(random);
      bus.publish(channel::kMapFix, &m);
      break;
    }
    case 7: {
      map_info_t m{};
      m.fingerprint = "made-up";
      m.metres_per_pixel = absurd(random);
      m.tile_columns = m.tile_rows = random() % 2 == 0 ? -1 : 1 << 30;
      m.num_features = std::numeric_limits<int64_t>::max();
      bus.publish(channel::kMapInfo, &m);
      break;
    }
    case 8: {
      map_tile_t m{};
      m.fingerprint = "made-up";
      m.tile = static_cast<int32_t>(random());
      m.num_parts = static_cast<int32_t>(random());
      bus.publish(channel::kMapTile, &m);
      break;
    }
    case 9: {
      nav_state_t m{};
      m.utime = some_time(random, now);
      m.session = session;
      m.mode = nav_state_t::MAP_AIDED;
      m.reset_counter = 1;
      // As sure of being 100 km away as the fixes are; or nowhere.
      m.latitude_deg = random() % 2 == 0 ? 49.5 : absurd(random);
      m.longitude_deg = 8.5;
      m.ellipsoidal_height = 300;
      m.processing_ms = kForged;
      fill(m.v_G_B, 3, random);
      fill(m.covariance, 36, random);
      if (random() % 2 == 0) m.covariance[0] = m.covariance[7] = m.covariance[14] = 0.01;
      bus.publish(channel::kNavState, &m);
      break;
    }
    case 10: {
      magnetometer_t m{};
      m.utime = some_time(random, now);
      fill(m.field, 3, random);
      bus.publish(channel::kMagnetometer, &m);
      break;
    }
    case 11: {
      health_t m{};
      m.utime = some_time(random, now);
      m.service = "vio";
      m.host = std::string(1 + random() % (random() % 20 == 0 ? 50'000 : 50), static_cast<char>(random()));
      m.state = static_cast<int8_t>(random());
      m.uptime = absurd(random);
      bus.publish(channel::kHealth, &m);
      break;
    }
    case 12: {
      // One of two with the numbers of an image of a camera that is flown here, and often whole.
      constexpr int kSizes[][2] = {{640, 480}, {320, 240}, {-1, 512}, {1 << 30, 1 << 30}};
      keyframe_image_t m{};
      const size_t size = random() % std::size(kSizes);
      m.utime = some_time(random, now);
      m.width = kSizes[size][0];
      m.height = kSizes[size][1];
      m.pixelformat = random() % 2 == 0 ? +image_t::PIXEL_FORMAT_GRAY : +image_t::PIXEL_FORMAT_MJPEG;
      m.size = random() % 4 == 0 ? static_cast<int32_t>(random()) : static_cast<int32_t>(1 + random() % 1000);
      m.part = random() % 4 == 0 ? static_cast<int32_t>(random()) : 0;
      m.data.resize(static_cast<size_t>(std::clamp(m.size, 0, 1000)));
      m.num_bytes = static_cast<int32_t>(m.data.size());
      bus.publish(channel::kKeyframeImage, &m);
      break;
    }
    default: {
      map_tile_request_t m{};
      m.fingerprint = "made-up";
      m.tile.assign(100, static_cast<int32_t>(random()));
      m.part.assign(100, static_cast<int32_t>(random()));
      m.num_tiles = 100;
      bus.publish(channel::kMapTileRequest, &m);
    }
  }
}

}  // namespace orthonav::faults
