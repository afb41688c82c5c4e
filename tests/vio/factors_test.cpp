#include <random>

#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "services/vio/aid_factors.h"
#include "services/vio/imu_factor.h"
#include "services/vio/normal_equations.h"
#include "services/vio/prior.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {
namespace {

using Eigen::MatrixXd;
using Eigen::Vector3d;
using Eigen::VectorXd;

class Random {
 public:
  double operator()() { return normal_(generator_); }
  Vector3d vector(double sigma) { return sigma * Vector3d((*this)(), (*this)(), (*this)()); }

 private:
  std::mt19937 generator_{3};
  std::normal_distribution<double> normal_;
};

StateValues random_state(Random& random) {
  StateValues state;
  state.p() = random.vector(2.0);
  state.q() = so3_exp(random.vector(0.7));
  state.v() = random.vector(1.0);
  state.ba() = random.vector(0.05);
  state.bg() = random.vector(0.02);
  return state;
}

// A block moved along one tangent direction.
std::vector<double> moved(const std::vector<double>& block, int direction, double step) {
  std::vector<double> result = block;
  if (block.size() == 7) {
    double delta[6] = {};
    delta[direction] = step;
    PoseManifold().Plus(block.data(), delta, result.data());
  } else {
    result[static_cast<size_t>(direction)] += step;
  }
  return result;
}

// Compares a cost function's Jacobians with central differences on the tangent spaces.
void expect_jacobians_match(const ceres::CostFunction& cost, const std::vector<std::vector<double>>& blocks,
                            double tolerance) {
  const int rows = cost.num_residuals();
  std::vector<const double*> parameters;
  std::vector<std::vector<double>> storage;
  std::vector<double*> jacobians;
  for (const auto& block : blocks) {
    parameters.push_back(block.data());
    storage.emplace_back(static_cast<size_t>(rows) * block.size());
  }
  for (auto& entry : storage) jacobians.push_back(entry.data());
  VectorXd residual(rows);
  ASSERT_TRUE(cost.Evaluate(parameters.data(), residual.data(), jacobians.data()));
  for (size_t b = 0; b < blocks.size(); ++b) {
    const auto width = static_cast<Eigen::Index>(blocks[b].size());
    const Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>> J(jacobians[b], rows,
                                                                                               width);
    const int directions = blocks[b].size() == 7 ? 6 : static_cast<int>(blocks[b].size());
    for (int d = 0; d < directions; ++d) {
      const double step = 1e-6;
      VectorXd side[2] = {VectorXd(rows), VectorXd(rows)};
      for (int s = 0; s < 2; ++s) {
        const auto block = moved(blocks[b], d, s ? step : -step);
        auto changed = parameters;
        changed[b] = block.data();
        ASSERT_TRUE(cost.Evaluate(changed.data(), side[s].data(), nullptr));
      }
      const VectorXd numeric = (side[1] - side[0]) / (2 * step);
      const double scale = 1.0 + numeric.norm();
      EXPECT_LT((J.col(d) - numeric).norm() / scale, tolerance) << "block " << b << " direction " << d;
    }
  }
}

std::vector<double> as_vector(const std::array<double, 7>& a) {
  return {a.begin(), a.end()};
}
std::vector<double> as_vector(const std::array<double, 9>& a) {
  return {a.begin(), a.end()};
}

Preintegration some_motion() {
  Preintegration pre({0.02, -0.03, 0.01}, {0.004, 0.001, -0.002}, {});
  for (int k = 0; k <= 60; ++k) {
    const double t = 0.005 * k;
    pre.add({5000 * k, {std::sin(4 * t), 0.5 * std::cos(3 * t), 0.3}, {std::cos(t), std::sin(6 * t), 9.6}});
  }
  return pre;
}

TEST(ImuFactor, JacobiansMatchFiniteDifferences) {
  Random random;
  const Preintegration pre = some_motion();
  for (int trial = 0; trial < 20; ++trial) {
    Frame i, j;
    i.state = random_state(random);
    j.state = random_state(random);
    const ImuFactor factor(pre, 9.81);
    expect_jacobians_match(factor,
                           {as_vector(i.state.pose), as_vector(i.state.speed_bias), as_vector(j.state.pose),
                            as_vector(j.state.speed_bias)},
                           1e-5);
  }
}

TEST(ImuFactor, VanishesOnTheMotionItSummarises) {
  Random random;
  const Preintegration pre = some_motion();
  Frame i, j;
  i.state = random_state(random);
  i.state.ba() = pre.accel_bias();
  i.state.bg() = pre.gyro_bias();
  const Vector3d g(0, 0, -9.81);
  const double T = pre.duration();
  j.state = i.state;
  j.state.p() = i.state.p() + T * i.state.v() + 0.5 * T * T * g + i.state.q() * pre.alpha();
  j.state.v() = i.state.v() + T * g + i.state.q() * pre.beta();
  j.state.q() = i.state.q() * pre.gamma();
  ImuFactor::Vector15 r;
  ImuFactor::evaluate(pre, i.state, j.state, 9.81, &r, nullptr);
  EXPECT_LT(r.norm(), 1e-6);
}

Extrinsics tilted_camera() {
  Extrinsics extrinsics;
  extrinsics.p_B_C = {0.1, -0.05, 0.02};
  extrinsics.R_B_C = so3_exp({0.3, -0.1, 0.2}).toRotationMatrix();
  return extrinsics;
}

TEST(ProjectionFactor, JacobiansMatchFiniteDifferences) {
  Random random;
  const Extrinsics extrinsics = tilted_camera();
  for (int trial = 0; trial < 50; ++trial) {
    Frame i, j;
    i.state = random_state(random);
    j.state = i.state;
    j.state.p() += random.vector(0.4);
    j.state.q() = i.state.q() * so3_exp(random.vector(0.1));
    Shared shared;
    shared.state.set(extrinsics);
    shared.camera_free = true;
    const Bearings bearings{{0.3 * random(), 0.3 * random(), 1.0},
                            {0.3 * random(), 0.3 * random(), 1.0},
                            {random(), random()},
                            {random(), random()},
                            0.01,
                            0.012};
    const ProjectionFactor factor(bearings, shared, extrinsics, 460.0);
    expect_jacobians_match(
        factor, {as_vector(i.state.pose), as_vector(j.state.pose), {0.2}, as_vector(shared.state.camera), {0.02}},
        1e-5);
  }
}

TEST(AidFactors, JacobiansMatchFiniteDifferences) {
  Random random;
  const Extrinsics extrinsics = tilted_camera();
  for (int trial = 0; trial < 20; ++trial) {
    Frame i, j;
    i.state = random_state(random);
    j.state = random_state(random);
    const Vector3d ray(0.3 * random(), 0.3 * random(), 1.0);
    const HeightFactor height({3.0, 0.5}, ray, extrinsics);
    expect_jacobians_match(height, {as_vector(i.state.pose), as_vector(j.state.pose), {0.2}, {0.4}}, 1e-5);
    const DistanceFactor distance(2.0, 0.1);
    expect_jacobians_match(distance, {as_vector(i.state.pose), as_vector(j.state.pose)}, 1e-5);
    expect_jacobians_match(StandstillFactor(0.05), {as_vector(i.state.speed_bias)}, 1e-5);
  }
}

TEST(PoseManifold, MinusUndoesPlus) {
  Random random;
  const StateValues state = random_state(random);
  Eigen::Matrix<double, 6, 1> delta, back;
  for (int k = 0; k < 6; ++k) delta[k] = 0.3 * random();
  double other[7];
  PoseManifold manifold;
  manifold.Plus(state.pose.data(), delta.data(), other);
  manifold.Minus(other, state.pose.data(), back.data());
  EXPECT_LT((back - delta).norm(), 1e-9);
}

// A chain of frames with landmarks, near but not at its optimum.
struct SmallProblem {
  std::vector<std::unique_ptr<Frame>> frames;
  std::vector<Landmark> landmarks;
  Shared shared;  // a camera at the body's origin; the time offset is free
  double weight = 460;

  explicit SmallProblem(int count) {
    Random random;
    shared.time_free = true;
    const Preintegration pre = some_motion();
    const Vector3d g(0, 0, -9.81);
    for (int k = 0; k < count; ++k) {
      auto frame = std::make_unique<Frame>();
      if (k == 0) {
        frame->state.v() = Vector3d(1, 0.5, 0);
      } else {
        const StateValues& last = frames.back()->state;
        const double T = pre.duration();
        frame->state = last;
        frame->state.p() = last.p() + T * last.v() + 0.5 * T * T * g + last.q() * pre.alpha() + random.vector(1e-3);
        frame->state.v() = last.v() + T * g + last.q() * pre.beta() + random.vector(1e-3);
        frame->state.q() = last.q() * pre.gamma() * so3_exp(random.vector(1e-4));
        frame->imu = std::make_unique<Preintegration>(pre);
      }
      frames.push_back(std::move(frame));
    }
    for (int n = 0; n < 12; ++n) {
      Landmark landmark;
      landmark.inverse_depth = 0.2;
      landmark.has_depth = true;
      const Vector3d ray(0.2 * random(), 0.2 * random(), 1);
      for (const auto& frame : frames) {
        const Vector3d p_W = frames[0]->state.q() * (ray / 0.2) + frames[0]->state.p();
        const Vector3d p_C = frame->state.q().conjugate() * (p_W - frame->state.p());
        Observation observation;
        observation.frame = frame.get();
        observation.ray = p_C / p_C.z() + Vector3d(1e-3 * random(), 1e-3 * random(), 0);
        observation.rate = {0.1 * random(), 0.1 * random()};
        if (frame == frames[0]) observation.ray = ray;
        landmark.observations.push_back(observation);
      }
      landmarks.push_back(landmark);
    }
  }

  std::vector<Frame*> pointers(size_t first = 0) const {
    std::vector<Frame*> result;
    for (size_t k = first; k < frames.size(); ++k) result.push_back(frames[k].get());
    return result;
  }
};

TEST(DepthManifold, MinusUndoesPlusAndItsJacobianIsOne) {
  const DepthManifold manifold;
  for (const double x : {0.002, 0.01, 0.7}) {
    for (const double delta : {-0.4 * x, 1e-3 * x, 0.6 * x}) {
      double y = 0, back = 0;
      ASSERT_TRUE(manifold.Plus(&x, &delta, &y));
      ASSERT_TRUE(manifold.Minus(&y, &x, &back));
      EXPECT_NEAR(back, delta, 1e-12 * x);
    }
    const double step = 1e-6 * x, step_back = -step;
    double up = 0, down = 0, jacobian = 0;
    manifold.Plus(&x, &step, &up);
    manifold.Plus(&x, &step_back, &down);
    manifold.PlusJacobian(&x, &jacobian);
    EXPECT_NEAR((up - down) / (2 * step), jacobian, 1e-9);
    const double far = 5 * x;
    manifold.Plus(&x, &far, &up);
    EXPECT_GT(up, 0);
  }
}

// The reason for it: the step that doubles positions and depths, however long, leaves a projection as it is.
TEST(DepthManifold, AStepOfScaleAloneChangesNoProjection) {
  Random random;
  Extrinsics extrinsics;
  extrinsics.p_B_C.setZero();  // a lever arm would tell the scale
  StateValues i = random_state(random), j = random_state(random);
  i.p().setZero();
  i.q().setIdentity();
  j.q() = so3_exp(random.vector(0.05));
  j.p() = Vector3d(1, 0.5, 0.2);
  const double inverse_depth = 0.2;
  const Bearings bearings{{0.1, -0.2, 1}, {0, 0, 1}, {0, 0}, {0, 0}, 0, 0};
  const auto project = [&](const StateValues& at, double inverse) {
    Eigen::Vector2d r;
    EXPECT_TRUE(
        ProjectionFactor::evaluate(bearings, 0, extrinsics, 1, i.pose.data(), at.pose.data(), inverse, &r, nullptr));
    return r;
  };
  const double delta = -1.0 * inverse_depth;  // of a depth that doubles
  double twice = 0;
  DepthManifold().Plus(&inverse_depth, &delta, &twice);
  StateValues moved_j = j;
  moved_j.p() *= 2;
  EXPECT_LT((project(moved_j, twice) - project(j, inverse_depth)).norm(), 1e-12);
}

TEST(PriorFactor, JacobiansMatchFiniteDifferences) {
  SmallProblem problem(3);
  NormalEquations equations(problem.pointers(), problem.shared);
  equations.add_prior(make_initial_prior(*problem.frames[0], {}, Vector3d::Zero(), Vector3d::Zero()));
  equations.add_imu(*problem.frames[0], *problem.frames[1], 9.81);
  for (const Landmark& landmark : problem.landmarks) {
    equations.add_landmark(landmark, problem.weight, 1e9);
  }
  const Prior prior = equations.marginalise(*problem.frames[0]);
  std::vector<std::vector<double>> blocks;
  for (const Prior::Block& block : prior.blocks) {
    blocks.emplace_back(block.x0.begin(), block.x0.begin() + block.ambient_size());
  }
  expect_jacobians_match(PriorFactor(prior), blocks, 1e-5);
}

// What is left after marginalising a frame is what the full problem says of the others: the same solution and the
// same covariance.
TEST(Marginalisation, KeepsTheInformationOfTheFullProblem) {
  SmallProblem problem(4);
  const Prior start = make_initial_prior(*problem.frames[0], {}, Vector3d::Zero(), Vector3d::Zero());
  NormalEquations full(problem.pointers(), problem.shared);
  full.add_prior(start);
  for (size_t k = 1; k < 4; ++k) full.add_imu(*problem.frames[k - 1], *problem.frames[k], 9.81);
  for (const Landmark& landmark : problem.landmarks) full.add_landmark(landmark, problem.weight, 1e9);

  NormalEquations leaving(problem.pointers(), problem.shared);
  leaving.add_prior(start);
  leaving.add_imu(*problem.frames[0], *problem.frames[1], 9.81);
  for (const Landmark& landmark : problem.landmarks) {
    leaving.add_landmark(landmark, problem.weight, 1e9);
  }
  const Prior prior = leaving.marginalise(*problem.frames[0]);
  NormalEquations rest(problem.pointers(1), problem.shared);
  rest.add_prior(prior);
  for (size_t k = 2; k < 4; ++k) rest.add_imu(*problem.frames[k - 1], *problem.frames[k], 9.81);

  const int time_full = full.offset({Prior::Block::Kind::kTimeOffset, nullptr, &problem.shared});
  const int time_rest = rest.offset({Prior::Block::Kind::kTimeOffset, nullptr, &problem.shared});
  const VectorXd step_full = full.H().ldlt().solve(full.b());
  const VectorXd step_rest = rest.H().ldlt().solve(rest.b());
  EXPECT_NEAR(step_full[time_full], step_rest[time_rest], 1e-6 * (1 + std::abs(step_full[time_full])));
  for (size_t k = 1; k < 4; ++k) {
    const Frame& frame = *problem.frames[k];
    const VectorXd a = step_full.segment<6>(full.pose_offset(frame));
    const VectorXd b = step_rest.segment<6>(rest.pose_offset(frame));
    EXPECT_LT((a - b).norm(), 1e-6 * (1 + a.norm())) << k;
    const VectorXd c = step_full.segment<9>(full.speed_bias_offset(frame));
    const VectorXd d = step_rest.segment<9>(rest.speed_bias_offset(frame));
    EXPECT_LT((c - d).norm(), 1e-5 * (1 + c.norm())) << k;
    const MatrixXd cov_full = full.pose_covariance({full.pose_offset(frame)});
    const MatrixXd cov_rest = rest.pose_covariance({rest.pose_offset(frame)});
    EXPECT_LT((cov_full - cov_rest).norm(), 1e-4 * cov_full.norm()) << k;
  }
}

// Tangent directions of what pictures do not tell, at the blocks' current values: a shift along each axis, a turn about
// each, a larger window. Velocities turn and grow along.
VectorXd symmetry(const Prior& prior, int direction) {
  VectorXd shift = VectorXd::Zero(prior.J.cols());
  int column = 0;
  for (const Prior::Block& block : prior.blocks) {
    const int at = column;
    column += block.size();
    if (!block.frame) continue;  // what is shared stays
    const StateValues& x = block.frame->state;
    const Vector3d vector = block.pose() ? Vector3d(x.p()) : Vector3d(x.v());
    if (direction < 3) {
      if (block.pose()) shift[at + direction] = 1;
    } else if (direction < 6) {
      const Vector3d axis = Vector3d::Unit(direction - 3);
      shift.segment<3>(at) = axis.cross(vector);
      if (block.pose()) shift.segment<3>(at + 3) = x.q().conjugate() * axis;
    } else {
      shift.segment<3>(at) = vector;
    }
  }
  return shift;
}

Prior of_pictures(SmallProblem& problem, bool with_imu) {
  NormalEquations equations(problem.pointers(), problem.shared);
  if (with_imu) equations.add_imu(*problem.frames[0], *problem.frames[1], 9.81);
  for (const Landmark& landmark : problem.landmarks) equations.add_landmark(landmark, problem.weight, 1e9);
  return equations.marginalise(*problem.frames[0]);
}

TEST(Marginalisation, GainsNoInformationAboutPositionAndYaw) {
  SmallProblem problem(3);
  const Prior prior = of_pictures(problem, true);
  for (const int direction : {0, 1, 2, 5}) {
    const double stiff = (prior.J * VectorXd::Ones(prior.J.cols())).norm();
    EXPECT_LT((prior.J * symmetry(prior, direction)).norm(), 1e-4 * stiff) << direction;
  }
}

// The estimate turns, grows and changes its shape; what pictures did not tell of its place, turn and scale they still
// do not, and the cost of where it is has not changed.
TEST(Prior, KnowsNothingNewWhereverTheWindowGoes) {
  SmallProblem problem(3);
  Prior prior = of_pictures(problem, false);
  const double stiff = (prior.J * VectorXd::Ones(prior.J.cols())).norm();
  Random random;
  const Eigen::Quaterniond turn = so3_exp(Vector3d(0.05, -0.03, 0.2));
  for (const auto& frame : problem.frames) {
    StateValues& x = frame->state;
    x.p() = 1.2 * (turn * Vector3d(x.p())) + random.vector(1e-3);
    x.v() = 1.2 * (turn * Vector3d(x.v()));
    x.q() = turn * x.q() * so3_exp(random.vector(1e-3));
  }
  double stale = 0;
  for (int direction = 0; direction < 7; ++direction) {
    stale = std::max(stale, (prior.J * symmetry(prior, direction)).norm() / stiff);
  }
  EXPECT_GT(stale, 1e-2) << "a prior that stays behind would claim to know";
  const VectorXd left = prior.residual();
  prior.follow();
  EXPECT_LT((prior.r0 - left).norm(), 1e-9 * (1 + left.norm()));
  EXPECT_LT((prior.residual() - left).norm(), 1e-9 * (1 + left.norm()));
  for (int direction = 0; direction < 7; ++direction) {
    EXPECT_LT((prior.J * symmetry(prior, direction)).norm(), 1e-4 * stiff) << direction;
  }
}

}  // namespace
}  // namespace orthonav::vio
