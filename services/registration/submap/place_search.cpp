#include "services/registration/submap/place_search.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Geometry>

#include "common/math/so3.h"
#include "services/registration/submap/dot_products.h"

namespace orthonav::registration {
namespace {

// Cells that a place may lie outside the map.
constexpr int kOutside = 8;
// Alignments compared, at most: each holds a picture of the map. Several times what a long submap of a young session
// has.
constexpr int kMostAlignments = 2000;

struct Cell {
  int row = 0, column = 0;
};

Cell cell_offset(const Eigen::Vector2d& offset, double pitch) {
  return {static_cast<int>(std::lround(-offset.y() / pitch)), static_cast<int>(std::lround(offset.x() / pitch))};
}

// Best cells of pictures of likelihoods, those within `separation` cells of a better one left out.
struct Peak {
  Cell cell;
  size_t picture = 0;
  double value = 0;
};

// The best picture at each cell.
struct BestPicture {
  std::vector<float> value;
  std::vector<int32_t> from;  // as wide as the values: the comparison is vectorised

  explicit BestPicture(size_t size) : value(size, -1), from(size, 0) {}
  void add(const std::vector<float>& picture, size_t index) {
    const auto number = static_cast<int32_t>(index);
    for (size_t i = 0; i < value.size(); ++i) {
      const bool larger = picture[i] > value[i];
      value[i] = larger ? picture[i] : value[i];
      from[i] = larger ? number : from[i];
    }
  }
};

std::vector<Peak> best_peaks(BestPicture pictures, int rows, int columns, double separation, int count) {
  std::vector<float>& best = pictures.value;
  std::vector<Peak> peaks;
  const int reach = static_cast<int>(std::ceil(separation));
  while (static_cast<int>(peaks.size()) < count) {
    const size_t at = static_cast<size_t>(std::max_element(best.begin(), best.end()) - best.begin());
    if (!(best[at] > 0)) break;
    const Cell cell{static_cast<int>(at) / columns, static_cast<int>(at) % columns};
    peaks.push_back({cell, static_cast<size_t>(pictures.from[at]), best[at]});
    for (int row = std::max(0, cell.row - reach); row <= std::min(rows - 1, cell.row + reach); ++row) {
      for (int column = std::max(0, cell.column - reach); column <= std::min(columns - 1, cell.column + reach);
           ++column) {
        if (std::hypot(row - cell.row, column - cell.column) > separation) continue;
        best[static_cast<size_t>(row) * static_cast<size_t>(columns) + static_cast<size_t>(column)] = -1;
      }
    }
  }
  return peaks;
}

// Of each cell the largest of it and its eight neighbours: keyframes of a submap may lie a cell off each other, as the
// odometry and whatever moved on the ground have it. `wide` is scratch space: large vectors cost more to get than to
// fill.
template <class Value>
void dilate(std::vector<Value>& picture, int rows, int columns, std::vector<Value>& wide) {
  const auto at = [columns](int row, int column) {
    return static_cast<size_t>(row) * static_cast<size_t>(columns) + static_cast<size_t>(column);
  };
  wide.resize(picture.size());
  const auto count = static_cast<size_t>(columns);
  for (int row = 0; row < rows; ++row) {
    const Value* in = &picture[at(row, 0)];
    Value* out = &wide[at(row, 0)];
    if (columns > 2) largest_of(in, in + 1, in + 2, count - 2, out + 1);
    out[0] = std::max(in[0], in[std::min<size_t>(1, count - 1)]);
    out[count - 1] = std::max(in[count - 1], in[count - std::min<size_t>(2, count)]);
  }
  for (int row = 0; row < rows; ++row) {
    largest_of(&wide[at(std::max(0, row - 1), 0)], &wide[at(row, 0)], &wide[at(std::min(rows - 1, row + 1), 0)], count,
               &picture[at(row, 0)]);
  }
}

// Of `all`, which refer to `yaw`, the one nearest to one that refers to another yaw. A turn moves points by as much as
// a scale of the same size.
size_t closest(const std::vector<Alignment>& all, double yaw, const Alignment& to, double its_yaw) {
  const auto distance = [&](const Alignment& one) {
    return std::hypot(wrap_angle(yaw + one.turn - its_yaw - to.turn), std::log(one.scale / to.scale));
  };
  const auto nearer = [&](const Alignment& a, const Alignment& b) { return distance(a) < distance(b); };
  return static_cast<size_t>(std::min_element(all.begin(), all.end(), nearer) - all.begin());
}

}  // namespace

EvidenceLine line_of(const Background& background, const EvidenceOptions& options) {
  return {background.product, 1 / background.stddev,
          background.mean / background.stddev + static_cast<float>(options.threshold),
          static_cast<float>(std::sqrt(options.limit))};
}

std::vector<Alignment> alignments(const Alignment& expected, double turn_stddev, double scale_stddev, double lever,
                                  double step) {
  if (!(lever > 0 && std::isfinite(lever))) return {expected};
  const auto turns_by = [&](double by) {
    return std::floor(std::min(2 * turn_stddev * lever / by + 0.5, M_PI * lever / by));
  };
  const auto scales_by = [&](double by) { return std::floor(2 * scale_stddev * lever / by + 0.5); };
  // Coarser rather than more.
  while ((2 * turns_by(step) + 1) * (2 * scales_by(step) + 1) > kMostAlignments) step *= 1.1;
  const int turns = static_cast<int>(turns_by(step));
  const int scales = static_cast<int>(scales_by(step));
  std::vector<Alignment> result{expected};
  for (int i = -turns; i <= turns; ++i) {
    for (int j = -scales; j <= scales; ++j) {
      if (i == 0 && j == 0) continue;
      result.push_back({expected.turn + i * step / lever, expected.scale * (1 + j * step / lever)});
    }
  }
  return result;
}

CoarseLikelihood coarse_likelihood(const View& view, const MapIndex& index, const std::vector<Alignment>& candidates,
                                   const SearchArea& area, const EvidenceOptions& options) {
  const double pitch = 2 * index.pitch();
  int rows[2] = {-kOutside, index.coarse_rows() + kOutside};        // NOLINT
  int columns[2] = {-kOutside, index.coarse_columns() + kOutside};  // NOLINT
  if (std::isfinite(area.radius)) {
    const Eigen::Vector2d centre = index.cell(area.centre) / 2;
    const double reach = area.radius / pitch;
    rows[0] = std::max(rows[0], static_cast<int>(std::floor(centre.y() - reach)));
    rows[1] = std::min(rows[1], static_cast<int>(std::ceil(centre.y() + reach)) + 1);
    columns[0] = std::max(columns[0], static_cast<int>(std::floor(centre.x() - reach)));
    columns[1] = std::min(columns[1], static_cast<int>(std::ceil(centre.x() + reach)) + 1);
  }
  CoarseLikelihood result;
  result.alignments = candidates;
  result.first_row = rows[0];
  result.first_column = columns[0];
  result.rows = std::max(0, rows[1] - rows[0]);
  result.columns = std::max(0, columns[1] - columns[0]);
  result.sums.assign(candidates.size(),
                     std::vector<uint16_t>(static_cast<size_t>(result.rows) * static_cast<size_t>(result.columns), 0));
  if (result.rows == 0 || result.columns == 0) return result;

  struct Points {
    const ViewPoint* point;
    std::vector<Cell> offsets;  // by alignment
    int row[2], column[2];      // NOLINT: least and largest of them
  };
  std::vector<Eigen::Matrix2d> from_W;
  for (const Alignment& candidate : candidates) from_W.push_back(candidate.from_W(view.yaw));
  std::vector<Points> points;
  for (const ViewPoint& point : view.points) {
    Points entry{&point, {}, {1 << 30, -(1 << 30)}, {1 << 30, -(1 << 30)}};
    const Eigen::Vector2d offset_W = (point.p_W - view.keyframe.p_W_B).head<2>();
    for (const Eigen::Matrix2d& rotation : from_W) {
      const Cell cell = cell_offset(rotation * offset_W, pitch);
      entry.offsets.push_back(cell);
      entry.row[0] = std::min(entry.row[0], cell.row);
      entry.row[1] = std::max(entry.row[1], cell.row);
      entry.column[0] = std::min(entry.column[0], cell.column);
      entry.column[1] = std::max(entry.column[1], cell.column);
    }
    points.push_back(std::move(entry));
  }
  const auto stride = static_cast<size_t>(index.coarse_columns());
  std::vector<uint16_t> products(stride);
  std::vector<uint8_t> weights(stride);
  // As fine as bytes, and the sums of all points in two of them, allow: bytes take a quarter of the time of floats.
  const float most = static_cast<float>(options.limit);
  const size_t most_of_each = 65535 / std::max<size_t>(257, points.size());
  const float levels = static_cast<float>(most_of_each) / most;
  result.unit = 1 / levels;
  // Row by row of the map, so that a row stays in the cache while all points pass over it.
  for (int row = 0; row < index.coarse_rows(); ++row) {
    for (const Points& entry : points) {
      if (row - entry.row[1] >= rows[1] || row - entry.row[0] < rows[0]) continue;
      const int begin = std::max(0, columns[0] + entry.column[0]);
      const int end = std::min(index.coarse_columns(), columns[1] + entry.column[1]);
      if (begin >= end) continue;
      const auto count = static_cast<size_t>(end - begin);
      coarse_products(entry.point->coarse.data(), index.coarse_row(row) + 2 * begin, stride, count, products.data());
      const EvidenceLine line = line_of(entry.point->coarse_background, options);
      evidence_of(products.data(), index.coarse_scales(row) + begin, index.coarse_offsets(row) + begin, count, line,
                  levels, weights.data());
      for (size_t h = 0; h < candidates.size(); ++h) {
        const int place_row = row - entry.offsets[h].row - rows[0];
        if (place_row < 0 || place_row >= result.rows) continue;
        // Columns of the map that fall into the picture with this alignment.
        const int first = std::max(begin, columns[0] + entry.offsets[h].column);
        const int last = std::min(end, columns[1] + entry.offsets[h].column);
        if (first >= last) continue;
        add(&weights[static_cast<size_t>(first - begin)], static_cast<size_t>(last - first),
            &result.sums[h][static_cast<size_t>(place_row) * static_cast<size_t>(result.columns) +
                            static_cast<size_t>(first - entry.offsets[h].column - columns[0])]);
      }
    }
  }
  std::vector<uint16_t> scratch;
  for (std::vector<uint16_t>& picture : result.sums) dilate(picture, result.rows, result.columns, scratch);
  return result;
}

std::vector<PlaceCandidate> best_coarse_places(const std::vector<ShiftedLikelihood>& keyframes, const MapIndex& index,
                                               const std::vector<Alignment>& candidates, double separation, int count) {
  if (keyframes.empty()) return {};
  const double pitch = 2 * index.pitch();
  const double yaw = keyframes.front().yaw;
  const CoarseLikelihood& newest = *keyframes.front().likelihood;
  BestPicture best(static_cast<size_t>(newest.rows) * static_cast<size_t>(newest.columns));
  std::vector<float> sum;
  for (size_t h = 0; h < candidates.size(); ++h) {
    sum.assign(best.value.size(), 0.0F);
    for (const ShiftedLikelihood& keyframe : keyframes) {
      const CoarseLikelihood& other = *keyframe.likelihood;
      const std::vector<uint16_t>& picture = other.sums[closest(other.alignments, keyframe.yaw, candidates[h], yaw)];
      // Where that keyframe's body was, seen from the newest.
      const Cell shift =
          cell_offset(candidates[h].from_W(yaw) * (keyframe.p_W_B - keyframes.front().p_W_B).head<2>(), pitch);
      for (int row = 0; row < newest.rows; ++row) {
        const int from = row + newest.first_row + shift.row - other.first_row;
        if (from < 0 || from >= other.rows) continue;
        const int move = newest.first_column + shift.column - other.first_column;
        const int first = std::max(0, -move);
        const int last = std::min(newest.columns, other.columns - move);
        if (first >= last) continue;
        add(&picture[static_cast<size_t>(from) * static_cast<size_t>(other.columns) +
                     static_cast<size_t>(first + move)],
            other.unit, static_cast<size_t>(last - first),
            &sum[static_cast<size_t>(row) * static_cast<size_t>(newest.columns) + static_cast<size_t>(first)]);
      }
    }
    best.add(sum, h);
  }
  std::vector<PlaceCandidate> places;
  // Keyframes may lie a cell off each other: one place fills three cells each way, whatever their size.
  constexpr double kOnePlace = 2.5;
  const double apart = std::max(kOnePlace, separation / pitch);
  for (const Peak& peak : best_peaks(std::move(best), newest.rows, newest.columns, apart, count)) {
    const Eigen::Vector2d en =
        index.place(2 * (peak.cell.row + newest.first_row), 2 * (peak.cell.column + newest.first_column));
    places.push_back({en, peak.picture, peak.value});
  }
  return places;
}

namespace {

// Likelihood at full resolution of the places around one, a picture for each alignment.
struct FineLikelihood {
  int reach = 0, side = 0;               // cells
  std::vector<std::vector<float>> sums;  // side x side each
};

// With `give`, each keyframe may lie a cell off.
FineLikelihood fine_likelihood(const std::vector<const View*>& views, const MapIndex& index,
                               const std::vector<Alignment>& candidates, const Eigen::Vector2d& centre, double radius,
                               bool give, const EvidenceOptions& options) {
  FineLikelihood result;
  result.reach = static_cast<int>(std::ceil(radius / index.pitch()));
  result.side = 2 * result.reach + 1;
  const int reach = result.reach, side = result.side;
  std::vector<std::vector<float>>& sums = result.sums;
  sums.assign(candidates.size(), std::vector<float>(static_cast<size_t>(side) * static_cast<size_t>(side), 0.0F));
  std::vector<std::vector<float>> own;
  std::vector<Eigen::Matrix2d> from_W;
  for (const Alignment& candidate : candidates) from_W.push_back(candidate.from_W(views.front()->yaw));
  // Of each point, the features that any alignment and place puts it on are compared once.
  std::vector<Cell> first(candidates.size());
  std::vector<int> features, products;
  std::vector<float> values, scratch;
  for (const View* view : views) {
    own.assign(candidates.size(), std::vector<float>(sums.front().size(), 0.0F));
    for (const ViewPoint& point : view->points) {
      Cell low{1 << 30, 1 << 30}, high{-(1 << 30), -(1 << 30)};
      const Eigen::Vector2d offset_W = (point.p_W - views.front()->keyframe.p_W_B).head<2>();
      for (size_t h = 0; h < candidates.size(); ++h) {
        const Eigen::Vector2d cell = index.cell(centre + from_W[h] * offset_W);
        first[h] = {static_cast<int>(std::lround(cell.y())) - reach, static_cast<int>(std::lround(cell.x())) - reach};
        low = {std::min(low.row, first[h].row), std::min(low.column, first[h].column)};
        high = {std::max(high.row, first[h].row + side), std::max(high.column, first[h].column + side)};
      }
      const int width = high.column - low.column;
      features.resize(static_cast<size_t>(width) * static_cast<size_t>(high.row - low.row));
      for (int row = low.row; row < high.row; ++row) {
        index.features(row, low.column, width,
                       &features[static_cast<size_t>(row - low.row) * static_cast<size_t>(width)]);
      }
      products.resize(features.size());
      values.resize(features.size());
      dot_products(point.descriptor.data(), index.descriptor(0), features.data(), features.size(), products.data());
      evidence_of(products.data(), features.data(), &index.centring(0), features.size(),
                  line_of(point.background, options), values.data());
      for (size_t h = 0; h < candidates.size(); ++h) {
        for (int i = 0; i < side; ++i) {
          const int from = (first[h].row + i - low.row) * width + first[h].column - low.column;
          add(&values[static_cast<size_t>(from)], static_cast<size_t>(side), &own[h][static_cast<size_t>(i * side)]);
        }
      }
    }
    for (size_t h = 0; h < candidates.size(); ++h) {
      if (give) dilate(own[h], side, side, scratch);
      add(own[h].data(), own[h].size(), sums[h].data());
    }
  }
  return result;
}

}  // namespace

std::vector<PlaceCandidate> best_fine_places(const std::vector<const View*>& views, const MapIndex& index,
                                             const std::vector<Alignment>& candidates, const Eigen::Vector2d& centre,
                                             double radius, double separation, int count,
                                             const EvidenceOptions& options) {
  const FineLikelihood pictures = fine_likelihood(views, index, candidates, centre, radius, true, options);
  const int reach = pictures.reach, side = pictures.side;
  BestPicture best(pictures.sums.front().size());
  for (size_t h = 0; h < candidates.size(); ++h) best.add(pictures.sums[h], h);
  std::vector<PlaceCandidate> places;
  for (const Peak& peak : best_peaks(std::move(best), side, side, separation / index.pitch(), count)) {
    const Eigen::Vector2d shift(peak.cell.column - reach, reach - peak.cell.row);
    places.push_back({centre + index.pitch() * shift, peak.picture, peak.value});
  }
  return places;
}

Eigen::Vector2d likeliest_place(const std::vector<const View*>& views, const MapIndex& index,
                                const Alignment& alignment, const Eigen::Vector2d& centre, double radius,
                                const EvidenceOptions& options) {
  const FineLikelihood picture = fine_likelihood(views, index, {alignment}, centre, radius, false, options);
  const std::vector<float>& sums = picture.sums.front();
  const int at = static_cast<int>(std::max_element(sums.begin(), sums.end()) - sums.begin());
  return centre + index.pitch() * Eigen::Vector2d(at % picture.side - picture.reach, picture.reach - at / picture.side);
}

std::optional<Eigen::Vector2d> peak_near(const std::vector<const View*>& views, const MapIndex& index,
                                         const Alignment& alignment, const Eigen::Vector2d& centre, double radius,
                                         const EvidenceOptions& options) {
  // A cell more on each side, to tell a peak from a slope.
  const FineLikelihood picture =
      fine_likelihood(views, index, {alignment}, centre, radius + index.pitch(), false, options);
  const std::vector<float>& sums = picture.sums.front();
  const int side = picture.side;
  const int at = static_cast<int>(std::max_element(sums.begin(), sums.end()) - sums.begin());
  const int row = at / side, column = at % side;
  if (row == 0 || column == 0 || row == side - 1 || column == side - 1) return std::nullopt;
  // Between the cells by the parabola through the peak and its neighbours.
  const auto between = [&](int step) {
    const double before = sums[static_cast<size_t>(at - step)], after = sums[static_cast<size_t>(at + step)];
    const double curvature = before - 2.0 * sums[static_cast<size_t>(at)] + after;
    return curvature < 0 ? 0.5 * (before - after) / curvature : 0.0;
  };
  return centre +
         index.pitch() * Eigen::Vector2d(column + between(1) - picture.reach, picture.reach - row - between(side));
}

}  // namespace orthonav::registration
