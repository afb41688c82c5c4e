#include "services/registration/acceptance.h"

#include <algorithm>

#include <fmt/format.h>

namespace orthonav::registration {
namespace {

// What speaks for a place where the aircraft is not expected: the share of aligned points, the log-likelihood ratio's
// share, the ratio that counts as 1 (where little ground was seen, large shares are of little), and each piece of new
// ground it has held over, up to so many. Against it: each keyframe of the submap, for among many points some are alike
// anywhere; without this wrong places had 1.2 over a few keyframes and 2.2 over 16.
constexpr double kShareEvidence = 2;
constexpr double kInlierEvidence = 3;
constexpr double kRatioEvidence = 3000;
constexpr double kHeldEvidence = 0.1;
constexpr int kMostHeld = 16;
constexpr double kLengthEvidence = 0.0375;
// And the least of the log-likelihood ratio's share.
constexpr double kLeastShare = 0.2;

}  // namespace

double evidence(const Standing& place) {
  return kShareEvidence * place.log_likelihood_ratio / place.log_likelihood + kInlierEvidence * place.aligned_share +
         place.log_likelihood_ratio / kRatioEvidence + kHeldEvidence * std::min(place.held, kMostHeld) -
         kLengthEvidence * place.num_keyframes;
}

std::string doubt(const Standing& place, const AcceptanceOptions& options) {
  const double share = place.log_likelihood_ratio / place.log_likelihood;
  const bool clear = place.is_expected ? share >= options.min_likelihood_share
                                       : share >= kLeastShare && evidence(place) >= options.min_evidence;
  if (!clear || place.log_likelihood_ratio < options.min_likelihood_ratio) {
    return fmt::format(
        "another place is nearly as likely: log-likelihood ratio {:.0f} of {:.0f}, evidence {:.2f}, held {}",
        place.log_likelihood_ratio, place.log_likelihood, evidence(place), place.held);
  }
  if (place.inliers < options.min_inliers) {
    return fmt::format("{} inliers, {} are needed", place.inliers, options.min_inliers);
  }
  return "";
}

}  // namespace orthonav::registration
