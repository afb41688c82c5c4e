#include "common/bus/clock_skew.h"

#include <algorithm>

namespace orthonav {

namespace {

constexpr int64_t kWindow = 10'000'000;  // microseconds
// A flood of made-up hosts or heartbeats must not eat the memory.
constexpr size_t kMostHosts = 16, kMostSamples = 100;

}  // namespace

void ClockSkew::add(const std::string& host, int64_t sent, int64_t received) {
  if (!samples_.contains(host) && samples_.size() >= kMostHosts) {
    std::erase_if(samples_, [&](const auto& entry) { return entry.second.back().received < received - kWindow; });
    if (samples_.size() >= kMostHosts) return;
  }
  auto& samples = samples_[host];
  // Unsigned: a made-up time must not overflow.
  const auto difference = static_cast<int64_t>(static_cast<uint64_t>(received) - static_cast<uint64_t>(sent));
  samples.push_back({received, difference});
  while (samples.size() > kMostSamples || samples.front().received < received - kWindow) samples.pop_front();
}

std::map<std::string, double> ClockSkew::skews(int64_t now) const {
  std::map<std::string, double> skews;
  for (const auto& [host, samples] : samples_) {
    if (samples.back().received < now - kWindow) continue;
    const auto least = std::min_element(samples.begin(), samples.end(),
                                        [](const Sample& a, const Sample& b) { return a.difference < b.difference; });
    skews[host] = 1e-6 * static_cast<double>(least->difference);
  }
  return skews;
}

}  // namespace orthonav
