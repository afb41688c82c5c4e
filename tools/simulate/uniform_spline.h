// Uniform B-splines of degree 7, whose derivatives are polynomials and so exact.
//
// Degree 7 leaves a path six continuous derivatives: an attitude that follows from the second one then has a
// continuous angular acceleration, which an inertial sensor that is exact between its samples needs.
#pragma once

#include <array>
#include <cmath>
#include <stdexcept>
#include <utility>
#include <vector>

#include <Eigen/Core>

namespace orthonav::simulate {

inline constexpr int kSplineDegree = 7;

namespace detail {

inline double scalar_part(double x) {
  return x;
}
template <class Jet>
double scalar_part(const Jet& x) {
  return x.a;
}

// coefficients[k][n]: factor of u^n of the basis function whose centre lies 4 - k knots before the segment's start.
using SplineBasis = std::array<std::array<double, kSplineDegree + 1>, kSplineDegree + 1>;

// The recursion of Cox and de Boor, on the polynomials of one segment.
inline SplineBasis make_spline_basis() {
  SplineBasis basis{};
  basis[0][0] = 1.0;
  for (int degree = 1; degree <= kSplineDegree; ++degree) {
    SplineBasis next{};
    for (int k = 0; k <= degree; ++k) {
      for (int n = 0; n < degree; ++n) {
        if (k < degree) {
          next[k][n] += k * basis[k][n] / degree;
          next[k][n + 1] += basis[k][n] / degree;
        }
        if (k > 0) {
          next[k][n] += (degree + 1 - k) * basis[k - 1][n] / degree;
          next[k][n + 1] -= basis[k - 1][n] / degree;
        }
      }
    }
    basis = next;
  }
  return basis;
}

}  // namespace detail

// A curve in R^Dim. Control point j is centred at time start + j * step; the curve is defined where four control
// points lie on either side. Immutable; thread-safe.
template <int Dim>
class UniformSpline {
 public:
  using Point = Eigen::Matrix<double, Dim, 1>;

  // Control points that a curve over [begin, end] needs, and the time of the first.
  static size_t control_count(double begin, double end, double step) {
    return static_cast<size_t>(std::ceil((end - begin) / step)) + 10;
  }
  static double control_start(double begin, double step) { return begin - 4.0 * step; }

  // Throws std::invalid_argument for fewer than eight control points or a step that is not positive.
  UniformSpline(double start, double step, std::vector<Point> control)
      : start_(start), step_(step), control_(std::move(control)) {
    if (control_.size() < kSplineDegree + 1 || !(step > 0)) throw std::invalid_argument("UniformSpline: too short");
  }

  // The derivative of order 0 to 7 with respect to time. T is double, or a ceres::Jet to go one derivative further.
  // Throws std::out_of_range outside the curve.
  template <class T>
  Eigen::Matrix<T, Dim, 1> evaluate(const T& t, int derivative = 0) const {
    static const detail::SplineBasis basis = detail::make_spline_basis();
    const T x = (t - start_) / step_;
    const double segment = std::floor(detail::scalar_part(x));
    if (!(segment >= 3) || segment + 4 >= static_cast<double>(control_.size())) {
      throw std::out_of_range("UniformSpline: time outside the curve");
    }
    const auto first = static_cast<size_t>(segment) - 3;
    const T u = x - segment;
    const double scale = std::pow(step_, -derivative);
    Eigen::Matrix<T, Dim, 1> result = Eigen::Matrix<T, Dim, 1>::Constant(T(0.0));
    for (int m = 0; m <= kSplineDegree; ++m) {
      const auto& c = basis[kSplineDegree - m];
      T weight(0.0);
      for (int n = kSplineDegree; n >= derivative; --n) {
        double factor = c[n];
        for (int k = 0; k < derivative; ++k) factor *= n - k;
        weight = weight * u + factor;
      }
      const Point& point = control_[first + m];
      for (int d = 0; d < Dim; ++d) result[d] += weight * (scale * point[d]);
    }
    return result;
  }

 private:
  double start_, step_;
  std::vector<Point> control_;
};

}  // namespace orthonav::simulate
