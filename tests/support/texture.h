// A ground whose brightness is known at every point, for tests that need a map and pictures of it.
#pragma once

#include <cmath>
#include <random>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

namespace orthonav::test {

// A picture of `texture` whose pixel (u, v) shows the ground point that `ground_of` gives.
template <class Texture, class GroundOf>
cv::Mat picture_of(const Texture& texture, const cv::Size& size, const GroundOf& ground_of) {
  cv::Mat image(size, CV_8U);
  for (int v = 0; v < size.height; ++v) {
    for (int u = 0; u < size.width; ++u) {
      image.at<uchar>(v, u) = cv::saturate_cast<uchar>(texture(ground_of(Eigen::Vector2d(u, v))));
    }
  }
  return image;
}

// Band-limited brightness as a sum of sinusoids of wavelengths 1.2 ... 30 m in all directions: smooth, and nowhere the
// same twice. The same seed gives the same ground.
class Texture {
 public:
  explicit Texture(unsigned seed, int num_waves = 60) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> part(0.0, 1.0);
    for (int i = 0; i < num_waves; ++i) {
      const double wavelength = 1.2 * std::pow(25.0, part(random));
      const double direction = 2 * M_PI * part(random);
      const double k = 2 * M_PI / wavelength;
      waves_.push_back({k * std::cos(direction), k * std::sin(direction), 2 * M_PI * part(random)});
    }
  }

  double operator()(const Eigen::Vector2d& en) const {
    double sum = 0;
    for (const Wave& wave : waves_) sum += std::sin(wave.kx * en.x() + wave.ky * en.y() + wave.phase);
    return 127.0 + 90.0 * sum / std::sqrt(static_cast<double>(waves_.size()));
  }

  template <class GroundOf>
  cv::Mat picture(const cv::Size& size, const GroundOf& ground_of) const {
    return picture_of(*this, size, ground_of);
  }

 private:
  struct Wave {
    double kx, ky, phase;
  };
  std::vector<Wave> waves_;
};

// A patchwork of fields and roofs over 200 m, each patch of one brightness: unlike waves, it looks different everywhere
// to a descriptor as wide as a field.
class Patchwork {
 public:
  explicit Patchwork(unsigned seed) : fine_(kSide, kSide, CV_8U, cv::Scalar(110)) {
    cv::RNG random(seed);
    for (int i = 0; i < 600; ++i) {
      const auto side = [&] { return static_cast<float>(random.uniform(2.0, 14.0) / kResolution); };
      const cv::Point2f centre(random.uniform(0.0F, static_cast<float>(kSide)),
                               random.uniform(0.0F, static_cast<float>(kSide)));
      cv::Point2f corners[4];  // NOLINT: OpenCV's interface
      cv::RotatedRect(centre, {side(), side()}, random.uniform(0.0F, 180.0F)).points(corners);
      cv::fillConvexPoly(fine_, std::vector<cv::Point>(std::begin(corners), std::end(corners)),
                         cv::Scalar(random.uniform(30, 220)), cv::LINE_AA);
    }
    cv::GaussianBlur(fine_, fine_, {}, 2);
  }

  double operator()(const Eigen::Vector2d& en) const {
    const int u = static_cast<int>(std::lround(en.x() / kResolution));
    const int v = static_cast<int>(std::lround(-en.y() / kResolution));
    return u >= 0 && v >= 0 && u < kSide && v < kSide ? fine_.at<uchar>(v, u) : 110;
  }

  template <class GroundOf>
  cv::Mat picture(const cv::Size& size, const GroundOf& ground_of) const {
    return picture_of(*this, size, ground_of);
  }

 private:
  static constexpr double kResolution = 0.1;
  static constexpr int kSide = 2000;
  cv::Mat fine_;
};

}  // namespace orthonav::test
