#include "services/vio/prior.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "common/math/so3.h"
#include "services/vio/imu_factor.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {
namespace {

// Difference of a block's value from its first estimate, in tangent space.
void block_difference(const Prior::Block& block, const double* value, Eigen::Ref<Eigen::VectorXd> out) {
  const StateValues& at = block.frame->first_estimate;
  if (block.speed_bias) {
    for (int k = 0; k < 9; ++k) out[k] = value[k] - at.speed_bias[static_cast<size_t>(k)];
    return;
  }
  out.head<3>() = Eigen::Map<const Eigen::Vector3d>(value) - at.p();
  out.tail<3>() = so3_log(at.q().conjugate() * Eigen::Map<const Eigen::Quaterniond>(value + 3));
}

const double* block_value(const Prior::Block& block) {
  return block.speed_bias ? block.frame->state.speed_bias.data() : block.frame->state.pose.data();
}

}  // namespace

double huber_weight(double s, double width) {
  return s <= width * width ? 1.0 : width / std::sqrt(s);
}

Eigen::VectorXd Prior::residual() const {
  Eigen::VectorXd difference(J.cols());
  int column = 0;
  for (const Block& block : blocks) {
    block_difference(block, block_value(block), difference.segment(column, block.size()));
    column += block.size();
  }
  return r0 + J * difference;
}

Prior make_initial_prior(Frame& frame, const InitialUncertainty& sigma, const Eigen::Vector3d& accel_bias,
                         const Eigen::Vector3d& gyro_bias) {
  frame.first_estimate = frame.state;
  frame.pose_fixed = frame.speed_bias_fixed = true;
  Prior prior;
  prior.blocks = {{&frame, false}, {&frame, true}};
  prior.J = Eigen::MatrixXd::Zero(10, 15);
  prior.r0 = Eigen::VectorXd::Zero(10);
  prior.J.block<3, 3>(0, 0).diagonal().setConstant(1.0 / sigma.position);
  // A turn about the world's z axis, seen as a rotation vector in B.
  prior.J.block<1, 3>(3, 3) = (frame.state.q().conjugate() * Eigen::Vector3d::UnitZ()).transpose() / sigma.yaw;
  prior.J.block<3, 3>(4, 9).diagonal().setConstant(1.0 / sigma.accel_bias);
  prior.J.block<3, 3>(7, 12).diagonal().setConstant(1.0 / sigma.gyro_bias);
  prior.r0.segment<3>(4) = (frame.state.ba() - accel_bias) / sigma.accel_bias;
  prior.r0.segment<3>(7) = (frame.state.bg() - gyro_bias) / sigma.gyro_bias;
  return prior;
}

PriorFactor::PriorFactor(const Prior& prior) : prior_(prior) {
  set_num_residuals(static_cast<int>(prior.r0.size()));
  for (const Prior::Block& block : prior.blocks) mutable_parameter_block_sizes()->push_back(block.speed_bias ? 9 : 7);
}

bool PriorFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  Eigen::VectorXd difference(prior_.J.cols());
  int column = 0;
  for (size_t k = 0; k < prior_.blocks.size(); ++k) {
    const Prior::Block& block = prior_.blocks[k];
    block_difference(block, parameters[k], difference.segment(column, block.size()));
    if (jacobians && jacobians[k]) {
      const int width = block.speed_bias ? 9 : 7;
      Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>> out(jacobians[k],
                                                                                             prior_.J.rows(), width);
      out.leftCols(block.size()) = prior_.J.middleCols(column, block.size());
      if (!block.speed_bias) out.col(6).setZero();
    }
    column += block.size();
  }
  Eigen::Map<Eigen::VectorXd>(residuals, prior_.r0.size()) = prior_.r0 + prior_.J * difference;
  return true;
}

NormalEquations::NormalEquations(std::vector<Frame*> frames) : frames_(std::move(frames)) {
  const auto size = static_cast<Eigen::Index>(15 * frames_.size());
  H_ = Eigen::MatrixXd::Zero(size, size);
  b_ = Eigen::VectorXd::Zero(size);
}

size_t NormalEquations::index_of(const Frame& frame) const {
  const auto found = std::find(frames_.begin(), frames_.end(), &frame);
  if (found == frames_.end()) throw std::logic_error("a factor refers to a frame outside the window");
  return static_cast<size_t>(found - frames_.begin());
}

int NormalEquations::pose_offset(const Frame& frame) const {
  return static_cast<int>(6 * index_of(frame));
}

int NormalEquations::speed_bias_offset(const Frame& frame) const {
  return static_cast<int>(6 * frames_.size() + 9 * index_of(frame));
}

void NormalEquations::add_imu(const Frame& i, const Frame& j, double gravity) {
  ImuFactor::Vector15 r;
  ImuFactor::evaluate(*j.imu, i.state, j.state, gravity, &r, nullptr);
  ImuFactor::Jacobians jacobians;
  ImuFactor::evaluate(*j.imu, linearisation_point(i, i.state), linearisation_point(j, j.state), gravity, nullptr,
                      &jacobians);
  Eigen::Matrix<double, 15, 30> J;
  J << jacobians.pose_i, jacobians.speed_bias_i, jacobians.pose_j, jacobians.speed_bias_j;
  const Eigen::Matrix<double, 30, 30> JtJ = J.transpose() * J;
  const Eigen::Matrix<double, 30, 1> Jtr = J.transpose() * r;
  const int from[4] = {0, 6, 15, 21};
  const int size[4] = {6, 9, 6, 9};
  const int to[4] = {pose_offset(i), speed_bias_offset(i), pose_offset(j), speed_bias_offset(j)};
  for (int a = 0; a < 4; ++a) {
    b_.segment(to[a], size[a]) -= Jtr.segment(from[a], size[a]);
    for (int c = 0; c < 4; ++c) {
      H_.block(to[a], to[c], size[a], size[c]) += JtJ.block(from[a], from[c], size[a], size[c]);
    }
  }
}

void NormalEquations::add_landmark(const Landmark& landmark, const Extrinsics& extrinsics, double weight,
                                   double robust_width) {
  const Observation& anchor = landmark.anchor();
  const Frame& frame_i = *anchor.frame;
  const int at_i = pose_offset(frame_i);
  const double* lin_i = frame_i.pose_fixed ? frame_i.first_estimate.pose.data() : frame_i.state.pose.data();
  std::vector<int> at{at_i};
  std::vector<Eigen::Matrix<double, 6, 1>> W{Eigen::Matrix<double, 6, 1>::Zero()};
  double h = 0, b = 0;
  for (size_t k = 1; k < landmark.observations.size(); ++k) {
    const Observation& observation = landmark.observations[k];
    const Frame& frame_j = *observation.frame;
    Eigen::Vector2d r;
    ProjectionFactor::Jacobians J;
    const double* lin_j = frame_j.pose_fixed ? frame_j.first_estimate.pose.data() : frame_j.state.pose.data();
    if (!ProjectionFactor::evaluate(anchor.ray, observation.ray, extrinsics, weight, frame_i.state.pose.data(),
                                    frame_j.state.pose.data(), landmark.inverse_depth, &r, nullptr) ||
        !ProjectionFactor::evaluate(anchor.ray, observation.ray, extrinsics, weight, lin_i, lin_j,
                                    landmark.inverse_depth, nullptr, &J)) {
      continue;
    }
    const double w = huber_weight(r.squaredNorm(), robust_width);
    const int at_j = pose_offset(frame_j);
    H_.block<6, 6>(at_i, at_i) += w * J.pose_i.transpose() * J.pose_i;
    H_.block<6, 6>(at_j, at_j) += w * J.pose_j.transpose() * J.pose_j;
    const Eigen::Matrix<double, 6, 6> cross = w * J.pose_i.transpose() * J.pose_j;
    H_.block<6, 6>(at_i, at_j) += cross;
    H_.block<6, 6>(at_j, at_i) += cross.transpose();
    b_.segment<6>(at_i) -= w * J.pose_i.transpose() * r;
    b_.segment<6>(at_j) -= w * J.pose_j.transpose() * r;
    W[0] += w * J.pose_i.transpose() * J.inverse_depth;
    at.push_back(at_j);
    W.emplace_back(w * J.pose_j.transpose() * J.inverse_depth);
    h += w * J.inverse_depth.squaredNorm();
    b -= w * J.inverse_depth.dot(r);
  }
  if (h <= 0) return;
  for (size_t k = 0; k < at.size(); ++k) {
    b_.segment<6>(at[k]) -= W[k] * (b / h);
    for (size_t l = 0; l < at.size(); ++l) H_.block<6, 6>(at[k], at[l]) -= W[k] * (W[l] / h).transpose();
  }
}

void NormalEquations::add_prior(const Prior& prior) {
  if (prior.empty()) return;
  const Eigen::MatrixXd JtJ = prior.J.transpose() * prior.J;
  const Eigen::VectorXd Jtr = prior.J.transpose() * prior.residual();
  int row = 0;
  for (const Prior::Block& a : prior.blocks) {
    const int to = a.speed_bias ? speed_bias_offset(*a.frame) : pose_offset(*a.frame);
    b_.segment(to, a.size()) -= Jtr.segment(row, a.size());
    int column = 0;
    for (const Prior::Block& c : prior.blocks) {
      const int right = c.speed_bias ? speed_bias_offset(*c.frame) : pose_offset(*c.frame);
      H_.block(to, right, a.size(), c.size()) += JtJ.block(row, column, a.size(), c.size());
      column += c.size();
    }
    row += a.size();
  }
}

Prior NormalEquations::marginalise(const Frame& frame) const {
  const int m_pose = pose_offset(frame), m_speed = speed_bias_offset(frame);
  std::vector<int> m;
  for (int k = 0; k < 6; ++k) m.push_back(m_pose + k);
  for (int k = 0; k < 9; ++k) m.push_back(m_speed + k);

  // The gradient at the first estimates, from that at the current states.
  Eigen::VectorXd difference = Eigen::VectorXd::Zero(b_.size());
  for (Frame* other : frames_) {
    if (other->pose_fixed) {
      block_difference({other, false}, other->state.pose.data(), difference.segment(pose_offset(*other), 6));
    }
    if (other->speed_bias_fixed) {
      block_difference({other, true}, other->state.speed_bias.data(), difference.segment(speed_bias_offset(*other), 9));
    }
  }
  const Eigen::VectorXd b = b_ + H_ * difference;

  Prior prior;
  std::vector<int> r;
  for (const bool speed_bias : {false, true}) {
    for (Frame* other : frames_) {
      if (other == &frame) continue;
      const int offset = speed_bias ? speed_bias_offset(*other) : pose_offset(*other);
      const int size = speed_bias ? 9 : 6;
      if (H_.diagonal().segment(offset, size).maxCoeff() <= 0) continue;
      prior.blocks.push_back({other, speed_bias});
      for (int k = 0; k < size; ++k) r.push_back(offset + k);
      bool& fixed = speed_bias ? other->speed_bias_fixed : other->pose_fixed;
      if (!fixed) {
        fixed = true;
        if (speed_bias) {
          other->first_estimate.speed_bias = other->state.speed_bias;
        } else {
          other->first_estimate.pose = other->state.pose;
        }
      }
    }
  }
  // Unit diagonals: the blocks' units differ by many orders of magnitude.
  Eigen::MatrixXd H_mm = H_(m, m), H_mr = H_(m, r), H_rr = H_(r, r);
  Eigen::VectorXd b_m = b(m), b_r = b(r);
  const Eigen::VectorXd scale_m = H_mm.diagonal().cwiseMax(1e-12).cwiseSqrt().cwiseInverse();
  const Eigen::VectorXd scale_r = H_rr.diagonal().cwiseMax(1e-12).cwiseSqrt().cwiseInverse();
  H_mm = scale_m.asDiagonal() * H_mm * scale_m.asDiagonal();
  H_mr = scale_m.asDiagonal() * H_mr * scale_r.asDiagonal();
  H_rr = scale_r.asDiagonal() * H_rr * scale_r.asDiagonal();
  b_m = scale_m.cwiseProduct(b_m);
  b_r = scale_r.cwiseProduct(b_r);

  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen_m(H_mm);
  const double floor_m = 1e-12 * eigen_m.eigenvalues().maxCoeff();
  const Eigen::VectorXd inverse_m =
      eigen_m.eigenvalues().unaryExpr([&](double x) { return x > floor_m ? 1.0 / x : 0; });
  const Eigen::MatrixXd H_rm_inv =
      H_mr.transpose() * eigen_m.eigenvectors() * inverse_m.asDiagonal() * eigen_m.eigenvectors().transpose();
  Eigen::MatrixXd H = H_rr - H_rm_inv * H_mr;
  H = 0.5 * (H + H.transpose().eval());
  const Eigen::VectorXd b_reduced = b_r - H_rm_inv * b_m;

  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(H);
  const double floor = 1e-11 * std::max(1e-300, eigen.eigenvalues().maxCoeff());
  std::vector<int> kept;
  for (int k = 0; k < eigen.eigenvalues().size(); ++k) {
    if (eigen.eigenvalues()[k] > floor) kept.push_back(k);
  }
  const Eigen::MatrixXd V = eigen.eigenvectors()(Eigen::all, kept);
  const Eigen::VectorXd root = eigen.eigenvalues()(kept).cwiseSqrt();
  prior.J = root.asDiagonal() * V.transpose() * scale_r.cwiseInverse().asDiagonal();
  prior.r0 = -(root.cwiseInverse().asDiagonal() * V.transpose() * b_reduced);
  return prior;
}

Eigen::MatrixXd NormalEquations::pose_covariance(const std::vector<int>& offsets) const {
  const Eigen::VectorXd scale = H_.diagonal().cwiseMax(1e-12).cwiseSqrt().cwiseInverse();
  const Eigen::MatrixXd scaled = scale.asDiagonal() * H_ * scale.asDiagonal();
  const Eigen::LLT<Eigen::MatrixXd> llt(scaled);
  if (llt.info() != Eigen::Success) return {};
  const auto columns = static_cast<Eigen::Index>(6 * offsets.size());
  Eigen::MatrixXd rhs = Eigen::MatrixXd::Zero(H_.rows(), columns);
  std::vector<int> rows;
  for (const int offset : offsets) {
    for (int k = 0; k < 6; ++k) {
      rhs(offset + k, static_cast<Eigen::Index>(rows.size())) = scale[offset + k];
      rows.push_back(offset + k);
    }
  }
  const Eigen::MatrixXd solution = scale.asDiagonal() * llt.solve(rhs);
  return solution(rows, Eigen::all);
}

}  // namespace orthonav::vio
