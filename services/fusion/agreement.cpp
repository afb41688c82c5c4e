#include "services/fusion/agreement.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "services/fusion/plausible.h"

namespace orthonav::fusion {
namespace {

// However sure a fix says it is: nobody can have counted whether it is right more often than so.
constexpr double kSurest = 0.9999;
// Exponent by which wrong places that move along with the aircraft become rarer with the way.
constexpr double kTail = 3.0;

}  // namespace

double log_odds_of(double probability) {
  return std::log(probability / (1 - probability));
}

Agreement::Agreement(int fixes, double most_told, double span, int64_t newest_utime)
    : fixes_(fixes), most_told_(most_told), span_(span), newest_utime_(newest_utime) {}

void Agreement::add(const Keyframe& keyframe, const Fix& fix, double height, const LockOptions& options) {
  const Eigen::Vector2d p_W = keyframe.p_W_B.head<2>();
  if (!first_p_W_) first_p_W_ = p_W;
  span_ = std::max(span_, (p_W - *first_p_W_).norm() / std::max(options.wrong_distance, options.wrong_height * height));
  most_told_ = std::fmax(most_told_, std::min(fix.log_odds, log_odds_of(kSurest)));
  newest_utime_ = std::max(newest_utime_, keyframe.utime);
  ++fixes_;
}

double Agreement::place_log_odds(int64_t now, const LockOptions& options) const {
  return log_odds(std::isnan(most_told_) ? log_odds_of(options.fix_probability) : most_told_, now, options);
}

double Agreement::accuracy_log_odds(int64_t now, const LockOptions& options) const {
  return log_odds(std::fmin(log_odds_of(options.fix_probability), most_told_), now, options);
}

double Agreement::log_odds(double first, int64_t now, const LockOptions& options) const {
  if (fixes_ == 0) return -std::numeric_limits<double>::infinity();
  const double wrong = std::exp(-first - std::min(kTail * std::log1p(span_), fixes_ - 1.0));
  const double age = std::max(0.0, seconds_between(newest_utime_, now));
  return -std::log(wrong + age / options.jump_time);
}

}  // namespace orthonav::fusion
