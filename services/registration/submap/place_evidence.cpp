#include "services/registration/submap/place_evidence.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <set>
#include <utility>

namespace orthonav::registration {
namespace {

// Places that the mean is taken over: its logarithm is known to a fifth of a nat then where likeness is as noise.
constexpr int kPlaces = 64;
// Cells of the map within which patches overlap by half and more, and so count together.
constexpr double kOverlap = 2;

// The k-th of a sequence that fills a rectangle evenly (Roberts, 2018: of the plastic number).
Eigen::Vector2d spread_evenly(int k) {
  constexpr double kFirst = 0.7548776662466927, kSecond = 0.5698402909980532;
  const double u = 0.5 + kFirst * k, v = 0.5 + kSecond * k;
  return {u - std::floor(u), v - std::floor(v)};
}

// Of each view its witnesses: the points that are the first in their cells of ground, the oldest view's first.
// `pitch`: of the map, m in W.
std::vector<std::vector<Witness>> witnesses_of(const std::vector<const View*>& views, double pitch) {
  std::vector<std::vector<Witness>> all(views.size());
  std::set<std::pair<int, int>> taken;
  std::vector<Eigen::Vector2f> cells;
  for (size_t k = views.size(); k-- > 0;) {
    for (const ViewPoint& point : views[k]->points) {
      const Eigen::Vector2d cell = point.p_W.head<2>() / pitch;
      if (!taken.emplace(static_cast<int>(std::floor(cell.x())), static_cast<int>(std::floor(cell.y()))).second)
        continue;
      all[k].push_back({&point, 1});
      cells.push_back(cell.cast<float>());
    }
  }
  size_t next = 0;
  for (size_t k = views.size(); k-- > 0;) {
    for (Witness& witness : all[k]) {
      const Eigen::Vector2f& cell = cells[next++];
      const auto overlaps = [&](const Eigen::Vector2f& other) {
        return (other - cell).squaredNorm() < static_cast<float>(kOverlap * kOverlap);
      };
      witness.weight = 1 / static_cast<float>(std::count_if(cells.begin(), cells.end(), overlaps));
    }
  }
  return all;
}

}  // namespace

PlaceEvidence::PlaceEvidence(const View& view, std::vector<Witness> witnesses, const Eigen::Matrix2d& G_W,
                             const MapIndex& index, double temperature, const EvidenceOptions& options)
    : view_(&view), witnesses_(std::move(witnesses)), index_(&index), temperature_(temperature), options_(options) {
  const Eigen::Vector2d size(index.columns() - 1, index.rows() - 1);
  std::array<double, kPlaces> all{};
  for (int k = 0; k < kPlaces; ++k) {
    const Eigen::Vector2d at = spread_evenly(k).cwiseProduct(size);
    all[static_cast<size_t>(k)] =
        likeness(index.place(static_cast<int>(std::lround(at.y())), static_cast<int>(std::lround(at.x()))), G_W);
  }
  const double most = *std::max_element(all.begin(), all.end());
  double sum = 0;
  for (const double each : all) sum += std::exp(each - most);
  anywhere_ = most + std::log(sum / kPlaces);
}

double PlaceEvidence::likeness(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W) const {
  constexpr int kSide = 3;
  std::array<float, kSide * kSide> sums{}, values{};
  std::array<int, kSide * kSide> features{}, products{};
  for (const Witness& witness : witnesses_) {
    const ViewPoint& point = *witness.point;
    const Eigen::Vector2d cell = index_->cell(en + G_W * (point.p_W - view_->keyframe.p_W_B).head<2>());
    const int row = static_cast<int>(std::lround(cell.y())), column = static_cast<int>(std::lround(cell.x()));
    for (int side = 0; side < kSide; ++side) {
      index_->features(row - 1 + side, column - 1, kSide, &features[static_cast<size_t>(side * kSide)]);
    }
    dot_products(point.descriptor.data(), index_->descriptor(0), features.data(), features.size(), products.data());
    evidence_of(products.data(), features.data(), &index_->centring(0), features.size(),
                line_of(point.background, options_), values.data());
    for (size_t k = 0; k < sums.size(); ++k) sums[k] += witness.weight * values[k];
  }
  return *std::max_element(sums.begin(), sums.end()) / temperature_;
}

double PlaceEvidence::log_likelihood_ratio(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W) const {
  return likeness(en, G_W) - anywhere_;
}

SubmapEvidence::SubmapEvidence(const std::vector<const View*>& views, const Eigen::Matrix2d& G_W, const MapIndex& index,
                               double temperature, const EvidenceOptions& options) {
  std::vector<std::vector<Witness>> witnesses = witnesses_of(views, index.pitch());
  for (size_t k = 0; k < views.size(); ++k) {
    if (witnesses[k].empty()) continue;
    const Eigen::Vector3d way = views[k]->keyframe.p_W_B - views.front()->keyframe.p_W_B;
    seen_.push_back(
        {way.head<2>(), PlaceEvidence(*views[k], std::move(witnesses[k]), G_W, index, temperature, options)});
  }
}

double SubmapEvidence::log_likelihood_ratio(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W) const {
  double sum = 0;
  for (const Seen& each : seen_) sum += each.evidence.log_likelihood_ratio(en + G_W * each.way, G_W);
  return sum;
}

}  // namespace orthonav::registration
