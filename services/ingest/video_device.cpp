#include "services/ingest/video_device.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <stdexcept>
#include <thread>

#include <fmt/format.h>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "common/bus/channels.h"

namespace orthonav::ingest {

namespace {

constexpr int kUrlTimeout = 2000;            // ms
constexpr int64_t kOldestStamp = 1'000'000;  // microseconds: an older one of a driver is of another clock

image_t image_of(const cv::Mat& picture, int jpeg_quality) {
  cv::Mat grey = picture;
  if (picture.channels() == 3) cv::cvtColor(picture, grey, cv::COLOR_BGR2GRAY);
  if (picture.channels() == 4) cv::cvtColor(picture, grey, cv::COLOR_BGRA2GRAY);
  if (grey.depth() == CV_16U) grey.convertTo(grey, CV_8U, 1.0 / 256);
  image_t image{};
  image.width = grey.cols;
  image.height = grey.rows;
  if (jpeg_quality > 0) {
    image.pixelformat = image_t::PIXEL_FORMAT_MJPEG;
    cv::imencode(".jpg", grey, image.data, {cv::IMWRITE_JPEG_QUALITY, jpeg_quality});
  } else {
    image.pixelformat = image_t::PIXEL_FORMAT_GRAY;
    image.row_stride = grey.cols;
    if (!grey.isContinuous()) grey = grey.clone();
    image.data.assign(grey.datastart, grey.dataend);
  }
  image.size = static_cast<int32_t>(image.data.size());
  return image;
}

}  // namespace

VideoDevice::VideoDevice(VideoOptions options, const HostClock& clock) : options_(std::move(options)), clock_(clock) {}

std::vector<std::string> VideoDevice::channels() const {
  return {channel::kCamera};
}

VideoDevice::Kind VideoDevice::kind() const {
  if (options_.source.find(" ! ") != std::string::npos) return Kind::kPipeline;
  if (options_.source.find("://") != std::string::npos) return Kind::kUrl;
  return options_.source.starts_with("/dev/") ? Kind::kDevice : Kind::kFile;
}

void VideoDevice::open() {
  capture_.release();
  stream_clock_ = SensorClock();
  waiting_.reset();
  bool open = false;
  switch (kind()) {
    case Kind::kDevice:
      open = capture_.open(options_.source, cv::CAP_V4L2);
      if (options_.width > 0) capture_.set(cv::CAP_PROP_FRAME_WIDTH, options_.width);
      if (options_.height > 0) capture_.set(cv::CAP_PROP_FRAME_HEIGHT, options_.height);
      if (options_.rate_hz > 0) capture_.set(cv::CAP_PROP_FPS, options_.rate_hz);
      break;
    case Kind::kPipeline:
      open = capture_.open(options_.source, cv::CAP_GSTREAMER);
      break;
    case Kind::kUrl:
      open = capture_.open(options_.source, cv::CAP_FFMPEG,
                           {cv::CAP_PROP_OPEN_TIMEOUT_MSEC, kUrlTimeout, cv::CAP_PROP_READ_TIMEOUT_MSEC, kUrlTimeout});
      break;
    case Kind::kFile:
      open = std::filesystem::is_regular_file(options_.source) && capture_.open(options_.source, cv::CAP_FFMPEG);
  }
  if (!open) throw std::runtime_error(fmt::format("{}: cannot be opened as a camera or video", options_.source));
  opened_ = clock_.now();
}

int64_t VideoDevice::stamp(int64_t arrival) {
  const Kind kind = this->kind();
  const bool arrival_by_default =
      kind == Kind::kPipeline || (kind == Kind::kUrl && !options_.source.starts_with("rtsp"));
  if (options_.stamps == VideoOptions::Stamps::kArrival ||
      (options_.stamps == VideoOptions::Stamps::kAuto && arrival_by_default)) {
    return arrival;
  }
  const double position_ms = capture_.get(cv::CAP_PROP_POS_MSEC);
  if (!std::isfinite(position_ms)) return arrival;
  const int64_t position = std::llround(position_ms * 1e3);
  if (kind == Kind::kFile) return opened_ + position;
  if (kind == Kind::kDevice) {
    const int64_t utime = clock_.of_monotonic(position * 1000);
    return utime <= arrival && arrival - utime < kOldestStamp ? utime : arrival;
  }
  return stream_clock_.to_host(position, arrival);
}

bool VideoDevice::read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) {
  if (!waiting_) {
    cv::Mat picture;
    if (!capture_.read(picture) || picture.empty()) {
      if (kind() == Kind::kFile) return false;
      throw std::runtime_error(options_.source + ": no image came");
    }
    due_ = stamp(clock_.now());
    image_t image = image_of(picture, options_.jpeg_quality);
    image.utime = due_ - std::llround(options_.delay_ms * 1e3);
    waiting_ = SensorEvent{SensorMessage(std::move(image)), ""};
  }
  const int64_t early = kind() == Kind::kFile ? due_ - clock_.now() : 0;
  if (early > 0)
    std::this_thread::sleep_for(std::min<std::chrono::microseconds>(std::chrono::microseconds(early), patience));
  if (early > std::chrono::microseconds(patience).count()) return true;
  events.push_back(std::move(*waiting_));
  waiting_.reset();
  return true;
}

}  // namespace orthonav::ingest
