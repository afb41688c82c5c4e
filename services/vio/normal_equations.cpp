#include "services/vio/normal_equations.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "services/vio/aid_factors.h"
#include "services/vio/imu_factor.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {

double huber_weight(double s, double width) {
  return s <= width * width ? 1.0 : width / std::sqrt(s);
}

NormalEquations::NormalEquations(std::vector<Frame*> frames, Shared& shared)
    : frames_(std::move(frames)), shared_(shared), extrinsics_(shared.state.extrinsics()) {
  const auto size = static_cast<Eigen::Index>(15 * frames_.size()) + (shared.camera_free ? 6 : 0) +
                    (shared.time_free ? 1 : 0) + (shared.height_free ? 1 : 0);
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

int NormalEquations::offset(const Prior::Block& block) const {
  const int shared = static_cast<int>(15 * frames_.size());
  switch (block.kind) {
    case Prior::Block::Kind::kPose:
      return pose_offset(*block.frame);
    case Prior::Block::Kind::kSpeedBias:
      return speed_bias_offset(*block.frame);
    case Prior::Block::Kind::kCamera:
      return shared;
    case Prior::Block::Kind::kTimeOffset:
      return shared + (shared_.camera_free ? 6 : 0);
    case Prior::Block::Kind::kHeightBias:
      return shared + (shared_.camera_free ? 6 : 0) + (shared_.time_free ? 1 : 0);
  }
  return 0;
}

void NormalEquations::add_imu(const Frame& i, const Frame& j, double gravity) {
  factor_.reset();
  ImuFactor::Vector15 r;
  ImuFactor::Jacobians jacobians;
  ImuFactor::evaluate(*j.imu, i.state, j.state, gravity, &r, &jacobians);
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

void NormalEquations::add_landmark(const Landmark& landmark, double weight, double robust_width) {
  factor_.reset();
  using Kind = Prior::Block::Kind;
  const Observation& anchor = landmark.anchor();
  const Frame& frame_i = *anchor.frame;
  const int at_i = pose_offset(frame_i);
  const double time_offset = shared_.state.time_offset[0];
  // The landmark's row of the system: what its depth has in common with every other block.
  struct Part {
    int at, size;
    Eigen::Matrix<double, 6, 1> w = Eigen::Matrix<double, 6, 1>::Zero();
  };
  std::vector<Part> parts{{at_i, 6}};
  const auto shared_part = [&](Kind kind, bool free) {
    if (!free) return size_t{0};
    const Prior::Block block{kind, nullptr, &shared_};
    parts.push_back({offset(block), block.size()});
    return parts.size() - 1;
  };
  const size_t camera = shared_part(Kind::kCamera, shared_.camera_free);
  const size_t time = shared_part(Kind::kTimeOffset, shared_.time_free);
  double h = 0, b = 0;
  // One row block of the landmark's residuals: its weight, its residual, and the Jacobians of parts of the system.
  const auto add_rows = [&](double w, const auto& r, const auto& J_depth, const auto&... terms) {
    const auto each = [&](auto& part, const auto& J) {
      part.w.head(J.cols()) += w * J.transpose().lazyProduct(J_depth);
      b_.segment(part.at, J.cols()) -= w * J.transpose().lazyProduct(r);
      const auto with = [&](const auto& other, const auto& K) {
        H_.block(part.at, other.at, J.cols(), K.cols()) += w * J.transpose().lazyProduct(K);
      };
      (with(parts[terms.first], terms.second), ...);
    };
    (each(parts[terms.first], terms.second), ...);
    h += w * J_depth.squaredNorm();
    b -= w * J_depth.dot(r);
  };
  for (size_t k = 1; k < landmark.observations.size(); ++k) {
    const Observation& observation = landmark.observations[k];
    const Frame& frame_j = *observation.frame;
    const Bearings bearings = bearings_of(anchor, observation);
    Eigen::Vector2d r;
    ProjectionFactor::Jacobians J;
    if (!ProjectionFactor::evaluate(bearings, time_offset, extrinsics_, weight, frame_i.state.pose.data(),
                                    frame_j.state.pose.data(), landmark.inverse_depth, &r, &J)) {
      continue;
    }
    const double w = huber_weight(r.squaredNorm(), robust_width);
    parts.push_back({pose_offset(frame_j), 6});
    const size_t j = parts.size() - 1;
    using Two6 = Eigen::Matrix<double, 2, 6>;
    const std::pair<size_t, const Two6&> term_i(0, J.pose_i), term_j(j, J.pose_j), term_camera(camera, J.camera);
    const std::pair<size_t, const Eigen::Vector2d&> term_time(time, J.time_offset);
    if (camera && time) {
      add_rows(w, r, J.inverse_depth, term_i, term_j, term_camera, term_time);
    } else if (camera) {
      add_rows(w, r, J.inverse_depth, term_i, term_j, term_camera);
    } else if (time) {
      add_rows(w, r, J.inverse_depth, term_i, term_j, term_time);
    } else {
      add_rows(w, r, J.inverse_depth, term_i, term_j);
    }
  }
  if (shared_.height_free) {
    size_t bias = 0;
    for (const Frame* frame_j : frames_) {
      if (!frame_j->height || frame_j->height_landmark != landmark.id || frame_j == &frame_i) continue;
      if (bias == 0) bias = shared_part(Kind::kHeightBias, true);
      HeightFactor::Jacobians J;
      using One = Eigen::Matrix<double, 1, 1>;
      const One r(HeightFactor::evaluate(*frame_j->height, anchor.ray, extrinsics_, frame_i.state.pose.data(),
                                         frame_j->state.pose.data(), landmark.inverse_depth,
                                         shared_.state.height_bias[0], &J));
      parts.push_back({pose_offset(*frame_j), 6});
      using Row6 = Eigen::Matrix<double, 1, 6>;
      const One J_depth(J.inverse_depth), J_bias(J.bias);
      add_rows(1.0, r, J_depth, std::pair<size_t, const Row6&>(0, J.pose_i),
               std::pair<size_t, const Row6&>(parts.size() - 1, J.pose_j), std::pair<size_t, const One&>(bias, J_bias));
    }
  }
  if (h <= 0) return;
  for (const Part& a : parts) {
    b_.segment(a.at, a.size) -= a.w.head(a.size) * (b / h);
    for (const Part& c : parts) {
      H_.block(a.at, c.at, a.size, c.size) -= a.w.head(a.size) * (c.w.head(c.size) / h).transpose();
    }
  }
}

void NormalEquations::add_prior(const Prior& prior) {
  factor_.reset();
  if (prior.empty()) return;
  const Eigen::MatrixXd JtJ = prior.J.transpose() * prior.J;
  const Eigen::VectorXd Jtr = prior.J.transpose() * prior.residual();
  int row = 0;
  for (const Prior::Block& a : prior.blocks) {
    const int to = offset(a);
    b_.segment(to, a.size()) -= Jtr.segment(row, a.size());
    int column = 0;
    for (const Prior::Block& c : prior.blocks) {
      H_.block(to, offset(c), a.size(), c.size()) += JtJ.block(row, column, a.size(), c.size());
      column += c.size();
    }
    row += a.size();
  }
}

void NormalEquations::add_cost(const ceres::CostFunction& cost, const std::vector<Prior::Block>& blocks) {
  factor_.reset();
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  const int rows = cost.num_residuals();
  Eigen::VectorXd r(rows);
  std::vector<RowMajor> J;
  std::vector<const double*> values;
  std::vector<double*> jacobians;
  for (const Prior::Block& block : blocks) J.emplace_back(rows, block.ambient_size());
  for (size_t k = 0; k < blocks.size(); ++k) {
    values.push_back(blocks[k].value());
    jacobians.push_back(J[k].data());
  }
  if (!cost.Evaluate(values.data(), r.data(), jacobians.data())) return;
  for (size_t a = 0; a < blocks.size(); ++a) {
    const auto J_a = J[a].leftCols(blocks[a].size());
    b_.segment(offset(blocks[a]), blocks[a].size()) -= J_a.transpose() * r;
    for (size_t c = 0; c < blocks.size(); ++c) {
      H_.block(offset(blocks[a]), offset(blocks[c]), blocks[a].size(), blocks[c].size()) +=
          J_a.transpose() * J[c].leftCols(blocks[c].size());
    }
  }
}

Prior NormalEquations::marginalise(const Frame& frame) const {
  const int m_pose = pose_offset(frame), m_speed = speed_bias_offset(frame);
  std::vector<int> m;
  for (int k = 0; k < 6; ++k) m.push_back(m_pose + k);
  for (int k = 0; k < 9; ++k) m.push_back(m_speed + k);

  // All blocks but those of the frame that leaves.
  using Kind = Prior::Block::Kind;
  std::vector<Prior::Block> blocks;
  for (const Kind kind : {Kind::kPose, Kind::kSpeedBias}) {
    for (Frame* other : frames_) blocks.push_back({kind, other});
  }
  if (shared_.camera_free) blocks.push_back({Kind::kCamera, nullptr, &shared_});
  if (shared_.time_free) blocks.push_back({Kind::kTimeOffset, nullptr, &shared_});
  if (shared_.height_free) blocks.push_back({Kind::kHeightBias, nullptr, &shared_});

  Prior prior;
  std::vector<int> r;
  for (Prior::Block& block : blocks) {
    if (block.frame == &frame) continue;
    const int at = offset(block);
    if (H_.diagonal().segment(at, block.size()).maxCoeff() <= 0) continue;
    block.linearise();
    prior.blocks.push_back(block);
    for (int k = 0; k < block.size(); ++k) r.push_back(at + k);
  }
  // Unit diagonals: the blocks' units differ by many orders of magnitude.
  Eigen::MatrixXd H_mm = H_(m, m), H_mr = H_(m, r), H_rr = H_(r, r);
  Eigen::VectorXd b_m = b_(m), b_r = b_(r);
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
  prior.made = prior.r0;
  return prior;
}

Eigen::MatrixXd NormalEquations::pose_covariance(const std::vector<int>& offsets) const {
  std::vector<int> rows;
  for (const int offset : offsets) {
    for (int k = 0; k < 6; ++k) rows.push_back(offset + k);
  }
  return covariance(rows);
}

const NormalEquations::Factor& NormalEquations::factor() const {
  if (!factor_) {
    factor_.emplace();
    factor_->scale = H_.diagonal().cwiseMax(1e-12).cwiseSqrt().cwiseInverse();
    factor_->llt.compute(factor_->scale.asDiagonal() * H_ * factor_->scale.asDiagonal());
  }
  return *factor_;
}

Eigen::MatrixXd NormalEquations::covariance(const std::vector<int>& rows) const {
  const auto& [scale, llt] = factor();
  if (llt.info() != Eigen::Success) return {};
  Eigen::MatrixXd rhs = Eigen::MatrixXd::Zero(H_.rows(), static_cast<Eigen::Index>(rows.size()));
  for (size_t k = 0; k < rows.size(); ++k) rhs(rows[k], static_cast<Eigen::Index>(k)) = scale[rows[k]];
  const Eigen::MatrixXd solution = scale.asDiagonal() * llt.solve(rhs);
  return solution(rows, Eigen::all);
}

}  // namespace orthonav::vio
