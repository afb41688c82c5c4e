// What a fusion that was killed in flight still knows when it is there again.
#include <algorithm>
#include <climits>
#include <cstdint>
#include <fstream>
#include <functional>

#include <gtest/gtest.h>

#include "services/fusion/memory.h"
#include "tests/fusion/faults.h"
#include "tests/fusion/fly.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::fusion {
namespace {

using Kind = SyntheticFlight::Step::Kind;

class KilledFusion : public ::testing::Test {
 protected:
  // Flies the steps whose states lie between two times, s.
  std::vector<Solution> play(Fusion& fusion, double from, double to) {
    std::vector<Solution> solutions;
    double seconds = 0;
    for (const SyntheticFlight::Step& step : flight_.steps) {
      if (step.kind == Kind::kState) seconds = 0.1 * static_cast<double>(step.index);
      if (seconds < from || seconds >= to) continue;
      switch (step.kind) {
        case Kind::kState:
          solutions.push_back(fusion.propagate(flight_.states[step.index]).solution);
          errors_.push_back((frame_.to_enu(solutions.back().position) - flight_.truth[step.index]).norm());
          break;
        case Kind::kKeyframe:
          fusion.add_keyframe(flight_.keyframes[step.index]);
          break;
        case Kind::kFix:
          outcomes_.push_back(fusion.add_fix(flight_.fixes[step.index]));
          break;
        case Kind::kCompass:
          fusion.add_compass(flight_.compass[step.index]);
          break;
        case Kind::kImu:
          break;
      }
    }
    return solutions;
  }
  Memory memory_at(double seconds) {
    Fusion fusion(options_);
    last_ = play(fusion, 0, seconds).back();
    outcomes_.clear();
    errors_.clear();
    return fusion.memory().value();
  }

  FusionOptions options_;
  SyntheticFlight flight_ = make_flight({.duration = 100.0, .single_wrong_rate = 0.0}, 5);
  EnuFrame frame_{flight_.anchor};
  Solution last_;  // before it was killed
  std::vector<Outcome> outcomes_;
  std::vector<double> errors_;
};

TEST_F(KilledFusion, GoesOnWhereItWasAndIsMapAidedWithItsFirstFix) {
  const Memory memory = memory_at(50);
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  const std::vector<Solution> solutions = play(fusion, 50.5, 60);
  EXPECT_EQ(solutions.front().mode, Mode::kCoasting) << "nothing has confirmed it yet";
  ASSERT_TRUE(solutions.front().located());
  EXPECT_LT((solutions.front().p_G_B - last_.p_G_B).norm(), 0.7 * 2.63 + 0.5) << "0.6 s of way, and no jump";
  for (size_t k = 0; k < solutions.size(); ++k) {
    EXPECT_EQ(solutions[k].reset_counter, last_.reset_counter);
    EXPECT_LT(errors_[k], 6.0);
  }
  const auto aided =
      std::find_if(solutions.begin(), solutions.end(), [](const Solution& s) { return s.mode == Mode::kMapAided; });
  EXPECT_LT(aided - solutions.begin(), 20) << "in frames";
  EXPECT_TRUE(std::all_of(aided, solutions.end(), [](const Solution& s) { return s.mode == Mode::kMapAided; }));
}

TEST_F(KilledFusion, KnowsAllThatTheOtherOneKnew) {
  const Memory memory = memory_at(50);
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  const std::vector<Solution> resumed = play(fusion, 50.0, 80);
  Fusion unharmed(options_);
  play(unharmed, 0, 50);
  const std::vector<Solution> expected = play(unharmed, 50, 80);
  ASSERT_EQ(resumed.size(), expected.size());
  for (size_t k = 0; k < resumed.size(); ++k) {
    // But for the two fixes that were on their way.
    EXPECT_LT((resumed[k].p_G_B - expected[k].p_G_B).norm(), 1.0);
    EXPECT_NEAR(std::sqrt(resumed[k].covariance(0, 0) / expected[k].covariance(0, 0)), 1.0, 0.2);
  }
}

TEST_F(KilledFusion, CountsTheTiltOfTheGroundThatItKnewOnlyOnce) {
  flight_ = make_flight({.duration = 60.0, .single_wrong_rate = 0.0, .perspective_stddev = 0.005}, 5);
  const Memory memory = memory_at(50);
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  play(fusion, 50.0, 51.2);
  Fusion unharmed(options_);
  play(unharmed, 0, 51.2);
  const auto known = [](const Fusion& f) { return std::sqrt(f.memory()->estimate.covariance(kLean, kLean)); };
  EXPECT_NEAR(known(fusion) / known(unharmed), 1.0, 0.02);
}

TEST_F(KilledFusion, FollowsWhatTheOdometryHasLearntMeanwhile) {
  SyntheticOptions options{.duration = 60.0, .single_wrong_rate = 0.0};
  options.lean = Eigen::Vector2d(0.0087, -0.0087);
  options.perspective_stddev = 0.001;
  options.lean_learnt_at = 50.2;
  flight_ = make_flight(options, 5);
  const Memory memory = memory_at(50);
  ASSERT_GT(memory.keyframe.levelled.norm(), 0.01);
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  const std::vector<Solution> solutions = play(fusion, 50.5, 51.0);
  const Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  for (size_t k = 0; k < solutions.size(); ++k) {
    EXPECT_LT((solutions[k].q_G_B * (flight_.truth_q[505 + k].conjugate() * up)).head<2>().norm(), 0.004) << k;
  }
}

TEST_F(KilledFusion, GivesNoProtectionLevelUntilItIsConfirmedAnew) {
  const Memory memory = memory_at(60);
  ASSERT_TRUE(std::isfinite(last_.horizontal_protection_level));
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  const std::vector<Solution> solutions = play(fusion, 60.5, 99);
  for (size_t k = 0; k < 290; ++k) EXPECT_TRUE(std::isnan(solutions[k].horizontal_protection_level));
  EXPECT_TRUE(std::isfinite(solutions.back().horizontal_protection_level));
}

TEST_F(KilledFusion, GoesOnWithNothingOfAnotherSessionOrTooOldAndSaysThatThePositionJumps) {
  const Memory memory = memory_at(50);
  const auto starts_anew = [&](const Memory& other, double from) {
    Fusion fusion(options_);
    ASSERT_TRUE(fusion.resume(other));
    const std::vector<Solution> solutions = play(fusion, from, from + 20);
    EXPECT_FALSE(solutions.front().located());
    EXPECT_EQ(solutions.front().reset_counter, last_.reset_counter + 1);
    EXPECT_TRUE(solutions.back().located());
    EXPECT_EQ(solutions.back().reset_counter, last_.reset_counter + 1) << "lost and found again is one jump";
  };
  starts_anew(memory, 50 + options_.memory_age + 1);
  Memory other = memory;
  other.keyframe.session += 7;
  starts_anew(other, 50.5);
  other = memory;
  other.keyframe.p_W_B.x() += 1000.0;
  starts_anew(other, 50.5);
  other = memory;
  other.keyframe.utime += 5'000'000;
  starts_anew(other, 50.5);
}

TEST_F(KilledFusion, AWrongMemoryIsNeverMapAidedIsSoonLostAndLeftForWhereFixesAgree) {
  Memory memory = memory_at(50);
  memory.estimate.state.x(kPosition) += 80.0;
  memory.believed = 1000;
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  const std::vector<Solution> solutions = play(fusion, 50.5, 99);
  const auto lost =
      std::find_if(solutions.begin(), solutions.end(), [](const Solution& s) { return s.mode == Mode::kLost; });
  EXPECT_LT(lost - solutions.begin(), 100) << "in frames: a few fixes, over some way";
  for (size_t k = 0; k < solutions.size(); ++k) {
    const bool trusted = solutions[k].mode == Mode::kMapAided || solutions[k].mode == Mode::kReacquired;
    EXPECT_TRUE(!trusted || errors_[k] < 6.0) << "frame " << k;
  }
  EXPECT_EQ(solutions.back().reset_counter, last_.reset_counter + 1);
  EXPECT_LT(errors_.back(), 6.0);
}

TEST_F(KilledFusion, ARunOfWrongFixesDoesNotMoveItElsewhere) {
  const Memory memory = memory_at(50);
  faults::shift_fixes(flight_, 45, 70, Eigen::Vector3d(50, 33, 2));
  Fusion fusion(options_);
  ASSERT_TRUE(fusion.resume(memory));
  const std::vector<Solution> solutions = play(fusion, 50.5, 80);
  EXPECT_EQ(solutions.back().reset_counter, last_.reset_counter);
  EXPECT_LT(*std::max_element(errors_.begin(), errors_.end()), 6.0);
}

TEST_F(KilledFusion, AMemoryOfImpossibleNumbersIsForgotten) {
  const Memory memory = memory_at(50);
  const auto refused = [&](const std::function<void(Memory&)>& spoil) {
    Memory spoilt = memory;
    spoil(spoilt);
    EXPECT_FALSE(Fusion(options_).resume(spoilt));
  };
  EXPECT_TRUE(Fusion(options_).resume(memory));
  refused([](Memory& m) { m.keyframe.p_W_B.x() = kUnknown; });
  refused([](Memory& m) { m.keyframe.q_W_B.coeffs().setZero(); });
  refused([](Memory& m) { m.estimate.state.x(kYaw) = kUnknown; });
  refused([](Memory& m) { m.estimate.state.x(kScale) = 5.0; });
  refused([](Memory& m) { m.estimate.covariance *= -1.0; });
  refused([](Memory& m) { m.anchor.latitude_deg = 200.0; });
  refused([](Memory& m) { m.reset_counter = -1; });
  refused([](Memory& m) { m.reset_counter = INT_MAX; });
  refused([](Memory& m) { m.keyframe.id = INT_MAX; });
  refused([](Memory& m) { m.keyframe.utime = INT64_MIN; });
  refused([](Memory& m) { m.session_utime = INT64_MAX; });
  refused([](Memory& m) { m.newest_fix_utime = -1; });
}

TEST_F(KilledFusion, AFileThatIsCutOrAlteredIsNoMemory) {
  const test::TemporaryFolder folder;
  const auto file = folder / "memory";
  EXPECT_FALSE(read_memory(file));
  const Memory memory = memory_at(50);
  ASSERT_TRUE(write_memory(file, memory));
  const auto read = read_memory(file);
  ASSERT_TRUE(read);
  EXPECT_EQ(read->keyframe.utime, memory.keyframe.utime);
  EXPECT_EQ(read->keyframe.id, memory.keyframe.id);
  EXPECT_EQ(read->keyframe.q_W_B.coeffs(), memory.keyframe.q_W_B.coeffs());
  EXPECT_EQ(read->keyframe.levelled, memory.keyframe.levelled);
  EXPECT_EQ(read->keyframe.lean_stddev, memory.keyframe.lean_stddev);
  EXPECT_EQ(read->keyframe.height_above_ground, memory.keyframe.height_above_ground);
  EXPECT_EQ(read->estimate.state.x, memory.estimate.state.x);
  EXPECT_EQ(read->estimate.covariance, memory.estimate.covariance);
  EXPECT_EQ(read->anchor.longitude_deg, memory.anchor.longitude_deg);
  EXPECT_EQ(read->reset_counter, memory.reset_counter);
  EXPECT_EQ(read->believed, memory.believed);

  std::fstream stream(file, std::ios::in | std::ios::out | std::ios::binary);
  stream.seekp(300);
  stream.put('x');
  stream.close();
  EXPECT_FALSE(read_memory(file));
  ASSERT_TRUE(write_memory(file, memory));
  std::filesystem::resize_file(file, std::filesystem::file_size(file) - 8);
  EXPECT_FALSE(read_memory(file));
  EXPECT_FALSE(write_memory(folder / "nowhere/memory", memory));
}

}  // namespace
}  // namespace orthonav::fusion
