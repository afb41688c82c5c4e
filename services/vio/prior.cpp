#include "services/vio/prior.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

// Difference of a block's value from its linearisation point, in tangent space.
void block_difference(const Prior::Block& block, const double* value, Eigen::Ref<Eigen::VectorXd> out) {
  const double* at = block.x0.data();
  if (!block.pose()) {
    for (int k = 0; k < block.size(); ++k) out[k] = value[k] - at[k];
    return;
  }
  out.head<3>() = Eigen::Map<const Eigen::Vector3d>(value) - Eigen::Map<const Eigen::Vector3d>(at);
  out.tail<3>() = so3_log(Eigen::Map<const Eigen::Quaterniond>(at + 3).conjugate() *
                          Eigen::Map<const Eigen::Quaterniond>(value + 3));
}

// Directions of the tangent space along which pictures tell nothing, one a column: the window turned about each axis of
// W, and made larger, all about the middle of its positions.
struct Symmetries {
  Eigen::MatrixXd directions;
  double size = 0;  // m, root mean square of the positions about their middle
};

template <class At>
Symmetries symmetries(const Prior& prior, const At& at) {
  Eigen::Vector3d middle = Eigen::Vector3d::Zero();
  double poses = 0;
  for (const Prior::Block& block : prior.blocks) {
    if (block.kind != Prior::Block::Kind::kPose) continue;
    middle += Eigen::Map<const Eigen::Vector3d>(at(block));
    ++poses;
  }
  middle /= std::max(1.0, poses);
  Symmetries result{Eigen::MatrixXd::Zero(prior.J.cols(), 4)};
  int column = 0;
  for (const Prior::Block& block : prior.blocks) {
    auto rows = result.directions.middleRows(column, block.size());
    column += block.size();
    if (!block.frame) continue;
    Eigen::Vector3d vector = Eigen::Map<const Eigen::Vector3d>(at(block));  // position or velocity
    if (block.kind == Prior::Block::Kind::kPose) {
      vector -= middle;
      result.size += vector.squaredNorm() / poses;
      rows.block<3, 3>(3, 0) = Eigen::Map<const Eigen::Quaterniond>(at(block) + 3).toRotationMatrix().transpose();
    }
    rows.block<3, 3>(0, 0) = -skew(vector);
    rows.block<3, 1>(0, 3) = vector;
  }
  result.size = std::sqrt(result.size);
  return result;
}

}  // namespace

int Prior::Block::size() const {
  switch (kind) {
    case Kind::kPose:
    case Kind::kCamera:
      return 6;
    case Kind::kSpeedBias:
      return 9;
    case Kind::kTimeOffset:
    case Kind::kHeightBias:
      return 1;
  }
  return 0;
}

int Prior::Block::ambient_size() const {
  return pose() ? 7 : size();
}

double* Prior::Block::value() const {
  switch (kind) {
    case Kind::kPose:
      return frame->state.pose.data();
    case Kind::kSpeedBias:
      return frame->state.speed_bias.data();
    case Kind::kCamera:
      return shared->state.camera.data();
    case Kind::kTimeOffset:
      return shared->state.time_offset.data();
    case Kind::kHeightBias:
      return shared->state.height_bias.data();
  }
  return nullptr;
}

void Prior::Block::linearise() {
  std::copy_n(value(), ambient_size(), x0.begin());
}

bool Prior::holds(const Frame& frame) const {
  return std::any_of(blocks.begin(), blocks.end(), [&](const Block& block) { return block.frame == &frame; });
}

bool Prior::holds(Block::Kind kind) const {
  return std::any_of(blocks.begin(), blocks.end(), [&](const Block& block) { return block.kind == kind; });
}

Eigen::VectorXd Prior::residual() const {
  Eigen::VectorXd difference(J.cols());
  int column = 0;
  for (const Block& block : blocks) {
    block_difference(block, block.value(), difference.segment(column, block.size()));
    column += block.size();
  }
  return r0 + J * difference;
}

// Not the residual itself: along what is hardly known that is rounding.
double Prior::departure() const {
  return empty() ? 0 : (residual() - made).squaredNorm() / static_cast<double>(made.size());
}

Prior make_initial_prior(Frame& frame, const InitialUncertainty& sigma, const Eigen::Vector3d& accel_bias,
                         const Eigen::Vector3d& gyro_bias) {
  Prior prior;
  prior.blocks = {{Prior::Block::Kind::kPose, &frame}, {Prior::Block::Kind::kSpeedBias, &frame}};
  for (Prior::Block& block : prior.blocks) block.linearise();
  prior.J = Eigen::MatrixXd::Zero(10, 15);
  prior.r0 = Eigen::VectorXd::Zero(10);
  prior.J.block<3, 3>(0, 0).diagonal().setConstant(1.0 / sigma.position);
  // A turn about the world's z axis, seen as a rotation vector in B.
  prior.J.block<1, 3>(3, 3) = (frame.state.q().conjugate() * Eigen::Vector3d::UnitZ()).transpose() / sigma.yaw;
  prior.J.block<3, 3>(4, 9).diagonal().setConstant(1.0 / sigma.accel_bias);
  prior.J.block<3, 3>(7, 12).diagonal().setConstant(1.0 / sigma.gyro_bias);
  prior.r0.segment<3>(4) = (frame.state.ba() - accel_bias) / sigma.accel_bias;
  prior.r0.segment<3>(7) = (frame.state.bg() - gyro_bias) / sigma.gyro_bias;
  prior.made = prior.r0;
  return prior;
}

void add_shared_prior(Prior& prior, Shared& shared, const SharedUncertainty& sigma) {
  using Kind = Prior::Block::Kind;
  const auto add = [&](Kind kind, const Eigen::VectorXd& sigmas) {
    prior.blocks.push_back({kind, nullptr, &shared});
    prior.blocks.back().linearise();
    const Eigen::Index rows = prior.J.rows(), columns = prior.J.cols(), n = sigmas.size();
    prior.J.conservativeResizeLike(Eigen::MatrixXd::Zero(rows + n, columns + n));
    prior.J.bottomRightCorner(n, n).diagonal() = sigmas.cwiseInverse();
    prior.r0.conservativeResizeLike(Eigen::VectorXd::Zero(rows + n));
    prior.made.conservativeResizeLike(Eigen::VectorXd::Zero(rows + n));
  };
  if (shared.camera_free && !prior.holds(Kind::kCamera)) {
    Eigen::VectorXd sigmas(6);
    sigmas << Eigen::Vector3d::Constant(sigma.camera_position), Eigen::Vector3d::Constant(sigma.camera_rotation);
    add(Kind::kCamera, sigmas);
  }
  if (shared.time_free && !prior.holds(Kind::kTimeOffset))
    add(Kind::kTimeOffset, Eigen::VectorXd::Constant(1, sigma.time_offset));
  if (shared.height_free && !prior.holds(Kind::kHeightBias))
    add(Kind::kHeightBias, Eigen::VectorXd::Constant(1, sigma.height_bias));
}

void Prior::follow() {
  if (empty()) return;
  const Symmetries then = symmetries(*this, [](const Block& block) { return block.x0.data(); });
  const Symmetries now = symmetries(*this, [](const Block& block) { return block.value(); });
  r0 = residual();
  // A turn and a growth by the same share are moves of the same size.
  const double length = 1 / std::max(1e-12, now.size * now.size);
  Eigen::MatrixXd weighted = Eigen::MatrixXd::Zero(J.cols(), 4);
  int column = 0;
  for (Block& block : blocks) {
    if (block.frame) weighted.middleRows<3>(column) = length * now.directions.middleRows<3>(column);
    if (block.kind == Block::Kind::kPose) weighted.middleRows<3>(column + 3) = now.directions.middleRows<3>(column + 3);
    column += block.size();
    block.linearise();
  }
  // Whatever moves the window otherwise costs what it did; along the directions of now, what it did along those of
  // then.
  const Eigen::Matrix4d gram = now.directions.transpose() * weighted;
  J += (J * (then.directions - now.directions)) * gram.ldlt().solve(weighted.transpose());
}

PriorFactor::PriorFactor(const Prior& prior) : prior_(prior) {
  set_num_residuals(static_cast<int>(prior.r0.size()));
  for (const Prior::Block& block : prior.blocks) mutable_parameter_block_sizes()->push_back(block.ambient_size());
}

bool PriorFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  Eigen::VectorXd difference(prior_.J.cols());
  int column = 0;
  for (size_t k = 0; k < prior_.blocks.size(); ++k) {
    const Prior::Block& block = prior_.blocks[k];
    block_difference(block, parameters[k], difference.segment(column, block.size()));
    if (jacobians && jacobians[k]) {
      const int width = block.ambient_size();
      Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>> out(jacobians[k],
                                                                                             prior_.J.rows(), width);
      out.leftCols(block.size()) = prior_.J.middleCols(column, block.size());
      if (block.pose()) out.col(6).setZero();
    }
    column += block.size();
  }
  Eigen::Map<Eigen::VectorXd>(residuals, prior_.r0.size()) = prior_.r0 + prior_.J * difference;
  return true;
}

}  // namespace orthonav::vio
