#include "services/registration/acceptance.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

// 2 x 0.6 + 3 x 0.1 + 600 / 3000 + 0.1 x 1 - 0.0375 x 8 = 1.5, which is what is needed.
Standing just_clear() {
  return {.log_likelihood = 1000,
          .log_likelihood_ratio = 600.1,
          .aligned_share = 0.1,
          .inliers = 30,
          .held = 1,
          .num_keyframes = 8};
}

bool is_refused(const Standing& place) {
  return !doubt(place, {}).empty();
}

TEST(Doubt, IsNoneOfAPlaceWhoseEvidenceIsEnough) {
  EXPECT_EQ(doubt(just_clear(), {}), "");
}

TEST(Doubt, IsOfAPlaceThatLacksAPieceOfTheEvidence) {
  Standing place = just_clear();
  place.log_likelihood_ratio = 599;
  EXPECT_THAT(doubt(place, {}), HasSubstr("ratio 599 of 1000, evidence 1.50, held 1"));
  place = just_clear();
  place.aligned_share = 0.099;
  EXPECT_TRUE(is_refused(place));
  place = just_clear();
  place.held = 0;
  EXPECT_TRUE(is_refused(place));
  place = just_clear();
  place.num_keyframes = 9;
  EXPECT_TRUE(is_refused(place));
}

TEST(Doubt, IsLessOfAPlaceThatHasHeldOverNewGround) {
  Standing place{.log_likelihood = 1000,
                 .log_likelihood_ratio = 205,
                 .aligned_share = 0.1,
                 .inliers = 30,
                 .held = 12,
                 .num_keyframes = 16};
  EXPECT_TRUE(is_refused(place));  // 1.38
  place.held = 14;
  EXPECT_FALSE(is_refused(place));
  // What it looks like itself has to say something, however long it held, and more than a submap is no news.
  place.log_likelihood_ratio = 195;
  place.held = 1000;
  EXPECT_TRUE(is_refused(place));
  place.log_likelihood_ratio = 205;
  place.aligned_share = 0;
  EXPECT_THAT(doubt(place, {}), HasSubstr("evidence 1.48"));
}

TEST(Doubt, IsOfFewInliersAndOfSmallRatios) {
  Standing place = just_clear();
  place.inliers = 7;
  EXPECT_TRUE(is_refused(place));
  place = {.log_likelihood = 150, .log_likelihood_ratio = 149, .aligned_share = 0.9, .inliers = 50};
  EXPECT_TRUE(is_refused(place));
}

TEST(Doubt, AsksForAShareAloneWhereTheAircraftIsExpected) {
  Standing place{.log_likelihood = 1000, .log_likelihood_ratio = 350, .inliers = 8, .num_keyframes = 16};
  EXPECT_TRUE(is_refused(place));
  place.is_expected = true;
  EXPECT_FALSE(is_refused(place));
  place.log_likelihood_ratio = 349;
  EXPECT_TRUE(is_refused(place));
}

}  // namespace
}  // namespace orthonav::registration
