#include "tests/registration/recorded_flight.h"

#include <cmath>
#include <map>
#include <utility>

#include "common/bus/channels.h"
#include "common/bus/keyframe_repeats.h"
#include "common/features/orientation_field.h"
#include "common/flightlog/flightlog.h"
#include "common/math/so3.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/truth_t.hpp"
#include "services/registration/heading_buffer.h"

namespace orthonav::registration {

BenchMap load_map(const std::filesystem::path& map, const std::filesystem::path& config, map_server::FeatureKind kind,
                  double size) {
  map_server::BuildOptions build = map_server::ServerOptions::from_config(config).build;
  build.features = kind;
  if (size > 0) build.keypoint_size = size;
  const map_server::MapDatabase database(map_server::prepare_map(map, build, {}));
  const auto& description = database.levels().front();
  BenchMap result{EnuFrame(description.anchor),
                  {description.metres_per_pixel, description.keypoint_size, description.keypoint_stride},
                  {},
                  description.num_features};
  map_server::TileFeatures all = database.all_tiles(0);
  result.features.descriptors =
      cv::Mat(static_cast<int>(all.positions.size()), kSiftBytes, CV_8U, all.descriptors.data()).clone();
  result.features.positions = std::move(all.positions);
  return result;
}

BenchAircraft load_bench_aircraft(const std::filesystem::path& config) {
  ConfigNode aircraft = ConfigNode::load(config / "aircraft.yaml");
  ConfigNode camera = aircraft.child("camera");
  double declination_deg = 0;
  aircraft.require("magnetic_declination_deg", declination_deg);
  return {CameraModel::from_config(camera), declination_deg * M_PI / 180};
}

void for_each_keyframe(const std::filesystem::path& log, const EnuFrame& frame, double declination, bool with_images,
                       const std::function<void(const BenchKeyframe&)>& visit) {
  std::map<int64_t, image_t> images;
  std::map<int64_t, Truth> truths;
  HeadingBuffer headings(300'000);
  KeyframeRepeats repeats;
  LogReader reader(log);
  while (const auto event = reader.next()) {
    if (event->channel == channel::kCamera && with_images) {
      if (const auto image = event->decode<image_t>()) images[image->utime] = *image;
      while (images.size() > 150) images.erase(images.begin());
    } else if (event->channel == channel::kCompass) {
      const auto compass = event->decode<compass_t>();
      if (!compass) continue;
      headings.add(compass->utime, {true_heading(compass->heading, declination),
                                    compass->heading_stddev > 0 ? compass->heading_stddev : M_PI / 60});
    } else if (event->channel == channel::kTruth) {
      const auto truth = event->decode<truth_t>();
      if (!truth) continue;
      Truth sample;
      sample.p_G = frame.to_enu({truth->latitude_deg, truth->longitude_deg, truth->ellipsoidal_height});
      sample.map_offset = {truth->map_offset_en[0], truth->map_offset_en[1]};
      sample.heading =
          heading_of(Eigen::Quaterniond(truth->q_ENU_B[0], truth->q_ENU_B[1], truth->q_ENU_B[2], truth->q_ENU_B[3]));
      truths[truth->utime] = sample;
    } else if (event->channel == channel::kVioKeyframe) {
      const auto keyframe = event->decode<vio_keyframe_t>();
      if (!keyframe || repeats.add(*keyframe)) continue;
      const auto image = images.find(keyframe->utime);
      const auto truth = truths.find(keyframe->utime);
      const auto heading = headings.at(keyframe->utime);
      if (truth == truths.end() || !heading || (with_images && image == images.end())) continue;
      visit({*keyframe, *heading, truth->second, with_images ? &image->second : nullptr});
    }
  }
}

}  // namespace orthonav::registration
