#include "services/ingest/sensor_source.h"

#include "common/bus/channels.h"

namespace orthonav::ingest {

namespace {

struct ChannelOf {
  const char* operator()(const imu_t&) const { return channel::kImu; }
  const char* operator()(const image_t&) const { return channel::kCamera; }
  const char* operator()(const compass_t&) const { return channel::kCompass; }
  const char* operator()(const magnetometer_t&) const { return channel::kMagnetometer; }
  const char* operator()(const altitude_t&) const { return channel::kAltitude; }
  const char* operator()(const gnss_reference_t&) const { return channel::kGnssReference; }
  const char* operator()(const truth_t&) const { return channel::kTruth; }
};

}  // namespace

int64_t utime_of(const SensorMessage& message) {
  return std::visit([](const auto& m) { return m.utime; }, message);
}

const char* channel_of(const SensorMessage& message) {
  return std::visit(ChannelOf{}, message);
}

}  // namespace orthonav::ingest
