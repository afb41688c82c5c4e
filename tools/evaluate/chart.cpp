#include "tools/evaluate/chart.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

namespace orthonav::evaluate {
namespace {

constexpr double kWidth = 860;
constexpr double kLeft = 52, kRight = 12, kTop = 30, kBottom = 40;

// 1, 2 or 5 times a power of ten, for about `count` steps.
double tick_step(double span, int count) {
  const double rough = span / count;
  const double power = std::pow(10.0, std::floor(std::log10(rough)));
  for (const double factor : {1.0, 2.0, 5.0}) {
    if (factor * power >= rough) return factor * power;
  }
  return 10.0 * power;
}

std::string number(double value) {
  const std::string text = fmt::format("{:.6g}", std::abs(value) < 1e-12 ? 0.0 : value);
  return text[0] == '-' ? "\u2212" + text.substr(1) : text;
}

}  // namespace

std::string escaped(const std::string& text) {
  std::string safe;
  for (const char c : text) {
    switch (c) {
      case '&':
        safe += "&amp;";
        break;
      case '<':
        safe += "&lt;";
        break;
      case '>':
        safe += "&gt;";
        break;
      case '"':
        safe += "&quot;";
        break;
      default:
        safe += c;
    }
  }
  return safe;
}

Chart::Chart(Axis x, Axis y, double height) : x_(std::move(x)), y_(std::move(y)), height_(height) {
  // An axis without extent, or with NaN, would divide by zero.
  if (!(x_.max > x_.min)) x_.max = x_.min + 1.0;
  if (!(y_.max > y_.min)) y_.max = y_.min + 1.0;
}

double Chart::px(double x) const {
  return kLeft + (x - x_.min) / (x_.max - x_.min) * (kWidth - kLeft - kRight);
}

double Chart::py(double y) const {
  // Far outside the plot is as good as infinitely far, and keeps the file small.
  const double clipped = std::clamp(y, y_.min - 2.0 * (y_.max - y_.min), y_.max + 2.0 * (y_.max - y_.min));
  return height_ - kBottom - (clipped - y_.min) / (y_.max - y_.min) * (height_ - kTop - kBottom);
}

void Chart::line(const std::vector<double>& x, const std::vector<double>& y, const std::string& css) {
  std::string path;
  bool down = false;
  for (size_t k = 0; k < x.size(); ++k) {
    if (!std::isfinite(y[k])) {
      down = false;
      continue;
    }
    path += fmt::format("{}{:.1f} {:.1f}", down ? "L" : "M", px(x[k]), py(y[k]));
    down = true;
  }
  if (!path.empty()) marks_ += fmt::format("<path class='line {}' d='{}'/>", css, path);
}

void Chart::band(const std::vector<double>& x, const std::vector<double>& low, const std::vector<double>& high,
                 const std::string& css) {
  size_t start = 0;
  while (start < x.size()) {
    while (start < x.size() && !(std::isfinite(low[start]) && std::isfinite(high[start]))) ++start;
    size_t end = start;
    while (end < x.size() && std::isfinite(low[end]) && std::isfinite(high[end])) ++end;
    if (end > start) {
      std::string path = "M";
      for (size_t k = start; k < end; ++k) path += fmt::format("{:.1f} {:.1f} ", px(x[k]), py(high[k]));
      for (size_t k = end; k-- > start;) path += fmt::format("{:.1f} {:.1f} ", px(x[k]), py(low[k]));
      marks_ += fmt::format("<path class='band {}' d='{}Z'/>", css, path);
    }
    start = end;
  }
}

void Chart::dots(const std::vector<double>& x, const std::vector<double>& y, const std::string& css, double radius) {
  // One path of zero-length strokes with round caps is a tenth of the size of circles.
  std::string path;
  for (size_t k = 0; k < x.size(); ++k) {
    if (std::isfinite(y[k])) path += fmt::format("M{:.1f} {:.1f}h0", px(x[k]), py(y[k]));
  }
  if (!path.empty()) {
    marks_ += fmt::format("<path class='dots {}' stroke-width='{}' d='{}'/>", css, 2.0 * radius, path);
  }
}

void Chart::bar(double x_from, double x_to, double y_from, double y_to, const std::string& css) {
  marks_ += fmt::format("<rect class='bar {}' x='{:.1f}' y='{:.1f}' width='{:.1f}' height='{:.1f}'/>", css, px(x_from),
                        py(y_to), std::max(0.5, px(x_to) - px(x_from) - 1.0), py(y_from) - py(y_to));
}

void Chart::upright(double x, const std::string& label) {
  marks_ += fmt::format(
      "<path class='upright' d='M{0:.1f} {1:.1f}V{2:.1f}'/><text class='mark' x='{3:.1f}' y='{4:.1f}'>{5}</text>",
      px(x), py(y_.min), py(y_.max), px(x) + 4, py(y_.max) + 11, escaped(label));
}

void Chart::legend(const std::string& css, const std::string& label) {
  legend_.emplace_back(css, label);
}

std::string Chart::svg() const {
  std::string text = fmt::format("<svg class='chart' viewBox='0 0 {} {}' role='img'>", kWidth, height_);
  const double y_step = tick_step(y_.max - y_.min, std::max(2, static_cast<int>((height_ - kTop - kBottom) / 38)));
  for (double y = std::ceil(y_.min / y_step - 1e-9) * y_step; y <= y_.max + 1e-9 * y_step; y += y_step) {
    text += fmt::format(
        "<path class='grid' d='M{:.1f} {:.1f}H{:.1f}'/><text class='tick' x='{:.1f}' y='{:.1f}' "
        "text-anchor='end'>{}</text>",
        kLeft, py(y), kWidth - kRight, kLeft - 6, py(y) + 4, number(y));
  }
  const double x_step = tick_step(x_.max - x_.min, 10);
  for (double x = std::ceil(x_.min / x_step - 1e-9) * x_step; x <= x_.max + 1e-9 * x_step; x += x_step) {
    text += fmt::format(
        "<path class='grid' d='M{0:.1f} {1:.1f}v4'/><text class='tick' x='{0:.1f}' y='{2:.1f}' "
        "text-anchor='middle'>{3}</text>",
        px(x), height_ - kBottom, height_ - kBottom + 17, number(x));
  }
  text += fmt::format("<path class='axis' d='M{:.1f} {:.1f}H{:.1f}'/>", kLeft, height_ - kBottom, kWidth - kRight);
  text += fmt::format("<text class='label' x='{:.1f}' y='{:.1f}' text-anchor='middle'>{}</text>",
                      0.5 * (kLeft + kWidth - kRight), height_ - 5, escaped(x_.label));
  text += fmt::format("<text class='label' x='2' y='16'>{}</text>", escaped(y_.label));
  // Overflow of a nested svg is hidden: that clips the marks to the plot.
  text += fmt::format("<svg x='{0}' y='{1}' width='{2}' height='{3}' viewBox='{0} {1} {2} {3}'>{4}</svg>", kLeft,
                      kTop - 3, kWidth - kLeft - kRight, height_ - kTop - kBottom + 3, marks_);
  double at = kWidth - kRight;
  for (auto entry = legend_.rbegin(); entry != legend_.rend(); ++entry) {
    at -= 6.6 * static_cast<double>(entry->second.size()) + 6;
    text += fmt::format("<text class='label' x='{:.1f}' y='16'>{}</text>", at, escaped(entry->second));
    at -= 15;
    text += fmt::format("<rect class='key {}' x='{:.1f}' y='7' width='11' height='9' rx='2'/>", entry->first, at);
    at -= 14;
  }
  return text + "</svg>";
}

}  // namespace orthonav::evaluate
