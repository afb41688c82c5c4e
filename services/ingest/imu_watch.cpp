#include "services/ingest/imu_watch.h"

#include <string>
#include <vector>

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

constexpr int64_t kWindow = 500'000;  // microseconds
constexpr size_t kFewest = 10;        // readings
// For how long, in microseconds, an axis may read the very same. At rest, and until it has had the time to move
// afterwards, well filtered noise is no larger than the last digit.
constexpr int64_t kDead = 450'000, kDeadAtRest = 10'000'000;
constexpr double kTolerableLeaps = 0.1;  // of the steps
constexpr int kFewestLeaps = 5;          // two readings by chance make four

struct Bounds {
  const char* name;
  const char* unit;
  double at_rest;            // standard deviation of each axis that no motor is below
  double leap;               // the largest step from reading to reading, of which a tenth may be larger
  double smallest, largest;  // of the mean's magnitude
  const char* why;
};
// Vibrations of 30 m/s^2 are flown with, of 60 estimators are known to fail: white, they leap by 160 in 0.3 and 31 % of
// the readings. Nothing flies half a second without weight, or at ten times it.
constexpr Bounds kRate{"angular_rate", "rad/s", 0.01, 2, 0, 15, "is it in degrees?"};
constexpr Bounds kForce{"specific_force", "m/s^2", 0.1, 160, 3, 100, "is it in g?"};
constexpr double kLeastWeight = 8, kMostWeight = 12;  // m/s^2, at rest
constexpr double kRestingRate = 0.1;                  // rad/s, with any bias

}  // namespace

void ImuWatch::feed(const imu_t& reading, int64_t now) {
  forget(now);
  Reading next{now, {}};
  next.axes << Eigen::Map<const Eigen::Vector3d>(reading.angular_rate),
      Eigen::Map<const Eigen::Vector3d>(reading.specific_force);
  for (int i = 0; i < 6; ++i)
    if (recent_.empty() || next.axes[i] != recent_.back().axes[i]) changed_[i] = now;
  recent_.push_back(next);
}

void ImuWatch::forget(int64_t now) {
  while (!recent_.empty() && now - recent_.front().time > kWindow) recent_.pop_front();
}

std::string ImuWatch::complaint(int64_t now) {
  forget(now);
  if (recent_.size() < kFewest) return {};
  const auto count = static_cast<double>(recent_.size());
  Axes mean = Axes::Zero(), square = Axes::Zero();
  int rate_leaps = 0, force_leaps = 0;
  for (size_t i = 0; i < recent_.size(); ++i) {
    // From the newest, for what is the same on an axis has no spread then, whatever its size.
    const Axes offset = recent_[i].axes - recent_.back().axes;
    mean += offset / count;
    square += offset.cwiseAbs2() / count;
    if (i == 0) continue;
    const Axes step = recent_[i].axes - recent_[i - 1].axes;
    rate_leaps += step.head<3>().norm() > kRate.leap ? 1 : 0;
    force_leaps += step.tail<3>().norm() > kForce.leap ? 1 : 0;
  }
  const Axes variance = square - mean.cwiseAbs2();
  mean += recent_.back().axes;
  const bool at_rest = variance.head<3>().maxCoeff() < kRate.at_rest * kRate.at_rest &&
                       variance.tail<3>().maxCoeff() < kForce.at_rest * kForce.at_rest &&
                       mean.head<3>().norm() < kRestingRate;

  if (at_rest) rested_ = now;

  std::vector<std::string> faults;
  const int64_t longest = now - rested_ > kWindow + kDead ? kDead : kDeadAtRest;
  for (int i = 0; i < 6; ++i) {
    if (recent_.back().time - changed_[i] <= longest) continue;
    faults.push_back(fmt::format("{}[{}] has read {} for {:.1f} s", (i < 3 ? kRate : kForce).name, i % 3,
                                 recent_.back().axes[i], 1e-6 * static_cast<double>(now - changed_[i])));
  }
  const auto judge = [&](const Bounds& bounds, int leaps, double size) {
    if (leaps >= kFewestLeaps && leaps > kTolerableLeaps * (count - 1))
      faults.push_back(fmt::format("{} leaps by more than {} {} in {} of {} readings", bounds.name, bounds.leap,
                                   bounds.unit, leaps, recent_.size() - 1));
    if (size < bounds.smallest || size > bounds.largest)
      faults.push_back(fmt::format("{} is {:.2f} {} in the mean: {}", bounds.name, size, bounds.unit, bounds.why));
  };
  judge(kRate, rate_leaps, mean.head<3>().norm());
  const double force = mean.tail<3>().norm();
  judge(kForce, force_leaps, force);
  if (at_rest && force > kForce.smallest && (force < kLeastWeight || force > kMostWeight))
    faults.push_back(fmt::format("specific_force is {:.2f} m/s^2 at rest: is its scale right?", force));
  return fmt::format("{}", fmt::join(faults, ", "));
}

}  // namespace orthonav::ingest
