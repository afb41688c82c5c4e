#include "tools/evaluate/pictures.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <stdexcept>

#include <fmt/format.h>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "common/bus/channels.h"
#include "common/camera/image_decode.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/image_t.hpp"

namespace orthonav::evaluate {
namespace {

constexpr int kNothing = 225;  // grey where the map is not
constexpr int kPictureWidth = 640;

std::string base64(const std::vector<uint8_t>& bytes) {
  static const char* const kAlphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  text.reserve((bytes.size() + 2) / 3 * 4);
  for (size_t k = 0; k < bytes.size(); k += 3) {
    const size_t left = std::min<size_t>(3, bytes.size() - k);
    uint32_t group = 0;
    for (size_t i = 0; i < 3; ++i) group = group << 8 | (i < left ? bytes[k + i] : 0u);
    for (size_t i = 0; i < 4; ++i) text += i <= left ? kAlphabet[group >> (18 - 6 * i) & 63u] : '=';
  }
  return text;
}

// A colour per match that is the same in both pictures.
cv::Scalar colour_of(size_t index) {
  cv::Mat hsv(1, 1, CV_8UC3, cv::Scalar(static_cast<double>((index * 47) % 180), 230, 255));
  cv::Mat bgr;
  cv::cvtColor(hsv, bgr, cv::COLOR_HSV2BGR);
  const cv::Vec3b c = bgr.at<cv::Vec3b>(0, 0);
  return cv::Scalar(c[0], c[1], c[2]);
}

void mark(cv::Mat& picture, const cv::Point2f& at, size_t index) {
  constexpr int kShift = 3;
  const cv::Point fixed(cvRound(at.x * (1 << kShift)), cvRound(at.y * (1 << kShift)));
  cv::circle(picture, fixed, 6 << kShift, cv::Scalar::all(0), 3, cv::LINE_AA, kShift);
  cv::circle(picture, fixed, 6 << kShift, colour_of(index), 2, cv::LINE_AA, kShift);
}

// The similarity that takes image pixels (y down) to metres east and south, fitted to the matches.
std::optional<cv::Matx23d> image_to_ground(const map_fix_t& fix) {
  std::vector<cv::Point2f> pixels, ground;
  for (const map_match_t& match : fix.matches) {
    pixels.emplace_back(match.pixel[0], match.pixel[1]);
    ground.emplace_back(match.map_en[0], -match.map_en[1]);
  }
  if (pixels.size() < 3) return std::nullopt;
  cv::setRNGSeed(1);
  const cv::Mat A = cv::estimateAffinePartial2D(pixels, ground, cv::noArray(), cv::RANSAC, 9.0);
  if (A.empty()) return std::nullopt;
  return cv::Matx23d(A);
}

// One picture per wanted thing; a fix is shown once.
std::vector<MatchPicture> choose(const RegistrationMetrics& registration) {
  std::vector<const JudgedFix*> good, wrong, refused;
  for (const JudgedFix& fix : registration.fixes) {
    if (fix.fix->matches.empty()) continue;
    if (fix.false_fix) {
      wrong.push_back(&fix);
    } else if (fix.fix->valid) {
      good.push_back(&fix);
    } else {
      refused.push_back(&fix);
    }
  }
  const auto by_inliers = [](const JudgedFix* a, const JudgedFix* b) {
    return a->fix->num_inliers < b->fix->num_inliers;
  };
  std::stable_sort(good.begin(), good.end(), by_inliers);
  std::stable_sort(wrong.begin(), wrong.end(), by_inliers);
  std::stable_sort(refused.begin(), refused.end(), by_inliers);
  std::vector<MatchPicture> chosen;
  auto add = [&](const JudgedFix* fix, const std::string& why) {
    for (const MatchPicture& other : chosen) {
      if (other.fix == fix) return;
    }
    MatchPicture picture;
    picture.fix = fix;
    picture.why = why;
    chosen.push_back(picture);
  };
  if (!good.empty()) {
    add(good[good.size() / 2], "a typical fix");
    add(good.back(), "the fix with most inliers");
    add(good.front(), "the fix with fewest inliers");
  }
  if (!wrong.empty()) add(wrong.back(), "the wrong fix with most inliers");
  if (!refused.empty()) add(refused.back(), "the best that was refused");
  return chosen;
}

void draw(MatchPicture& picture, const cv::Mat& grey, const FlightRecord& record, const MapPicture* map) {
  const map_fix_t& fix = *picture.fix->fix;
  const double zoom = static_cast<double>(kPictureWidth) / grey.cols;
  cv::Mat resized;
  cv::resize(grey, resized, cv::Size(), zoom, zoom, zoom < 1 ? cv::INTER_AREA : cv::INTER_LINEAR);
  cv::cvtColor(resized, picture.camera, cv::COLOR_GRAY2BGR);
  for (size_t k = 0; k < fix.matches.size(); ++k) {
    const auto* pixel = fix.matches[k].pixel;
    mark(picture.camera, cv::Point2f(static_cast<float>(zoom * pixel[0]), static_cast<float>(zoom * pixel[1])), k);
  }
  const auto A = map != nullptr && record.frame ? image_to_ground(fix) : std::nullopt;
  if (!A) return;
  const Eigen::Vector2d origin((*A)(0, 2), -(*A)(1, 2));
  const Eigen::Vector2d along = Eigen::Vector2d((*A)(0, 0), -(*A)(1, 0)) / zoom;
  const Eigen::Vector2d across = Eigen::Vector2d((*A)(0, 1), -(*A)(1, 1)) / zoom;
  cv::cvtColor(map->resample(*record.frame, origin, along, across, resized.size()), picture.map, cv::COLOR_GRAY2BGR);
  Eigen::Matrix2d axes;
  axes << along, across;
  const Eigen::Matrix2d to_pixel = axes.inverse();
  for (size_t k = 0; k < fix.matches.size(); ++k) {
    const Eigen::Vector2d en(fix.matches[k].map_en[0], fix.matches[k].map_en[1]);
    const Eigen::Vector2d uv = to_pixel * (en - origin);
    mark(picture.map, cv::Point2f(static_cast<float>(uv.x()), static_cast<float>(uv.y())), k);
  }
}

}  // namespace

MapPicture::MapPicture(const std::filesystem::path& map) : raster_(map) {
  if (static_cast<int64_t>(raster_.width()) * raster_.height() > 400'000'000) {
    throw std::runtime_error(fmt::format("{}: too large for a picture", map.string()));
  }
  cv::Mat valid;
  grey_ = raster_.read_grey(cv::Rect(0, 0, raster_.width(), raster_.height()), &valid);
  grey_.setTo(kNothing, valid == 0);
}

void MapPicture::bounds(const EnuFrame& frame, Eigen::Vector2d& low, Eigen::Vector2d& high) const {
  const double w = raster_.width() - 1.0;
  const double h = raster_.height() - 1.0;
  low.setConstant(1e12);
  high.setConstant(-1e12);
  for (const Eigen::Vector2d& corner :
       {Eigen::Vector2d(0, 0), Eigen::Vector2d(w, 0), Eigen::Vector2d(0, h), Eigen::Vector2d(w, h)}) {
    Geodetic place = raster_.pixel_to_geodetic(corner);
    place.height = frame.anchor().height;
    const Eigen::Vector2d en = frame.to_enu(place).head<2>();
    low = low.cwiseMin(en);
    high = high.cwiseMax(en);
  }
}

cv::Mat MapPicture::resample(const EnuFrame& frame, const Eigen::Vector2d& origin, const Eigen::Vector2d& along,
                             const Eigen::Vector2d& across, cv::Size size) const {
  // Projections are smooth: exact at every 16th pixel, bilinear between them.
  constexpr int kStep = 16;
  const cv::Size coarse(size.width / kStep + 2, size.height / kStep + 2);
  cv::Mat_<cv::Vec2f> grid(coarse);
  for (int row = 0; row < coarse.height; ++row) {
    for (int column = 0; column < coarse.width; ++column) {
      const Eigen::Vector2d en = origin + kStep * (column * along + row * across);
      const Eigen::Vector2d pixel = raster_.geodetic_to_pixel(frame.to_geodetic(Eigen::Vector3d(en.x(), en.y(), 0.0)));
      grid(row, column) = cv::Vec2f(static_cast<float>(pixel.x()), static_cast<float>(pixel.y()));
    }
  }
  cv::Mat_<cv::Vec2f> where(size);
  for (int v = 0; v < size.height; ++v) {
    for (int u = 0; u < size.width; ++u) {
      const int row = v / kStep;
      const int column = u / kStep;
      const float b = static_cast<float>(v % kStep) / kStep;
      const float a = static_cast<float>(u % kStep) / kStep;
      where(v, u) = (1 - b) * ((1 - a) * grid(row, column) + a * grid(row, column + 1)) +
                    b * ((1 - a) * grid(row + 1, column) + a * grid(row + 1, column + 1));
    }
  }
  // Shrinking without averaging first would alias.
  const double metres = std::sqrt(std::abs(along.x() * across.y() - along.y() * across.x()));
  const double map_metres = raster_.metres_per_pixel(Eigen::Vector2d(0.5 * raster_.width(), 0.5 * raster_.height()));
  const double shrink = std::max(1.0, std::floor(metres / map_metres));
  cv::Mat source = grey_;
  if (shrink > 1.0) {
    cv::resize(grey_, source, cv::Size(), 1.0 / shrink, 1.0 / shrink, cv::INTER_AREA);
    where.forEach([shrink](cv::Vec2f& p, const int*) {
      p = (p + cv::Vec2f(0.5f, 0.5f)) / static_cast<float>(shrink) - cv::Vec2f(0.5f, 0.5f);
    });
  }
  cv::Mat picture;
  cv::remap(source, picture, where, cv::noArray(), cv::INTER_LINEAR, cv::BORDER_CONSTANT, cv::Scalar(kNothing));
  return picture;
}

std::string as_data_uri(const cv::Mat& picture, int jpeg_quality) {
  std::vector<uint8_t> bytes;
  cv::imencode(".jpg", picture, bytes, {cv::IMWRITE_JPEG_QUALITY, jpeg_quality});
  return "data:image/jpeg;base64," + base64(bytes);
}

std::vector<MatchPicture> draw_matches(const std::filesystem::path& log, const FlightRecord& record,
                                       const RegistrationMetrics& registration, const MapPicture* map) {
  std::vector<MatchPicture> pictures = choose(registration);
  std::set<int64_t> wanted;
  for (const MatchPicture& picture : pictures) wanted.insert(picture.fix->fix->utime);
  std::map<int64_t, cv::Mat> images;
  LogReader reader(log);
  while (images.size() < wanted.size()) {
    const auto event = reader.next();
    if (!event) break;
    if (event->channel != channel::kCamera) continue;
    const auto message = event->decode<image_t>();
    if (!message || wanted.count(message->utime) == 0) continue;
    const DecodedImage decoded = decode_image(*message);
    if (decoded.ok()) images[message->utime] = decoded.grey;
  }
  for (MatchPicture& picture : pictures) {
    const auto image = images.find(picture.fix->fix->utime);
    if (image != images.end()) draw(picture, image->second, record, map);
  }
  std::erase_if(pictures, [](const MatchPicture& picture) { return picture.camera.empty(); });
  return pictures;
}

}  // namespace orthonav::evaluate
