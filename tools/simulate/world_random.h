// Repeatable randomness for the world: every draw depends on (seed, what it is for) only, never on the order of the
// work or on the standard library's distributions.
#pragma once

#include <cstdint>
#include <string_view>

#include <Eigen/Core>
#include <opencv2/core.hpp>

namespace orthonav::simulate {

// Mixes two numbers into one without visible structure (finaliser of splitmix64).
uint64_t mix(uint64_t a, uint64_t b);
uint64_t mix(uint64_t a, std::string_view text);

// A stream of draws. Not thread-safe.
class Random {
 public:
  explicit Random(uint64_t seed) : state_(seed) {}

  double uniform();                         // [0, 1)
  double uniform(double low, double high);  // [low, high)
  double normal();                          // mean 0, standard deviation 1
  int index(int count);                     // 0 .. count - 1
  bool chance(double probability) { return uniform() < probability; }

 private:
  uint64_t state_;
};

// Smooth random displacement of the plane: a sum of sines with an rms of `rms` in each of east and north.
class SmoothField {
 public:
  SmoothField(uint64_t seed, double rms, double wavelength);
  Eigen::Vector2d operator()(const Eigen::Vector2d& p) const;

 private:
  static constexpr int kWaves = 12;
  Eigen::Vector2d wave_[2][kWaves];  // rad/m
  double phase_[2][kWaves];
  double amplitude_;
};

// Noise on a regular grid: octaves from `longest` to `shortest` wavelength (m), the amplitude of each growing with its
// wavelength to the power `slope`; mean 0 and standard deviation 1. `size` in cells of `cell` metres. Returns CV_32F.
cv::Mat noise_grid(uint64_t seed, cv::Size size, double cell, double longest, double shortest, double slope);

// Periodic noise for fine detail, side kTile cells: white noise blurred by `sigma` cells, 127 being 4 standard
// deviations. Returns CV_8S.
inline constexpr int kTile = 1024;
cv::Mat noise_tile(uint64_t seed, double sigma);

}  // namespace orthonav::simulate
