// The pictures of the report: the map from above, and camera images beside the map they were found on.
#pragma once

#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/geo/enu_frame.h"
#include "common/geo/raster.h"
#include "tools/evaluate/metrics.h"

namespace orthonav::evaluate {

// The map, ready to be resampled. Luminance of the whole raster stays in memory.
class MapPicture {
 public:
  // Throws std::runtime_error naming the file when it cannot be read or is larger than 400 million pixels.
  explicit MapPicture(const std::filesystem::path& map);

  // Bounds in the frame, m: east and north, smallest and largest.
  void bounds(const EnuFrame& frame, Eigen::Vector2d& low, Eigen::Vector2d& high) const;

  // The map at points of the frame: pixel (u, v) of the result shows origin + u along + v across (m, east and north).
  // What the map does not cover is grey.
  cv::Mat resample(const EnuFrame& frame, const Eigen::Vector2d& origin, const Eigen::Vector2d& along,
                   const Eigen::Vector2d& across, cv::Size size) const;

 private:
  Raster raster_;
  cv::Mat grey_;
};

// A picture as a data: URI (JPEG).
std::string as_data_uri(const cv::Mat& picture, int jpeg_quality = 80);

// A keyframe with its matches on the map.
struct MatchPicture {
  const JudgedFix* fix = nullptr;
  std::string why;  // why this keyframe was chosen
  cv::Mat camera;   // BGR, with the inliers marked
  cv::Mat map;      // BGR, turned and scaled to lie as the camera image does; empty without a map
};

// Chooses keyframes that tell most (a typical and the best true match, wrong fixes, a refused one) and draws them.
// Reads the log a second time for their images; those that are missing or damaged are left out.
std::vector<MatchPicture> draw_matches(const std::filesystem::path& log, const FlightRecord& record,
                                       const RegistrationMetrics& registration, const MapPicture* map);

// The tracks on the map as one SVG. Without a map the background is plain.
std::string draw_tracks(const FlightRecord& record, const Metrics& metrics, const MapPicture* map);

}  // namespace orthonav::evaluate
