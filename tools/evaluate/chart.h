// Line, dot and bar charts as inline SVG: no library, no script, sharp on a phone and on paper.
#pragma once

#include <string>
#include <utility>
#include <vector>

namespace orthonav::evaluate {

struct Axis {
  std::string label;
  double min = 0;
  double max = 1;
};

// Colours and strokes come from the page's style sheet: every mark has a class. Data outside the axes is clipped.
class Chart {
 public:
  Chart(Axis x, Axis y, double height = 240);

  // Filled between two curves; samples with NaN break it.
  void band(const std::vector<double>& x, const std::vector<double>& low, const std::vector<double>& high,
            const std::string& css);
  // NaN breaks the line.
  void line(const std::vector<double>& x, const std::vector<double>& y, const std::string& css);
  void dots(const std::vector<double>& x, const std::vector<double>& y, const std::string& css, double radius = 2.5);
  void bar(double x_from, double x_to, double y_from, double y_to, const std::string& css);
  // A dashed line from bottom to top with a word at its head.
  void upright(double x, const std::string& label);
  // Shown above the plot, in order.
  void legend(const std::string& css, const std::string& label);

  std::string svg() const;

 private:
  double px(double x) const;
  double py(double y) const;

  Axis x_, y_;
  double height_;
  std::string marks_;
  std::vector<std::pair<std::string, std::string>> legend_;
};

// Text that is safe inside HTML and SVG.
std::string escaped(const std::string& text);

}  // namespace orthonav::evaluate
