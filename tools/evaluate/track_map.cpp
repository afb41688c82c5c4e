// The tracks on the map, declared in pictures.h.
#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "tools/evaluate/chart.h"
#include "tools/evaluate/pictures.h"

namespace orthonav::evaluate {
namespace {

constexpr double kWidth = 1200;  // of the picture, pixels

// East and north in metres to SVG coordinates.
struct View {
  Eigen::Vector2d low, high;
  double metres_per_pixel = 1;
  double height = 0;

  double x(double east) const { return (east - low.x()) / metres_per_pixel; }
  double y(double north) const { return (high.y() - north) / metres_per_pixel; }
};

void include(const Eigen::Vector3d& p, View& view) {
  view.low = view.low.cwiseMin(p.head<2>());
  view.high = view.high.cwiseMax(p.head<2>());
}

View choose_view(const FlightRecord& record, const Metrics& metrics, const MapPicture* map) {
  View view;
  view.low.setConstant(1e12);
  view.high.setConstant(-1e12);
  const Reference& reference = record.truth.empty() ? record.gnss : record.truth;
  for (const ReferenceSample& sample : reference.samples()) include(sample.p_G_B, view);
  for (const ErrorSample& sample : metrics.fusion.track) include(sample.p_G_B, view);
  for (const ErrorSample& sample : metrics.vio.track) include(sample.p_G_B, view);
  if (!(view.high.x() > view.low.x())) {
    view.low.setConstant(-100);
    view.high.setConstant(100);
  }
  view.low.array() -= 40.0;
  view.high.array() += 40.0;
  if (map != nullptr) {
    // The whole map, unless it is so large that the flight would be a scribble on it.
    Eigen::Vector2d low, high;
    map->bounds(*record.frame, low, high);
    const Eigen::Vector2d margin = 0.75 * (view.high - view.low).maxCoeff() * Eigen::Vector2d::Ones();
    view.low = low.cwiseMax(view.low - margin);
    view.high = high.cwiseMin(view.high + margin);
  }
  view.metres_per_pixel = (view.high.x() - view.low.x()) / kWidth;
  view.height = (view.high.y() - view.low.y()) / view.metres_per_pixel;
  return view;
}

template <class Samples, class Position>
std::string path_of(const Samples& samples, const View& view, Position position) {
  std::string path;
  Eigen::Vector2d last(1e9, 1e9);
  int64_t last_utime = 0;
  for (const auto& sample : samples) {
    const Eigen::Vector3d p = position(sample);
    const Eigen::Vector2d at(view.x(p.x()), view.y(p.y()));
    const bool broken = sample.utime - last_utime > 2'000'000;
    last_utime = sample.utime;
    if (!broken && (at - last).norm() < 1.0) continue;
    path += fmt::format("{}{:.1f} {:.1f}", broken || path.empty() ? "M" : "L", at.x(), at.y());
    last = at;
  }
  return path;
}

std::string fixes_of(const RegistrationMetrics& registration, const View& view) {
  std::string right, wrong;
  for (const JudgedFix& fix : registration.fixes) {
    if (!fix.p_G_B) continue;
    const double x = view.x(fix.p_G_B->x());
    const double y = view.y(fix.p_G_B->y());
    if (!fix.false_fix) {
      right += fmt::format("M{:.1f} {:.1f}h0", x, y);
      continue;
    }
    // A line leads from a wrong fix to where the aircraft was.
    if (fix.reference) {
      wrong += fmt::format("<path class='astray' d='M{:.1f} {:.1f}L{:.1f} {:.1f}'/>", x, y,
                           view.x(fix.reference->p_G_B.x()), view.y(fix.reference->p_G_B.y()));
    }
    wrong += fmt::format("<path class='wrong' d='M{:.1f} {:.1f}l14 14m0 -14l-14 14'/>", x - 7, y - 7);
  }
  return fmt::format("<path class='fix' d='{}'/>{}", right, wrong);
}

std::string scale_bar(const View& view) {
  double metres = 10;
  for (const double candidate : {20., 50., 100., 200., 500., 1000., 2000., 5000.}) {
    if (candidate / view.metres_per_pixel < 0.25 * kWidth) metres = candidate;
  }
  const double x = 24;
  const double y = view.height - 24;
  return fmt::format(
      "<g class='scale'><rect x='{0}' y='{1}' width='{2:.1f}' height='34' rx='4'/><path d='M{3} {4}h{5:.1f}m0 "
      "-6v12m-{5:.1f} -12v12'/><text x='{3}' y='{6}'>{7:.0f} m, north is up</text></g>",
      x - 12, y - 24, metres / view.metres_per_pixel + 24, x, y, metres / view.metres_per_pixel, y - 9, metres);
}

std::string marker(const View& view, const Eigen::Vector3d& p, const std::string& label, double down) {
  return fmt::format(
      "<circle class='place' cx='{0:.1f}' cy='{1:.1f}' r='7'/><text class='place' x='{2:.1f}' "
      "y='{3:.1f}'>{4}</text>",
      view.x(p.x()), view.y(p.y()), view.x(p.x()) + 11, view.y(p.y()) + down, escaped(label));
}

}  // namespace

std::string draw_tracks(const FlightRecord& record, const Metrics& metrics, const MapPicture* map) {
  const View view = choose_view(record, metrics, record.frame ? map : nullptr);
  std::string svg = fmt::format("<svg class='map' viewBox='0 0 {:.0f} {:.0f}' role='img'>", kWidth, view.height);
  if (map != nullptr && record.frame) {
    const Eigen::Vector2d origin(view.low.x() + 0.5 * view.metres_per_pixel,
                                 view.high.y() - 0.5 * view.metres_per_pixel);
    const cv::Size size(static_cast<int>(kWidth), std::max(1, static_cast<int>(view.height)));
    cv::Mat picture = map->resample(*record.frame, origin, Eigen::Vector2d(view.metres_per_pixel, 0),
                                    Eigen::Vector2d(0, -view.metres_per_pixel), size);
    picture.convertTo(picture, -1, 0.7, 76);  // paler, so that the tracks stand out
    svg += fmt::format("<image width='{}' height='{}' href='{}'/>", size.width, size.height, as_data_uri(picture, 72));
  } else {
    svg += fmt::format("<rect class='nomap' width='{:.0f}' height='{:.0f}'/>", kWidth, view.height);
  }
  const auto sample_position = [](const auto& sample) { return sample.p_G_B; };
  const Reference& reference = record.truth.empty() ? record.gnss : record.truth;
  const std::string truth = path_of(reference.samples(), view, sample_position);
  svg += fmt::format("<path class='track casing' d='{0}'/><path class='track truth' d='{0}'/>", truth);
  svg += fmt::format("<path class='track vio' d='{}'/>", path_of(metrics.vio.track, view, sample_position));
  svg += fixes_of(metrics.registration, view);
  const std::string fusion = path_of(metrics.fusion.track, view, sample_position);
  svg += fmt::format("<path class='track fusion' d='{}'/>", fusion);
  if (!reference.empty()) svg += marker(view, reference.samples().front().p_G_B, "start", -10);
  if (!metrics.fusion.track.empty()) svg += marker(view, metrics.fusion.track.front().p_G_B, "first position", 24);
  return svg + scale_bar(view) + "</svg>";
}

}  // namespace orthonav::evaluate
