#include "services/ingest/asl_source.h"

#include <charconv>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <vector>

#include <fmt/format.h>
#include <opencv2/imgcodecs.hpp>

namespace orthonav::ingest {

namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// Numbers after the time stamp of a row; empty when one of them is not a number.
std::vector<double> numbers_of(const std::string& row) {
  std::vector<double> numbers;
  size_t at = row.find(',');
  while (at != std::string::npos) {
    ++at;
    while (at < row.size() && row[at] == ' ') ++at;
    double value = 0;
    const auto [end, error] = std::from_chars(row.data() + at, row.data() + row.size(), value);
    if (error != std::errc()) return {};
    numbers.push_back(value);
    at = row.find(',', static_cast<size_t>(end - row.data()));
  }
  return numbers;
}

// Empty when there is no such file, or when it is a folder or a device.
std::vector<uint8_t> read_bytes(const std::filesystem::path& file) {
  std::error_code error;
  if (!std::filesystem::is_regular_file(file, error)) return {};
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
}

cv::Mat decode(const std::vector<uint8_t>& bytes) {
  if (bytes.empty()) return {};
  try {
    return cv::imdecode(bytes, cv::IMREAD_GRAYSCALE | cv::IMREAD_IGNORE_ORIENTATION);
  } catch (const cv::Exception&) {
    return {};  // a header of a size that OpenCV refuses
  }
}

bool is_jpeg(const std::vector<uint8_t>& bytes) {
  return bytes.size() > 2 && bytes[0] == 0xFF && bytes[1] == 0xD8;
}

}  // namespace

bool AslSource::Table::open(const std::filesystem::path& csv) {
  file = csv;
  stream.open(csv);
  if (!stream) return false;
  advance();
  return true;
}

void AslSource::Table::advance() {
  time_ns = -1;
  while (std::getline(stream, row)) {
    ++line;
    if (!row.empty() && row.back() == '\r') row.pop_back();
    if (row.empty() || row[0] == '#') continue;
    const auto [end, error] = std::from_chars(row.data(), row.data() + row.size(), time_ns);
    // A row without a time is reported by whoever reads it: it takes the place of the next one.
    if (error != std::errc() || time_ns < 0) time_ns = 0;
    return;
  }
}

AslSource::AslSource(const std::filesystem::path& folder) {
  const auto root = std::filesystem::exists(folder / "mav0") ? folder / "mav0" : folder;
  images_ = root / "cam0" / "data";
  if (!camera_.open(root / "cam0" / "data.csv")) {
    throw std::runtime_error(camera_.file.string() + ": cannot be read: is this an ASL folder?");
  }
  if (!imu_.open(root / "imu0" / "data.csv")) {
    throw std::runtime_error(imu_.file.string() + ": cannot be read: is this an ASL folder?");
  }
  truth_.open(root / "state_groundtruth_estimate0" / "data.csv");
  imu_bytes_ = std::max<uintmax_t>(1, std::filesystem::file_size(imu_.file));
}

double AslSource::progress() const {
  auto& stream = const_cast<std::ifstream&>(imu_.stream);
  const auto at = stream.tellg();
  return at < 0 ? 1.0 : static_cast<double>(at) / static_cast<double>(imu_bytes_);
}

std::optional<SensorEvent> AslSource::next() {
  // Inertial samples first at equal times, so that an image finds the samples up to its own time.
  Table* first = nullptr;
  for (Table* table : {&imu_, &truth_, &camera_}) {
    if (table->time_ns >= 0 && (first == nullptr || table->time_ns < first->time_ns)) first = table;
  }
  if (first == nullptr) return std::nullopt;
  SensorEvent event = first == &imu_ ? read_imu() : first == &camera_ ? read_image() : read_truth();
  if (!event.error.empty()) event.error = fmt::format("{}:{}: {}", first->file.string(), first->line, event.error);
  first->advance();
  return event;
}

SensorEvent AslSource::read_imu() {
  const auto numbers = numbers_of(imu_.row);
  if (numbers.size() != 6) return {std::nullopt, "expected a time and 6 numbers"};
  imu_t imu;
  imu.utime = imu_.time_ns / 1000;
  for (int i = 0; i < 3; ++i) {
    imu.angular_rate[i] = numbers[static_cast<size_t>(i)];
    imu.specific_force[i] = numbers[static_cast<size_t>(i) + 3];
  }
  imu.temperature_deg_c = std::numeric_limits<float>::quiet_NaN();
  return {SensorMessage(imu), ""};
}

SensorEvent AslSource::read_image() {
  const size_t comma = camera_.row.find(',');
  const size_t name = comma == std::string::npos ? comma : camera_.row.find_first_not_of(' ', comma + 1);
  if (name == std::string::npos) return {std::nullopt, "expected a time and a file name"};
  const auto file = images_ / camera_.row.substr(name);
  image_t image;
  image.utime = camera_.time_ns / 1000;
  image.data = read_bytes(file);
  const cv::Mat grey = decode(image.data);
  if (grey.empty()) return {std::nullopt, file.string() + " is missing or is no image"};
  image.width = grey.cols;
  image.height = grey.rows;
  if (is_jpeg(image.data)) {
    image.pixelformat = image_t::PIXEL_FORMAT_MJPEG;
    image.row_stride = 0;
  } else {
    image.pixelformat = image_t::PIXEL_FORMAT_GRAY;
    image.row_stride = grey.cols;
    image.data.assign(grey.datastart, grey.dataend);
  }
  image.size = static_cast<int32_t>(image.data.size());
  image.nmetadata = 0;
  return {SensorMessage(std::move(image)), ""};
}

SensorEvent AslSource::read_truth() {
  const auto numbers = numbers_of(truth_.row);
  if (numbers.size() < 7) return {std::nullopt, "expected a time, a position and a quaternion"};
  const auto at = [&](size_t i) { return i < numbers.size() ? numbers[i] : kNaN; };
  const Geodetic position = frame_.to_geodetic({numbers[0], numbers[1], numbers[2]});
  truth_t truth;
  truth.utime = truth_.time_ns / 1000;
  truth.latitude_deg = position.latitude_deg;
  truth.longitude_deg = position.longitude_deg;
  truth.ellipsoidal_height = position.height;
  for (size_t i = 0; i < 4; ++i) truth.q_ENU_B[i] = numbers[3 + i];
  for (size_t i = 0; i < 3; ++i) {
    truth.velocity_enu[i] = at(7 + i);
    truth.gyro_bias[i] = at(10 + i);
    truth.accel_bias[i] = at(13 + i);
  }
  truth.height_above_ground = truth.compass_bias = truth.magnetic_declination = kNaN;
  truth.map_offset_en[0] = truth.map_offset_en[1] = kNaN;
  return {SensorMessage(truth), ""};
}

}  // namespace orthonav::ingest
