#include "tools/evaluate_registration/photo_folder.h"

#include <cmath>
#include <fstream>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>

#include <fmt/format.h>

#include "common/config/config.h"

namespace orthonav::evaluate_registration {
namespace {

constexpr double kRadian = M_PI / 180.0;

std::vector<std::string> cells_of(const std::string& line) {
  std::vector<std::string> cells;
  std::stringstream stream(line);
  for (std::string cell; std::getline(stream, cell, ',');) {
    const size_t first = cell.find_first_not_of(" \t\r");
    const size_t last = cell.find_last_not_of(" \t\r");
    cells.push_back(first == std::string::npos ? "" : cell.substr(first, last - first + 1));
  }
  return cells;
}

double number(const std::string& cell) {
  try {
    size_t used = 0;
    const double value = std::stod(cell, &used);
    return used == cell.size() ? value : std::numeric_limits<double>::quiet_NaN();
  } catch (const std::exception&) {
    return std::numeric_limits<double>::quiet_NaN();
  }
}

class Table {
 public:
  explicit Table(const std::filesystem::path& file) : file_(file), in_(file) {
    std::string line;
    if (!in_ || !std::getline(in_, line)) throw std::runtime_error(fmt::format("cannot read {}", file.string()));
    const auto names = cells_of(line);
    for (size_t i = 0; i < names.size(); ++i) {
      for (const char* known : {"image", "latitude_deg", "longitude_deg", "east_m", "north_m", "map_u_px", "map_v_px",
                                "height_m", "heading_deg", "pitch_deg", "roll_deg"}) {
        if (names[i] == known) columns_[names[i]] = i;
      }
      if (!columns_.contains(names[i])) {
        throw std::runtime_error(fmt::format("{}:1: unknown column '{}'", file.string(), names[i]));
      }
    }
  }

  bool next() {
    for (std::string line; std::getline(in_, line);) {
      ++line_;
      if (line.find_first_not_of(" \t\r") == std::string::npos) continue;
      cells_ = cells_of(line);
      if (cells_.size() > columns_.size()) fail("more values than columns");
      return true;
    }
    return false;
  }
  bool has(const std::string& column) const { return columns_.contains(column); }
  std::string text(const std::string& column) const {
    const auto found = columns_.find(column);
    if (found == columns_.end()) fail("no column '" + column + "'");
    return found->second < cells_.size() ? cells_[found->second] : "";
  }
  double value(const std::string& column) const { return number(text(column)); }
  double value_or_zero(const std::string& column) const { return has(column) ? value(column) : 0.0; }
  [[noreturn]] void fail(const std::string& what) const {
    throw std::runtime_error(fmt::format("{}:{}: {}", file_.string(), line_, what));
  }

 private:
  std::filesystem::path file_;
  std::ifstream in_;
  std::map<std::string, size_t> columns_;
  std::vector<std::string> cells_;
  int line_ = 1;
};

Eigen::Vector2d position(const Table& row, const EnuFrame& frame, const Raster* map) {
  if (row.has("east_m")) return {row.value("east_m"), row.value("north_m")};
  Geodetic place;
  if (row.has("latitude_deg")) {
    place = {row.value("latitude_deg"), row.value("longitude_deg"), 0};
    if (!(std::abs(place.latitude_deg) <= 90) || !(std::abs(place.longitude_deg) <= 360)) {
      return Eigen::Vector2d::Constant(std::numeric_limits<double>::quiet_NaN());
    }
  } else if (row.has("map_u_px")) {
    if (map == nullptr) row.fail("positions in map pixels need --map to be the raster, not its database");
    Eigen::Vector2d pixel(row.value("map_u_px"), row.value("map_v_px"));
    if (!pixel.allFinite()) return pixel;
    place = map->pixel_to_geodetic(pixel);
  } else {
    row.fail("no position: latitude_deg and longitude_deg, map_u_px and map_v_px, or east_m and north_m");
  }
  place.height = frame.anchor().height;
  return frame.to_enu(place).head<2>();
}

}  // namespace

Eigen::Quaterniond q_G_B(const Photo& photo) {
  return Eigen::AngleAxisd(M_PI / 2 - photo.heading, Eigen::Vector3d::UnitZ()) *
         Eigen::AngleAxisd(-photo.pitch, Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(photo.roll, Eigen::Vector3d::UnitX());
}

PhotoFolder read_photos(const std::filesystem::path& folder, const EnuFrame& frame, const Raster* map) {
  ConfigNode file = ConfigNode::load(folder / "camera.yaml");
  ConfigNode camera = file.child("camera");
  PhotoFolder result{CameraModel::from_config(camera), {}};
  file.finish();
  Table row(folder / "metadata.csv");
  while (row.next()) {
    Photo photo;
    photo.image = folder / row.text("image");  // an absolute path stays as it is
    photo.en = position(row, frame, map);
    photo.height = row.value("height_m");
    photo.heading = row.value("heading_deg") * kRadian;
    photo.pitch = row.value_or_zero("pitch_deg") * kRadian;
    photo.roll = row.value_or_zero("roll_deg") * kRadian;
    if (!photo.en.allFinite()) {
      photo.problem = "position is not a number";
    } else if (!(photo.height > 0) || !std::isfinite(photo.height)) {
      photo.problem = "height is not a positive number";
    } else if (!std::isfinite(photo.heading) || !std::isfinite(photo.pitch) || !std::isfinite(photo.roll)) {
      photo.problem = "heading, pitch or roll is not a number";
    }
    result.photos.push_back(photo);
  }
  if (result.photos.empty()) row.fail("no photo");
  return result;
}

}  // namespace orthonav::evaluate_registration
