#include "tools/evaluate/error_regression.h"

#include <cmath>
#include <map>
#include <vector>

#include <Eigen/QR>

#include "common/math/so3.h"
#include "tools/evaluate/figures.h"

namespace orthonav::evaluate {
namespace {

constexpr int kFewest = 10;           // fixes, for five unknowns
constexpr double kCourseSpeed = 0.5;  // m/s: slower aircraft have no course
constexpr int64_t kSecond = 1'000'000;

// What could have caused the error of one fix. Unknown causes are 0: they explain nothing.
struct Causes {
  Eigen::Vector3d error;                                  // m, east north up
  Eigen::Vector2d tilt_height = Eigen::Vector2d::Zero();  // m
  Eigen::Vector2d heading = Eigen::Vector2d::Zero();      // rad, to the left of the course
  Eigen::Vector2d scale = Eigen::Vector2d::Zero();        // along the course
  double scale_height = 0;                                // m
};

double finite_or_zero(double value) {
  return std::isfinite(value) ? value : 0.0;
}

Eigen::Vector2d course_at(const Reference& reference, int64_t utime) {
  const auto before = reference.at(utime - kSecond), after = reference.at(utime + kSecond);
  if (!before || !after) return Eigen::Vector2d::Zero();
  const Eigen::Vector2d way = (after->p_G_B - before->p_G_B).head<2>();
  return way.norm() < 2 * kCourseSpeed ? Eigen::Vector2d::Zero() : Eigen::Vector2d(way.normalized());
}

std::vector<Causes> causes_of(const FlightRecord& record, const RegistrationMetrics& registration,
                              const OdometryScale& odometry) {
  std::map<int64_t, const vio_state_t*> states;
  for (const auto& [logged_at, state] : record.vio) states[state.utime] = &state;
  std::vector<Causes> all;
  for (const JudgedFix& judged : registration.fixes) {
    if (!judged.p_G_B || !judged.reference || judged.false_fix) continue;
    const ReferenceSample& truth = *judged.reference;
    Causes causes;
    causes.error = *judged.p_G_B - truth.p_G_B;
    const double height = finite_or_zero(truth.height_above_ground);
    const Eigen::Vector2d course = course_at(record.truth, judged.fix->utime);
    const auto state = states.find(judged.fix->utime);
    if (state != states.end()) {
      const Eigen::Vector3d up_B = quaternion_of(state->second->q_W_B).conjugate() * Eigen::Vector3d::UnitZ();
      if (up_B.allFinite()) causes.tilt_height = -height * (truth.q_G_B * up_B).head<2>();
    }
    const Eigen::Quaterniond q_G_B = quaternion_of(judged.fix->q_G_B);
    if (q_G_B.coeffs().allFinite()) {
      const double turn = wrap_angle(heading_of(q_G_B) - heading_of(truth.q_G_B));  // clockwise
      causes.heading = turn * Eigen::Vector2d(-course.y(), course.x());
    }
    if (const auto scale = odometry.ending_at(judged.fix->utime)) {
      const double fitted = std::isfinite(judged.fix->scale) ? judged.fix->scale : 1.0;
      const double error = fitted * (1 + scale->error) - 1;
      causes.scale = error * course;
      causes.scale_height = error * height;
    }
    all.push_back(causes);
  }
  return all;
}

double rms(const Eigen::VectorXd& values) {
  return std::sqrt(values.squaredNorm() / static_cast<double>(values.size()));
}

struct Fit {
  Eigen::VectorXd slopes;
  double left = 0;
};

Fit fit(const Eigen::MatrixXd& causes, const Eigen::VectorXd& errors) {
  Fit result;
  result.slopes = causes.colPivHouseholderQr().solve(errors);
  result.left = rms(errors - causes * result.slopes);
  return result;
}

}  // namespace

ErrorRegression regress_errors(const FlightRecord& record, const RegistrationMetrics& registration,
                               const OdometryScale& odometry) {
  ErrorRegression result;
  if (record.truth.empty()) return result;
  const std::vector<Causes> all = causes_of(record, registration, odometry);
  result.fixes = static_cast<int>(all.size());
  if (result.fixes < kFewest) return result;

  const auto n = static_cast<Eigen::Index>(all.size());
  Eigen::MatrixXd plane = Eigen::MatrixXd::Zero(2 * n, 5), up(n, 2);  // tilt, heading, scale, offset east and north
  Eigen::VectorXd plane_errors(2 * n), up_errors(n);
  for (Eigen::Index i = 0; i < n; ++i) {
    const Causes& causes = all[static_cast<size_t>(i)];
    plane_errors.segment<2>(2 * i) = causes.error.head<2>();
    plane.block<2, 1>(2 * i, 0) = causes.tilt_height;
    plane.block<2, 1>(2 * i, 1) = causes.heading;
    plane.block<2, 1>(2 * i, 2) = causes.scale;
    plane.block<2, 2>(2 * i, 3).setIdentity();
    up_errors[i] = causes.error.z();
    up.row(i) << causes.scale_height, 1.0;
  }
  const auto alone = [&](Eigen::Index column) {
    const Fit one = fit(plane.col(column), plane_errors);
    return ExplainedError{one.slopes[0], one.left};
  };
  result.horizontal = rms(plane_errors);
  result.tilt_height = alone(0);
  result.heading = alone(1);
  result.scale = alone(2);
  const Fit offset = fit(plane.rightCols<2>(), plane_errors), whole = fit(plane, plane_errors);
  result.offset_en = offset.slopes;
  result.offset_left = offset.left;
  result.together = whole.slopes;
  result.together_left = whole.left;
  result.vertical = rms(up_errors);
  const Fit height = fit(up.leftCols<1>(), up_errors), constant = fit(up.rightCols<1>(), up_errors),
            both = fit(up, up_errors);
  result.scale_height = {height.slopes[0], height.left};
  result.vertical_offset = {constant.slopes[0], constant.left};
  result.vertical_together_left = both.left;
  return result;
}

}  // namespace orthonav::evaluate
