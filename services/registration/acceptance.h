// When the best place that was found is believed: by how much likelier it is than the best other one, for what one
// field looks like, the next one may too, and then both are likely. Pure functions, thread-safe.
#pragma once

#include <string>

namespace orthonav::registration {

struct AcceptanceOptions {
  // The log-likelihood of the best place less that of the second, in itself, and, where the aircraft is expected, as a
  // share of the former;
  double min_likelihood_ratio = 150;
  double min_likelihood_share = 0.35;
  // elsewhere the evidence, which that share is a part of.
  double min_evidence = 1.5;
  int min_inliers = 8;
};

// What the best place has to show for itself against the best other one.
struct Standing {
  double log_likelihood = 0;
  double log_likelihood_ratio = 0;  // less that of the other place
  double aligned_share = 0;         // of the points, how many stay where they are aligned to the map
  int inliers = 0;
  int held = 0;              // over how much new ground (HeldPlace)
  int num_keyframes = 1;     // of the submap
  bool is_expected = false;  // the place is where the aircraft is expected closely
};

// What speaks for such a place where the aircraft is not expected: a sum of the likelihood ratio as a share of the
// likelihood, of the share of aligned points, the likelihood ratio and the new ground held over, less something for
// each keyframe. docs/registration.md says how it was weighed.
double evidence(const Standing& place);

// Why such a place is not accepted; empty when it is.
std::string doubt(const Standing& place, const AcceptanceOptions& options);

}  // namespace orthonav::registration
