#include "tools/simulate/world_random.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <opencv2/imgproc.hpp>

namespace orthonav::simulate {

namespace {

uint64_t finalise(uint64_t z) {
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
  return z ^ (z >> 31);
}

cv::Mat white_noise(uint64_t seed, cv::Size size) {
  Random random(seed);
  cv::Mat noise(size, CV_32F);
  for (int v = 0; v < size.height; ++v) {
    float* row = noise.ptr<float>(v);
    // The sum of three uniforms is close enough to a normal here, and cheap.
    for (int u = 0; u < size.width; ++u)
      row[u] = static_cast<float>(2.0 * (random.uniform() + random.uniform() + random.uniform() - 1.5));
  }
  return noise;
}

}  // namespace

uint64_t mix(uint64_t a, uint64_t b) {
  return finalise(finalise(a + 0x9e3779b97f4a7c15ULL) + b * 0xd1342543de82ef95ULL);
}

uint64_t mix(uint64_t a, std::string_view text) {
  for (const char c : text) a = mix(a, static_cast<uint64_t>(static_cast<unsigned char>(c)));
  return mix(a, static_cast<uint64_t>(text.size()));
}

double Random::uniform() {
  state_ += 0x9e3779b97f4a7c15ULL;
  return static_cast<double>(finalise(state_) >> 11) * 0x1.0p-53;
}

double Random::uniform(double low, double high) {
  return low + (high - low) * uniform();
}

double Random::normal() {
  const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
  return radius * std::cos(2.0 * std::numbers::pi * uniform());
}

int Random::index(int count) {
  return std::min(count - 1, static_cast<int>(uniform() * count));
}

SmoothField::SmoothField(uint64_t seed, double rms, double wavelength) : amplitude_(rms * std::sqrt(2.0 / kWaves)) {
  Random random(seed);
  for (int axis = 0; axis < 2; ++axis) {
    for (int i = 0; i < kWaves; ++i) {
      const double angle = random.uniform(0.0, 2.0 * std::numbers::pi);
      const double k = 2.0 * std::numbers::pi / (wavelength * random.uniform(0.7, 1.6));
      wave_[axis][i] = {k * std::cos(angle), k * std::sin(angle)};
      phase_[axis][i] = random.uniform(0.0, 2.0 * std::numbers::pi);
    }
  }
}

Eigen::Vector2d SmoothField::operator()(const Eigen::Vector2d& p) const {
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  for (int axis = 0; axis < 2; ++axis)
    for (int i = 0; i < kWaves; ++i) sum[axis] += std::sin(wave_[axis][i].dot(p) + phase_[axis][i]);
  return amplitude_ * sum;
}

cv::Mat noise_grid(uint64_t seed, cv::Size size, double cell, double longest, double shortest, double slope) {
  cv::Mat sum = cv::Mat::zeros(size, CV_32F);
  int octave = 0;
  for (double wavelength = longest; wavelength >= shortest; wavelength /= 2, ++octave) {
    // Nodes half a wavelength apart, at least one per cell.
    const double step = std::max(1.0, wavelength / 2 / cell);
    const cv::Size nodes(static_cast<int>(size.width / step) + 3, static_cast<int>(size.height / step) + 3);
    cv::Mat fine;
    const cv::Size fine_size(static_cast<int>(nodes.width * step), static_cast<int>(nodes.height * step));
    cv::resize(white_noise(mix(seed, octave), nodes), fine, fine_size, 0, 0, cv::INTER_CUBIC);
    const int du = std::max(0, (fine_size.width - size.width) / 2),
              dv = std::max(0, (fine_size.height - size.height) / 2);
    cv::scaleAdd(fine(cv::Rect(du, dv, size.width, size.height)), std::pow(wavelength, slope), sum, sum);
  }
  cv::Scalar mean, deviation;
  cv::meanStdDev(sum, mean, deviation);
  sum = (sum - mean[0]) / std::max(1e-9, deviation[0]);
  return sum;
}

cv::Mat noise_tile(uint64_t seed, double sigma) {
  const int border = static_cast<int>(std::ceil(4 * sigma)) + 1;
  cv::Mat noise, padded;
  cv::copyMakeBorder(white_noise(seed, {kTile, kTile}), padded, border, border, border, border, cv::BORDER_WRAP);
  cv::GaussianBlur(padded, padded, {}, sigma);
  padded(cv::Rect(border, border, kTile, kTile)).copyTo(noise);
  cv::Scalar mean, deviation;
  cv::meanStdDev(noise, mean, deviation);
  cv::Mat tile;
  noise.convertTo(tile, CV_8S, 127.0 / 4.0 / deviation[0], -mean[0] * 127.0 / 4.0 / deviation[0]);
  return tile;
}

}  // namespace orthonav::simulate
