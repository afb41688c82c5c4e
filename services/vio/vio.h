// The odometry without its middleware: IMU and images in, states and keyframes out.
//
//   Vio vio(options, camera, extrinsics);
//   vio.feed_imu(sample);  vio.feed_image(utime, grey);
//   while (auto output = vio.next()) ...
//
// Initialises by itself, in flight or from standstill; finds its own failure, restarts and counts the session up.
// The first session is the Unix second of the first image: a process that is started anew in flight takes a larger
// number than its predecessor, since no session is shorter than a second.
// A calibration that cannot be right (CalibrationCheck) is reported and not flown. Bad input is refused, counted and
// survived, wrong stamps too (SampleOrder). Not thread-safe; deterministic: the outputs depend on the order of the
// samples of each sensor and not on how the two are interleaved, unless a clock is set back.
#pragma once

#include <cstdint>
#include <deque>
#include <future>
#include <map>
#include <optional>
#include <string>

#include <opencv2/core.hpp>

#include "services/vio/options.h"
#include "services/vio/sample_order.h"

namespace orthonav::vio {

struct VioOutput {
  int64_t utime = 0;  // of the image
  int session = 1;
  Estimator::Status status = Estimator::Status::kInitialising;
  std::string reason;              // why initialising or degraded; why the last session ended, at a restart
  std::string notice;              // what is not as it was declared to be, and is made do with; empty: nothing
  StateValues state;               // meaningful unless initialising
  Eigen::Vector2d levelled{0, 0};  // rad, as in vio_state_t; likewise
  double height_above_ground = 0;  // m, NaN: unknown
  Eigen::Matrix<double, 6, 6> pose_covariance;  // as in vio_state_t
  Eigen::Matrix3d velocity_covariance;          // likewise
  double scale_stddev = 0;                      // likewise
  double time_offset = 0;                       // s, likewise
  Extrinsics extrinsics;                        // in use
  int num_tracked = 0;
  int last_keyframe_id = -1;
  std::optional<Keyframe> keyframe;
};

class Vio {
 public:
  Vio(const VioOptions& options, const CameraModel& camera, const Extrinsics& extrinsics);
  Vio(const Vio&) = delete;
  Vio& operator=(const Vio&) = delete;

  // Samples must be finite, plausible and in time order; others are counted and ignored. A stamp that is ahead of the
  // others does not outlive the half second in which they go on without it.
  void feed_imu(const ImuSample& sample);

  // `grey`: CV_8UC1 of the camera's size, kept without copying. Others, and images out of order, are counted and
  // ignored; of stamps the same holds.
  void feed_image(int64_t utime, const cv::Mat& grey);

  // A height above ground, m; `stddev` NaN: unknown. Others than finite ones, and those out of order, are counted and
  // ignored.
  void feed_altitude(int64_t utime, double height, double stddev);

  // True lengths over published ones, as the map sees them; see Estimator::hint_scale.
  void hint_scale(double ratio, double stddev);

  // Ends the session, or what is collected for its start, for a reason shown in the outputs until the next one begins.
  // False, counted and without effect within 5 s of the last one: requests that repeat must not keep it from starting.
  bool reset(const std::string& reason);

  // Before the first image: goes on from what another process knew. False for a memory of impossible numbers.
  bool resume(const Memory& memory) { return estimator_.resume(memory); }
  // What another process may go on from; nullopt before there was a sound session. After next(), with a keyframe.
  const std::optional<Memory>& memory() const { return estimator_.memory(); }

  // Processes the next image that the IMU reaches beyond; nullopt when there is none.
  std::optional<VioOutput> next();

  int session() const { return session_; }
  // Named numbers for the health: what was received, rejected, restarted.
  const std::map<std::string, double>& counters() const { return counters_; }

 private:
  struct PendingImage {
    int64_t utime;
    cv::Mat grey;
  };
  // Counts what was refused under the sensor's name.
  template <class Sample>
  void count(const char* sensor, const typename SampleOrder<Sample>::Taken& taken);
  std::vector<ImuSample> take_imu(int64_t from, int64_t to, bool* gap);
  void restart(const std::string& reason);
  void finish_start();  // waits for a start being solved; before anything of the estimator is touched
  std::optional<HeightMeasurement> height_at(int64_t utime) const;
  const std::vector<TrackedFeature>& with_row_delays(const std::vector<TrackedFeature>& features);

  struct Altitude {
    int64_t utime;
    double height, stddev;
  };
  VioOptions options_;
  CameraModel camera_;
  Extrinsics extrinsics_;
  Tracker tracker_;
  Estimator estimator_;
  CalibrationCheck calibration_;
  int64_t session_began_ = 0;
  std::deque<Altitude> altitudes_;
  std::vector<TrackedFeature> delayed_;
  SampleOrder<ImuSample> imu_order_;
  SampleOrder<PendingImage> image_order_;
  SampleOrder<Altitude> altitude_order_;
  std::deque<ImuSample> imu_;
  std::deque<PendingImage> images_;
  int64_t last_state_ = 0;  // the time of the newest state, by the IMU's clock; 0: none yet
  int session_ = 0;         // 0: before the first image
  std::string restart_reason_;
  int64_t reset_at_ = 0;  // last_state_ when a reset was last asked for
  std::map<std::string, double> counters_;
  // A start being solved while the next image is on its way. Last, so that it ends before what it works on.
  std::future<void> start_;
};

}  // namespace orthonav::vio
