#include "services/vio/reference_patch.h"

#include <algorithm>
#include <cmath>

#include <Eigen/LU>

namespace orthonav::vio {
namespace {

// Grey level between pixels; the four around `at` must lie in the image.
float sample(const cv::Mat& image, const Eigen::Vector2d& at) {
  const int u = static_cast<int>(at.x()), v = static_cast<int>(at.y());
  const auto a = static_cast<float>(at.x() - u), b = static_cast<float>(at.y() - v);
  const uchar* upper = image.ptr<uchar>(v) + u;
  const uchar* lower = image.ptr<uchar>(v + 1) + u;
  const float top = static_cast<float>(upper[0]) + a * static_cast<float>(upper[1] - upper[0]);
  const float bottom = static_cast<float>(lower[0]) + a * static_cast<float>(lower[1] - lower[0]);
  return top + b * (bottom - top);
}

bool lies_in(const cv::Mat& image, const Eigen::Vector2d& pixel, const Eigen::Vector2d& reach) {
  return pixel.x() - reach.x() >= 0 && pixel.y() - reach.y() >= 0 && pixel.x() + reach.x() < image.cols - 1 &&
         pixel.y() + reach.y() < image.rows - 1;
}

}  // namespace

std::optional<ReferencePatch> ReferencePatch::make(const cv::Mat& image, const Eigen::Vector2d& pixel,
                                                   const CameraModel& camera) {
  constexpr double kMinEigenvalue = 4;  // of a sample's mean squared gradient, grey levels per pixel, squared
  if (!lies_in(image, pixel, Eigen::Vector2d::Constant(kHalf + 1))) return std::nullopt;
  ReferencePatch patch;
  const auto ray = camera.unproject(pixel);
  const auto right = camera.unproject(pixel + Eigen::Vector2d::UnitX());
  const auto below = camera.unproject(pixel + Eigen::Vector2d::UnitY());
  if (!ray || !right || !below) return std::nullopt;
  patch.ray_per_pixel_.col(0) = (*right - *ray).head<2>();
  patch.ray_per_pixel_.col(1) = (*below - *ray).head<2>();

  float mean = 0, mean_u = 0, mean_v = 0;
  for (int v = -kHalf, i = 0; v <= kHalf; ++v) {
    for (int u = -kHalf; u <= kHalf; ++u, ++i) {
      const Eigen::Vector2d at = pixel + Eigen::Vector2d(u, v);
      const auto k = static_cast<size_t>(i);
      patch.values_[k] = sample(image, at);
      patch.gradient_u_[k] =
          0.5F * (sample(image, at + Eigen::Vector2d::UnitX()) - sample(image, at - Eigen::Vector2d::UnitX()));
      patch.gradient_v_[k] =
          0.5F * (sample(image, at + Eigen::Vector2d::UnitY()) - sample(image, at - Eigen::Vector2d::UnitY()));
      mean += patch.values_[k] / kSamples;
      mean_u += patch.gradient_u_[k] / kSamples;
      mean_v += patch.gradient_v_[k] / kSamples;
    }
  }
  float squares = 0, uu = 0, uv = 0, vv = 0;
  for (size_t k = 0; k < kSamples; ++k) {
    patch.values_[k] -= mean;
    patch.gradient_u_[k] -= mean_u;
    patch.gradient_v_[k] -= mean_v;
    squares += patch.values_[k] * patch.values_[k];
    uu += patch.gradient_u_[k] * patch.gradient_u_[k];
    uv += patch.gradient_u_[k] * patch.gradient_v_[k];
    vv += patch.gradient_v_[k] * patch.gradient_v_[k];
  }
  patch.contrast_ = std::sqrt(squares);
  const double half_trace = 0.5 * (uu + vv);
  const double smallest = half_trace - std::hypot(0.5 * (uu - vv), static_cast<double>(uv));
  if (smallest < kMinEigenvalue * kSamples) return std::nullopt;
  Eigen::Matrix2d hessian;
  hessian << uu, uv, uv, vv;
  patch.inverse_hessian_ = hessian.inverse();
  return patch;
}

ReferencePatch::Result ReferencePatch::align(const cv::Mat& image, const CameraModel& camera,
                                             const Eigen::Vector3d& ray, Eigen::Vector2d& pixel) const {
  constexpr int kIterations = 8;
  constexpr double kConverged = 0.01, kFurthest = 1.5;  // pixels of the reference
  constexpr float kAlike = 0.8F;                        // correlation
  // Pixels of the image per pixel of the reference: through the ray, turned back to how the camera was.
  const Eigen::Vector3d back = R_cur_ref_.transpose() * ray;
  if (!(back.z() > 0.2)) return Result::kUnlike;
  Eigen::Matrix2d warp;
  for (int axis = 0; axis < 2; ++axis) {
    Eigen::Vector3d step = Eigen::Vector3d::Zero();
    step.head<2>() = kHalf * ray_per_pixel_.col(axis);
    const auto after = camera.project(R_cur_ref_ * (back / back.z() + step));
    const auto before = camera.project(R_cur_ref_ * (back / back.z() - step));
    if (!after || !before) return Result::kUnlike;
    warp.col(axis) = (*after - *before) / (2.0 * kHalf);
  }
  const Eigen::Vector2d reach = kHalf * warp.cwiseAbs().rowwise().sum() + Eigen::Vector2d::Constant(kFurthest + 1);
  if (!lies_in(image, pixel, reach)) return Result::kAtTheBorder;

  Eigen::Vector2d shift = Eigen::Vector2d::Zero();
  std::array<float, kSamples> seen{};
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    const Eigen::Vector2d middle = pixel + warp * shift;
    float mean = 0;
    for (int v = -kHalf, i = 0; v <= kHalf; ++v) {
      Eigen::Vector2d at = middle + warp * Eigen::Vector2d(-kHalf, v);
      for (int u = -kHalf; u <= kHalf; ++u, ++i, at += warp.col(0)) {
        seen[static_cast<size_t>(i)] = sample(image, at);
        mean += seen[static_cast<size_t>(i)];
      }
    }
    mean /= kSamples;
    float squares = 0, product = 0;
    for (size_t k = 0; k < kSamples; ++k) {
      seen[k] -= mean;
      squares += seen[k] * seen[k];
      product += seen[k] * values_[k];
    }
    const float contrast = std::sqrt(squares);
    if (!(product > kAlike * contrast * contrast_)) return Result::kUnlike;
    const float gain = contrast_ / contrast;
    Eigen::Vector2f gradient = Eigen::Vector2f::Zero();
    for (size_t k = 0; k < kSamples; ++k) {
      const float error = gain * seen[k] - values_[k];
      gradient += error * Eigen::Vector2f(gradient_u_[k], gradient_v_[k]);
    }
    const Eigen::Vector2d step = inverse_hessian_ * gradient.cast<double>();
    shift -= step;
    if (shift.norm() > kFurthest) return Result::kUnlike;
    if (step.norm() < kConverged) {
      pixel += warp * shift;
      return Result::kAligned;
    }
  }
  return Result::kUnlike;
}

}  // namespace orthonav::vio
