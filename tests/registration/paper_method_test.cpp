// Methods paper, m1 and m2 behind the interface that the service knows.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "services/registration/methods.h"
#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

const MapGeometry kGrid{SyntheticGround::kSigma, 8, 10};
const MapGeometry kDetected{SyntheticGround::kSigma, 0, 0};

class PaperMethods : public testing::TestWithParam<MethodName> {
 protected:
  PaperMethods() {
    MethodOptions options;
    options.registrar.method = GetParam();
    method_ = make_method(options, test_camera());
    const bool detected = GetParam() == MethodName::kM2;
    method_->set_map(detected ? ground_.detected_features() : ground_.grid_features(8), detected ? kDetected : kGrid);
  }
  Fix add(const Capture& capture, int session = 1) {
    method_->describe(capture.keyframe, session, capture.image, capture.heading);
    method_->search({});
    return method_->solve();
  }
  SyntheticGround ground_{1};
  std::unique_ptr<Method> method_;
};

TEST_P(PaperMethods, PutTheirPlaceToTheBelief) {
  const Capture capture = ground_.capture({95, -80, 60}, 2.0, 0.03, -0.04);
  const Fix fix = add(capture);
  ASSERT_TRUE(fix.valid) << fix.reason;
  ASSERT_GE(fix.num_hypotheses, 1);
  const PlaceHypothesis& likeliest = method_->belief().hypotheses().front();
  EXPECT_LT((likeliest.en - capture.p_G_B.head<2>()).norm(), 3);
  EXPECT_EQ(fix.log_odds, method_->belief().log_odds(likeliest.id));
  EXPECT_GT(method_->belief().probability(likeliest.id), 0.9);
}

TEST_P(PaperMethods, CarryThePlaceAlongTheWay) {
  add(ground_.capture({95, -80, 60}, 2.0, 0.03, -0.04));
  const int64_t id = method_->belief().hypotheses().front().id;
  const Capture next = ground_.capture({101, -84, 60}, 2.0, 0, 0);
  add(next);
  EXPECT_EQ(method_->belief().hypotheses().front().id, id) << "the same place, of another keyframe";
  EXPECT_LT((method_->belief().hypotheses().front().en - next.p_G_B.head<2>()).norm(), 3);
  add(next, 2);
  EXPECT_NE(method_->belief().hypotheses().front().id, id) << "another session's W is another";
}

TEST_P(PaperMethods, AreNotSureOnAnotherGround) {
  for (uint64_t seed = 77; seed < 82; ++seed) {
    const Fix fix = add(SyntheticGround(seed).capture({95, -80, 60}, 1.0, 0.03, -0.04), static_cast<int>(seed));
    EXPECT_LT(fix.log_odds, 6.9) << seed;
  }
}

TEST_P(PaperMethods, AHintMakesAPlaceSurer) {
  const Capture capture = ground_.capture({95, -80, 60}, 2.0, 0.03, -0.04);
  const double without = add(capture).log_odds;
  method_->hint({{capture.p_G_B.head<2>()}, 20, 0.9});
  EXPECT_GT(add(capture, 2).log_odds, without);
}

TEST_P(PaperMethods, NeedAHeadingAndSayWhyTheyRefuse) {
  Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  capture.heading = {};
  Fix fix = add(capture);
  EXPECT_FALSE(fix.valid);
  EXPECT_THAT(fix.reason, HasSubstr("compass"));
  capture.heading = {1.0, 0.05};
  capture.keyframe.height_above_ground = -1;
  fix = add(capture);
  EXPECT_FALSE(fix.valid);
  EXPECT_THAT(fix.reason, HasSubstr("height"));
}

INSTANTIATE_TEST_SUITE_P(Registration, PaperMethods,
                         testing::Values(MethodName::kPaper, MethodName::kM1, MethodName::kM2),
                         [](const auto& param) { return std::string(name_of(param.param)); });

}  // namespace
}  // namespace orthonav::registration
