// A motion as samples of it.
#pragma once

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

namespace orthonav::simulate {

// Linear between samples kStep apart, the first at 0. Before the first and after the last it goes on as there.
template <class T>
class SampledMotion {
 public:
  static constexpr double kStep = 0.02;  // s

  explicit SampledMotion(std::vector<T> samples) : samples_(std::move(samples)) {}

  T at(double t) const {
    const double x = t / kStep;
    const auto i = static_cast<size_t>(std::clamp(std::floor(x), 0.0, static_cast<double>(samples_.size()) - 2.0));
    return samples_[i] + (x - static_cast<double>(i)) * (samples_[i + 1] - samples_[i]);
  }

 private:
  std::vector<T> samples_;
};

}  // namespace orthonav::simulate
