// The figures of a log that was made to give known ones.
#include "tools/evaluate/metrics.h"

#include <fstream>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/evaluate/made_up_log.h"
#include "tools/evaluate/report_json.h"
#include "tools/evaluate/tum.h"

namespace orthonav::evaluate {
namespace {

namespace fs = std::filesystem;

class Evaluate : public ::testing::Test {
 protected:
  const FlightRecord& read(const LogContent& content) {
    file_ = fs::path(::testing::TempDir()) /
            (std::string(::testing::UnitTest::GetInstance()->current_test_info()->name()) + ".lcm");
    write_log(file_, content);
    record_ = FlightRecord::read(file_);
    return record_;
  }
  fs::path file_;
  FlightRecord record_;
};

TEST_F(Evaluate, PositionErrorsAreThoseThatWereMade) {
  const Metrics metrics = evaluate(read({.false_fix = -1}));
  EXPECT_NEAR(metrics.fusion.truth.rmse, 3.0, 1e-6);
  EXPECT_NEAR(metrics.fusion.truth.horizontal_rmse, std::sqrt(5.0), 1e-6);
  EXPECT_NEAR(metrics.fusion.truth.vertical_rmse, 2.0, 1e-6);
  EXPECT_EQ(metrics.fusion.truth.samples, kImages - 50);
  EXPECT_NEAR(metrics.fusion.gnss.vertical_rmse, 0.0, 1e-6) << "the GNSS is 2 m high, as the navigation state is";
  EXPECT_NEAR(metrics.fusion.to_map.horizontal_rmse, std::hypot(0.5, 2.0), 1e-6);
  EXPECT_NEAR(metrics.fusion.heading_rmse, std::numbers::pi / 180.0, 1e-6);
  EXPECT_NEAR(metrics.registration.truth.rmse, 5.0, 1e-6);
  EXPECT_NEAR(metrics.registration.heading_rmse, 0.0, 1e-6);
}

TEST_F(Evaluate, NeesIsTheSquaredErrorOverTheReportedVariance) {
  const Metrics metrics = evaluate(read({.nav_error = {3.0, 0.0, 0.0}, .nav_stddev = 1.5}));
  EXPECT_NEAR(metrics.fusion.nees.position, 4.0 / 3.0, 1e-6);
  EXPECT_NEAR(metrics.fusion.nees.horizontal, 2.0, 1e-6);
  EXPECT_EQ(metrics.fusion.within_3_sigma, 1.0);
}

TEST_F(Evaluate, OdometryIsAlignedWithAndWithoutItsScale) {
  const Metrics exact = evaluate(read({}));
  EXPECT_NEAR(exact.vio.truth.rmse, 0.0, 1e-6);
  EXPECT_NEAR(exact.vio.scale, 1.0 / 0.8, 1e-9);
  EXPECT_GT(exact.vio.yaw_only.rmse, 10.0) << "a fifth of the way is missing";
  EXPECT_NEAR(exact.vio.heading_rmse, 0.0, 1e-6);
  // A fifth of the displacement, which on a winding way is a little less than the 100 m flown.
  EXPECT_GT(exact.vio.drift_per_100m, 18.5);
  EXPECT_LE(exact.vio.drift_per_100m, 20.0);
  EXPECT_EQ(exact.vio.tracking_share, 1.0);

  const Metrics noisy = evaluate(read({.vio_scale = 1.0, .vio_noise = 1.0}));
  EXPECT_NEAR(noisy.vio.truth.rmse, 1.0, 0.01);
  EXPECT_NEAR(noisy.vio.yaw_only.rmse, 1.0, 0.01);
}

TEST_F(Evaluate, TheOdometrysScaleIsGivenAtTheStartAndLater) {
  const Metrics metrics = evaluate(read({.vio_scale = 0.8}));
  for (const auto& scale : {metrics.vio.scale_at_start, metrics.vio.scale_after_30s, metrics.vio.scale_at_end}) {
    ASSERT_TRUE(scale);
    EXPECT_NEAR(scale->error, -0.2, 1e-6);
    EXPECT_TRUE(std::isnan(scale->stddev)) << "the odometry said nothing";
  }
  EXPECT_FALSE(evaluate(read({.vio = false})).vio.scale_at_start);
}

TEST_F(Evaluate, AScaleThatChangesIsThatOfItsStretch) {
  const FlightRecord& record = read({.vio_scale = 0.9, .scale_change = 0.002, .scale_stddev = 0.03});
  const VioMetrics vio = evaluate(record).vio;
  // A stretch of 10 m takes 1.5 to 2 s; poses are there from 2 s on, to 60 s.
  ASSERT_TRUE(vio.scale_at_start && vio.scale_after_30s && vio.scale_at_end);
  EXPECT_NEAR(vio.scale_at_start->error, -0.1 + 0.002 * 3, 0.0015);
  EXPECT_NEAR(vio.scale_after_30s->error, -0.1 + 0.002 * 33, 0.0015);
  EXPECT_NEAR(vio.scale_at_end->error, -0.1 + 0.002 * 59, 0.0015);
  EXPECT_EQ(vio.scale_at_end->stddev, 0.03);

  // Nearest to the time asked for, on the side asked for.
  const OdometryScale scale(record);
  const int64_t at = kStart + 40'000'000;
  EXPECT_LT(scale.ending_at(at)->error, -0.1 + 0.002 * 40);
  EXPECT_GT(scale.beginning_at(at)->error, -0.1 + 0.002 * 40);
  EXPECT_FALSE(scale.ending_at(scale.begin())) << "nothing lies before the first pose";
  EXPECT_FALSE(scale.ending_at(scale.begin() - 1));
  EXPECT_FALSE(scale.beginning_at(scale.end()));
}

TEST_F(Evaluate, FixesThatLeanWithTheOdometryOverAnOffMapAreExplained) {
  const FlightRecord& record =
      read({.vio_scale = 1.0, .fix_error = {0.5, -0.3, 2.0}, .lean = 0.02, .fix_leans = 0.8, .false_fix = -1});
  const ErrorRegression causes = evaluate(record).registration.regression;
  EXPECT_EQ(causes.fixes, 29);
  ASSERT_EQ(causes.together.size(), 5);
  EXPECT_NEAR(causes.together[0], 0.8, 1e-3);
  EXPECT_NEAR(causes.together[3], 0.5, 1e-3);
  EXPECT_NEAR(causes.together[4], -0.3, 1e-3);
  EXPECT_LT(causes.together_left, 1e-3);
  EXPECT_GT(causes.horizontal, 1.0);
  EXPECT_LT(causes.tilt_height.left, 0.45) << "what is left is the map's offset";
  EXPECT_GT(causes.offset_left, 0.9);
  EXPECT_GT(causes.heading.left, 0.9) << "headings were right, and explain nothing";
  EXPECT_NEAR(causes.vertical_offset.slope, 2.0, 1e-6);
  EXPECT_TRUE(std::isnan(evaluate(read({.fixes = false})).registration.regression.horizontal));
}

TEST_F(Evaluate, SharesAreOfAllImages) {
  const FusionMetrics bounded = evaluate(read({})).fusion;
  EXPECT_NEAR(bounded.located_share, (kImages - 50.0) / kImages, 1e-9);
  EXPECT_NEAR(bounded.protection.bounded_share, (kImages - 50.0) / kImages, 1e-9);
  const FusionMetrics unbounded = evaluate(read({.nav_level = std::nan("")})).fusion;
  EXPECT_NEAR(unbounded.located_share, (kImages - 50.0) / kImages, 1e-9);
  EXPECT_EQ(unbounded.protection.bounded_share, 0.0);
}

TEST_F(Evaluate, WhatHealthSaidIsKeptOncePerWording) {
  read({});
  {
    LogReader reader(file_);
    LogWriter writer(file_.string() + ".health");
    while (const auto event = reader.next())
      writer.write(event->utime, event->channel, event->data.data(), event->data.size());
    health_t health{};
    health.service = "vio";
    for (const auto& [state, message] :
         std::vector<std::pair<int8_t, std::string>>{{health_t::STARTING, "scale is uncertain by 19 %"},
                                                     {health_t::DEGRADED, "scale is uncertain by 7.5 %"},
                                                     {health_t::OK, ""},
                                                     {health_t::DEGRADED, "few features"}}) {
      health.utime += 1'000'000;
      health.state = state;
      health.message = message;
      writer.write(kStart + health.utime, channel::kHealth, health);
    }
  }
  const FlightRecord record = FlightRecord::read(file_.string() + ".health");
  const auto said = to_json(record, evaluate(record))["health"]["vio"]["said"];
  ASSERT_EQ(said.size(), 2U);
  EXPECT_EQ(said[0]["message"], "scale is uncertain by 19 %");
  EXPECT_EQ(said[0]["state"], "degraded") << "the worst with these words";
  EXPECT_EQ(said[0]["heartbeats"], 2);
  EXPECT_EQ(said[1]["message"], "few features");
}

TEST_F(Evaluate, TrueMatchesAreJudgedByTheImpliedPositionOfRefusedFixesToo) {
  const Metrics metrics = evaluate(read({}));
  const RegistrationMetrics& registration = metrics.registration;
  EXPECT_EQ(registration.tried, 58);
  EXPECT_EQ(registration.valid, 29);
  EXPECT_EQ(registration.false_fixes, 1);
  // Of 29 valid one is false; of 29 refused those with id % 4 == 1, 15 of them, are far away.
  EXPECT_EQ(registration.true_matches, 28 + 14);
  EXPECT_NEAR(registration.true_match_rate, 42.0 / 58.0, 1e-9);
  EXPECT_EQ(registration.inliers_median, 20.0);
  for (const JudgedFix& fix : registration.fixes) {
    if (!fix.p_G_B || fix.false_fix) continue;
    ASSERT_TRUE(fix.implied_en);
    // The odometry's scale does not matter: the translation was made with its own points.
    EXPECT_LT((*fix.implied_en - fix.p_G_B->head<2>()).norm(), 1e-6);
  }
}

TEST(ImpliedPosition, OfAnImageMethodStepsBackAlongTheOpticalAxis) {
  vio_keyframe_t keyframe{};
  put(Eigen::Vector3d(500.0, 600.0, 10.0), keyframe.p_W_B);
  // Body pitched nose down by 0.1 rad and heading east, camera looking along -z of the body.
  put(so3_exp(Eigen::Vector3d(0.0, 0.1, 0.0)), keyframe.q_W_B);
  put(Eigen::Quaterniond(0, 1, 0, 0), keyframe.q_B_C);
  keyframe.height_above_ground = 100.0;
  map_fix_t fix{};
  fix.method = "m1";
  fix.heading = M_PI / 2.0;  // east
  fix.translation[0] = 30.0;
  fix.translation[1] = 40.0;
  fix.num_inliers = 9;
  const auto p = implied_position(fix, keyframe);
  ASSERT_TRUE(p);
  // Nose down, the camera looks backwards: it stands ahead of what it sees.
  EXPECT_NEAR(p->x(), 30.0 + 100.0 * std::tan(0.1), 1e-9);
  EXPECT_NEAR(p->y(), 40.0, 1e-9);
}

TEST_F(Evaluate, TimesAreMedianAndPercentile) {
  const Metrics metrics = evaluate(read({}));
  EXPECT_EQ(metrics.vio.time.median, 10.0);
  EXPECT_EQ(metrics.vio.time.samples, kImages - 5);
  EXPECT_GT(metrics.vio.time.p99, 10.0 - 1e-9);
  EXPECT_EQ(metrics.fusion.time.samples, 6) << "the message repeats the time of the newest solution";
  EXPECT_NEAR(metrics.fusion.time_to_first_fix, 3.0, 1e-6);
  EXPECT_NEAR(metrics.fusion.time_to_first_fix_from_start, 5.0, 1e-6);
  EXPECT_EQ(metrics.fusion.resets, 1);
}

TEST_F(Evaluate, LatencyIsMeasuredLiveOnly) {
  EXPECT_FALSE(evaluate(read({})).transport.latency);
  const Metrics live = evaluate(read({.logger_delay = 35'000}));
  ASSERT_TRUE(live.transport.latency);
  EXPECT_NEAR(live.transport.latency->median, 35.0, 1e-6);
}

TEST_F(Evaluate, WithoutTruthTheGnssReferenceJudges) {
  const FlightRecord& record = read({.truth = false});
  const Metrics metrics = evaluate(record);
  EXPECT_EQ(metrics.fusion.truth.samples, 0);
  EXPECT_NEAR(metrics.fusion.gnss.rmse, std::sqrt(5.0), 1e-6);
  EXPECT_EQ(metrics.registration.false_fixes, 1);
  EXPECT_NEAR(metrics.vio.gnss.rmse, 0.0, 1e-6);
  EXPECT_EQ(to_json(record, metrics)["reference"], "gnss");
  EXPECT_TRUE(std::isnan(metrics.fusion.heading_rmse));
  EXPECT_THAT(metrics.notes, ::testing::Contains(::testing::HasSubstr("no TRUTH")));
}

TEST_F(Evaluate, EveryMissingChannelIsSaidAndSurvived) {
  const std::vector<std::pair<LogContent, std::string>> cases{
      {{.truth = false, .gnss = false}, "no TRUTH and no GNSS_REFERENCE"},
      {{.images = false}, "no CAMERA"},
      {{.vio = false, .keyframes = false}, "no VIO_STATE"},
      {{.fixes = false}, "no MAP_FIX"},
      {{.nav = false}, "no NAV_STATE"}};
  for (const auto& [content, note] : cases) {
    const FlightRecord& record = read(content);
    const Metrics metrics = evaluate(record);
    EXPECT_THAT(metrics.notes, ::testing::Contains(::testing::HasSubstr(note)));
    EXPECT_NO_THROW(to_json(record, metrics).dump());
    EXPECT_THAT(to_table(metrics), ::testing::HasSubstr(note));
  }
}

TEST_F(Evaluate, UnknownFiguresAreNullInJson) {
  const FlightRecord& record = read({.fixes = false});
  const auto json = nlohmann::json::parse(to_json(record, evaluate(record)).dump());
  EXPECT_TRUE(json["registration"]["rmse_m"].is_null());
  EXPECT_TRUE(json["latency_ms"].is_null());
  EXPECT_NEAR(json["fusion"]["rmse_m"].get<double>(), 3.0, 1e-6);
}

TEST_F(Evaluate, ATruncatedLogIsEvaluatedAsFarAsItGoes) {
  read({});
  fs::resize_file(file_, fs::file_size(file_) / 2 + 7);
  const FlightRecord record = FlightRecord::read(file_);
  const Metrics metrics = evaluate(record);
  EXPECT_NEAR(metrics.duration, 30.0, 1.0);
  EXPECT_NEAR(metrics.fusion.truth.rmse, 3.0, 1e-6);
  EXPECT_THAT(metrics.notes, ::testing::Contains(::testing::HasSubstr("damaged or cut off")));
}

TEST_F(Evaluate, UndecodableMessagesAreCounted) {
  read({});
  const fs::path other = file_.string() + ".mixed";
  {
    LogReader reader(file_);
    LogWriter writer(other);
    while (const auto event = reader.next())
      writer.write(event->utime, event->channel, event->data.data(), event->data.size());
    writer.write(kStart, channel::kMapFix, "nonsense", 8);
  }
  const Metrics metrics = evaluate(FlightRecord::read(other));
  EXPECT_EQ(metrics.transport.undecodable, 1);
  EXPECT_THAT(metrics.notes, ::testing::Contains(::testing::HasSubstr("MAP_FIX")));
}

TEST_F(Evaluate, ALogOfSomethingElseIsRefused) {
  const fs::path file = fs::path(::testing::TempDir()) / "else.lcm";
  LogWriter(file).write(kStart, "WEATHER", "rain", 4);
  EXPECT_THROW(FlightRecord::read(file), std::runtime_error);
  EXPECT_THROW(FlightRecord::read("/nonexistent.lcm"), std::runtime_error);
}

TEST_F(Evaluate, TumFilesHoldEveryPose) {
  const FlightRecord& record = read({});
  const fs::path folder = fs::path(::testing::TempDir()) / "tum";
  write_tum(record, folder);
  const std::vector<std::pair<std::string, int>> expected{
      {"truth.tum", kImages}, {"vio.tum", kImages - 20}, {"fusion.tum", kImages - 50}};
  for (const auto& [name, lines] : expected) {
    std::ifstream file(folder / name);
    std::string line;
    int count = 0;
    while (std::getline(file, line)) {
      ++count;
      EXPECT_EQ(std::count(line.begin(), line.end(), ' '), 7) << line;
    }
    EXPECT_EQ(count, lines) << name;
  }
}

}  // namespace
}  // namespace orthonav::evaluate
