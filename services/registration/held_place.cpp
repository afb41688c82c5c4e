#include "services/registration/held_place.h"

#include <algorithm>

namespace orthonav::registration {
namespace {

constexpr int kMostElsewhere = 1;  // keyframes in a row
// Of what a keyframe says the place is, against what those before it say: all of it, and places walk.
constexpr double kNewest = 0.3;

}  // namespace

void HeldPlace::found(const Eigen::Vector2d& p_W, const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W,
                      double tolerance, double spacing) {
  const Eigen::Vector2d expected = en_ + G_W_ * (p_W - p_W_);
  const bool agrees = !seen_.empty() && (expected - en).norm() <= tolerance;
  if (!agrees) {
    ++elsewhere_;
    if (!seen_.empty() && elsewhere_ <= kMostElsewhere) return;
    seen_.clear();
  }
  elsewhere_ = 0;
  p_W_ = p_W;
  en_ = agrees ? expected + kNewest * (en - expected) : en;
  G_W_ = G_W;
  const auto is_far = [&](const Eigen::Vector2d& other) { return (p_W - other).norm() >= spacing; };
  if (std::all_of(seen_.begin(), seen_.end(), is_far)) seen_.push_back(p_W);
}

}  // namespace orthonav::registration
