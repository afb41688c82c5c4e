// Order statistics of small samples.
#pragma once

#include <vector>

namespace orthonav {

// Quantile q in [0, 1] by linear interpolation; NaN for an empty sample.
double quantile(std::vector<double> values, double q);

// Middle of the sample; NaN for an empty one.
double median(std::vector<double> values);

// Root of the mean square; NaN for an empty sample.
double root_mean_square(const std::vector<double>& values);

}  // namespace orthonav
