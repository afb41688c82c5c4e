#include "common/features/orientation_field.h"

#include <string>
#include <vector>

#include <Eigen/Geometry>
#include <gtest/gtest.h>
#include <opencv2/imgproc.hpp>

#include "common/features/fixed_sift.h"

namespace orthonav {
namespace {

constexpr double kSize = 12;
// A patchwork of fields and roofs, drawn three times finer than its pixels, that can be pictured from anywhere.
// `share_new` of its patches are drawn from another seed, as at another date.
class Patchwork {
 public:
  explicit Patchwork(unsigned seed, double share_new = 0) : fine_(3 * kSide, 3 * kSide, CV_8U, cv::Scalar(110)) {
    cv::RNG kept(seed), replaced(seed + 1000), choice(seed + 2000);
    for (int i = 0; i < 400; ++i) {
      const cv::RotatedRect own = rectangle(kept);
      const cv::RotatedRect other = rectangle(replaced);
      const double own_level = kept.uniform(30.0, 220.0), other_level = replaced.uniform(30.0, 220.0);
      const bool is_new = choice.uniform(0.0, 1.0) < share_new;
      cv::Point2f corners[4];  // NOLINT: OpenCV's interface
      (is_new ? other : own).points(corners);
      const std::vector<cv::Point> polygon(std::begin(corners), std::end(corners));
      cv::fillConvexPoly(fine_, polygon, cv::Scalar(is_new ? other_level : own_level), cv::LINE_AA);
    }
    cv::GaussianBlur(fine_, fine_, {}, 1.5);
  }

  // Pixel (u, v) of the picture shows the place a (u, v) + b, in pixels of the map.
  cv::Mat picture(const cv::Size& size, const Eigen::Matrix2d& a, const Eigen::Vector2d& b) const {
    const cv::Matx23d affine(3 * a(0, 0), 3 * a(0, 1), 3 * b.x() + 1, 3 * a(1, 0), 3 * a(1, 1), 3 * b.y() + 1);
    cv::Mat picture;
    cv::warpAffine(fine_, picture, affine, size, cv::INTER_LINEAR | cv::WARP_INVERSE_MAP, cv::BORDER_REPLICATE);
    return picture;
  }
  cv::Mat map(const Eigen::Vector2d& offset = Eigen::Vector2d::Zero()) const {
    return picture({kSide, kSide}, Eigen::Matrix2d::Identity(), offset);
  }

  static constexpr int kSide = 420;

 private:
  static cv::RotatedRect rectangle(cv::RNG& random) {
    const auto side = [&] { return static_cast<float>(30 * std::exp(random.uniform(0.0, 1.5))); };
    const cv::Point2f centre(random.uniform(0.0F, 3.0F * kSide), random.uniform(0.0F, 3.0F * kSide));
    return {centre, {side(), side()}, random.uniform(0.0F, 180.0F)};
  }

  cv::Mat fine_;
};

double similarity(const cv::Mat& a, const cv::Mat& b) {
  return a.dot(b) / (kRootSiftLength * kRootSiftLength);
}

std::vector<cv::Point2f> grid(const cv::Size& size, int stride, int margin) {
  std::vector<cv::Point2f> points;
  for (int v = margin; v < size.height - margin; v += stride) {
    for (int u = margin; u < size.width - margin; u += stride) {
      points.emplace_back(static_cast<float>(u), static_cast<float>(v));
    }
  }
  return points;
}

// Share of the points whose nearest descriptor of the map is that of the same place.
double match_rate(const cv::Mat& map, const cv::Mat& queries) {
  cv::Mat map_values, query_values;
  map.convertTo(map_values, CV_32F);
  queries.convertTo(query_values, CV_32F);
  int right = 0;
  for (int i = 0; i < queries.rows; ++i) {
    int best = -1;
    double nearest = 1e300;
    for (int j = 0; j < map.rows; ++j) {
      const double distance = cv::norm(query_values.row(i), map_values.row(j), cv::NORM_L2SQR);
      if (distance < nearest) {
        nearest = distance;
        best = j;
      }
    }
    right += best == i ? 1 : 0;
  }
  return static_cast<double>(right) / queries.rows;
}

// The same ground at another date: part of the pattern is new, the light differs, and the pictures have noise.
TEST(OrientationFieldTest, MatchesAsManyChangedPatchesAsOpenCvsSift) {
  double ours = 0, opencv = 0;
  for (unsigned seed = 1; seed <= 3; ++seed) {
    const cv::Mat map = Patchwork(seed).map();
    cv::Mat changed;
    Patchwork(seed, 0.5).map(Eigen::Vector2d(1.3, -0.8)).convertTo(changed, CV_8U, 0.6, 20);
    cv::Mat noise(changed.size(), CV_8U);
    cv::RNG(seed).fill(noise, cv::RNG::NORMAL, 12, 5);
    changed += noise;
    const std::vector<cv::Point2f> points = grid(map.size(), 10, 50);
    const FixedSift sift(kSize);
    opencv += match_rate(sift.describe(map, points), sift.describe(changed, points)) / 3;
    ours += match_rate(OrientationField(map, {.keypoint_size = kSize}).describe(points),
                       OrientationField(changed, {.keypoint_size = kSize}).describe(points)) /
            3;
  }
  RecordProperty("ours", std::to_string(ours));
  RecordProperty("opencv", std::to_string(opencv));
  EXPECT_GT(opencv, 0.2);  // neither hopeless nor trivial, or the comparison says nothing
  EXPECT_LT(opencv, 0.95);
  EXPECT_GT(ours, opencv - 0.02);
}

// A camera that lies turned, scaled and a little oblique on the map describes the map's patch from its own pixels.
TEST(OrientationFieldTest, DescribesThroughAnyAffineMap) {
  const Patchwork ground(5);
  const OrientationField on_map(ground.map(), {.keypoint_size = kSize});
  for (const double angle_deg : {-170.0, -63.0, 12.0, 90.0}) {
    for (const double width : {0.5, 1.0, 1.9}) {
      const double angle = angle_deg * M_PI / 180;
      Eigen::Matrix2d to_map = width * Eigen::Rotation2Dd(angle).toRotationMatrix();
      to_map.row(0) *= 1.05;
      const cv::Size picture_size(static_cast<int>(260 / width), static_cast<int>(260 / width));
      const Eigen::Vector2d middle(0.5 * picture_size.width, 0.5 * picture_size.height);
      const Eigen::Vector2d target(151.3, 148.8);
      const cv::Mat picture = ground.picture(picture_size, to_map, target - to_map * middle);
      const OrientationField field(picture, {.keypoint_size = kSize, .pixel_width = width, .rotation = angle});
      cv::Mat seen(1, kSiftBytes, CV_8U);
      ASSERT_TRUE(field.describe(middle.cast<float>(), to_map.inverse().cast<float>(), seen.ptr()));
      const cv::Mat wanted = on_map.describe({{151.3F, 148.8F}});
      const cv::Mat other = on_map.describe({{120.0F, 170.0F}});
      EXPECT_GT(similarity(seen, wanted), 0.975) << angle_deg << " degrees, width " << width;
      EXPECT_LT(similarity(seen, other), 0.93) << angle_deg << " degrees, width " << width;
    }
  }
}

TEST(OrientationFieldTest, SimilarityPeaksAtThePlaceItselfToAFractionOfAPixel) {
  const Eigen::Vector2d shift(3.4, -1.7);
  const Patchwork ground(9);
  const OrientationField here(ground.map(), {.keypoint_size = kSize});
  const OrientationField shifted(ground.map(shift), {.keypoint_size = kSize});
  for (const cv::Point2f& point : grid({300, 300}, 40, 100)) {
    const cv::Mat wanted = here.describe({point});
    double best = -1;
    Eigen::Vector2d at(0, 0);
    for (double dv = -4; dv <= 4; dv += 0.2) {
      for (double du = -4; du <= 4; du += 0.2) {
        const cv::Mat seen = shifted.describe({point + cv::Point2f(static_cast<float>(du), static_cast<float>(dv))});
        if (const double value = similarity(wanted, seen); value > best) {
          best = value;
          at = {du, dv};
        }
      }
    }
    EXPECT_LT((at + shift).norm(), 1.0);
  }
}

TEST(OrientationFieldTest, SaysWhenThereIsNothingToDescribe) {
  cv::Mat flat(100, 100, CV_8U, cv::Scalar(90));
  cv::RNG(1).fill(flat, cv::RNG::NORMAL, 90, 1);
  const OrientationField field(flat, {.keypoint_size = kSize});
  EXPECT_EQ(cv::countNonZero(field.describe({{50, 50}, {1000, -1000}})), 0);
  // Smaller than a descriptor, even smaller than a gradient: no crash, and no descriptor out of nothing.
  EXPECT_EQ(cv::countNonZero(OrientationField(cv::Mat(1, 1, CV_8U, cv::Scalar(3)), {}).describe({{0, 0}})), 0);
  EXPECT_EQ(cv::countNonZero(OrientationField(cv::Mat(2, 7, CV_8U, cv::Scalar(3)), {}).describe({{1, 1}})), 0);
}

TEST(OrientationFieldTest, RefusesWhatItCannotDescribe) {
  EXPECT_THROW(OrientationField(cv::Mat(), {}), std::invalid_argument);
  EXPECT_THROW(OrientationField(cv::Mat(9, 9, CV_8UC3), {}), std::invalid_argument);
  const cv::Mat grey(50, 50, CV_8U, cv::Scalar(1));
  EXPECT_THROW(OrientationField(grey, {.keypoint_size = 1}), std::invalid_argument);
  EXPECT_THROW(OrientationField(grey, {.pixel_width = 0}), std::invalid_argument);
  EXPECT_THROW(OrientationField(grey, {.pixel_width = 5}), std::invalid_argument);
  EXPECT_THROW(OrientationField(grey, {.rotation = NAN}), std::invalid_argument);
}

}  // namespace
}  // namespace orthonav
