#include "tools/simulate/random_stream.h"

#include <cmath>
#include <numbers>
#include <stdexcept>

namespace orthonav::simulate {
namespace {

uint64_t mix(uint64_t x) {  // splitmix64: neighbouring seeds give unrelated streams
  x += 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

uint64_t hash_name(std::string_view name) {  // FNV-1a
  uint64_t hash = 0xcbf29ce484222325ULL;
  for (const char c : name) hash = (hash ^ static_cast<unsigned char>(c)) * 0x100000001b3ULL;
  return hash;
}

}  // namespace

RandomStream::RandomStream(uint64_t seed, std::string_view name) : engine_(mix(seed ^ mix(hash_name(name)))) {}

double RandomStream::uniform(double low, double high) {
  return low + (high - low) * (static_cast<double>(engine_() >> 11) * 0x1.0p-53);
}

double RandomStream::gaussian() {
  if (has_spare_) {
    has_spare_ = false;
    return spare_;
  }
  const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform(0.0, 1.0)));
  const double angle = uniform(0.0, 2.0 * std::numbers::pi);
  spare_ = radius * std::sin(angle);
  has_spare_ = true;
  return radius * std::cos(angle);
}

std::vector<double> correlated_noise(RandomStream& stream, size_t count, double step, double stddev,
                                     double correlation_time) {
  if (!(step > 0) || !(correlation_time > 0)) throw std::invalid_argument("correlated_noise: times must be positive");
  const double keep = std::exp(-step / correlation_time);
  const double drive = std::sqrt(1.0 - keep * keep);
  std::vector<double> values(count);
  double x = stream.gaussian();
  for (double& value : values) {
    value = stddev * x;
    x = keep * x + drive * stream.gaussian();
  }
  return values;
}

}  // namespace orthonav::simulate
