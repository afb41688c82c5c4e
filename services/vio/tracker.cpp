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

// Of a cell's side: how near tracks may come before the younger one ends, and how far from them new ones are taken. In
// between lies what the ground's own relief and a turn move neighbours by.
constexpr double kClosest = 1.0 / 3, kNewApart = 0.5;

constexpr int kCellsOfPart = 4;
constexpr int kBatch = 12;  // a share of the tracks, or of the parts, that is worth a search for corners

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

Tracker::Tracker(const CameraModel& camera, const TrackerOptions& options)
    : camera_(camera),
      options_(options),
      cells_({camera.width(), camera.height()}, options.max_features),
      parts_({camera.width(), camera.height()}, options.max_features / kCellsOfPart) {}

void Tracker::reset() {
  pyramid_.clear();
  features_.clear();
  references_.clear();
  R_since_.setIdentity();
  passed_over_ = 0;
  barren_ = 0;
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
    keep(features_, kept_apart(features_, kClosest * cells_.side()));
  } else {
    features_.clear();
  }
  passed_over_ = 0;
  R_since_.setIdentity();
  // In batches: finding corners costs as much as tracking them.
  const bool few = static_cast<int>(features_.size()) < options_.max_features - options_.max_features / kBatch;
  if (few || num_gaps() > barren_ + parts_.size() / kBatch) detect(image, gain);
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

int Tracker::num_gaps() const {
  const std::vector<int> occupancy = parts_.occupancy(features_);
  return static_cast<int>(std::count(occupancy.begin(), occupancy.end(), 0));
}

void Tracker::detect(const cv::Mat& image, double gain) {
  // What the sensor's noise (about 1.5 grey levels) makes of a flat surface, as cornerMinEigenVal counts: no corner.
  const double noise = 3e-5 * gain * gain;
  const auto apart = static_cast<int>(kNewApart * cells_.side());

  cv::Mat response;
  cv::cornerMinEigenVal(image, response, 5, 3);
  cv::Mat free = cv::Mat::zeros(image.size(), CV_8U);
  const int border = static_cast<int>(std::ceil(options_.border));
  free(cv::Rect(border, border, image.cols - 2 * border, image.rows - 2 * border)).setTo(255);
  double best = 0;
  cv::minMaxLoc(response, nullptr, &best, nullptr, nullptr, free);
  const std::vector<int> occupancy = cells_.occupancy(features_);
  for (const TrackedFeature& feature : features_) cv::circle(free, to_point(feature.pixel), apart, 0, cv::FILLED);
  struct Corner {
    float response;
    cv::Point at;
  };
  std::vector<Corner> corners;
  for (size_t cell = 0; cell < occupancy.size(); ++cell) {
    if (occupancy[cell] > 0) continue;
    const cv::Rect where = cells_.area(cell);
    double strongest = 0;
    cv::Point at;
    cv::minMaxLoc(response(where), nullptr, &strongest, nullptr, &at, free(where));
    if (strongest <= std::max(noise, options_.corner_quality * best)) continue;
    corners.push_back({static_cast<float>(strongest), at + where.tl()});
  }
  std::stable_sort(corners.begin(), corners.end(),
                   [](const Corner& a, const Corner& b) { return a.response > b.response; });
  std::vector<int> in_part = parts_.occupancy(features_);
  for (const Corner& corner : corners) {
    if (!free.at<uchar>(corner.at)) continue;  // too near a corner taken from the next cell
    const Eigen::Vector2d pixel(corner.at.x, corner.at.y);
    const auto ray = camera_.unproject(pixel);
    if (!ray) continue;
    const size_t part = parts_.cell_of(pixel);
    const auto is_full = [&] { return static_cast<int>(features_.size()) >= options_.max_features; };
    if (is_full() && in_part[part] == 0) make_room(in_part);
    if (is_full()) continue;
    if (auto patch = ReferencePatch::make(image, pixel, camera_)) references_.emplace(next_id_, std::move(*patch));
    features_.push_back({next_id_++, pixel, *ray});
    ++in_part[part];
    cv::circle(free, corner.at, apart, 0, cv::FILLED);
  }
  barren_ = num_gaps();
}

// Ends the youngest track of the fullest part; none where no part has two.
void Tracker::make_room(std::vector<int>& in_part) {
  const auto fullest = std::max_element(in_part.begin(), in_part.end());
  if (*fullest < 2) return;
  const auto part = static_cast<size_t>(fullest - in_part.begin());
  for (size_t i = features_.size(); i-- > 0;) {
    if (parts_.cell_of(features_[i].pixel) != part) continue;
    references_.erase(features_[i].id);
    features_.erase(features_.begin() + static_cast<std::ptrdiff_t>(i));
    --*fullest;
    return;
  }
}

}  // namespace orthonav::vio
