#include "services/fusion/chain.h"

#include <Eigen/Cholesky>

namespace orthonav::fusion {

Elimination eliminate_first(const Quadratic& on_i, const PairQuadratic& pair) {
  const Eigen::LLT<StateMatrix> solver(on_i.H + pair.i.H);
  Elimination result;
  result.gain = solver.solve(pair.H_ij);
  result.offset = solver.solve(on_i.b + pair.i.b);
  result.left.H = pair.j.H;
  result.left.H.noalias() -= pair.H_ij.transpose() * result.gain;
  result.left.H = 0.5 * (result.left.H + result.left.H.transpose()).eval();
  result.left.b = pair.j.b - pair.H_ij.transpose() * result.offset;
  return result;
}

Quadratic eliminate_second(const PairQuadratic& pair, const Quadratic& on_j) {
  const PairQuadratic mirrored{pair.j, pair.i, pair.H_ij.transpose()};
  return eliminate_first(on_j, mirrored).left;
}

void Chain::truncate(int size) {
  const auto left = static_cast<size_t>(size);
  own_.resize(left);
  tie_.resize(left);
  forward_.resize(left);
}

Quadratic Chain::newest() const {
  Quadratic sum = own_.back();
  sum += forward_.back().left;
  return sum;
}

void Chain::append(const Quadratic& own, const PairQuadratic& tie) {
  if (own_.empty()) {
    forward_.emplace_back();
  } else {
    Quadratic before = own_.back();
    before += forward_.back().left;
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
  own_.front() += forward_.front().left;
  forward_.front() = Elimination();
  tie_.front() = PairQuadratic();
}

StateMatrix Chain::information(int index) const {
  Quadratic after;
  for (int k = size() - 1; k > index; --k) {
    Quadratic on_k = own_[static_cast<size_t>(k)];
    on_k += after;
    after = eliminate_second(tie_[static_cast<size_t>(k)], on_k);
  }
  const auto i = static_cast<size_t>(index);
  return own_[i].H + forward_[i].left.H + after.H;
}

std::vector<StateVector> Chain::solve() const {
  std::vector<StateVector> change(own_.size());
  if (own_.empty()) return change;
  const Quadratic last = newest();
  change.back() = -last.H.llt().solve(last.b);
  for (size_t k = own_.size() - 1; k-- > 0;) {
    change[k] = -forward_[k + 1].offset - forward_[k + 1].gain * change[k + 1];
  }
  return change;
}

}  // namespace orthonav::fusion
