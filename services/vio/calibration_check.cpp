#include "services/vio/calibration_check.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/SVD>
#include <fmt/format.h>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

constexpr double kLargeError = 15;  // degrees: beyond, it is not a mount that is a little off
constexpr double kPi = 3.14159265358979323846;
constexpr double kLongestPair = 1.0;    // s
constexpr double kLargestTurn = 0.12;   // rad
constexpr size_t kFewestFeatures = 25;  // common to a pair
constexpr double kBiasSigma = 0.1;      // rad/s, of the gyroscope's bias
constexpr double kMapSigma = 100.0;     // of an entry of A - I: nothing is assumed
constexpr double kForceTime = 3.0;      // s, over which the accelerometer's magnitude is averaged
constexpr int kMemory = 200;            // pairs, after which what was learnt counts half
constexpr int kFewestPairs = 6;
// Tracks of one feature share their errors from pair to pair, which the information of a pair does not know of.
constexpr double kDiscount = 0.5;
constexpr double kPixelSigma = 0.3;  // pixels, of a feature: of every camera, so above that of a good one

const char* const kAxesComplaint =
    "the camera-IMU rotation, or the gyroscope's axes or units, are wrong: camera and gyroscope turn differently";

// Two directions across a unit vector.
Eigen::Matrix<double, 3, 2> across(const Eigen::Vector3d& t) {
  const Eigen::Vector3d helper = std::abs(t.z()) < 0.9 ? Eigen::Vector3d::UnitZ() : Eigen::Vector3d::UnitX();
  Eigen::Matrix<double, 3, 2> B;
  B.col(0) = t.cross(helper).normalized();
  B.col(1) = t.cross(B.col(0));
  return B;
}

RelativeRotation refine(const std::vector<Eigen::Vector3d>& rays_1, const std::vector<Eigen::Vector3d>& rays_2,
                        const Eigen::Vector3d& guess, const Eigen::Vector3d& direction, double focal,
                        double pixel_sigma) {
  RelativeRotation result;
  const size_t n = rays_1.size();
  std::vector<Eigen::Vector3d> turned(n);
  Eigen::Quaterniond q = so3_exp(guess);
  Eigen::Vector3d t = direction;
  const double weight = focal / pixel_sigma;
  Eigen::Matrix<double, 5, 5> H;
  double squares = 0, weights = 0;
  constexpr int kIterations = 8;
  for (int iteration = 0; iteration <= kIterations; ++iteration) {
    const Eigen::Matrix3d R = q.toRotationMatrix();
    for (size_t i = 0; i < n; ++i) turned[i] = R * rays_1[i];
    const Eigen::Matrix<double, 3, 2> B = across(t);
    H.setZero();
    Eigen::Matrix<double, 5, 1> b = Eigen::Matrix<double, 5, 1>::Zero();
    squares = weights = 0;
    for (size_t i = 0; i < n; ++i) {
      const double length = t.cross(turned[i]).head<2>().norm();
      if (length < 1e-3) continue;  // at the epipole
      const double scale = weight / length;
      const Eigen::Vector3d normal = turned[i].cross(rays_2[i]);
      const double e = scale * t.dot(normal);
      Eigen::Matrix<double, 5, 1> J;
      J << scale * turned[i].cross(rays_2[i].cross(t)), scale * (B.transpose() * normal);
      const double w = 1.0 / (1.0 + e * e / 4.0);  // Cauchy at two standard deviations
      H += w * J * J.transpose();
      b -= w * e * J;
      squares += w * e * e;
      weights += w;
    }
    if (iteration == kIterations) break;
    Eigen::Matrix<double, 5, 5> damped = H;
    damped.diagonal().array() *= 1.0 + 1e-6;
    damped.diagonal().array() += 1e-3;
    const Eigen::Matrix<double, 5, 1> step = damped.ldlt().solve(b);
    if (!step.allFinite()) break;
    const double shrink = std::min(1.0, 0.1 / std::max(1e-12, step.head<3>().norm()));
    q = (so3_exp(shrink * step.head<3>()) * q).normalized();
    t = (t + shrink * B * step.tail<2>()).normalized();
  }
  result.w = so3_log(q);
  Eigen::Matrix2d across_t = H.bottomRightCorner<2, 2>();
  across_t.diagonal().array() += 1e-6 * (1.0 + across_t.trace());
  result.information =
      H.topLeftCorner<3, 3>() - H.topRightCorner<3, 2>() * across_t.inverse() * H.bottomLeftCorner<2, 3>();
  result.residual = pixel_sigma * std::sqrt(squares / std::max(1e-9, weights));
  return result;
}

}  // namespace

RelativeRotation relative_rotation(const std::vector<Eigen::Vector3d>& rays_1,
                                   const std::vector<Eigen::Vector3d>& rays_2, const Eigen::Vector3d& expected,
                                   double focal, double pixel_sigma) {
  std::vector<Eigen::Vector3d> guesses{Eigen::Vector3d::Zero()};
  if (expected.norm() < 2 * kLargestTurn) guesses.push_back(expected);
  std::vector<RelativeRotation> found;
  double best = INFINITY;
  for (const Eigen::Vector3d& guess : guesses) {
    for (int axis = 0; axis < 3; ++axis) {
      found.push_back(refine(rays_1, rays_2, guess, Eigen::Vector3d::Unit(axis), focal, pixel_sigma));
      best = std::min(best, found.back().residual);
    }
  }
  std::erase_if(found, [&](const RelativeRotation& one) { return one.residual > 1.2 * best + 0.02; });
  return *std::min_element(found.begin(), found.end(), [&](const RelativeRotation& a, const RelativeRotation& b) {
    return (a.w - expected).norm() < (b.w - expected).norm();
  });
}

CalibrationCheck::CalibrationCheck(const CalibrationCheckOptions& options, const Extrinsics& extrinsics, double gravity,
                                   double focal)
    : options_(options), extrinsics_(extrinsics), gravity_(gravity), focal_(focal) {}

void CalibrationCheck::check_gravity(const std::vector<ImuSample>& imu) {
  // From image to image the sensor hardly turns, and what shakes it is nothing in the mean: of single samples'
  // magnitudes it is not (5 m/s^2 an axis made 12.4 of 9.81).
  Eigen::Vector3d impulse = Eigen::Vector3d::Zero();
  for (size_t k = 1; k < imu.size(); ++k) {
    const double dt = 1e-6 * static_cast<double>(imu[k].utime - imu[k - 1].utime);
    impulse += 0.5 * dt * (imu[k - 1].accel + imu[k].accel);
    force_time_ += dt;
  }
  force_sum_ += impulse.norm();
  if (force_time_ < kForceTime) return;
  const double mean = force_sum_ / force_time_;
  gravity_complaint_ = std::abs(mean / gravity_ - 1) > options_.max_gravity_error
                           ? fmt::format(
                                 "the accelerometer reads {:.3g} m/s^2 on average where gravity is {:.2f}: its "
                                 "units or its scale are wrong",
                                 mean, gravity_)
                           : "";
  force_sum_ = force_time_ = 0;
}

void CalibrationCheck::add(const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu) {
  check_gravity(imu);
  for (size_t k = 1; k < imu.size(); ++k) {
    const double dt = 1e-6 * static_cast<double>(imu[k].utime - imu[k - 1].utime);
    turned_ = (turned_ * so3_exp(0.5 * dt * (imu[k].gyro + imu[k - 1].gyro))).normalized();
    elapsed_ += dt;
  }
  std::map<int64_t, Eigen::Vector3d> now;
  size_t common = 0;
  for (const TrackedFeature& feature : features) {
    now[feature.id] = feature.ray;
    common += reference_.count(feature.id);
  }
  const bool broken = common < kFewestFeatures;
  if (!broken && elapsed_ < kLongestPair && 2 * common > reference_.size() && so3_log(turned_).norm() < kLargestTurn) {
    return;
  }
  if (!broken && elapsed_ > 0) add_pair(now);
  reference_ = std::move(now);
  turned_.setIdentity();
  elapsed_ = 0;
  complaint_ = gravity_complaint_;
  if (complaint_.empty()) check_rotation();
}

void CalibrationCheck::add_pair(const std::map<int64_t, Eigen::Vector3d>& now) {
  std::vector<Eigen::Vector3d> rays_1, rays_2;
  for (const auto& [id, ray] : now) {
    const auto before = reference_.find(id);
    if (before == reference_.end()) continue;
    rays_1.push_back(before->second);
    rays_2.push_back(ray);
  }
  // Camera coordinates of the first image to those of the second, by the gyroscope.
  const Eigen::Vector3d g = -(extrinsics_.R_B_C.transpose() * so3_log(turned_));
  const RelativeRotation seen = relative_rotation(rays_1, rays_2, g + elapsed_ * bias_, focal_, kPixelSigma);
  if (seen.residual > 5 * kPixelSigma || seen.w.norm() > 5 * kLargestTurn) return;
  const double excess = std::max(1.0, seen.residual / kPixelSigma);
  const Eigen::Matrix3d information = kDiscount / (excess * excess) * seen.information;

  const Eigen::Vector3d difference = seen.w - g;
  Eigen::Matrix<double, 3, 12> M = Eigen::Matrix<double, 3, 12>::Zero();
  for (int row = 0; row < 3; ++row) M.block<1, 3>(row, 3 * row) = g.transpose();
  M.rightCols<3>() = elapsed_ * Eigen::Matrix3d::Identity();
  Eigen::Matrix<double, 3, 6> M_turn;
  M_turn << -skew(g), elapsed_ * Eigen::Matrix3d::Identity();
  if (++pairs_ % kMemory == 0) {
    pairs_ /= 2;
    squares_ *= 0.5;
    H_ *= 0.5;
    b_ *= 0.5;
    H_turn_ *= 0.5;
    b_turn_ *= 0.5;
  }
  H_ += M.transpose() * information * M;
  b_ += M.transpose() * information * difference;
  H_turn_ += M_turn.transpose() * information * M_turn;
  b_turn_ += M_turn.transpose() * information * difference;
  squares_ += difference.dot(information * difference);
}

void CalibrationCheck::check_rotation() {
  if (pairs_ < kFewestPairs) return;
  Eigen::Matrix<double, 12, 12> H = H_;
  H.diagonal().head<9>().array() += 1.0 / (kMapSigma * kMapSigma);
  H.diagonal().tail<3>().array() += 1.0 / (kBiasSigma * kBiasSigma);
  const Eigen::Matrix<double, 12, 12> covariance = H.ldlt().solve(Eigen::Matrix<double, 12, 12>::Identity());
  const Eigen::Matrix<double, 12, 1> x = covariance * b_;
  const double cost_map = squares_ - x.dot(b_);
  const double unit = std::max(1.0, cost_map / std::max(1, 3 * pairs_ - 12));

  Eigen::Matrix<double, 6, 6> H_turn = H_turn_;
  H_turn.diagonal().head<3>().array() += 1e-2;
  H_turn.diagonal().tail<3>().array() += 1.0 / (kBiasSigma * kBiasSigma);
  const Eigen::Matrix<double, 6, 6> covariance_turn = H_turn.ldlt().solve(Eigen::Matrix<double, 6, 6>::Identity());
  const Eigen::Matrix<double, 6, 1> y = covariance_turn * b_turn_;
  const double limit = options_.significance * options_.significance;
  bias_ = y.tail<3>();

  // A whole axis of the gyroscope that the camera contradicts, and that no small turn of the camera explains: units or
  // axes. Each of the six further unknowns of the map costs what chance alone would gain by it.
  const double cost_turn = squares_ - y.dot(b_turn_);
  const bool small_turn = cost_turn - cost_map < 6 * limit * unit;
  for (int axis = 0; axis < 3 && !small_turn; ++axis) {
    Eigen::Vector3d column, sigma;
    for (int row = 0; row < 3; ++row) {
      column[row] = x[3 * row + axis] + (row == axis ? 1.0 : 0.0);
      sigma[row] = std::sqrt(unit * covariance(3 * row + axis, 3 * row + axis));
    }
    // Off by half, or by half of what is left: where units differ by degrees for radians, what is left is small.
    const double apart = (column - Eigen::Vector3d::Unit(axis)).norm();
    if (apart < 0.5 || apart < options_.significance * sigma.norm()) continue;
    if (column.norm() < 0.5 || column.norm() > 2.0) {
      complaint_ =
          fmt::format("the gyroscope turns {:.3g} times as much as the camera: its units or its scale are wrong",
                      1.0 / std::max(1e-3, column.norm()));
    } else {
      complaint_ = kAxesComplaint;
    }
    return;
  }
  const Eigen::Vector3d turn = y.head<3>();
  const double angle = turn.norm();
  if (angle * 180 / kPi < options_.max_rotation_deg) return;
  const Eigen::Vector3d direction = turn / angle;
  const double variance = unit * direction.dot(covariance_turn.topLeftCorner<3, 3>() * direction);
  if (angle * angle > limit * variance) {
    complaint_ = angle * 180 / kPi > kLargeError
                     ? kAxesComplaint
                     : fmt::format("the camera-IMU rotation is wrong by {:.1f} degrees", angle * 180 / kPi);
  }
}

}  // namespace orthonav::vio
