#include "services/vio/tracker.h"

#include <algorithm>
#include <cmath>
#include <map>

#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>

#include "services/vio/two_point.h"

namespace orthonav::vio {
namespace {

cv::Point2f to_point(const Eigen::Vector2d& pixel) {
  return {static_cast<float>(pixel.x()), static_cast<float>(pixel.y())};
}

// Keeps the elements whose flag is set, in order.
template <class T>
void keep(std::vector<T>& values, const std::vector<bool>& flags) {
  size_t to = 0;
  for (size_t i = 0; i < values.size(); ++i) {
    if (flags[i]) values[to++] = values[i];
  }
  values.resize(to);
}

}  // namespace

Tracker::Tracker(const CameraModel& camera, const TrackerOptions& options) : camera_(camera), options_(options) {}

void Tracker::reset() {
  pyramid_.clear();
  features_.clear();
  references_.clear();
  R_since_.setIdentity();
  passed_over_ = 0;
}

void Tracker::drop(const std::set<int64_t>& ids) {
  std::erase_if(features_, [&](const TrackedFeature& feature) { return ids.count(feature.id) > 0; });
}

cv::Mat Tracker::normalised(const cv::Mat& grey, double* gain_used) const {
  // Lucas-Kanade compares brightness: exposure drift is taken out by a gain and an offset for the whole image.
  cv::Scalar mean, stddev;
  cv::meanStdDev(grey, mean, stddev);
  const double gain = std::clamp(48.0 / std::max(1.0, stddev[0]), 0.5, 4.0);
  *gain_used = gain;
  cv::Mat image;
  grey.convertTo(image, CV_8U, gain, 128.0 - gain * mean[0]);
  return image;
}

const std::vector<TrackedFeature>& Tracker::track(const cv::Mat& grey, const Eigen::Matrix3d& R_cur_prev,
                                                  bool rotation_trusted) {
  constexpr int kMostPassedOver = 3;
  constexpr size_t kEnough = 20;  // features, for a share of them to mean something
  double gain = 1;
  const cv::Mat image = normalised(grey, &gain);
  std::vector<cv::Mat> pyramid;
  cv::buildOpticalFlowPyramid(image, pyramid, {options_.search_window, options_.search_window}, options_.pyramid_levels,
                              true);
  R_since_ = R_cur_prev * R_since_;
  if (!pyramid_.empty() && !features_.empty()) {
    std::vector<TrackedFeature> followed = follow(pyramid, R_since_);
    if (features_.size() >= kEnough && 2 * followed.size() < features_.size()) {
      std::vector<TrackedFeature> unguided = follow(pyramid, Eigen::Matrix3d::Identity());
      if (unguided.size() > followed.size()) followed = std::move(unguided);
    }
    if (features_.size() >= kEnough && 4 * followed.size() < features_.size() && passed_over_ < kMostPassedOver) {
      ++passed_over_;
      return none_;
    }
    // follow() keeps the order, so the survivors' former rays are found by walking both.
    std::vector<TrackedFeature> previous;
    for (const TrackedFeature& old : features_) {
      if (previous.size() < followed.size() && followed[previous.size()].id == old.id) previous.push_back(old);
    }
    features_ = std::move(followed);
    align(image, R_since_);
    reject_outliers(previous, R_since_, rotation_trusted);
  } else {
    features_.clear();
  }
  passed_over_ = 0;
  R_since_.setIdentity();
  // Topped up in batches: finding corners costs as much as tracking them.
  if (static_cast<int>(features_.size()) < options_.max_features - options_.max_features / 12) detect(image, gain);
  pyramid_ = std::move(pyramid);
  return features_;
}

std::vector<TrackedFeature> Tracker::follow(const std::vector<cv::Mat>& pyramid,
                                            const Eigen::Matrix3d& R_cur_prev) const {
  std::vector<cv::Point2f> from, to;
  for (const TrackedFeature& feature : features_) {
    from.push_back(to_point(feature.pixel));
    const auto predicted = camera_.project(R_cur_prev * feature.ray);
    to.push_back(predicted && camera_.contains(*predicted) ? to_point(*predicted) : from.back());
  }
  const cv::Size window(options_.search_window, options_.search_window);
  const cv::TermCriteria criteria(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 30, 0.01);
  std::vector<uchar> status, status_back;
  std::vector<float> error;
  cv::calcOpticalFlowPyrLK(pyramid_, pyramid, from, to, status, error, window, options_.pyramid_levels, criteria,
                           cv::OPTFLOW_USE_INITIAL_FLOW);
  std::vector<cv::Point2f> back = from;
  cv::calcOpticalFlowPyrLK(pyramid, pyramid_, to, back, status_back, error, window, 1, criteria,
                           cv::OPTFLOW_USE_INITIAL_FLOW);
  std::vector<TrackedFeature> followed;
  for (size_t i = 0; i < features_.size(); ++i) {
    const Eigen::Vector2d pixel(to[i].x, to[i].y);
    if (!status[i] || !status_back[i] || !camera_.contains(pixel, options_.border)) continue;
    if (std::hypot(back[i].x - from[i].x, back[i].y - from[i].y) > options_.round_trip) continue;
    const auto ray = camera_.unproject(pixel);
    if (!ray) continue;
    followed.push_back({features_[i].id, pixel, *ray});
  }
  return followed;
}

void Tracker::align(const cv::Mat& image, const Eigen::Matrix3d& R_cur_prev) {
  std::map<int64_t, ReferencePatch> references;
  for (TrackedFeature& feature : features_) {
    auto reference = references_.extract(feature.id);
    auto result = ReferencePatch::Result::kUnlike;
    if (reference) {
      reference.mapped().turn(R_cur_prev);
      result = reference.mapped().align(image, camera_, feature.ray, feature.pixel);
    }
    if (result == ReferencePatch::Result::kAligned) {
      if (const auto ray = camera_.unproject(feature.pixel)) feature.ray = *ray;
    }
    if (result != ReferencePatch::Result::kUnlike) {
      references.insert(std::move(reference));
    } else if (auto patch = ReferencePatch::make(image, feature.pixel, camera_)) {
      references.emplace(feature.id, std::move(*patch));
    }
  }
  references_ = std::move(references);
}

void Tracker::reject_outliers(const std::vector<TrackedFeature>& previous, const Eigen::Matrix3d& R_cur_prev,
                              bool rotation_trusted) {
  if (features_.size() < 8) return;
  const double threshold = options_.outlier_distance / camera_.focal();
  if (rotation_trusted) {
    std::vector<Eigen::Vector3d> rays_1, rays_2;
    for (size_t i = 0; i < features_.size(); ++i) {
      rays_1.push_back(previous[i].ray);
      rays_2.push_back(features_[i].ray);
    }
    keep(features_, two_point_inliers(rays_1, rays_2, R_cur_prev, threshold));
    return;
  }
  std::vector<cv::Point2d> points_1, points_2;
  for (size_t i = 0; i < features_.size(); ++i) {
    points_1.emplace_back(previous[i].ray.x(), previous[i].ray.y());
    points_2.emplace_back(features_[i].ray.x(), features_[i].ray.y());
  }
  std::vector<uchar> mask;
  const cv::Mat E =
      cv::findEssentialMat(points_1, points_2, cv::Mat::eye(3, 3, CV_64F), cv::RANSAC, 0.99, threshold, 100, mask);
  if (E.empty() || mask.size() != features_.size()) return;
  keep(features_, std::vector<bool>(mask.begin(), mask.end()));
}

void Tracker::detect(const cv::Mat& image, double gain) {
  // What the sensor's noise (about 1.5 grey levels) makes of a flat surface, as cornerMinEigenVal counts: no corner.
  const double noise = 3e-5 * gain * gain;
  // Square cells, about as many as features are wanted.
  const double area = static_cast<double>(image.cols) * image.rows;
  const double cell = std::sqrt(area / options_.max_features);
  const int columns = std::max(1, static_cast<int>(std::lround(image.cols / cell)));
  const int rows = std::max(1, static_cast<int>(std::lround(image.rows / cell)));
  const double cell_width = static_cast<double>(image.cols) / columns;
  const double cell_height = static_cast<double>(image.rows) / rows;
  const double apart = 0.5 * cell;

  cv::Mat response;
  cv::cornerMinEigenVal(image, response, 5, 3);
  cv::Mat free = cv::Mat::zeros(image.size(), CV_8U);
  const int border = static_cast<int>(std::ceil(options_.border));
  free(cv::Rect(border, border, image.cols - 2 * border, image.rows - 2 * border)).setTo(255);
  double best = 0;
  cv::minMaxLoc(response, nullptr, &best, nullptr, nullptr, free);
  std::vector<int> count(static_cast<size_t>(columns * rows));
  const auto cell_of = [&](double u, double v) {
    const int column = std::clamp(static_cast<int>((u + 0.5) / cell_width), 0, columns - 1);
    const int row = std::clamp(static_cast<int>((v + 0.5) / cell_height), 0, rows - 1);
    return static_cast<size_t>(row * columns + column);
  };
  for (const TrackedFeature& feature : features_) {
    ++count[cell_of(feature.pixel.x(), feature.pixel.y())];
    cv::circle(free, to_point(feature.pixel), static_cast<int>(apart), 0, cv::FILLED);
  }
  struct Corner {
    float response;
    cv::Point at;
  };
  std::vector<Corner> corners;
  for (int row = 0; row < rows; ++row) {
    for (int column = 0; column < columns; ++column) {
      if (count[static_cast<size_t>(row * columns + column)] > 0) continue;
      const int u0 = static_cast<int>(column * cell_width), v0 = static_cast<int>(row * cell_height);
      const cv::Rect where = cv::Rect(u0, v0, static_cast<int>(cell_width), static_cast<int>(cell_height)) &
                             cv::Rect(0, 0, image.cols, image.rows);
      double strongest = 0;
      cv::Point at;
      cv::minMaxLoc(response(where), nullptr, &strongest, nullptr, &at, free(where));
      if (strongest <= std::max(noise, options_.corner_quality * best)) continue;
      corners.push_back({static_cast<float>(strongest), at + where.tl()});
    }
  }
  std::stable_sort(corners.begin(), corners.end(),
                   [](const Corner& a, const Corner& b) { return a.response > b.response; });
  for (const Corner& corner : corners) {
    if (static_cast<int>(features_.size()) >= options_.max_features) break;
    if (!free.at<uchar>(corner.at)) continue;  // too near a corner taken from the next cell
    const Eigen::Vector2d pixel(corner.at.x, corner.at.y);
    const auto ray = camera_.unproject(pixel);
    if (!ray) continue;
    if (auto patch = ReferencePatch::make(image, pixel, camera_)) references_.emplace(next_id_, std::move(*patch));
    features_.push_back({next_id_++, pixel, *ray});
    cv::circle(free, corner.at, static_cast<int>(apart), 0, cv::FILLED);
  }
}

}  // namespace orthonav::vio
