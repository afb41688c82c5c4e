#include "services/vio/initialiser.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/vio/inertial_chain.h"

namespace orthonav::vio {
namespace {

// Unknowns besides the depths: velocity, accelerometer bias, gravity.
using Vector9 = Eigen::Matrix<double, 9, 1>;
using Matrix9 = Eigen::Matrix<double, 9, 9>;

struct Track {
  Landmark* landmark = nullptr;
  std::vector<size_t> frames;  // indices of the observations' frames
  double scale = 1.0;          // 1 / expected depth: turns metres into radians
  double depth = 0;
};

// Minimises g' G g - 2 h' g on the sphere |g| = norm.
Eigen::Vector3d minimise_on_sphere(const Eigen::Matrix3d& G, const Eigen::Vector3d& h, double norm) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(G);
  const Eigen::Vector3d c = eigen.eigenvectors().transpose() * h;
  const auto at = [&](double mu) { return Eigen::Vector3d(c.array() / (eigen.eigenvalues().array() + mu)); };
  double low = -eigen.eigenvalues()[0] + 1e-9 * (eigen.eigenvalues()[2] + 1e-12);
  double high = low + c.norm() / norm + 1.0;
  while (at(high).norm() > norm) high = low + 2 * (high - low);
  for (int k = 0; k < 200; ++k) {
    const double middle = 0.5 * (low + high);
    (at(middle).norm() > norm ? low : high) = middle;
  }
  const Eigen::Vector3d g = eigen.eigenvectors() * at(high);
  return g * (norm / std::max(1e-9, g.norm()));
}

class Solver {
 public:
  Solver(const std::vector<Frame*>& frames, std::vector<Track> tracks, const Extrinsics& extrinsics, double gravity,
         double weight, double accel_bias_sigma)
      : frames_(frames),
        tracks_(std::move(tracks)),
        extrinsics_(extrinsics),
        gravity_(gravity),
        weight_(weight),
        accel_bias_sigma_(accel_bias_sigma) {}

  // Solves for velocity, gravity and depths at a gyroscope bias; returns the residuals, in standard deviations. They
  // are divided by the depth found: in metres, a scene shrunk onto the camera would always fit best.
  Eigen::VectorXd solve(const Eigen::Vector3d& gyro_bias) {
    inertial_ = inertial_chain(frames_, gyro_bias);
    Matrix9 A = Matrix9::Zero();
    Vector9 b = Vector9::Zero();
    // Until the depths are known, residuals are metres and no prior can be weighed against them: no bias then.
    const double prior = 1.0 / (depths_known_ ? accel_bias_sigma_ : 1e-9);
    A.diagonal().segment<3>(3).setConstant(prior * prior);
    rows_.clear();
    for (const Track& track : tracks_) {
      const Inertial& anchor = inertial_[track.frames[0]];
      const Eigen::Vector3d ray = anchor.R * extrinsics_.R_B_C * track.landmark->anchor().ray;
      Vector9 m_d = Vector9::Zero();
      double dd = 0, db = 0;
      for (size_t k = 1; k < track.frames.size(); ++k) {
        const Inertial& other = inertial_[track.frames[k]];
        const Eigen::Vector3d bearing =
            (other.R * extrinsics_.R_B_C * track.landmark->observations[k].ray).normalized();
        const Eigen::Matrix<double, 2, 3> N = weight_ * track.scale * across(bearing);
        Row row;
        row.M.leftCols<3>() = (anchor.t - other.t) * N;
        row.M.middleCols<3>(3) = N * (anchor.alpha_ba - other.alpha_ba);
        row.M.rightCols<3>() = 0.5 * (anchor.t * anchor.t - other.t * other.t) * N;
        row.d = N * ray;
        row.rhs = -N * (anchor.alpha - other.alpha + (anchor.R - other.R) * extrinsics_.p_B_C);
        A += row.M.transpose() * row.M;
        b += row.M.transpose() * row.rhs;
        m_d += row.M.transpose() * row.d;
        dd += row.d.squaredNorm();
        db += row.d.dot(row.rhs);
        rows_.push_back(row);
      }
      dd = std::max(dd, 1e-12);
      A -= m_d * m_d.transpose() / dd;
      b -= m_d * db / dd;
    }
    const Eigen::Matrix<double, 6, 6> A_mm = A.topLeftCorner<6, 6>();
    const Eigen::Matrix<double, 6, 3> A_mg = A.topRightCorner<6, 3>();
    const Eigen::LDLT<Eigen::Matrix<double, 6, 6>> ldlt(A_mm);
    const Eigen::Matrix3d G = A.bottomRightCorner<3, 3>() - A_mg.transpose() * ldlt.solve(A_mg);
    const Eigen::Vector3d h = b.tail<3>() - A_mg.transpose() * ldlt.solve(b.head<6>());
    g_ = minimise_on_sphere(0.5 * (G + G.transpose()), h, gravity_);
    const Eigen::Matrix<double, 6, 1> m = ldlt.solve(b.head<6>() - A_mg * g_);
    v_ = m.head<3>();
    ba_ = m.tail<3>();
    Vector9 x;
    x << m, g_;
    Eigen::VectorXd residuals(static_cast<Eigen::Index>(2 * rows_.size()));
    size_t first = 0;
    double relative_depth = 1e-9;
    for (Track& track : tracks_) {
      const size_t count = track.frames.size() - 1;
      double dd = 1e-12, db = 0;
      for (size_t k = first; k < first + count; ++k) {
        dd += rows_[k].d.squaredNorm();
        db += rows_[k].d.dot(rows_[k].rhs - rows_[k].M * x);
      }
      track.depth = db / dd;
      for (size_t k = first; k < first + count; ++k) {
        residuals.segment<2>(static_cast<Eigen::Index>(2 * k)) =
            rows_[k].M * x + rows_[k].d * track.depth - rows_[k].rhs;
      }
      relative_depth += std::abs(track.depth) * track.scale / static_cast<double>(tracks_.size());
      first += count;
    }
    return residuals / relative_depth;
  }

  // Integrates the IMU again about a bias; in between, the first-order correction does.
  void integrate_about(const Eigen::Vector3d& gyro_bias) {
    for (size_t k = 1; k < frames_.size(); ++k) frames_[k]->imu->repropagate(Eigen::Vector3d::Zero(), gyro_bias);
  }

  // Weighs each track by its depth, which makes the residuals angles, and leaves out those that do not fit.
  void reweigh(const Eigen::VectorXd& residuals) {
    std::vector<double> depths, errors;
    size_t first = 0;
    for (const Track& track : tracks_) {
      const size_t count = track.frames.size() - 1;
      const auto segment =
          residuals.segment(static_cast<Eigen::Index>(2 * first), static_cast<Eigen::Index>(2 * count));
      errors.push_back(std::sqrt(segment.squaredNorm() / static_cast<double>(count)));
      if (track.depth > 0) depths.push_back(track.depth);
      first += count;
    }
    if (depths.empty()) return;
    const double typical = median(depths), worst = 4.0 * median(errors) + 1e-9;
    std::vector<Track> kept;
    for (size_t i = 0; i < tracks_.size(); ++i) {
      if (errors[i] > worst) continue;
      kept.push_back(tracks_[i]);
      kept.back().scale = 1.0 / std::clamp(tracks_[i].depth, 0.2 * typical, 5.0 * typical);
    }
    tracks_ = std::move(kept);
    depths_known_ = true;
  }

  const std::vector<Track>& tracks() const { return tracks_; }
  const std::vector<Inertial>& inertial() const { return inertial_; }
  const Eigen::Vector3d& v() const { return v_; }
  const Eigen::Vector3d& accel_bias() const { return ba_; }
  const Eigen::Vector3d& g() const { return g_; }

 private:
  struct Row {
    Eigen::Matrix<double, 2, 9> M;
    Eigen::Vector2d d, rhs;
  };

  const std::vector<Frame*>& frames_;
  std::vector<Track> tracks_;
  const Extrinsics& extrinsics_;
  double gravity_, weight_, accel_bias_sigma_;
  bool depths_known_ = false;
  std::vector<Inertial> inertial_;
  std::vector<Row> rows_;
  Eigen::Vector3d v_ = Eigen::Vector3d::Zero(), ba_ = Eigen::Vector3d::Zero(), g_ = Eigen::Vector3d::Zero();
};

// Gauss-Newton with damping over the gyroscope bias, whose prior counts as three more residuals.
Eigen::Vector3d refine_gyro_bias(Solver& solver, const Eigen::Vector3d& start, const Eigen::Vector3d& prior,
                                 double sigma, int iterations) {
  Eigen::Vector3d bias = start;
  Eigen::VectorXd r = solver.solve(bias);
  const auto cost = [&](const Eigen::VectorXd& residuals, const Eigen::Vector3d& at) {
    return residuals.squaredNorm() + ((at - prior) / sigma).squaredNorm();
  };
  double best = cost(r, bias), damping = 1e-3;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    constexpr double kStep = 1e-5;  // rad/s
    Eigen::MatrixXd J(r.size(), 3);
    for (int axis = 0; axis < 3; ++axis) {
      Eigen::Vector3d moved = bias;
      moved[axis] += kStep;
      J.col(axis) = (solver.solve(moved) - r) / kStep;
    }
    Eigen::Matrix3d H = J.transpose() * J;
    H.diagonal().array() += 1.0 / (sigma * sigma);
    const Eigen::Vector3d gradient = J.transpose() * r + (bias - prior) / (sigma * sigma);
    bool improved = false;
    double change = 0;
    for (int attempt = 0; attempt < 5 && !improved; ++attempt) {
      Eigen::Matrix3d damped = H;
      damped.diagonal() *= 1.0 + damping;
      const Eigen::Vector3d step = -damped.ldlt().solve(gradient);
      const Eigen::VectorXd trial = solver.solve(bias + step);
      const double value = cost(trial, bias + step);
      if (value < best) {
        change = step.norm();
        bias += step;
        r = trial;
        best = value;
        damping *= 0.1;
        improved = true;
      } else {
        damping *= 10;
      }
    }
    if (!improved || change < 1e-6) break;
  }
  return bias;
}

}  // namespace

LinearStart solve_linear_start(const std::vector<Frame*>& frames, std::map<int64_t, Landmark>& landmarks,
                               const Extrinsics& extrinsics, double gravity, const Eigen::Vector3d& gyro_bias,
                               double gyro_bias_sigma, double accel_bias_sigma, double weight, double pixel_sigma) {
  LinearStart result;
  result.gyro_bias = gyro_bias;
  std::vector<Track> tracks;
  for (auto& [id, landmark] : landmarks) {
    if (landmark.observations.size() < 3) continue;
    Track track;
    track.landmark = &landmark;
    for (const Observation& observation : landmark.observations) {
      const auto at = std::find(frames.begin(), frames.end(), observation.frame);
      track.frames.push_back(static_cast<size_t>(at - frames.begin()));
    }
    tracks.push_back(std::move(track));
  }
  if (frames.size() < 4 || tracks.size() < 20) {
    result.reason = "too few features tracked";
    return result;
  }
  Solver solver(frames, std::move(tracks), extrinsics, gravity, weight, accel_bias_sigma);
  solver.integrate_about(gyro_bias);
  // Two rounds: the first with all depths taken as equal, the second with what it found.
  Eigen::Vector3d bias = refine_gyro_bias(solver, gyro_bias, gyro_bias, gyro_bias_sigma, 6);
  for (int round = 0; round < 2; ++round) {
    solver.integrate_about(bias);
    solver.reweigh(solver.solve(bias));
    if (solver.tracks().size() < 15) {
      result.reason = "the tracks do not agree";
      return result;
    }
    bias = refine_gyro_bias(solver, bias, gyro_bias, gyro_bias_sigma, 5);
  }
  const Eigen::VectorXd residuals = solver.solve(bias);
  result.gyro_bias = bias;
  result.residual = pixel_sigma * std::sqrt(2.0 * residuals.squaredNorm() / static_cast<double>(residuals.size()));
  size_t in_front = 0;
  std::vector<double> depths;
  for (const Track& track : solver.tracks()) {
    if (track.depth <= 0) continue;
    ++in_front;
    depths.push_back(track.depth);
  }
  if (5 * in_front < 4 * solver.tracks().size()) {
    result.reason = "points fall behind the camera";
    return result;
  }
  set_states(frames, solver.inertial(), solver.v(), solver.g(), solver.accel_bias(), bias);
  for (auto& [id, landmark] : landmarks) landmark.has_depth = false;
  for (const Track& track : solver.tracks()) {
    if (track.depth <= 0) continue;
    track.landmark->inverse_depth = 1.0 / track.depth;
    track.landmark->has_depth = true;
  }
  result.ok = true;
  return result;
}

}  // namespace orthonav::vio
