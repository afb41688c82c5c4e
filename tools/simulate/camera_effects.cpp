#include "tools/simulate/camera_effects.h"

#include <algorithm>
#include <cmath>
#include <string>

#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "common/config/config.h"

namespace orthonav::simulate {
namespace {

constexpr size_t kNoiseTable = 65536;
constexpr double kSharp = 0.01;  // pixels: motion that blurs nothing

// Displacement, in pixels, of the scene in the image when the camera moves from one pose to another, at the depth
// nodes of a view. CV_32FC2; zero for sky. Rows that are read at other times move as their own poses say.
cv::Mat node_flow(const View& view, const RayCaster& caster, const CameraModel& camera,
                  const std::vector<CameraPose>& from_rows, const std::vector<CameraPose>& to_rows) {
  cv::Mat flow(view.node_depth.size(), CV_32FC2, cv::Scalar::all(0));
  for (int j = 0; j < flow.rows; ++j) {
    const size_t row = from_rows.size() > 1 ? static_cast<size_t>(j) * View::kNodeStep : 0;
    const CameraPose &from = from_rows[row], &to = to_rows[row];
    for (int i = 0; i < flow.cols; ++i) {
      const float depth = view.node_depth.at<float>(j, i);
      if (std::isnan(depth)) continue;
      const Eigen::Vector2i pixel(i * View::kNodeStep, j * View::kNodeStep);
      const Eigen::Vector3d direction = from.R_G_C * caster.ray(pixel.x(), pixel.y());
      const Eigen::Vector3d point = from.p_G_C + direction * (depth / -direction.z());
      const auto moved = camera.project(to.R_G_C.transpose() * (point - to.p_G_C));
      if (!moved) continue;
      const Eigen::Vector2f difference = (*moved - pixel.cast<double>()).cast<float>();
      flow.at<cv::Vec2f>(j, i) = {difference.x(), difference.y()};
    }
  }
  return flow;
}

double longest(const cv::Mat& flow) {
  double length = 0;
  for (int j = 0; j < flow.rows; ++j) {
    for (int i = 0; i < flow.cols; ++i) length = std::max(length, cv::norm(flow.at<cv::Vec2f>(j, i)));
  }
  return length;
}

// Nodes to pixels, bilinear. Beyond the last node the flow goes on as at it.
cv::Mat dense_flow(const cv::Mat& nodes, cv::Size size) {
  cv::Mat flow(size, CV_32FC2);
  for (int y = 0; y < size.height; ++y) {
    const float row = static_cast<float>(y) / View::kNodeStep;
    const int j = std::min(static_cast<int>(row), nodes.rows - 1), j1 = std::min(j + 1, nodes.rows - 1);
    const float b = row - static_cast<float>(j);
    cv::Vec2f* out = flow.ptr<cv::Vec2f>(y);
    const auto* top = nodes.ptr<cv::Vec2f>(j);
    const auto* bottom = nodes.ptr<cv::Vec2f>(j1);
    for (int x = 0; x < size.width; ++x) {
      const int i = std::min(x / View::kNodeStep, nodes.cols - 1), i1 = std::min(i + 1, nodes.cols - 1);
      const float a = static_cast<float>(x - i * View::kNodeStep) / View::kNodeStep;
      out[x] = (top[i] * (1 - a) + top[i1] * a) * (1 - b) + (bottom[i] * (1 - a) + bottom[i1] * a) * b;
    }
  }
  return flow;
}

}  // namespace

CameraEffectOptions CameraEffectOptions::from_config(ConfigNode& node) {
  CameraEffectOptions options;
  node.read("exposure_ms", options.exposure_ms, 0.0, 100.0);
  node.read("readout_ms", options.readout_ms, 0.0, 100.0);
  node.read("mean_level", options.mean_level, 1.0, 255.0);
  node.read("gain_stddev", options.gain_stddev, 0.0, 1.0);
  node.read("gain_time_s", options.gain_time_s, 0.1, 1e4);
  node.read("gain_step", options.gain_step, 0.0, 5.0);
  node.read("gain_step_s", options.gain_step_s, 0.1, 1e4);
  node.read("vignetting", options.vignetting, 0.0, 0.9);
  node.read("shot_noise", options.shot_noise, 0.0, 10.0);
  node.read("read_noise", options.read_noise, 0.0, 50.0);
  node.read("jpeg_quality", options.jpeg_quality, 0, 100);
  node.finish();
  return options;
}

CameraEffects::CameraEffects(const CameraEffectOptions& options, const CameraModel& camera, uint64_t seed)
    : options_(options), camera_(camera), seed_(seed), vignette_(camera.height(), camera.width(), CV_32F) {
  const cv::Point2d centre(camera.parameters().cx, camera.parameters().cy);
  const double corner = 0.25 * (camera.width() * camera.width() + camera.height() * camera.height());
  for (int y = 0; y < vignette_.rows; ++y) {
    for (int x = 0; x < vignette_.cols; ++x) {
      const double dx = x - centre.x, dy = y - centre.y;
      vignette_.at<float>(y, x) = static_cast<float>(1.0 - options.vignetting * (dx * dx + dy * dy) / corner);
    }
  }
  RandomStream stream(seed, "camera.noise.table");
  gaussian_.resize(kNoiseTable);
  for (float& value : gaussian_) value = static_cast<float>(stream.gaussian());
  for (size_t i = 0; i < stddev_.size(); ++i) {
    stddev_[i] = static_cast<float>(
        std::sqrt(options.read_noise * options.read_noise + options.shot_noise * static_cast<double>(i)));
  }
}

std::vector<double> CameraEffects::gains(size_t count, double period, double mean_luminance) const {
  RandomStream stream(seed_, "camera.gain");
  std::vector<double> gains = correlated_noise(stream, count, period, options_.gain_stddev, options_.gain_time_s);
  const double base = options_.mean_level / std::max(mean_luminance, 1.0);
  RandomStream steps(seed_, "camera.gain_step");
  const double phase = steps.uniform(0, 2);  // of a jump up and one down
  for (size_t i = 0; i < gains.size(); ++i) {
    const double jumps = static_cast<double>(i) * period / options_.gain_step_s + phase;
    const double step = std::fmod(jumps, 2.0) < 1.0 ? 0.5 * options_.gain_step : -0.5 * options_.gain_step;
    gains[i] = base * std::exp(gains[i] + step);
  }
  return gains;
}

cv::Mat CameraEffects::blur(const View& view, const RayCaster& caster, const Exposure& exposure) const {
  const cv::Mat back_nodes = node_flow(view, caster, camera_, exposure.middle, exposure.begin);
  const cv::Mat ahead_nodes = node_flow(view, caster, camera_, exposure.middle, exposure.end);
  const double length = std::max(longest(back_nodes), longest(ahead_nodes));
  if (length < kSharp) return view.luminance;
  const int half = static_cast<int>(std::ceil(2.0 * length));  // samples at most half a pixel apart
  const cv::Mat back = dense_flow(back_nodes, view.luminance.size());
  const cv::Mat ahead = dense_flow(ahead_nodes, view.luminance.size());
  // The pixel sees at another time what the middle view has at the place from which the scene moves here.
  cv::Mat out(view.luminance.size(), CV_32F);
  const float weight = 1.0F / static_cast<float>(2 * half);
  const int border = static_cast<int>(std::ceil(length)) + 1;
  const auto stride = static_cast<int64_t>(view.luminance.step1());
  for (int y = 0; y < out.rows; ++y) {
    const bool row_inside = y >= border && y < out.rows - border;
    const cv::Vec2f* const flows[2] = {back.ptr<cv::Vec2f>(y), ahead.ptr<cv::Vec2f>(y)};
    for (int x = 0; x < out.cols; ++x) {
      const bool inside = row_inside && x >= border && x < out.cols - border;
      float sum = 0;
      for (const cv::Vec2f* flow : flows) {
        const cv::Vec2f move = flow[x];
        for (int i = 0; i < half; ++i) {
          const float part = (static_cast<float>(i) + 0.5F) / static_cast<float>(half);
          const float u = static_cast<float>(x) - part * move[0], v = static_cast<float>(y) - part * move[1];
          sum += inside ? detail::bilinear_inside(view.luminance.ptr<float>(), stride, u, v)
                        : detail::bilinear<float>(view.luminance, u, v);
        }
      }
      out.at<float>(y, x) = sum * weight;
    }
  }
  return out;
}

cv::Mat CameraEffects::expose(const View& view, const RayCaster& caster, const Exposure& exposure, double gain,
                              uint64_t index) const {
  const cv::Mat light = blur(view, caster, exposure);
  cv::Mat image(light.size(), CV_8U);
  RandomStream stream(seed_, "camera.noise." + std::to_string(index));
  uint64_t pool = 0;
  int left = 0;
  const float factor = static_cast<float>(gain);
  for (int y = 0; y < light.rows; ++y) {
    const float* in = light.ptr<float>(y);
    const float* vignette = vignette_.ptr<float>(y);
    uint8_t* out = image.ptr<uint8_t>(y);
    for (int x = 0; x < light.cols; ++x) {
      if (left == 0) {
        pool = stream.bits();
        left = 4;
      }
      const float signal = in[x] * vignette[x] * factor;
      const float sigma = stddev_[static_cast<size_t>(std::clamp(signal, 0.0F, 256.0F))];
      const float value = signal + sigma * gaussian_[pool & (kNoiseTable - 1)];
      out[x] = static_cast<uint8_t>(std::clamp(value + 0.5F, 0.0F, 255.0F));
      pool >>= 16;
      --left;
    }
  }
  return image;
}

std::vector<uint8_t> CameraEffects::encode(const cv::Mat& image) const {
  std::vector<uint8_t> bytes;
  if (options_.jpeg_quality > 0) {
    cv::imencode(".jpg", image, bytes, {cv::IMWRITE_JPEG_QUALITY, options_.jpeg_quality});
  } else {
    bytes.assign(image.datastart, image.dataend);
  }
  return bytes;
}

}  // namespace orthonav::simulate
