#include "common/features/orientation_field.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <stdexcept>

#include <opencv2/imgproc.hpp>

#include "common/features/orientation_kernels.h"

namespace orthonav {
namespace {

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

// Image pixels a node gathers, to each side.
int pixels_per_node(const OrientationFieldOptions& options) {
  return std::max(1, cvRound(1.5 * options.keypoint_size / (kNodesPerCell * options.pixel_width)));
}

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
    differentiate(image_.ptr<float>(v - 1), image_.ptr<float>(v), image_.ptr<float>(v + 1), image_.cols, gain_,
                  du_.ptr<float>(), dv_.ptr<float>());
    cv::cartToPolar(du_, dv_, magnitude_, direction_);
    add_gradients(magnitude_.ptr<float>(), direction_.ptr<float>(), image_.cols, block_, turn_, nodes);
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
    const auto count = static_cast<size_t>(kChannels * columns);
    weigh(window.data(), in_rows.data(), window.size(), count, across.ptr<float>() + kChannels * reach);
    weigh(window.data(), in_columns.data(), window.size(), count, result.ptr<float>(v + 1) + kChannels);
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
  // In nodes; the middle of node 0 is the middle of its block of pixels.
  const Eigen::Vector2f right = cell_ / pixels_per_node_ * jacobian.col(0);
  const Eigen::Vector2f down = cell_ / pixels_per_node_ * jacobian.col(1);
  const Eigen::Vector2f middle = (centre.array() - 0.5F * (pixels_per_node_ - 1)) / pixels_per_node_;
  const Eigen::Vector2f first = middle - 0.5F * (kCells - 1) * (right + down);
  const std::array<float, kCells* kCells>& weights = cell_weights();
  static const float total = std::accumulate(weights.begin(), weights.end(), 0.0F);
  return describe_cells({nodes_.ptr<float>(), static_cast<ptrdiff_t>(nodes_.step1()), nodes_.cols, nodes_.rows},
                        {{first.x(), first.y()}, {right.x(), right.y()}, {down.x(), down.y()}}, weights.data(),
                        {kMinGradient * total, kLargestShare, static_cast<float>(kRootSiftLength)}, out);
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
