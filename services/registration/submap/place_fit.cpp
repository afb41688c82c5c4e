#include "services/registration/submap/place_fit.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include <Eigen/Cholesky>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/registration/submap/dot_products.h"
#include "services/registration/submap/ground_slope.h"

namespace orthonav::registration {
namespace {

// A residual is never believed to be better than this, m.
constexpr double kMinResidual = 0.05;
// Weight below which a match is no inlier.
constexpr double kInlierWeight = 0.1;
constexpr double kConverged = 1e-3;  // m: steps that move no point by more are the last
// Matches are sought anew where the fit has come to, until it moves no point by more, m, or so many times.
constexpr double kSettled = 1;
constexpr int kMostRounds = 4;
// So much as to be free: what the matches say of the scale is in its prior.
constexpr double kAnyStretch = 0.3;

// Geman-McClure: falls to 0 for residuals well beyond `width`.
double robust_weight(double squared, double width) {
  const double part = 1 / (1 + squared / (width * width));
  return part * part;
}

const ViewPoint& point_of(const std::vector<const View*>& views, const PlacedPoint& placed) {
  return views[static_cast<size_t>(placed.view)]->points[static_cast<size_t>(placed.point)];
}

// Horizontal offset in W of a point from the newest body.
Eigen::Vector2d offset_of(const std::vector<const View*>& views, const ViewPoint& point) {
  return (point.p_W - views.front()->keyframe.p_W_B).head<2>();
}

// The best-looking map feature within `reach` cells of where the fit puts each point.
std::vector<PlacedPoint> associate(const std::vector<const View*>& views, const MapIndex& index, const PlaceFit& fit,
                                   double reach, double min_excess) {
  std::vector<PlacedPoint> matches;
  const int cells = static_cast<int>(std::ceil(reach));
  const Eigen::Matrix2d from_W = fit.alignment.from_W(views.front()->yaw);
  std::vector<int> features, products;  // of the cells within reach
  for (size_t k = 0; k < views.size(); ++k) {
    for (size_t i = 0; i < views[k]->points.size(); ++i) {
      const ViewPoint& point = views[k]->points[i];
      const Eigen::Vector2d cell = index.cell(fit.en + from_W * offset_of(views, point));
      const int row = static_cast<int>(std::lround(cell.y()));
      const int column = static_cast<int>(std::lround(cell.x()));
      features.clear();
      for (int v = row - cells; v <= row + cells; ++v) {
        for (int u = column - cells; u <= column + cells; ++u) {
          const int feature = index.feature(v, u);
          if (feature < 0 || (Eigen::Vector2d(u, v) - cell).squaredNorm() > reach * reach) continue;
          features.push_back(feature);
        }
      }
      products.resize(features.size());
      dot_products(point.descriptor.data(), index.descriptor(0), features.data(), features.size(), products.data());
      PlacedPoint best;
      double most = min_excess;
      for (size_t candidate = 0; candidate < features.size(); ++candidate) {
        const double excess =
            point.background.excess(static_cast<float>(products[candidate]), index.centring(features[candidate]));
        if (excess <= most) continue;
        most = excess;
        best.feature = features[candidate];
      }
      if (best.feature < 0) continue;
      best.view = static_cast<int>(k);
      best.point = static_cast<int>(i);
      best.en = index.position(best.feature).head<2>().cast<double>();
      best.ground = index.position(best.feature).z();
      matches.push_back(best);
    }
  }
  return matches;
}

double stretch_stddev(const std::vector<const View*>& views, const FitOptions& options) {
  return options.lean / views.front()->keyframe.height_above_ground;
}

// What the fit leaves of each point, and what it counts for that.
void weigh(const std::vector<const View*>& views, double width, PlaceFit& fit) {
  const Eigen::Matrix2d from_W = fit.alignment.from_W(views.front()->yaw);
  for (PlacedPoint& placed : fit.points) {
    placed.residual = fit.en + from_W * offset_of(views, point_of(views, placed)) - placed.en;
    placed.weight = robust_weight(placed.residual.squaredNorm(), width);
  }
}

// Robust least squares of place, turn and log scale, the residuals' width shrinking from `first` to `last` m.
void solve(const std::vector<const View*>& views, double first, double last, const FitOptions& options,
           const FitPrior& prior, PlaceFit& fit) {
  constexpr int kIterations = 12;
  std::vector<Eigen::Vector2d> offsets;
  offsets.reserve(fit.points.size());
  for (const PlacedPoint& placed : fit.points) offsets.push_back(offset_of(views, point_of(views, placed)));
  Eigen::Matrix4d information = Eigen::Matrix4d::Identity();
  double scale_information = 0;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    const double width = std::max(last, first * std::pow(0.75, iteration));
    // The residual's derivatives by place, turn and log scale are the identity, the lever turned by 90 degrees and the
    // lever: of the normal equations these are the sums that differ.
    Eigen::Vector2d levers = Eigen::Vector2d::Zero(), residuals = Eigen::Vector2d::Zero();
    double squared_levers = 0, turning = 0, stretching = 0, weights = 0, sum = 0;
    const Eigen::Matrix2d from_W = fit.alignment.from_W(views.front()->yaw);
    for (size_t i = 0; i < offsets.size(); ++i) {
      PlacedPoint& placed = fit.points[i];
      const Eigen::Vector2d lever = from_W * offsets[i];
      placed.residual = fit.en + lever - placed.en;
      placed.weight = robust_weight(placed.residual.squaredNorm(), width);
      const Eigen::Vector2d weighted = placed.weight * placed.residual;
      levers += placed.weight * lever;
      squared_levers += placed.weight * lever.squaredNorm();
      residuals += weighted;
      turning += lever.x() * weighted.y() - lever.y() * weighted.x();
      stretching += lever.dot(weighted);
      weights += placed.weight;
      sum += weighted.dot(placed.residual);
    }
    information << weights, 0, -levers.y(), levers.x(),  //
        0, weights, levers.x(), levers.y(),              //
        -levers.y(), levers.x(), squared_levers, 0,      //
        levers.x(), levers.y(), 0, squared_levers;
    Eigen::Vector4d gradient(residuals.x(), residuals.y(), turning, stretching);
    // Variance of a match per axis; matches that err together count less.
    const double variance = std::max(kMinResidual * kMinResidual, 0.5 * sum / std::max(1.0, weights));
    const double trust = 1 / (variance * options.matches_per_observation * static_cast<double>(views.size()));
    information *= trust;
    gradient *= trust;
    const double turn_information = 1 / (prior.heading_stddev * prior.heading_stddev);
    const double stretched = std::log(fit.alignment.scale / prior.alignment.scale);
    // Of the odometry, which may be wrong by what the matches say, and the stretch.
    scale_information = 1 / (prior.scale_stddev * prior.scale_stddev + 0.5 * stretched * stretched +
                             std::pow(stretch_stddev(views, options), 2));
    information(2, 2) += turn_information;
    gradient(2) += turn_information * (fit.alignment.turn - prior.alignment.turn);
    information(3, 3) += scale_information;
    gradient(3) += scale_information * stretched;
    information.topLeftCorner<2, 2>() += 1e-9 * Eigen::Matrix2d::Identity();
    const Eigen::Vector4d step = information.ldlt().solve(-gradient);
    if (!step.allFinite()) return;
    fit.en += step.head<2>();
    fit.alignment.turn += step(2);
    fit.alignment.scale *= std::exp(step(3));
    fit.inliers = weights;
    fit.rms = std::sqrt(sum / std::max(1e-9, weights));
    const double moved = std::abs(step(2)) + std::abs(step(3));
    if (width == last && step.head<2>().norm() + moved * std::sqrt(squared_levers / weights) < kConverged) break;
  }
  const Eigen::Matrix4d covariance = information.inverse();
  fit.turn_stddev = std::sqrt(covariance(2, 2));
  // Less what was known beforehand.
  const double all = 1 / covariance(3, 3), of_matches = std::max(1e-6, all - scale_information);
  const double log_scale = std::log(fit.alignment.scale);
  fit.scale.log_scale = log_scale + (all / of_matches - 1) * (log_scale - std::log(prior.alignment.scale));
  fit.scale.stddev = std::hypot(1 / std::sqrt(of_matches), stretch_stddev(views, options));
  fit.ok = covariance.allFinite() && fit.inliers > 0;
}

constexpr float kClose = 1.75F;    // map pixels: a smaller move needs no second look
constexpr float kFurthest = 3.5F;  // map pixels: a peak further from the start is another one

// Where the point's descriptor, shifted in its own image, looks most like the feature.
std::optional<Eigen::Vector2f> find_peak(const View& view, const ViewPoint& point, const uint8_t* feature,
                                         const Eigen::Vector2f& start) {
  constexpr float kStep = 2.5F;  // map pixels
  std::array<uint8_t, kSiftBytes> descriptor{};
  const auto similarity = [&](const Eigen::Vector2f& at) {
    view.field->describe(point.pixel + point.jacobian * at, point.jacobian, descriptor.data());
    return static_cast<float>(dot_product(descriptor.data(), feature));
  };
  Eigen::Vector2f shift = start;
  for (int iteration = 0; iteration < 2; ++iteration) {
    const float centre = similarity(shift);
    Eigen::Vector2f move;
    for (int axis = 0; axis < 2; ++axis) {
      const Eigen::Vector2f step = kStep * Eigen::Vector2f::Unit(axis);
      const float before = similarity(shift - step);
      const float after = similarity(shift + step);
      const float curvature = before - 2 * centre + after;
      if (!(curvature < 0)) return std::nullopt;
      move(axis) = std::clamp(0.5F * (before - after) / curvature, -1.0F, 1.0F) * kStep;
    }
    shift += move;
    if (move.norm() < kClose) break;
  }
  if ((shift - start).norm() >= kFurthest) return std::nullopt;
  return shift;
}

// The same, unless it was done before.
std::optional<Eigen::Vector2f> align(const View& view, const ViewPoint& point, const MapIndex& index, int feature,
                                     const Eigen::Vector2f& start) {
  for (const AlignedFeature& known : point.aligned) {
    if (known.feature != feature) continue;
    if (known.peak ? (*known.peak - start).norm() < kFurthest : (known.start - start).norm() < kClose) {
      return known.peak;
    }
  }
  point.aligned.push_back({feature, start, find_peak(view, point, index.descriptor(feature), start)});
  return point.aligned.back().peak;
}

// Puts matches between the map's features: aligned to the feature nearest to where the fit puts the point.
void align_points(const std::vector<const View*>& views, const MapIndex& index, double metres_per_pixel,
                  PlaceFit& fit) {
  const Eigen::Vector2d flip(1, -1);  // north to south and back
  std::vector<PlacedPoint> aligned;
  for (PlacedPoint placed : fit.points) {
    if (placed.weight < kInlierWeight) continue;
    const View& view = *views[static_cast<size_t>(placed.view)];
    const ViewPoint& point = point_of(views, placed);
    const Eigen::Vector2d expected = placed.en + placed.residual;
    const Eigen::Vector2d cell = index.cell(expected);
    const int feature = index.feature(static_cast<int>(std::lround(cell.y())), static_cast<int>(std::lround(cell.x())));
    if (feature < 0) continue;
    const Eigen::Vector2d en = index.position(feature).head<2>().cast<double>();
    const Eigen::Vector2d offset = (en - expected) / metres_per_pixel;
    const auto shift = align(view, point, index, feature, offset.cwiseProduct(flip).cast<float>());
    if (!shift) continue;
    placed.en = en - metres_per_pixel * shift->cast<double>().cwiseProduct(flip);
    placed.ground = index.position(feature).z();
    aligned.push_back(placed);
  }
  fit.points = std::move(aligned);
}

}  // namespace

PlaceFit fit_place(const std::vector<const View*>& views, const MapIndex& index, double metres_per_pixel,
                   const Eigen::Vector2d& place, const Alignment& alignment, const FitPrior& prior,
                   const FitOptions& options) {
  PlaceFit fit;
  fit.en = place;
  fit.alignment = alignment;
  fit.points = associate(views, index, fit, 2.5, options.min_excess);
  solve(views, 2 * index.pitch(), index.pitch(), options, prior, fit);
  if (!fit.ok) return fit;
  fit.points = associate(views, index, fit, 1.5, options.min_excess);
  solve(views, index.pitch(), 0.7 * index.pitch(), options, prior, fit);
  const double lever = spread_of({views.front()});
  for (int round = 0; fit.ok && round < kMostRounds; ++round) {
    const Eigen::Vector2d en = fit.en;
    const Alignment before = fit.alignment;
    if (round > 0) {
      // Of all points: those that were left out for lying elsewhere under the fit before, too.
      fit.points = associate(views, index, fit, 1.5, options.min_excess);
      weigh(views, 0.7 * index.pitch(), fit);
    }
    align_points(views, index, metres_per_pixel, fit);
    solve(views, index.pitch(), 0.4 * index.pitch(), options, prior, fit);
    const double turned = std::abs(fit.alignment.turn - before.turn);
    const double stretched = std::abs(std::log(fit.alignment.scale / before.scale));
    if ((fit.en - en).norm() + lever * (turned + stretched) < kSettled) break;
  }
  return fit;
}

FittedPose fit_pose(const std::vector<const View*>& views, const PlaceFit& fit, const FitPrior& prior,
                    const ScaleBelief& scale_before, const FitOptions& options, GroundLevel& ground) {
  FittedPose result;
  std::vector<const PlacedPoint*> inliers;
  for (const PlacedPoint& placed : fit.points) {
    if (placed.weight >= kInlierWeight) inliers.push_back(&placed);
  }
  if (inliers.size() < 6) return result;
  const View& newest = *views.front();
  const Keyframe& keyframe = newest.keyframe;

  // Heights: the odometry's points, scaled, lie on the map's ground or above it.
  const double scaled = std::exp(scale_before.log_scale);
  std::vector<double> lifts;
  lifts.reserve(inliers.size());
  for (const PlacedPoint* placed : inliers) {
    lifts.push_back(placed->ground - scaled * (point_of(views, *placed).p_W.z() - keyframe.p_W_B.z()));
  }
  ground.add(lifts, keyframe.height_above_ground, keyframe.p_W_B,
             options.matches_per_observation * static_cast<double>(views.size()), scale_before);
  const double level = ground.level();
  std::vector<Eigen::Vector3d> offsets;  // in W, from the body
  std::vector<double> rises;             // above the level
  std::vector<GroundLevel::Above> above;
  Eigen::Vector3d mean_offset = Eigen::Vector3d::Zero();
  for (size_t i = 0; i < inliers.size(); ++i) {
    offsets.push_back(point_of(views, *inliers[i]).p_W - keyframe.p_W_B);
    rises.push_back(level - lifts[i]);
    above.push_back(GroundLevel::above(rises[i], keyframe.height_above_ground));
    mean_offset += offsets[i] / static_cast<double>(inliers.size());
  }
  const double mean_drop = -mean_offset.z();  // of the points below the body, by the odometry

  // Of each view, the camera as the odometry has it. Views differ in the yaw assumed only as far as the compass does;
  // the newest's counts for all.
  struct Camera {
    Eigen::Matrix3d R_C_W, R_C_G;
    Eigen::Vector3d arm_C;  // from the newest body, before scale
  };
  std::vector<Camera> cameras;
  for (const View* view : views) {
    const Keyframe& own = view->keyframe;
    const Eigen::Matrix3d R_W_B = own.q_W_B.toRotationMatrix();
    const Eigen::Matrix3d R_C_W = (R_W_B * own.extrinsics.R_B_C).transpose();
    cameras.push_back({R_C_W, R_C_W, R_C_W * (own.p_W_B + R_W_B * own.extrinsics.p_B_C - keyframe.p_W_B)});
  }

  // Unknowns: position of the newest body, a turn of all the odometry's frame about G's z, log of the scale, and by how
  // much the map shows all that is in view stretched about the newest body. The vertical is the odometry's.
  Eigen::Vector3d p_G_B(fit.en.x(), fit.en.y(), level);
  double turn = newest.yaw + fit.alignment.turn;
  double log_scale = scale_before.log_scale;
  double stretch = std::log(fit.alignment.scale) - log_scale;
  using Row = Eigen::Matrix<double, 6, 1>;
  using Matrix6d = Eigen::Matrix<double, 6, 6>;
  Matrix6d information, of_matches, of_ground;
  Eigen::Matrix<double, 6, 2> with_tilt;  // of the information: what another vertical would do
  const double width = std::max(0.5, 2 * fit.rms);
  for (int iteration = 0; iteration < 6; ++iteration) {
    information.setZero();
    with_tilt.setZero();
    Row gradient = Row::Zero();
    double weights = 0, sum = 0;
    const double scale = std::exp(log_scale);
    const Eigen::Matrix3d R_G_W = Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()).matrix();
    for (Camera& camera : cameras) camera.R_C_G = camera.R_C_W * R_G_W.transpose();
    for (size_t i = 0; i < inliers.size(); ++i) {
      const Camera& camera = cameras[static_cast<size_t>(inliers[i]->view)];
      const Eigen::Vector3d point_G(inliers[i]->en.x(), inliers[i]->en.y(), inliers[i]->ground + above[i].expected);
      Eigen::Vector3d from_body_G = point_G - p_G_B;
      const Eigen::Vector3d outward(from_body_G.x(), from_body_G.y(), 0);
      from_body_G -= stretch * outward;
      const Eigen::Vector3d p_C = camera.R_C_G * from_body_G - scale * camera.arm_C;
      if (!(p_C.z() > 1)) return result;
      // In metres on the ground: the ray's miss times the depth.
      const Eigen::Vector2d residual = p_C.head<2>() - p_C.z() * point_of(views, *inliers[i]).ray;
      Eigen::Matrix<double, 2, 3> projection;
      projection << Eigen::Matrix2d::Identity(), -point_of(views, *inliers[i]).ray;
      const Eigen::Matrix3d turning = camera.R_C_G * skew(from_body_G);
      Eigen::Matrix<double, 3, 6> point;
      point << -camera.R_C_G, turning.col(2), -scale * camera.arm_C, -camera.R_C_G * outward;
      const Eigen::Matrix<double, 2, 6> jacobian = projection * point;
      // What is on something lies where the odometry has it.
      const Eigen::Vector2d offset_G = scaled * (R_G_W * offsets[i]).head<2>();
      const Eigen::Matrix<double, 3, 2> tilting =
          turning.leftCols<2>() +
          above[i].on_something * camera.R_C_G.col(2) * Eigen::RowVector2d(offset_G.y(), -offset_G.x());
      const double weight = robust_weight(residual.squaredNorm(), width);
      information += weight * jacobian.transpose() * jacobian;
      with_tilt += weight * jacobian.transpose() * projection * tilting;
      gradient += weight * jacobian.transpose() * residual;
      weights += weight;
      sum += weight * residual.squaredNorm();
    }
    const double variance = std::max(kMinResidual * kMinResidual, 0.5 * sum / std::max(1.0, weights));
    const double trust = 1 / (variance * options.matches_per_observation * static_cast<double>(views.size()));
    information *= trust;
    with_tilt *= trust;
    gradient *= trust;
    of_matches = information;
    const auto add_prior = [&](const Row& row, double residual, double stddev) {
      information += row * row.transpose() / (stddev * stddev);
      gradient += row * residual / (stddev * stddev);
    };
    add_prior(Row::Unit(3), wrap_angle(turn - newest.yaw - prior.alignment.turn), prior.heading_stddev);
    add_prior(Row::Unit(4), log_scale - scale_before.log_scale, scale_before.stddev);
    add_prior(Row::Unit(5), stretch, kAnyStretch);
    // The body is above the ground by what the odometry says, scaled.
    Row height = Row::Unit(2);
    height(4) = -scale * mean_drop;
    const double expected_height = level + (scale - scaled) * mean_drop;
    add_prior(height, p_G_B.z() - expected_height, options.ground_height_stddev);
    of_ground = height * height.transpose() / std::pow(options.ground_height_stddev, 2);
    const Row step = information.ldlt().solve(-gradient);
    if (!step.allFinite()) return result;
    p_G_B += step.head<3>();
    turn += step(3);
    log_scale += step(4);
    stretch += step(5);
    if (step.head<3>().norm() + step.tail<3>().norm() * mean_drop < kConverged) break;
  }
  const Matrix6d inverse = information.inverse();
  // The fit weighs matches as if those of other keyframes erred by the same, and is better for it (medians of `rural`
  // 1.05 m, 1.10 m with twice the weight); they do not, and what it says of itself is put right by that.
  const double errors = 1 / static_cast<double>(views.size());
  const Matrix6d covariance = inverse * (information - (1 - errors) * of_matches) * inverse;
  if (!covariance.allFinite()) return result;
  Upright& upright = result.upright;
  upright.p_G_B = p_G_B;
  // What the map's heights err by is not the matches' word.
  const Eigen::Matrix3d by_ground = (inverse * of_ground * inverse).topLeftCorner<3, 3>();
  upright.covariance = covariance.topLeftCorner<3, 3>() - by_ground;
  upright.covariance(2, 2) += std::pow(ground.hidden_stddev(), 2);
  upright.lever = (inverse * with_tilt).topRows<3>();
  const Eigen::Matrix3d R_G_W = Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()).matrix();
  for (size_t i = 0; i < inliers.size(); ++i) offsets[i] = scaled * (R_G_W * offsets[i]);
  const GroundSlope slope = slope_of_ground(offsets, rises, keyframe.height_above_ground,
                                            static_cast<double>(views.size()), options.ground_height_stddev);
  upright.tilt = slope.tilt;
  upright.tilt_covariance = slope.covariance;
  // The ground's word on the vertical, weighed against the odometry's.
  const Eigen::Matrix2d of_slope = slope.covariance.inverse();
  const Eigen::Matrix2d tilt_covariance =
      (of_slope + Eigen::Matrix2d::Identity() / (options.tilt_stddev * options.tilt_stddev)).inverse();
  const Eigen::Vector2d tilt = tilt_covariance * (of_slope * slope.tilt);
  result.p_G_B = upright.p_G_B - upright.lever * tilt;
  result.q_G_B = Eigen::Quaterniond(so3_exp(Eigen::Vector3d(tilt.x(), tilt.y(), 0)).toRotationMatrix() * R_G_W *
                                    keyframe.q_W_B.toRotationMatrix())
                     .normalized();
  result.covariance = upright.covariance + by_ground + upright.lever * tilt_covariance * upright.lever.transpose();
  result.covariance.topLeftCorner<2, 2>() += options.map_stddev * options.map_stddev * Eigen::Matrix2d::Identity();
  result.scale = std::exp(log_scale);
  result.scale_stddev = result.scale * std::sqrt(covariance(4, 4));
  result.yaw = wrap_angle(turn);
  result.yaw_stddev = std::hypot(std::sqrt(covariance(3, 3)), prior.common_stddev);
  result.ok = true;
  return result;
}

GroundLevel ground_along(const std::vector<const View*>& views, const PlaceFit& fit, const ScaleBelief& scale,
                         const MapIndex& index, const FitOptions& options) {
  GroundLevel ground;
  // At its true scale: `fit` has that which the newest are seen under.
  const Alignment alignment{fit.alignment.turn, std::exp(scale.log_scale)};
  const Eigen::Matrix2d from_W = alignment.from_W(views.front()->yaw);
  for (size_t k = views.size() - 1; k > 0; --k) {
    const View& view = *views[k];
    std::vector<double> lifts;
    for (const ViewPoint& point : view.points) {
      const Eigen::Vector2d cell = index.cell(fit.en + from_W * offset_of(views, point));
      const int feature =
          index.feature(static_cast<int>(std::lround(cell.y())), static_cast<int>(std::lround(cell.x())));
      if (feature < 0) continue;
      lifts.push_back(index.position(feature).z() - alignment.scale * (point.p_W.z() - view.keyframe.p_W_B.z()));
    }
    if (!lifts.empty()) {
      ground.add(lifts, view.keyframe.height_above_ground, view.keyframe.p_W_B, options.matches_per_observation, scale);
    }
  }
  return ground;
}

}  // namespace orthonav::registration
