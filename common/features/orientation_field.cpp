#include "common/features/orientation_field.h"

#include <algorithm>
#include <array>
#include <cmath>
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

using Channels = std::array<float, kChannels>;

// Image pixels a node gathers, to each side.
int pixels_per_node(const OrientationFieldOptions& options) {
  return std::max(1, cvRound(1.5 * options.keypoint_size / (kNodesPerCell * options.pixel_width)));
}

// Sums of the gradients' magnitudes by direction over blocks of `block` x `block` pixels; CV_32FC(8).
cv::Mat gather_gradients(const cv::Mat& image, const OrientationFieldOptions& options, int block) {
  const int rows = (image.rows + block - 1) / block;
  const int columns = (image.cols + block - 1) / block;
  cv::Mat nodes(rows, columns, CV_32FC(kChannels), cv::Scalar::all(0));
  cv::Mat du(1, image.cols, CV_32F), dv(1, image.cols, CV_32F), magnitude, direction;
  // Grey levels per map pixel, mean over the block, whatever the image's resolution.
  const auto gain = static_cast<float>(0.5 / (options.pixel_width * block * block));
  const double turns = options.rotation / (2 * M_PI);
  const auto turn = static_cast<float>((turns - std::floor(turns)) * kChannels);
  constexpr float kPerRadian = static_cast<float>(kChannels / (2 * M_PI));
  for (int v = 1; v + 1 < image.rows; ++v) {
    const auto* above = image.ptr<float>(v - 1);
    const auto* here = image.ptr<float>(v);
    const auto* below = image.ptr<float>(v + 1);
    auto* x = du.ptr<float>();
    auto* y = dv.ptr<float>();
    x[0] = y[0] = x[image.cols - 1] = y[image.cols - 1] = 0;
    for (int u = 1; u + 1 < image.cols; ++u) {
      x[u] = gain * (here[u + 1] - here[u - 1]);
      y[u] = gain * (below[u] - above[u]);
    }
    cv::cartToPolar(du, dv, magnitude, direction);
    const auto* m = magnitude.ptr<float>();
    const auto* a = direction.ptr<float>();
    auto* row = nodes.ptr<float>(v / block);
    for (int u = 1; u + 1 < image.cols; ++u) {
      const float bin = a[u] * kPerRadian + turn;
      const int lower = static_cast<int>(bin);
      const float upper_share = (bin - static_cast<float>(lower)) * m[u];
      float* node = row + kChannels * (u / block);
      node[lower & (kChannels - 1)] += m[u] - upper_share;
      node[(lower + 1) & (kChannels - 1)] += upper_share;
    }
  }
  return nodes;
}

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

cv::Mat smooth(const cv::Mat& nodes, const std::vector<float>& window) {
  const int reach = static_cast<int>(window.size() / 2);
  const int width = nodes.cols * kChannels;
  cv::Mat columns(nodes.size(), nodes.type(), cv::Scalar::all(0));
  for (int v = 0; v < nodes.rows; ++v) {
    auto* out = columns.ptr<float>(v);
    for (int k = std::max(-reach, -v); k <= std::min(reach, nodes.rows - 1 - v); ++k) {
      const float weight = window[static_cast<size_t>(k + reach)];
      const auto* in = nodes.ptr<float>(v + k);
      for (int i = 0; i < width; ++i) out[i] += weight * in[i];
    }
  }
  cv::Mat result(nodes.size(), nodes.type(), cv::Scalar::all(0));
  for (int v = 0; v < nodes.rows; ++v) {
    auto* out = result.ptr<float>(v);
    for (int k = -reach; k <= reach; ++k) {
      const float weight = window[static_cast<size_t>(k + reach)];
      const int begin = std::max(0, -k) * kChannels;
      const int end = (nodes.cols - std::max(0, k)) * kChannels;
      const auto* in = columns.ptr<float>(v) + k * kChannels;
      for (int i = begin; i < end; ++i) out[i] += weight * in[i];
    }
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
bool normalise(std::array<float, kSiftBytes>& values, uint8_t* out) {
  float squares = 0, sum = 0;
  for (const float value : values) {
    squares += value * value;
    sum += value;
  }
  float weights = 0;
  for (const float weight : cell_weights()) weights += weight;
  if (!(sum > kMinGradient * weights)) {
    std::fill_n(out, kSiftBytes, uint8_t{0});
    return false;
  }
  const float largest = kLargestShare * std::sqrt(squares);
  sum = 0;
  for (float& value : values) {
    value = std::min(value, largest);
    sum += value;
  }
  const auto scale = static_cast<float>(kRootSiftLength * kRootSiftLength) / sum;
  for (size_t i = 0; i < values.size(); ++i) {
    out[i] = static_cast<uint8_t>(std::min(255.0F, std::sqrt(scale * values[i]) + 0.5F));
  }
  return true;
}

}  // namespace

OrientationField::OrientationField(const cv::Mat& grey, const OrientationFieldOptions& options)
    : cell_(1.5 * options.keypoint_size) {
  if (grey.empty() || grey.type() != CV_8UC1) {
    throw std::invalid_argument("OrientationField wants an 8-bit grey image");
  }
  if (!(options.keypoint_size >= 2.0 && options.keypoint_size <= 128.0) || !(options.pixel_width >= 0.1) ||
      !(options.pixel_width <= options.keypoint_size / 3) || !std::isfinite(options.rotation)) {
    throw std::invalid_argument("keypoint_size must be in [2, 128] pixels, pixel_width in [0.1, keypoint_size / 3]");
  }
  cv::Mat image;
  grey.convertTo(image, CV_32F);
  const double wanted = kBaseSigma / options.pixel_width;
  if (wanted > kImageSigma + 0.05) {
    const double sigma = std::sqrt(wanted * wanted - kImageSigma * kImageSigma);
    cv::GaussianBlur(image, image, {}, sigma, sigma, cv::BORDER_REPLICATE);
  }
  const int block = pixels_per_node(options);
  pixels_per_node_ = static_cast<float>(block);
  nodes_ = smooth(gather_gradients(image, options, block), triangle(kWindow * cell_ / (block * options.pixel_width)));
}

bool OrientationField::describe(const Eigen::Vector2f& centre, const Eigen::Matrix2f& jacobian, uint8_t* out) const {
  std::array<float, kSiftBytes> values{};
  const std::array<float, kCells* kCells>& weights = cell_weights();
  for (int cell = 0; cell < kCells * kCells; ++cell) {
    const int cell_row = cell / kCells, cell_column = cell % kCells;
    const auto x = static_cast<float>((cell_column - 0.5 * (kCells - 1)) * cell_);
    const auto y = static_cast<float>((cell_row - 0.5 * (kCells - 1)) * cell_);
    // The middle of node 0 is the middle of its block of pixels.
    const Eigen::Vector2f place =
        ((centre + jacobian * Eigen::Vector2f(x, y)).array() - 0.5F * (pixels_per_node_ - 1)) / pixels_per_node_;
    if (!(place.x() > -1 && place.y() > -1 && place.x() < static_cast<float>(nodes_.cols) &&
          place.y() < static_cast<float>(nodes_.rows))) {
      continue;
    }
    const int u = static_cast<int>(std::floor(place.x()));
    const int v = static_cast<int>(std::floor(place.y()));
    const float a = place.x() - static_cast<float>(u);
    const float b = place.y() - static_cast<float>(v);
    float* histogram = &values[static_cast<size_t>(cell) * kChannels];
    for (int corner = 0; corner < 4; ++corner) {
      const int column = u + (corner & 1);
      const int row = v + (corner >> 1);
      if (column < 0 || row < 0 || column >= nodes_.cols || row >= nodes_.rows) continue;
      const float weight =
          weights[static_cast<size_t>(cell)] * ((corner & 1) != 0 ? a : 1 - a) * ((corner >> 1) != 0 ? b : 1 - b);
      const float* node = nodes_.ptr<float>(row) + kChannels * column;
      for (int k = 0; k < kChannels; ++k) histogram[k] += weight * node[k];
    }
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
