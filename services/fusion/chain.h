// Least squares over a chain of nodes by block elimination.
//
// A graph whose terms touch one node or two neighbours has a block-tridiagonal Hessian. One sweep from the oldest
// node to the newest and one back solve it in time linear in the number of nodes; the forward sweep alone gives the
// newest node's marginal and the prior that replaces the oldest nodes. Exact for the given linearisation.
//
// Instead of Ceres: a sparse solver spends most of its time in finding out what is known here, that the graph is a
// chain (200 nodes: 1.0 ms a step here), and its order of summation depends on addresses unless told otherwise.
#pragma once

#include <deque>
#include <vector>

#include "services/fusion/node_state.h"

namespace orthonav::fusion {

// 1/2 d^T H d + b^T d over one node.
struct Quadratic {
  StateMatrix H = StateMatrix::Zero();
  StateVector b = StateVector::Zero();

  Quadratic& operator+=(const Quadratic& other) {
    H += other.H;
    b += other.b;
    return *this;
  }
};

// The same over two neighbours i and j.
struct PairQuadratic {
  Quadratic i;
  Quadratic j;
  StateMatrix H_ij = StateMatrix::Zero();
};

// What is left about j when i, whose other terms are `on_i`, is eliminated; i's best change is then
// -offset - gain * d_j.
struct Elimination {
  Quadratic left;
  StateMatrix gain = StateMatrix::Zero();
  StateVector offset = StateVector::Zero();
};
Elimination eliminate_first(const Quadratic& on_i, const PairQuadratic& pair);
// Eliminates j, whose other terms are `on_j`: what is left about i.
Quadratic eliminate_second(const PairQuadratic& pair, const Quadratic& on_j);

class Chain {
 public:
  // Forgets the newest nodes, so that `size` are left.
  void truncate(int size);
  // Appends a node with its own terms and, from the second node on, the terms that tie it to the one before.
  void append(const Quadratic& own, const PairQuadratic& tie = {});
  // All that is known about the newest node.
  Quadratic newest() const;

  // Forgets the oldest node; what it knew stays as terms of the next one's own.
  void drop_oldest();

  int size() const { return static_cast<int>(own_.size()); }
  // All that the nodes before `index` know about it.
  const Quadratic& forward(int index) const { return forward_[static_cast<size_t>(index)].left; }
  // Marginal information of a node. Linear in the distance to the newest node.
  StateMatrix information(int index) const;
  // The change of every node that minimises the sum of all terms.
  std::vector<StateVector> solve() const;

 private:
  std::deque<Quadratic> own_;
  std::deque<PairQuadratic> tie_;    // tie_[k] ties k - 1 and k
  std::deque<Elimination> forward_;  // forward_[k]: of node k - 1
};

}  // namespace orthonav::fusion
