#include "tests/vio/bench_run.h"

#include <cstdio>
#include <ctime>
#include <fstream>
#include <sstream>

#include <opencv2/imgcodecs.hpp>

#include "common/bus/channels.h"
#include "common/camera/image_decode.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "orthonav/altitude_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/truth_t.hpp"
#include "services/vio/asl_setup.h"

namespace orthonav::vio {
namespace {

double thread_ms() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e3 * static_cast<double>(now.tv_sec) + 1e-6 * static_cast<double>(now.tv_nsec);
}

void print(const VioOutput& output, double ms) {
  const auto& s = output.state;
  std::printf(
      "%.2f session %d status %d tracked %d features %zu h %.2f v %.2f %.2f %.2f ba %.3f %.3f %.3f bg %.4f %.4f %.4f "
      "scale %.3f %.1f ms %s\n",
      1e-6 * static_cast<double>(output.utime), output.session, static_cast<int>(output.status), output.num_tracked,
      output.keyframe ? output.keyframe->features.size() : 0, output.height_above_ground, s.v().x(), s.v().y(),
      s.v().z(), s.ba().x(), s.ba().y(), s.ba().z(), s.bg().x(), s.bg().y(), s.bg().z(), output.scale_stddev, ms,
      output.reason.c_str());
}

void run_pending(Vio& vio, Result& result, bool verbose) {
  while (true) {
    const double start = thread_ms();
    auto output = vio.next();
    const double ms = thread_ms() - start;
    if (!output) break;
    if (verbose && (output->keyframe || output->status != Estimator::Status::kTracking)) print(*output, ms);
    result.outputs.push_back(*output);
    result.ms.push_back(ms);
  }
}

// Noise of a fixed sequence on an image, where it is asked for.
cv::Mat with_noise(const cv::Mat& image, const BenchRun& run, int64_t utime) {
  if (run.image_noise <= 0) return image;
  cv::RNG random(static_cast<uint64_t>(utime));
  cv::Mat noise(image.size(), CV_16S), sum;
  random.fill(noise, cv::RNG::NORMAL, 0, run.image_noise);
  cv::add(image, noise, sum, cv::noArray(), CV_8U);
  return sum;
}

bool enough(const Result& result, const BenchRun& run) {
  const auto start = result.started();
  return start && 1e-6 * static_cast<double>(result.outputs.back().utime - *start) > run.after_start;
}

std::vector<std::vector<std::string>> read_csv(const std::filesystem::path& file) {
  std::ifstream in(file);
  std::vector<std::vector<std::string>> rows;
  for (std::string line; std::getline(in, line);) {
    if (line.empty() || line[0] == '#') continue;
    while (!line.empty() && (line.back() == '\r' || line.back() == '\n')) line.pop_back();
    std::vector<std::string> cells;
    std::stringstream stream(line);
    for (std::string cell; std::getline(stream, cell, ',');) cells.push_back(cell);
    rows.push_back(cells);
  }
  return rows;
}

Result run_asl(const BenchInput& input, const BenchRun& run) {
  const auto mav = input.path / "mav0";
  const VioSetup setup = load_asl_setup(input.path, input.setup.options);
  Vio vio(setup.options, setup.camera, setup.extrinsics);
  Result result;
  const auto images = read_csv(mav / "cam0/data.csv"), samples = read_csv(mav / "imu0/data.csv");
  for (const auto& row : read_csv(mav / "state_groundtruth_estimate0/data.csv")) {
    result.truth[std::stoll(row[0]) / 1000] = {
        {std::stod(row[1]), std::stod(row[2]), std::stod(row[3])},
        {std::stod(row[4]), std::stod(row[5]), std::stod(row[6]), std::stod(row[7])}};
  }
  size_t next_image = 0;
  const int64_t first = std::stoll(images.front()[0]) / 1000;
  const auto age = [&](int64_t utime) { return 1e-6 * static_cast<double>(utime - first) - run.begin; };
  for (const auto& row : samples) {
    ImuSample sample;
    sample.utime = std::stoll(row[0]) / 1000;
    if (age(sample.utime) > run.duration || enough(result, run)) break;
    for (int k = 0; k < 3; ++k) {
      sample.gyro[k] = std::stod(row[static_cast<size_t>(1 + k)]);
      sample.accel[k] = std::stod(row[static_cast<size_t>(4 + k)]);
    }
    if (run.begin <= 0 || age(sample.utime) >= 0) vio.feed_imu(sample);
    for (; next_image < images.size(); ++next_image) {
      const int64_t utime = std::stoll(images[next_image][0]) / 1000;
      if (utime > sample.utime) break;
      if (age(utime) < 0) continue;
      const auto file = mav / "cam0/data" / images[next_image][1];
      vio.feed_image(utime, with_noise(cv::imread(file.string(), cv::IMREAD_GRAYSCALE), run, utime));
      run_pending(vio, result, run.verbose);
    }
    run_pending(vio, result, run.verbose);
  }
  result.counters = vio.counters();
  return result;
}

}  // namespace

std::optional<int64_t> Result::started() const {
  for (const VioOutput& output : outputs) {
    if (output.status != Estimator::Status::kInitialising) return output.utime;
  }
  return std::nullopt;
}

std::optional<Pose> truth_at(const std::map<int64_t, Pose>& truth, int64_t utime) {
  auto after = truth.lower_bound(utime);
  if (after == truth.end()) return std::nullopt;
  if (after->first == utime) return after->second;
  if (after == truth.begin()) return std::nullopt;
  const auto before = std::prev(after);
  if (after->first - before->first > 200000) return std::nullopt;
  const double s = static_cast<double>(utime - before->first) / static_cast<double>(after->first - before->first);
  return Pose{(1 - s) * before->second.p + s * after->second.p, before->second.q.slerp(s, after->second.q)};
}

int64_t feed_log(const std::filesystem::path& file, const BenchRun& run, int64_t later, Vio& vio, Result& result) {
  LogReader reader(file);
  std::optional<EnuFrame> frame;
  int64_t first = 0, last = 0;
  double next_reset = run.reset_every;
  while (const auto event = reader.next()) {
    if (first == 0) first = event->utime;
    const double age = 1e-6 * static_cast<double>(event->utime - first) - run.begin;
    if (age > run.duration || enough(result, run)) break;
    if (age < 0) continue;
    last = std::max(last, event->utime + later);
    if (age > next_reset) {
      vio.reset("vio_bench");
      next_reset += run.reset_every;
    }
    if (event->channel == channel::kImu) {
      if (const auto imu = event->decode<imu_t>()) {
        ImuSample sample;
        sample.utime = imu->utime + later;
        sample.gyro = Eigen::Map<const Eigen::Vector3d>(imu->angular_rate);
        sample.accel = Eigen::Map<const Eigen::Vector3d>(imu->specific_force);
        vio.feed_imu(sample);
      }
    } else if (event->channel == channel::kCamera) {
      if (const auto image = event->decode<image_t>()) {
        const DecodedImage decoded = decode_image(*image);
        if (decoded.ok()) vio.feed_image(image->utime + later, with_noise(decoded.grey, run, image->utime));
      }
    } else if (event->channel == channel::kAltitude) {
      if (const auto altitude = event->decode<altitude_t>()) {
        vio.feed_altitude(altitude->utime + later, altitude->height_above_ground, altitude->stddev);
      }
    } else if (event->channel == channel::kTruth) {
      if (const auto truth = event->decode<truth_t>()) {
        const Geodetic position{truth->latitude_deg, truth->longitude_deg, truth->ellipsoidal_height};
        if (!frame) frame.emplace(position);
        const double* q = truth->q_ENU_B;
        result.truth[truth->utime + later] = {frame->to_enu(position), {q[0], q[1], q[2], q[3]}};
        result.height[truth->utime + later] = truth->height_above_ground;
      }
    }
    run_pending(vio, result, run.verbose);
  }
  result.counters = vio.counters();
  return last;
}

Result run_input(const BenchInput& input, const BenchRun& run) {
  if (input.asl) return run_asl(input, run);
  Vio vio(input.setup.options, input.setup.camera, input.setup.extrinsics);
  Result result;
  feed_log(input.path, run, 0, vio, result);
  return result;
}

}  // namespace orthonav::vio
