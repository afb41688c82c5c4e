#include "services/ingest/imu_watch.h"

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

constexpr int64_t kWindow = 500'000;  // microseconds
constexpr size_t kFewest = 10;        // readings

struct Bounds {
  const char* name;
  const char* unit;
  double leap;               // the largest step from reading to reading, of which a tenth may be larger
  double smallest, largest;  // of the mean's magnitude
  const char* why;
};
// Vibrations of 30 m/s^2 are flown with, of 60 estimators are known to fail: white, they leap by 106 and 212 in a tenth
// of the readings. Nothing flies half a second without weight, or at four times it.
constexpr Bounds kRate{"angular_rate", "rad/s", 2, 0, 15, "is it in degrees?"};
constexpr Bounds kForce{"specific_force", "m/s^2", 120, 3, 40, "is it in g?"};
constexpr double kTolerableLeaps = 0.1;

}  // namespace

void ImuWatch::feed(const imu_t& reading, int64_t now) {
  Reading next{now, {}};
  next.axes << Eigen::Map<const Eigen::Vector3d>(reading.angular_rate),
      Eigen::Map<const Eigen::Vector3d>(reading.specific_force);
  for (int i = 0; i < 6; ++i)
    if (recent_.empty() || next.axes[i] != recent_.back().axes[i]) changed_[i] = now;
  recent_.push_back(next);
}

std::string ImuWatch::complaint(int64_t now) {
  while (!recent_.empty() && now - recent_.front().time > kWindow) recent_.pop_front();
  if (recent_.size() < kFewest) return {};
  for (int i = 0; i < 6; ++i) {
    if (recent_.back().time - changed_[i] > kWindow - kWindow / 10)
      return fmt::format("{}[{}] has read {} for {:.1f} s", (i < 3 ? kRate : kForce).name, i % 3,
                         recent_.back().axes[i], 1e-6 * static_cast<double>(now - changed_[i]));
  }
  const size_t steps = recent_.size() - 1;
  for (const auto& [bounds, first] : {std::pair{kRate, 0}, std::pair{kForce, 3}}) {
    const auto vector = [first = first](const Reading& r) { return r.axes.segment<3>(first); };
    Eigen::Vector3d mean = vector(recent_.back()) / static_cast<double>(recent_.size());
    size_t leaps = 0;
    for (size_t i = 0; i < steps; ++i) {
      mean += vector(recent_[i]) / static_cast<double>(recent_.size());
      leaps += (vector(recent_[i + 1]) - vector(recent_[i])).norm() > bounds.leap ? 1 : 0;
    }
    if (leaps > 1 && static_cast<double>(leaps) > kTolerableLeaps * static_cast<double>(steps))
      return fmt::format("{} leaps by more than {} {} in {} of {} readings", bounds.name, bounds.leap, bounds.unit,
                         leaps, steps);
    if (mean.norm() < bounds.smallest || mean.norm() > bounds.largest)
      return fmt::format("{} is {:.2f} {} in the mean: {}", bounds.name, mean.norm(), bounds.unit, bounds.why);
  }
  return {};
}

}  // namespace orthonav::ingest
