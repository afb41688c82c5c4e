#include "services/registration/submap/scale_of_way.h"

#include <cmath>
#include <vector>

#include <gtest/gtest.h>

#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

constexpr size_t kFitted = 2;

// A flight east of an odometry whose world is `factor` times as large; views with the newest first.
class ScaleOfWay : public testing::Test {
 protected:
  void fly(int keyframes, double factor) {
    const Eigen::Vector3d newest(130, -80, 60);
    for (int k = 0; k < keyframes; ++k) {
      const Capture capture = ground_.capture(newest - Eigen::Vector3d(12 * k, 0, 0), 1.0, 0.02, -0.02);
      Keyframe keyframe = capture.keyframe;
      keyframe.p_W_B *= factor;
      keyframe.height_above_ground *= factor;
      for (TrackedPoint& point : keyframe.points) point.p_W *= factor;
      views_.push_back(make_view(keyframe, capture.image, test_camera(), 1.0, 1, index_, kFieldsMap, {}));
    }
    for (const View& view : views_) pointers_.push_back(&view);
    FitPrior prior;
    prior.scale_stddev = 0.1;
    fit_ = fit_place({pointers_.begin(), pointers_.begin() + kFitted}, index_, kFieldsMap.metres_per_pixel,
                     newest.head<2>(), {}, prior, {});
    ASSERT_TRUE(fit_.ok);
  }
  std::optional<ScaleBelief> way() const { return scale_of_way(pointers_, kFitted, fit_, index_, {}, {}); }

  SyntheticFields ground_{1};
  MapIndex index_{described_map(ground_), kFieldsMap};
  std::vector<View> views_;
  std::vector<const View*> pointers_;
  PlaceFit fit_;
};

TEST_F(ScaleOfWay, IsToldByThePlacesAlongTheWay) {
  for (const double factor : {0.9, 0.97, 1.0, 1.1}) {
    views_.clear();
    pointers_.clear();
    fly(8, factor);
    const std::optional<ScaleBelief> scale = way();
    ASSERT_TRUE(scale) << factor;
    EXPECT_NEAR(scale->log_scale, -std::log(factor), 2.5 * scale->stddev) << factor;
    EXPECT_LT(scale->stddev, 0.02) << factor;
    EXPECT_LT(scale->stddev, fit_.scale.stddev) << factor;
  }
}

TEST_F(ScaleOfWay, IsNotToldWhereThereIsNone) {
  fly(kFitted, 1.0);
  EXPECT_FALSE(way());
}

TEST_F(ScaleOfWay, EndsWhereTheOdometryLostItsWay) {
  fly(8, 1.0);
  const std::optional<ScaleBelief> whole = way();
  ASSERT_TRUE(whole);
  // The older half lies 40 m aside: another world.
  for (size_t k = 4; k < views_.size(); ++k) views_[k].keyframe.p_W_B.y() += 40;
  const std::optional<ScaleBelief> half = way();
  if (half) {
    EXPECT_NEAR(half->log_scale, 0, 2.5 * half->stddev);
    EXPECT_GT(half->stddev, whole->stddev);
  }
}

}  // namespace
}  // namespace orthonav::registration
