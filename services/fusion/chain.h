// Marginals of a chain of Gaussian factors by block elimination.
//
// A pose graph whose factors touch one node or two neighbours has a block-tridiagonal Hessian. One sweep from each
// end gives every node's marginal in time linear in the number of nodes; the forward sweep alone gives the newest
// node's and the prior that replaces the oldest nodes. Exact for the given linearisation.
#pragma once

#include <deque>

#include "services/fusion/node_state.h"

namespace orthonav::fusion {

// 1/2 d^T H d + b^T d over one node's tangent.
struct Quadratic {
  TangentMatrix H = TangentMatrix::Zero();
  Tangent b = Tangent::Zero();

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
  TangentMatrix H_ij = TangentMatrix::Zero();
};

// Eliminates i, whose other terms are `on_i`: what is left about j.
Quadratic eliminate_first(const Quadratic& on_i, const PairQuadratic& pair);
// Eliminates j, whose other terms are `on_j`: what is left about i.
Quadratic eliminate_second(const PairQuadratic& pair, const Quadratic& on_j);

class Chain {
 public:
  // Forgets everything.
  void clear();
  // Appends a node with its own terms and, from the second node on, the terms that tie it to the one before.
  void append(const Quadratic& own, const PairQuadratic& tie = {});

  // Forgets the oldest node; what it knew stays as terms of the next one's own.
  void drop_oldest();

  int size() const { return static_cast<int>(own_.size()); }
  // Marginal information of node `index`. Linear in the distance to the newest node.
  TangentMatrix information(int index) const;

 private:
  std::deque<Quadratic> own_;
  std::deque<PairQuadratic> tie_;  // tie_[k] ties k - 1 and k
  std::deque<Quadratic> forward_;
};

}  // namespace orthonav::fusion
