#include "services/registration/place_message.h"

#include <cmath>

#include <fmt/format.h>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

// People are wrong now and then: the share of hints that are true.
constexpr double kHintTrust = 0.9;
// Of a two-dimensional normal distribution, the radius that holds 95 %, in standard deviations of an axis.
constexpr double kRadiusOf95 = 2.4477;
// m: corners are clicked on a map.
constexpr double kCornerStddev = 10;
// m: who knows no more than this says nothing.
constexpr double kLargestRadius = 1e6;
constexpr int32_t kMostCorners = 1000;

bool is_position(double latitude_deg, double longitude_deg) {
  return std::abs(latitude_deg) <= 90 && std::abs(longitude_deg) <= 180;
}

}  // namespace

place_hypotheses_t hypotheses_message(const PlaceBelief& belief, const vio_keyframe_t& keyframe,
                                      const EnuFrame& frame) {
  place_hypotheses_t message{};
  message.utime = keyframe.utime;
  message.session = keyframe.session;
  message.none = belief.none();
  const double* q = keyframe.q_W_B;
  const double odometry_heading = heading_of(Eigen::Quaterniond(q[0], q[1], q[2], q[3]));
  for (const PlaceHypothesis& each : belief.hypotheses()) {
    place_hypothesis_t place{};
    const Geodetic position = frame.to_geodetic({each.en.x(), each.en.y(), 0});
    place.latitude_deg = position.latitude_deg;
    place.longitude_deg = position.longitude_deg;
    place.stddev = each.stddev;
    const double yaw = std::atan2(each.G_W(1, 0), each.G_W(0, 0));
    const double heading = wrap_angle(odometry_heading - yaw);
    place.heading = heading < 0 ? heading + 2 * M_PI : heading;
    place.scale = each.G_W.col(0).norm();
    place.probability = belief.probability(each.id);
    message.hypotheses.push_back(place);
  }
  message.num_hypotheses = static_cast<int32_t>(message.hypotheses.size());
  return message;
}

HintedArea area_of(const position_hint_t& hint, const EnuFrame& frame) {
  HintedArea result;
  result.area.trust = kHintTrust;
  const auto add = [&](double latitude_deg, double longitude_deg) {
    if (!is_position(latitude_deg, longitude_deg)) {
      result.problem = fmt::format("latitude {} and longitude {} are no position", latitude_deg, longitude_deg);
      return;
    }
    result.area.corners.push_back(frame.to_enu({latitude_deg, longitude_deg, frame.anchor().height}).head<2>());
  };
  if (hint.num_corners == 0) {
    result.area.stddev = hint.radius / kRadiusOf95;
    add(hint.latitude_deg, hint.longitude_deg);
    if (!(hint.radius > 0 && hint.radius <= kLargestRadius)) {
      result.problem =
          fmt::format("radius {} m: more than 0 and at most {:.0f} is needed", hint.radius, kLargestRadius);
    }
    return result;
  }
  if (hint.num_corners < 3 || hint.num_corners > kMostCorners) {
    result.problem = fmt::format("{} corners: an area has 3 to {}", hint.num_corners, kMostCorners);
    return result;
  }
  result.area.stddev = kCornerStddev;
  for (size_t i = 0; i < static_cast<size_t>(hint.num_corners) && result.problem.empty(); ++i) {
    add(hint.corner_latitudes_deg[i], hint.corner_longitudes_deg[i]);
  }
  return result;
}

}  // namespace orthonav::registration
