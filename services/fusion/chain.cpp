#include "services/fusion/chain.h"

#include <Eigen/Cholesky>

namespace orthonav::fusion {
namespace {

Quadratic schur(const TangentMatrix& H_kept, const Tangent& b_kept, const TangentMatrix& H_cross,
                const TangentMatrix& H_gone, const Tangent& b_gone) {
  const Eigen::LDLT<TangentMatrix> solver(H_gone);
  Quadratic left;
  left.H = H_kept - H_cross * solver.solve(H_cross.transpose());
  left.H = 0.5 * (left.H + left.H.transpose()).eval();
  left.b = b_kept - H_cross * solver.solve(b_gone);
  return left;
}

}  // namespace

Quadratic eliminate_first(const Quadratic& on_i, const PairQuadratic& pair) {
  return schur(pair.j.H, pair.j.b, pair.H_ij.transpose(), on_i.H + pair.i.H, on_i.b + pair.i.b);
}

Quadratic eliminate_second(const PairQuadratic& pair, const Quadratic& on_j) {
  return schur(pair.i.H, pair.i.b, pair.H_ij, on_j.H + pair.j.H, on_j.b + pair.j.b);
}

void Chain::clear() {
  own_.clear();
  tie_.clear();
  forward_.clear();
}

void Chain::append(const Quadratic& own, const PairQuadratic& tie) {
  if (own_.empty()) {
    forward_.emplace_back();
  } else {
    Quadratic before = own_.back();
    before += forward_.back();
    forward_.push_back(eliminate_first(before, tie));
  }
  own_.push_back(own);
  tie_.push_back(tie);
}

void Chain::drop_oldest() {
  own_.pop_front();
  tie_.pop_front();
  forward_.pop_front();
  if (own_.empty()) return;
  own_.front() += forward_.front();
  forward_.front() = Quadratic();
  tie_.front() = PairQuadratic();
}

TangentMatrix Chain::information(int index) const {
  Quadratic after;
  for (int k = size() - 1; k > index; --k) {
    Quadratic on_k = own_[static_cast<size_t>(k)];
    on_k += after;
    after = eliminate_second(tie_[static_cast<size_t>(k)], on_k);
  }
  const auto i = static_cast<size_t>(index);
  return own_[i].H + forward_[i].H + after.H;
}

}  // namespace orthonav::fusion
