// How far fits follow the odometry's error of scale, and whether they say how well they know it.
//
// The odometry's world (way, points, height) of a recorded flight is made longer by each of several factors, and its
// keyframes are registered anew, each time around the true place. Of the fixes within 30 m:
//   gain    how much of the factor the fitted scale, and the height, follow: the mean of their change against the
//           factor 1, over the change that would be right. 1 is whole, 0 is an echo of the odometry;
//   scale   median and root mean square of the fitted scale's error, its stated deviation in the median, and NEES
//           (of 1). The true scale is that of the truth's way against the odometry's, 40 m to both sides;
//   height  the same of the height, m; across: of the position on the ground, rms in m and NEES (of 2).
#pragma once

#include <filesystem>
#include <vector>

namespace orthonav::registration {

struct ScaleBench {
  std::filesystem::path log, map, config;
  std::filesystem::path csv;    // empty: none. One row a keyframe and factor
  std::vector<double> factors;  // of the odometry's world; 1 is added
  double seconds = 0;           // of the flight that the factors apply to, and 1 from then on; 0: all of it
  double prior_stddev = 3;      // m, of the expected position
  int seed = 1;                 // of its error
};

// Prints a row for each factor. With `seconds`, the rows are of the fixes from five seconds after the change on.
void run(const ScaleBench& bench);

}  // namespace orthonav::registration
