#include "tools/simulate/flight_recorder.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <string>
#include <tuple>
#include <vector>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "tools/simulate/asl_writer.h"
#include "tools/simulate/ordered_parallel.h"

namespace orthonav::simulate {
namespace {

// Everything but the images, in time order, ready to be written.
class EventQueue {
 public:
  EventQueue(const SensorRecord& record, const EnuFrame& frame, LogWriter& log, AslWriter* asl)
      : record_(record), frame_(frame), log_(log), asl_(asl) {
    add(record.imu, 0);
    add(record.compass, 1);
    add(record.altitude, 2);
    add(record.gnss, 3);
    add(record.truth, 4);
    std::sort(order_.begin(), order_.end());
  }

  // Writes the events up to `utime`.
  void write_until(int64_t utime) {
    for (; next_ < order_.size() && order_[next_].utime <= utime; ++next_) write(order_[next_]);
  }

 private:
  struct Entry {
    int64_t utime;
    int kind;
    size_t index;
    bool operator<(const Entry& other) const {
      return std::tie(utime, kind, index) < std::tie(other.utime, other.kind, other.index);
    }
  };

  template <class Msg>
  void add(const std::vector<Msg>& messages, int kind) {
    for (size_t i = 0; i < messages.size(); ++i) order_.push_back({messages[i].utime, kind, i});
  }

  void write(const Entry& entry) {
    switch (entry.kind) {
      case 0:
        log_.write(entry.utime, channel::kImu, record_.imu[entry.index]);
        if (asl_ != nullptr) asl_->write_imu(record_.imu[entry.index]);
        break;
      case 1:
        log_.write(entry.utime, channel::kCompass, record_.compass[entry.index]);
        break;
      case 2:
        log_.write(entry.utime, channel::kAltitude, record_.altitude[entry.index]);
        break;
      case 3:
        log_.write(entry.utime, channel::kGnssReference, record_.gnss[entry.index]);
        break;
      default:
        log_.write(entry.utime, channel::kTruth, record_.truth[entry.index]);
        if (asl_ != nullptr) asl_->write_truth(record_.truth[entry.index], frame_);
    }
  }

  const SensorRecord& record_;
  const EnuFrame& frame_;
  LogWriter& log_;
  AslWriter* asl_;
  std::vector<Entry> order_;
  size_t next_ = 0;
};

// The camera over an image whose middle row is exposed around t. Rows follow one another at `readout`, s for all.
Exposure expose_at(const Trajectory& trajectory, const Extrinsics& extrinsics, double t, double exposure,
                   double readout, int height) {
  const auto pose = [&](double at) -> CameraPose {
    const MotionState state = trajectory.at(at);
    return {state.p_G_B + state.R_G_B * extrinsics.p_B_C, state.R_G_B * extrinsics.R_B_C};
  };
  Exposure poses;
  const int rows = readout > 0 ? height : 1;
  for (int row = 0; row < rows; ++row) {
    const double middle = rows > 1 ? t + readout * (row / (rows - 1.0) - 0.5) : t;
    poses.begin.push_back(pose(middle - 0.5 * exposure));
    poses.middle.push_back(pose(middle));
    poses.end.push_back(pose(middle + 0.5 * exposure));
  }
  return poses;
}

struct Shot {
  std::vector<uint8_t> bytes;
  double outside = 0;
};

}  // namespace

RecordingSummary record_flight(const Scenario& scenario, const World& world, uint64_t seed,
                               const RecordingOptions& options) {
  const HeightField field(world.surface);
  const auto surface_height = [&](const Eigen::Vector2d& p_en) { return field.height(p_en); };
  const FlightArea area{world.map_east_min,  world.map_east_max,  world.map_north_min,
                        world.map_north_max, world.ground_height, surface_height};
  const Trajectory trajectory = plan_flight(scenario.flight, area, scenario.imu.gravity, seed);
  const double seconds = options.seconds > 0 ? std::min(options.seconds, trajectory.duration()) : trajectory.duration();
  const SensorSurroundings around{world.frame, surface_height, world.map_offset, scenario.magnetic_declination,
                                  scenario.start_unix_s * 1000000};
  const SensorRecord record =
      simulate_sensors(trajectory, seconds, scenario.imu.rate_hz, scenario.sensors, around, seed);

  LogWriter log(options.log);
  std::unique_ptr<AslWriter> asl;
  if (!options.asl_folder.empty()) asl = std::make_unique<AslWriter>(options.asl_folder, scenario);
  EventQueue events(record, world.frame, log, asl.get());

  const RayCaster caster(field, scenario.camera);
  const CameraEffects effects(scenario.camera_effects, scenario.camera, seed);
  const size_t exposures = record.frames.empty() ? 0 : record.frames.back().index + 1;
  const std::vector<double> gains =
      effects.gains(exposures, 1.0 / scenario.sensors.camera.rate_hz, field.mean_luminance());
  RecordingSummary summary;
  const auto shoot = [&](size_t i) {
    const FrameTime& frame = record.frames[i];
    const Exposure exposure =
        expose_at(trajectory, scenario.extrinsics, frame.t, 1e-3 * scenario.camera_effects.exposure_ms,
                  1e-3 * scenario.camera_effects.readout_ms, scenario.camera.height());
    const View view = caster.render(exposure.middle);
    const cv::Mat image = effects.expose(view, caster, exposure, gains[frame.index], frame.index);
    return Shot{effects.encode(image), view.outside};
  };
  const auto write = [&](size_t i, Shot&& shot) {
    image_t image;
    image.utime = record.frames[i].utime;
    image.width = scenario.camera.width();
    image.height = scenario.camera.height();
    const bool jpeg = scenario.camera_effects.jpeg_quality > 0;
    image.row_stride = jpeg ? 0 : image.width;
    image.pixelformat = image_t::PIXEL_FORMAT_GRAY;
    if (jpeg) image.pixelformat = image_t::PIXEL_FORMAT_MJPEG;
    image.data = std::move(shot.bytes);
    image.size = static_cast<int32_t>(image.data.size());
    image_metadata_t exposure;
    exposure.key = "exposure_us";
    const std::string text = std::to_string(std::llround(1e3 * scenario.camera_effects.exposure_ms));
    exposure.value.assign(text.begin(), text.end());
    exposure.n = static_cast<int32_t>(text.size());
    image.metadata.push_back(exposure);
    image.nmetadata = 1;
    events.write_until(image.utime);
    log.write(image.utime, channel::kCamera, image);
    if (asl) asl->write_image(image);
    summary.outside = std::max(summary.outside, shot.outside);
    if (options.progress) options.progress(record.frames[i].t, seconds);
  };
  ordered_parallel(record.frames.size(), options.threads, shoot, write);
  events.write_until(std::numeric_limits<int64_t>::max());
  if (asl) asl->finish();

  summary.seconds = seconds;
  summary.flight_seconds = trajectory.duration();
  summary.path_length = trajectory.path_length();
  summary.mean_tilt = trajectory.mean_tilt();
  summary.images = record.frames.size();
  summary.imu_samples = record.imu.size();
  return summary;
}

}  // namespace orthonav::simulate
