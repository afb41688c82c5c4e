#include "services/ingest/log_source.h"

#include <fmt/format.h>

#include "common/bus/channels.h"

namespace orthonav::ingest {

namespace {

template <class Msg>
SensorEvent decode_as(const LogEvent& event, const std::filesystem::path& file) {
  if (auto message = event.decode<Msg>()) return {SensorMessage(std::move(*message)), ""};
  return {std::nullopt, fmt::format("{}: channel {} at {}: {} bytes that do not decode", file.string(), event.channel,
                                    event.utime, event.data.size())};
}

}  // namespace

LogSource::LogSource(const std::filesystem::path& file) : file_(file), reader_(file) {}

std::optional<SensorEvent> LogSource::next() {
  while (auto event = reader_.next()) {
    if (reader_.skipped_bytes() > skipped_) {
      const int64_t lost = reader_.skipped_bytes() - skipped_;
      skipped_ = reader_.skipped_bytes();
      return SensorEvent{std::nullopt,
                         fmt::format("{}: {} damaged bytes passed over before {}", file_.string(), lost, event->utime)};
    }
    if (event->channel == channel::kImu) return decode_as<imu_t>(*event, file_);
    if (event->channel == channel::kCamera) return decode_as<image_t>(*event, file_);
    if (event->channel == channel::kCompass) return decode_as<compass_t>(*event, file_);
    if (event->channel == channel::kMagnetometer) return decode_as<magnetometer_t>(*event, file_);
    if (event->channel == channel::kAltitude) return decode_as<altitude_t>(*event, file_);
    if (event->channel == channel::kGnssReference) return decode_as<gnss_reference_t>(*event, file_);
    if (event->channel == channel::kTruth) return decode_as<truth_t>(*event, file_);
  }
  return std::nullopt;
}

}  // namespace orthonav::ingest
