// What a camera does to the light of a scene: exposure, vignetting, motion blur, noise and quantisation.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "tools/simulate/random_stream.h"
#include "tools/simulate/ray_caster.h"

namespace orthonav {
class ConfigNode;
}

namespace orthonav::simulate {

struct CameraEffectOptions {
  double exposure_ms = 4.0;   // ms, time of exposure, during which motion blurs the image
  double readout_ms = 0.0;    // ms, of a rolling shutter, from the first row to the last; 0: all rows at once
  double mean_level = 110.0;  // grey level to which the mean luminance of the world is exposed
  double gain_stddev = 0.06;  // 1 sigma of the logarithm of the gain: exposure drifts
  double gain_time_s = 15.0;  // s, correlation time of that drift
  double gain_step = 0.0;     // logarithm of the factor by which the gain jumps up, and down again
  double gain_step_s = 10.0;  // s between jumps
  double vignetting = 0.25;   // fraction of the light lost in the corners
  double shot_noise = 0.04;   // grey levels^2 of noise variance per grey level of signal
  double read_noise = 1.0;    // grey levels, 1 sigma
  int jpeg_quality = 90;      // 1..100; 0: raw grey images

  static CameraEffectOptions from_config(ConfigNode& node);
};

// The camera's poses over one image: one for all rows, or of a rolling shutter one for each row.
struct Exposure {
  std::vector<CameraPose> begin, middle, end;
};

// Stateless but for its tables: frames may be made in any order and from several threads, and frame `index` of a
// seed is always the same.
class CameraEffects {
 public:
  CameraEffects(const CameraEffectOptions& options, const CameraModel& camera, uint64_t seed);

  // Gain of the exposure for frames 0 .. count - 1, `period` seconds apart, over a world of this mean luminance.
  std::vector<double> gains(size_t count, double period, double mean_luminance) const;

  // The 8-bit image of a view, which was rendered from exposure.middle.
  cv::Mat expose(const View& view, const RayCaster& caster, const Exposure& exposure, double gain,
                 uint64_t index) const;

  // The bytes of an image as the options want it transmitted: a JPEG file, or grey rows.
  std::vector<uint8_t> encode(const cv::Mat& image) const;

 private:
  cv::Mat blur(const View& view, const RayCaster& caster, const Exposure& exposure) const;

  CameraEffectOptions options_;
  CameraModel camera_;
  uint64_t seed_;
  cv::Mat vignette_;                 // CV_32F, factor per pixel
  std::vector<float> gaussian_;      // 65536 quantiles of the unit normal distribution
  std::array<float, 257> stddev_{};  // noise, grey levels, by signal
};

}  // namespace orthonav::simulate
