// A small world and scenarios for the tests of the flight simulator.
#pragma once

#include <cmath>
#include <filesystem>
#include <string>
#include <vector>

#include <opencv2/imgproc.hpp>

#include "common/config/config.h"
#include "tools/simulate/scenario.h"
#include "tools/simulate/world.h"

namespace orthonav::simulate {

inline std::filesystem::path config_folder(const std::string& scenario) {
  return std::filesystem::path(ORTHONAV_SOURCE) / "config" / scenario;
}

// Rolling ground, textured at the scale of its pixels, `width` x `depth` m of map and a margin around it.
inline World rolling_world(double width, double depth, double resolution = 0.5, double margin = 120) {
  const int columns = static_cast<int>((width + 2 * margin) / resolution);
  const int rows = static_cast<int>((depth + 2 * margin) / resolution);
  World world{EnuFrame({47.4, 8.5, 500.0}), {}, 0, width, -depth, 0, 0, {}};
  world.surface.east_min = -margin;
  world.surface.north_max = margin;
  world.surface.resolution = resolution;
  world.surface.height.create(rows, columns, CV_32F);
  for (int v = 0; v < rows; ++v) {
    for (int u = 0; u < columns; ++u) {
      const double east = (u + 0.5) * resolution, north = (v + 0.5) * resolution;
      world.surface.height.at<float>(v, u) =
          static_cast<float>(4.0 * std::sin(east / 60.0) * std::cos(north / 45.0) + 0.01 * east);
    }
  }
  world.surface.luminance.create(rows, columns, CV_8U);
  cv::RNG rng(5);
  rng.fill(world.surface.luminance, cv::RNG::UNIFORM, 40, 220);
  cv::GaussianBlur(world.surface.luminance, world.surface.luminance, {0, 0}, 1.5);
  world.ground_height = cv::mean(world.surface.height)[0];
  world.map_offset = [](const Eigen::Vector2d& p_en) { return Eigen::Vector2d(0.3, -0.2 + 1e-4 * p_en.x()); };
  return world;
}

// begin, begin + step, ... below end.
inline std::vector<double> range(double begin, double end, double step) {
  std::vector<double> values(static_cast<size_t>(std::ceil((end - begin) / step - 1e-9)));
  for (size_t i = 0; i < values.size(); ++i) values[i] = begin + static_cast<double>(i) * step;
  return values;
}

// Where `plan_flight` flies over a flat map of this size, m.
inline FlightArea flat_area(double width, double depth, double ground = 0) {
  return {0, width, -depth, 0, ground, [ground](const Eigen::Vector2d&) { return ground; }};
}

}  // namespace orthonav::simulate
