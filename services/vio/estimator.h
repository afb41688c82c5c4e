// The back end: a sliding window of keyframes, tightly coupled (equations 1 and 2).
//
// The window holds `window` keyframes and the newest frame. Per frame: propagate with the IMU, add the observations,
// triangulate what has parallax, optimise all in Ceres (IMU, reprojection under a Huber loss, prior), find outliers,
// look for failure. A frame becomes a keyframe when features have moved on average by `keyframe_parallax` beyond what
// the gyroscope's rotation explains, or many have been lost; a frame that does not is dropped when the next arrives,
// its IMU samples merged. Keyframes by parallax make the window long in time where the aircraft is high, which is
// what keeps the scale: monocular scale comes from acceleration, and a straight leg has none.
//
// Hovering makes no parallax and must neither empty the window nor lengthen an IMU interval for ever: after
// `keyframe_interval` a keyframe is made all the same, and takes the place of the one made so before. Where nothing
// moves at all the newest frame's velocity is held at zero.
//
// The time offset between camera and IMU is estimated, the extrinsics on request; heights above ground and scale hints
// are further factors when they are given.
//
// When the window is full the oldest keyframe is marginalised with the landmarks that begin in it and are no longer
// seen. Landmarks that are still seen only lose that observation and are anchored at their next one: nothing is used
// twice. What it leaves behind goes along with the estimate (prior.h).
//
// What is told to others continues what was told before. Each optimisation moves the whole window a little, mostly in
// tilt (which trades against the accelerometer's bias) and about the ground, 0.2 m at 110 m: a jump that is no motion
// and that relative_covariance does not describe. So newest() and keyframe() are given with respect to the last
// published keyframe, at the pose it was published with: the relative pose of consecutive keyframes is the window's
// own, and only the tilt is led back to gravity, over `tilt_return_time`, and the accelerometer's bias with it. A start
// whose scale turns out to have been wrong is published anew, as a new session, from the window as it is then.
//
// Knows no images and no middleware. Not thread-safe; deterministic.
#pragma once

#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "common/camera/camera_model.h"
#include "services/vio/bearing_rates.h"
#include "services/vio/imu_noise.h"
#include "services/vio/memory.h"
#include "services/vio/normal_equations.h"
#include "services/vio/prior.h"
#include "services/vio/state.h"

namespace orthonav::vio {

struct EstimatorOptions {
  int window = 12;                // keyframes
  double keyframe_parallax = 20;  // pixels
  double keyframe_tracked = 0.5;  // fraction of the last keyframe's features below which a new one is made
  double pixel_sigma = 0.1;       // pixels, 1 sigma of a tracked feature, at least
  double max_pixel_sigma = 0.5;   // pixels, likewise, at most: in between it is measured
  double robust_width = 1.5;      // sigmas at which the loss turns linear
  double outlier_error = 3.0;     // pixels, root mean square over the window, or in the newest frame twice that
  double min_parallax = 4.0;      // pixels, before a landmark is triangulated
  int iterations = 5;             // of the solver per frame
  double gravity = 9.81;          // m/s^2
  double accel_bias_sigma = 0.1;  // m/s^2, 1 sigma at the start of a session
  double gyro_bias_sigma = 0.02;  // rad/s, likewise
  double tilt_return_time = 3;    // s, in which the published attitude follows a correction of tilt
  double keyframe_interval = 3;   // s, after which a keyframe is made without motion
  bool estimate_time_offset = true;
  double time_offset = 0;           // s, IMU time = image time + this, as configured
  double time_offset_sigma = 0.01;  // s, 1 sigma of that
  double max_time_offset = 0.05;    // s, the estimate goes no further from the configured one
  bool refine_extrinsics = false;
  double extrinsics_sigma_deg = 0.5;  // degrees, 1 sigma of the configured rotation
  double extrinsics_sigma_m = 0.01;   // m, 1 sigma of the configured position
  bool use_altitude = true;           // heights, where there are any
  double altitude_bias_sigma = 1;     // m, 1 sigma of what all measured heights have in common
  double altitude_relief = 3;         // m, 1 sigma of the ground under one measurement about the tracked points
  double max_rescale = 0.12;          // of a start's scale that turns out wrong, before it is published anew
  double max_error_time = 0.7;        // s, for which camera and IMU may contradict each other
  double init_interval = 0.4;         // s, longest time between the frames that a start is made of
  double init_parallax = 15;          // pixels of movement that make such a frame earlier
  double init_min_time = 1.5;         // s, shortest stretch to start from
  double init_scale_sigma = 0.05;     // accept a start when the scale's relative standard deviation is below this
  double max_accel_bias = 1.0;        // m/s^2: beyond this the estimate has failed
  double max_gyro_bias = 0.3;         // rad/s: likewise
  double max_speed = 60;              // m/s: likewise
  int min_landmarks = 8;              // with fewer in view for `blind_time` the estimate has failed
  int degraded_landmarks = 20;        // with fewer in view the status is degraded
  double blind_time = 2.0;            // s
};

struct KeyframeFeature {
  int64_t id = 0;
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();
  Eigen::Vector3d ray_C = Eigen::Vector3d::UnitZ();
  Eigen::Vector3d p_W = Eigen::Vector3d::Zero();  // m
  double reprojection_error = 0;                  // pixels
  double depth_stddev = 0;                        // m, along the ray, poses taken as known
};

// A keyframe as published: the newest one as soon as the window has been optimised with it.
struct Keyframe {
  int64_t utime = 0;
  int id = 0;
  StateValues state;
  Eigen::Vector2d levelled{0, 0};                   // rad, as in vio_keyframe_t
  double height_above_ground = 0;                   // m, NaN: unknown
  Eigen::Matrix<double, 6, 6> relative_covariance;  // as in vio_keyframe_t; NaN: unknown
  double scale_stddev = 0;                          // relative, of the window; NaN: unknown
  std::vector<KeyframeFeature> features;
};

class Estimator {
 public:
  enum class Status { kInitialising, kTracking, kDegraded, kFailed };

  // `focal`: mean focal length, pixels.
  Estimator(const EstimatorOptions& options, const Extrinsics& extrinsics, const ImuNoise& noise, double focal);

  // Takes one frame: the features seen in it, the IMU samples from the previous frame's time to this one's, both ends
  // included, and a height above ground measured then. Times are of the IMU: image time plus time_offset() as it was
  // before the call. Returns the new status; after kFailed the caller reads reason() and calls reset().
  Status process(int64_t utime, const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu,
                 const std::optional<HeightMeasurement>& height = std::nullopt);

  // Whether the last frame makes a start worth trying: before the next frame the caller calls try_start(). It takes as
  // long as ten frames and more, so it may be called on a thread of its own, with nothing else of this object touched
  // until it returns. After a success status() is kTracking, and the next frame is the session's first keyframe.
  bool start_due() const { return start_due_; }
  void try_start();

  // The true lengths of the newest stretch over those published are `ratio` to `stddev` (relative), somebody knows:
  // a factor on the window's length. Ignored before a start, and where it is not a sensible number.
  void hint_scale(double ratio, double stddev);

  // Forgets everything but the gyroscope's bias, the time offset and, unless it has failed, its memory.
  void reset();

  // What another start may begin from; nullopt before there was a sound session.
  const std::optional<Memory>& memory() const { return memory_; }
  // Takes over the memory of an estimator that is no more, before the first frame. False for one of impossible numbers,
  // which is forgotten.
  bool resume(const Memory& memory);

  Status status() const { return status_; }
  const std::string& reason() const { return reason_; }          // why not yet initialised, degraded or failed
  const StateValues& newest() const { return newest_; }          // as published
  const Eigen::Vector2d& levelled() const { return levelled_; }  // rad, of newest(), as in vio_state_t
  // Whether the last call of process() published the window anew: a new session, without a loss of tracking.
  bool rescaled() const { return rescaled_; }
  double time_offset() const { return shared_.state.time_offset[0]; }  // s
  double height_bias() const { return shared_.state.height_bias[0]; }  // m
  const Extrinsics& extrinsics() const { return extrinsics_; }         // in use
  double pixel_sigma() const { return pixel_sigma_; }                  // pixels, noise of a feature as measured
  const ImuVariances& imu_variances() const { return imu_noise_.variances(); }  // as measured
  bool still() const { return still_; }                                         // nothing moves
  // Gyroscope bias as far as known, rad/s, and whether it is known well enough to predict rotations with.
  Eigen::Vector3d gyro_bias() const { return gyro_bias_; }
  bool gyro_bias_known() const { return gyro_bias_known_; }
  // The keyframe that the last call of process() made, if it made one.
  const std::optional<Keyframe>& keyframe() const { return published_; }
  int last_keyframe_id() const { return next_keyframe_id_ - 1; }
  // Features that the last call of process() found to be wrong.
  const std::set<int64_t>& outliers() const { return outliers_; }
  double height_above_ground() const { return height_; }  // m, NaN: unknown
  // Covariance of (position in W, rotation vector in W) as of the newest keyframe; NaN before the first.
  const Eigen::Matrix<double, 6, 6>& pose_covariance() const { return pose_covariance_; }
  const Eigen::Matrix3d& velocity_covariance() const { return velocity_covariance_; }  // in W; likewise
  // Of (accelerometer bias, gyroscope bias) in B; likewise.
  const Eigen::Matrix<double, 6, 6>& bias_covariance() const { return bias_covariance_; }
  double scale_stddev() const { return scale_stddev_; }  // relative; likewise
  size_t window_size() const { return frames_.size(); }

 private:
  struct ScaleHint {
    Frame* from;
    Frame* to;
    double distance, sigma;  // m
  };
  static std::vector<Prior::Block> blocks_of(const ScaleHint& hint);

  // estimator.cpp
  void add_frame(int64_t utime, const std::vector<ImuSample>& imu);
  void add_observations(const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu);
  void drop_newest();
  double parallax_to(const Frame& reference, int* common) const;
  void choose_keyframe();
  void triangulate();
  Eigen::Vector3d position_of(const Landmark& landmark) const;  // m, in W; it has a depth
  void update_height();
  std::vector<Frame*> frame_pointers() const;
  double weight() const { return focal_ / pixel_sigma_; }

  // estimator_solve.cpp
  struct Solution {
    bool converged;
    double cost;  // infinite: there is none
  };
  Solution optimise(int iterations, double tolerance);
  void choose_height_landmark(Frame& frame);
  NormalEquations normal_equations();
  void marginalise_oldest();
  void remove_frame(size_t index);
  void leave_frame(Landmark& landmark, const Frame& leaving);
  void take_hint();

  // estimator_watch.cpp
  void watch_standstill(int64_t utime, const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu);
  void find_outliers();
  void measure_noise(double share);
  ImuVariances imu_noise_of(const NormalEquations& equations, size_t index) const;
  std::string find_failure();
  bool scale_was_wrong() const;

  // estimator_start.cpp
  void collect_for_start();
  void recall_height(Frame& frame) const;
  void thin_out();
  bool solve_start();
  void weigh_imu();
  bool learn_imu_noise();
  bool fits_better_at_another_scale(double cost);
  void start_prior(const SharedValues& shared, double gyro_sigma);
  double scale_sigma(const NormalEquations& equations) const;

  // estimator_keyframe.cpp
  void follow_published();
  StateValues as_published(const StateValues& state) const;
  void publish_keyframe();
  void publish_anew();
  void update_covariance(const NormalEquations& equations, Keyframe& keyframe);

  EstimatorOptions options_;
  Extrinsics extrinsics_;  // of shared_
  Shared shared_;
  ImuNoise noise_;
  double focal_;

  Status status_ = Status::kInitialising;
  std::string reason_ = "no frame yet";
  std::vector<std::unique_ptr<Frame>> frames_;
  std::map<int64_t, Landmark> landmarks_;
  Prior prior_;
  Eigen::Vector3d gyro_bias_ = Eigen::Vector3d::Zero();
  double gyro_bias_sigma_ = 0;
  bool gyro_bias_known_ = false;
  BearingRates rates_;
  // The last second, to see standstill.
  struct Glance {
    int64_t utime;
    std::map<int64_t, Eigen::Vector3d> rays;
    Eigen::Vector3d gyro;  // rad/s, mean since the one before
  };
  std::deque<Glance> glances_;
  bool still_ = false;
  double still_time_ = 0;                                 // s
  Eigen::Vector3d still_gyro_ = Eigen::Vector3d::Zero();  // rad/s, mean of the last second
  int64_t next_frame_id_ = 0;
  int next_keyframe_id_ = 0;
  int64_t tried_utime_ = 0;  // when a start was last due
  bool start_due_ = false;
  int64_t seen_utime_ = 0;        // when enough landmarks were last in view
  int64_t last_frame_utime_ = 0;  // of the last frame that was judged; 0: none since the reset
  double pixel_sigma_ = 0;        // pixels, 1 sigma of a tracked feature, as measured
  ImuNoiseMeter imu_noise_;
  double widening_ = 1;            // of variances: how much more than they said it was of late
  double error_time_ = 0;          // s, for which camera and IMU have contradicted each other
  double sunk_time_ = 0;           // s, for which the ground has been above the aircraft
  int in_view_ = 0, refused_ = 0;  // landmarks of the newest frame: with a depth, and found to be wrong
  double height_ = 0;
  std::vector<ScaleHint> hints_;
  std::optional<std::pair<double, double>> new_hint_;  // ratio and its standard deviation
  bool rescaled_ = false;
  std::optional<Memory> memory_;
  Eigen::Matrix<double, 6, 6> pose_covariance_;
  Eigen::Matrix3d velocity_covariance_;
  Eigen::Matrix<double, 6, 6> bias_covariance_;
  double scale_stddev_ = 0;
  // The published world from the window's.
  Eigen::Quaterniond q_P_W_ = Eigen::Quaterniond::Identity();
  Eigen::Vector3d p_P_W_ = Eigen::Vector3d::Zero();
  Eigen::Vector2d levelled_{0, 0};  // rad, of newest_
  StateValues newest_;
  std::optional<Keyframe> published_;
  std::set<int64_t> outliers_;
};

}  // namespace orthonav::vio
