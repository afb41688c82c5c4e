#include "common/features/orientation_field.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <stdexcept>

#include <opencv2/imgproc.hpp>

namespace orthonav {
namespace {

constexpr int kChannels = 8;
constexpr int kCells = 4;
// Blur of a descriptor's image, map pixels: that of SIFT's first octave.
constexpr double kBaseSigma = 1.6;
// Blur an image is assumed to have already, its own pixels.
constexpr double kImageSigma = 0.5;
// SIFT limits the share of single directions, which depends on the light.
constexpr float kLargestShare = 0.3F;
// Half the width of a histogram's window over the cell's. SIFT's is 1, but under a Gaussian over all cells, which here
// is only known cell by cell: with 0.7 as many patches match as with OpenCV's SIFT (32.4 and 32.2 % of the patches of
// orientation_field_test.cpp; with 1 they are 29.2 %).
constexpr double kWindow = 0.7;
// Mean gradient below which a patch is taken to be noise, grey levels per map pixel.
constexpr float kMinGradient = 0.4F;
// Nodes of the field to a cell: its window is smooth, so few are enough.
constexpr double kNodesPerCell = 4.5;

using Channels = Eigen::Array<float, kChannels, 1>;

// Of a number above -2^31; std::floor is a call where the machine may be an old one.
int round_down(float value) {
  const int towards_zero = static_cast<int>(value);
  return towards_zero - (static_cast<float>(towards_zero) > value ? 1 : 0);
}

// Image pixels a node gathers, to each side.
int pixels_per_node(const OrientationFieldOptions& options) {
  return std::max(1, cvRound(1.5 * options.keypoint_size / (kNodesPerCell * options.pixel_width)));
}

// Column k is 1 in channel k: what goes into two channels is added to all at once, without a jump by which they are.
const Eigen::Array<float, kChannels, kChannels> kUnits = Eigen::Matrix<float, kChannels, kChannels>::Identity().array();

// Sums of the gradients' magnitudes by direction over blocks of `block` x `block` pixels, row by row from the top.
class GradientRows {
 public:
  GradientRows(const cv::Mat& image, const OrientationFieldOptions& options, int block)
      : image_(image),
        block_(block),
        // Grey levels per map pixel, mean over the block, whatever the image's resolution.
        gain_(static_cast<float>(0.5 / (options.pixel_width * block * block))),
        du_(1, image.cols, CV_32F, cv::Scalar(0)),
        dv_(1, image.cols, CV_32F, cv::Scalar(0)) {
    const double turns = options.rotation / (2 * M_PI);
    turn_ = static_cast<float>((turns - std::floor(turns)) * kChannels);
  }

  int rows() const { return (image_.rows + block_ - 1) / block_; }
  int columns() const { return (image_.cols + block_ - 1) / block_; }

  // Adds row `row` to `nodes`, columns() of them.
  void add(int row, float* nodes) {
    const int end = std::min((row + 1) * block_, image_.rows - 1);
    for (int v = std::max(1, row * block_); v < end; ++v) add_line(v, nodes);
  }

 private:
  void add_line(int v, float* nodes) {
    constexpr float kPerRadian = static_cast<float>(kChannels / (2 * M_PI));
    const auto* above = image_.ptr<float>(v - 1);
    const auto* here = image_.ptr<float>(v);
    const auto* below = image_.ptr<float>(v + 1);
    auto* x = du_.ptr<float>();
    auto* y = dv_.ptr<float>();
    for (int u = 1; u + 1 < image_.cols; ++u) {
      x[u] = gain_ * (here[u + 1] - here[u - 1]);
      y[u] = gain_ * (below[u] - above[u]);
    }
    cv::cartToPolar(du_, dv_, magnitude_, direction_);
    const auto* m = magnitude_.ptr<float>();
    const auto* a = direction_.ptr<float>();
    for (int first = 0; first < image_.cols; first += block_, nodes += kChannels) {
      Eigen::Map<Channels> node(nodes);
      Channels sum = node;
      const int end = std::min(image_.cols, first + block_);
      for (int u = first; u < end; ++u) {
        const float bin = a[u] * kPerRadian + turn_;
        const int lower = static_cast<int>(bin);
        const float upper_share = (bin - static_cast<float>(lower)) * m[u];
        sum += (m[u] - upper_share) * kUnits.col(lower & (kChannels - 1)) +
               upper_share * kUnits.col((lower + 1) & (kChannels - 1));
      }
      node = sum;
    }
  }

  cv::Mat image_;
  int block_;
  float gain_, turn_;
  cv::Mat du_, dv_, magnitude_, direction_;
};

// Separable triangular window of this half-width in nodes, normalised to a sum of one.
std::vector<float> triangle(double half_width) {
  const int reach = static_cast<int>(std::ceil(half_width)) - 1;
  std::vector<float> window;
  float sum = 0;
  for (int i = -reach; i <= reach; ++i) {
    window.push_back(static_cast<float>(1 - std::abs(i) / half_width));
    sum += window.back();
  }
  for (float& weight : window) weight /= sum;
  return window;
}

// out[i] = sum over k of window[k] in[k][i], for `nodes` nodes from `first` on.
template <int nodes>
void weigh_nodes(const std::vector<float>& window, const std::vector<const float*>& in, int first, float* out) {
  using Nodes = Eigen::Array<float, nodes * kChannels, 1>;
  Nodes sum = Nodes::Zero();
  for (size_t k = 0; k < window.size(); ++k) sum += window[k] * Eigen::Map<const Nodes>(in[k] + kChannels * first);
  Eigen::Map<Nodes> target(out + kChannels * first);
  target = sum;
}

void weigh(const std::vector<float>& window, const std::vector<const float*>& in, int columns, float* out) {
  constexpr int kAtOnce = 4;  // whose sums stay in registers
  int column = 0;
  for (; column + kAtOnce <= columns; column += kAtOnce) weigh_nodes<kAtOnce>(window, in, column, out);
  for (; column < columns; ++column) weigh_nodes<1>(window, in, column, out);
}

// The gradients smoothed by the window in both directions, with one more node of zeros on each side. Row by row, so
// that what is in work stays in the cache.
cv::Mat smooth(GradientRows gradients, const std::vector<float>& window) {
  const int reach = static_cast<int>(window.size() / 2);
  const int rows = gradients.rows();
  const int columns = gradients.columns();
  cv::Mat result(rows + 2, columns + 2, CV_32FC(kChannels));
  for (cv::Mat border : {result.row(0), result.row(rows + 1), result.col(0), result.col(columns + 1)}) border.setTo(0);
  // The rows below the window, zeros beyond the first and the last; and one row of them, zeros on either side.
  cv::Mat below(static_cast<int>(window.size()), columns, result.type(), cv::Scalar::all(0));
  cv::Mat across(1, columns + 2 * reach, result.type(), cv::Scalar::all(0));
  std::vector<const float*> in_rows(window.size()), in_columns(window.size());
  for (int k = 0; k <= 2 * reach; ++k) in_columns[static_cast<size_t>(k)] = across.ptr<float>() + kChannels * k;
  for (int v = -reach; v < rows; ++v) {
    cv::Mat next = below.row((v + 2 * reach + 1) % below.rows);
    next.setTo(0);
    if (v + reach < rows) gradients.add(v + reach, next.ptr<float>());
    if (v < 0) continue;
    for (int k = 0; k <= 2 * reach; ++k) {
      in_rows[static_cast<size_t>(k)] = below.ptr<float>((v + k + 1) % below.rows);
    }
    weigh(window, in_rows, columns, across.ptr<float>() + kChannels * reach);
    weigh(window, in_columns, columns, result.ptr<float>(v + 1) + kChannels);
  }
  return result;
}

// SIFT's Gaussian window over the cells, half the descriptor wide.
const std::array<float, kCells * kCells>& cell_weights() {
  static const auto weights = [] {
    std::array<float, kCells * kCells> w{};
    for (int i = 0; i < kCells * kCells; ++i) {
      const int row = i / kCells, column = i % kCells;
      const double x = column - 0.5 * (kCells - 1);
      const double y = row - 0.5 * (kCells - 1);
      w[static_cast<size_t>(i)] = static_cast<float>(std::exp(-(x * x + y * y) / (0.5 * kCells * kCells)));
    }
    return w;
  }();
  return weights;
}

// RootSIFT in bytes. False and zeros when the gradients are too weak.
bool normalise(Eigen::Array<float, kChannels, kCells * kCells>& values, uint8_t* out) {
  static const float total = std::accumulate(cell_weights().begin(), cell_weights().end(), 0.0F);
  // Channel by channel first, for each sum waits for the one before.
  if (!(values.rowwise().sum().sum() > kMinGradient * total)) {
    std::fill_n(out, kSiftBytes, uint8_t{0});
    return false;
  }
  values = values.min(kLargestShare * std::sqrt(values.square().rowwise().sum().sum()));
  const float scale = static_cast<float>(kRootSiftLength * kRootSiftLength) / values.rowwise().sum().sum();
  for (int i = 0; i < kSiftBytes; ++i) {
    out[i] = static_cast<uint8_t>(static_cast<int>(std::min(255.0F, std::sqrt(scale * values.data()[i]) + 0.5F)));
  }
  return true;
}

}  // namespace

OrientationField::OrientationField(const cv::Mat& grey, const OrientationFieldOptions& options)
    : cell_(static_cast<float>(1.5 * options.keypoint_size)) {
  if (grey.empty() || grey.type() != CV_8UC1) {
    throw std::invalid_argument("OrientationField wants an 8-bit grey image");
  }
  if (!(options.keypoint_size >= 2.0 && options.keypoint_size <= 128.0) || !(options.pixel_width >= 0.1) ||
      !(options.pixel_width <= options.keypoint_size / 3) || !std::isfinite(options.rotation)) {
    throw std::invalid_argument("keypoint_size must be in [2, 128] pixels, pixel_width in [0.1, keypoint_size / 3]");
  }
  cv::Mat image;
  const double wanted = kBaseSigma / options.pixel_width;
  if (wanted > kImageSigma + 0.05) {
    const double sigma = std::sqrt(wanted * wanted - kImageSigma * kImageSigma);
    const cv::Mat kernel = cv::getGaussianKernel(cvRound(8 * sigma + 1) | 1, sigma, CV_32F);
    cv::sepFilter2D(grey, image, CV_32F, kernel, kernel, {-1, -1}, 0, cv::BORDER_REPLICATE);
  } else {
    grey.convertTo(image, CV_32F);
  }
  const int block = pixels_per_node(options);
  pixels_per_node_ = static_cast<float>(block);
  nodes_ = smooth(GradientRows(image, options, block),
                  triangle(kWindow * 1.5 * options.keypoint_size / (block * options.pixel_width)));
}

bool OrientationField::describe(const Eigen::Vector2f& centre, const Eigen::Matrix2f& jacobian, uint8_t* out) const {
  Eigen::Array<float, kChannels, kCells * kCells> values;
  const std::array<float, kCells* kCells>& weights = cell_weights();
  // In nodes; the middle of node 0 is the middle of its block of pixels.
  const Eigen::Vector2f step_x = cell_ / pixels_per_node_ * jacobian.col(0);
  const Eigen::Vector2f step_y = cell_ / pixels_per_node_ * jacobian.col(1);
  const Eigen::Vector2f middle = (centre.array() - 0.5F * (pixels_per_node_ - 1)) / pixels_per_node_;
  const Eigen::Vector2f first = middle - 0.5F * (kCells - 1) * (step_x + step_y);
  for (int cell = 0; cell < kCells * kCells; ++cell) {
    const int row = cell / kCells;
    const int column = cell % kCells;
    const Eigen::Vector2f place = first + static_cast<float>(column) * step_x + static_cast<float>(row) * step_y;
    if (!(place.x() > -1 && place.y() > -1 && place.x() < static_cast<float>(nodes_.cols - 2) &&
          place.y() < static_cast<float>(nodes_.rows - 2))) {
      values.col(cell).setZero();
      continue;
    }
    const int u = round_down(place.x());
    const int v = round_down(place.y());
    const float a = place.x() - static_cast<float>(u);
    const float b = place.y() - static_cast<float>(v);
    const auto node = [&](int down, int right) {
      return Eigen::Map<const Channels>(nodes_.ptr<float>(v + 1 + down) + kChannels * (u + 1 + right));
    };
    const float weight = weights[static_cast<size_t>(cell)];
    values.col(cell) = weight * (1 - a) * (1 - b) * node(0, 0) + weight * a * (1 - b) * node(0, 1) +
                       weight * (1 - a) * b * node(1, 0) + weight * a * b * node(1, 1);
  }
  return normalise(values, out);
}

cv::Mat OrientationField::describe(const std::vector<cv::Point2f>& points) const {
  cv::Mat descriptors(static_cast<int>(points.size()), kSiftBytes, CV_8U);
  for (size_t i = 0; i < points.size(); ++i) {
    describe({points[i].x, points[i].y}, Eigen::Matrix2f::Identity(), descriptors.ptr(static_cast<int>(i)));
  }
  return descriptors;
}

int orientation_margin(double keypoint_size) {
  const double cells = 0.5 * (kCells + 1) * 1.5 * keypoint_size;
  return static_cast<int>(std::ceil(cells + 1.5 * keypoint_size / kNodesPerCell + 4 * kBaseSigma)) + 2;
}

}  // namespace orthonav
