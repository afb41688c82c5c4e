// A camera, a video file or a network stream, through OpenCV's VideoCapture (V4L2, GStreamer, FFmpeg).
#pragma once

#include <optional>

#include <opencv2/videoio.hpp>

#include "services/ingest/device.h"
#include "services/ingest/sensor_clock.h"

namespace orthonav::ingest {

struct VideoOptions {
  // /dev/video0, a file, a URL (rtsp://..., http://...), or a GStreamer pipeline (with " ! "), which ends in appsink;
  // empty: none.
  std::string source;
  // Where an image's time comes from. source: the driver's stamp of a V4L2 device, a file's own times from the moment
  // it is opened, a stream's own times on the host's clock (RTSP). arrival: when it was read. auto: arrival for http://
  // and pipelines, which often carry no true times, else source.
  enum class Stamps { kAuto, kSource, kArrival };
  Stamps stamps = Stamps::kAuto;
  int width = 0, height = 0;  // pixels, asked of a V4L2 device; 0: as it is
  double rate_hz = 0;         // asked of a V4L2 device; 0: as it is
  double delay_ms = 0;        // from the middle of the exposure to the stamp
  int jpeg_quality = 90;      // 1..100; 0: raw grey
};

class VideoDevice : public Device {
 public:
  VideoDevice(VideoOptions options, const HostClock& clock);

  std::string name() const override { return options_.source; }
  std::vector<std::string> channels() const override;
  void open() override;
  // One image. A file waits for the image's time. Blocks until the next image is there or the source gives up, which
  // takes OpenCV up to 10 s for a V4L2 device, 2 s for a URL.
  bool read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) override;

 private:
  enum class Kind { kDevice, kFile, kUrl, kPipeline };
  Kind kind() const;
  int64_t stamp(int64_t arrival);

  VideoOptions options_;
  const HostClock& clock_;
  cv::VideoCapture capture_;
  SensorClock stream_clock_;
  int64_t opened_ = 0;
  // An image of a file that is not due yet.
  std::optional<SensorEvent> waiting_;
  int64_t due_ = 0;
};

}  // namespace orthonav::ingest
