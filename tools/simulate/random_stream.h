// Named streams of random numbers: what one sensor draws never depends on what another one drew.
#pragma once

#include <cstdint>
#include <random>
#include <string_view>
#include <vector>

namespace orthonav::simulate {

// Pseudo-random numbers that depend on (seed, name) alone. std::mt19937_64 gives the bits, and the distributions
// are ours, because the standard leaves those of <random> to the library. Not thread-safe.
class RandomStream {
 public:
  RandomStream(uint64_t seed, std::string_view name);

  uint64_t bits() { return engine_(); }
  double uniform(double low, double high);  // in [low, high)
  double gaussian();                        // zero mean, unit variance

 private:
  std::mt19937_64 engine_;
  double spare_ = 0;
  bool has_spare_ = false;
};

// `count` samples, `step` seconds apart, of a stationary Ornstein-Uhlenbeck process: zero mean, standard deviation
// `stddev`, autocorrelation exp(-|t| / correlation_time). Throws std::invalid_argument unless both times are > 0.
std::vector<double> correlated_noise(RandomStream& stream, size_t count, double step, double stddev,
                                     double correlation_time);

}  // namespace orthonav::simulate
