// What the errors of a flight's fixes come from: least squares of the errors on what could have caused them.
//
// Horizontally, of each fix within 30 m of the truth, e its error, h its height above ground, c its course:
//   e = a h (tilt of the odometry's "down": east, north) + b (heading's error) c_left + d (scale's error) c + map's
//   offset,
// vertically e = a h (scale's error) + a constant. Each cause is fitted alone, too: what it leaves says what it
// explains, for causes that go together (a tilt and a scale that are both wrong at the start) share the credit in the
// whole fit.
#pragma once

#include <Eigen/Core>

#include "tools/evaluate/metrics.h"
#include "tools/evaluate/odometry_scale.h"

namespace orthonav::evaluate {

ErrorRegression regress_errors(const FlightRecord& record, const RegistrationMetrics& registration,
                               const OdometryScale& odometry);

}  // namespace orthonav::evaluate
