#include "services/vio/vio_service.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>

#include <gtest/gtest.h>
#include <opencv2/imgcodecs.hpp>

#include "common/bus/channels.h"
#include "common/bus/image_parts.h"
#include "common/camera/image_decode.h"
#include "common/config/config.h"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "tests/support/temporary_folder.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

int64_t to_utime(double t) {
  return 1'000'000'000 + static_cast<int64_t>(std::llround(1e6 * t));
}

image_t grey_message(double t, const cv::Mat& picture) {
  image_t message{};
  message.utime = to_utime(t);
  message.width = picture.cols;
  message.height = picture.rows;
  message.row_stride = picture.cols;
  message.pixelformat = image_t::PIXEL_FORMAT_GRAY;
  message.data.assign(picture.datastart, picture.dataend);
  message.size = static_cast<int32_t>(message.data.size());
  message.nmetadata = 0;
  return message;
}

image_t jpeg_message(double t, const cv::Mat& picture) {
  image_t message = grey_message(t, picture);
  message.pixelformat = image_t::PIXEL_FORMAT_MJPEG;
  message.row_stride = 0;
  cv::imencode(".jpg", picture, message.data);
  message.size = static_cast<int32_t>(message.data.size());
  return message;
}

const cv::Mat& some_picture() {
  static const cv::Mat picture = TexturedGround(60, 0.06, 1).picture(survey_flight(40, 2), 0);
  return picture;
}

TEST(DecodeImage, ReturnsWhatWasSent) {
  const DecodedImage grey = decode_image(grey_message(0, some_picture()), 640, 480);
  ASSERT_TRUE(grey.ok()) << grey.error;
  EXPECT_EQ(cv::norm(grey.grey, some_picture(), cv::NORM_INF), 0);
  const DecodedImage jpeg = decode_image(jpeg_message(0, some_picture()), 640, 480);
  ASSERT_TRUE(jpeg.ok()) << jpeg.error;
  EXPECT_LT(cv::norm(jpeg.grey, some_picture(), cv::NORM_L1) / (640 * 480), 5);
}

TEST(DecodeImage, HonoursTheRowStride) {
  image_t message = grey_message(0, some_picture());
  message.row_stride = 700;
  message.data.assign(700 * 480, 0);
  for (int v = 0; v < 480; ++v) {
    std::copy_n(some_picture().ptr<uint8_t>(v), 640, message.data.begin() + 700 * v);
  }
  message.size = 700 * 480;
  const DecodedImage decoded = decode_image(message);
  ASSERT_TRUE(decoded.ok()) << decoded.error;
  EXPECT_EQ(cv::norm(decoded.grey, some_picture(), cv::NORM_INF), 0);
}

TEST(DecodeImage, RefusesWhatIsDamaged) {
  image_t truncated_grey = grey_message(0, some_picture());
  truncated_grey.data.resize(1000);
  truncated_grey.size = 1000;
  image_t truncated_jpeg = jpeg_message(0, some_picture());
  truncated_jpeg.data.resize(truncated_jpeg.data.size() / 2);
  truncated_jpeg.size = static_cast<int32_t>(truncated_jpeg.data.size());
  image_t no_jpeg = truncated_jpeg;
  no_jpeg.data.assign(5000, 17);
  no_jpeg.size = 5000;
  image_t other_jpeg = jpeg_message(0, cv::Mat(100, 100, CV_8U, cv::Scalar(50)));
  other_jpeg.width = 640;
  other_jpeg.height = 480;
  image_t negative = grey_message(0, some_picture());
  negative.width = -640;
  image_t format = grey_message(0, some_picture());
  format.pixelformat = 12345;
  image_t lying = grey_message(0, some_picture());
  lying.data.resize(10);
  for (const image_t& message : {truncated_grey, truncated_jpeg, no_jpeg, other_jpeg, negative, format, lying}) {
    const DecodedImage decoded = decode_image(message);
    EXPECT_FALSE(decoded.ok());
    EXPECT_TRUE(decoded.grey.empty() || !decoded.ok());
  }
  EXPECT_NE(decode_image(grey_message(0, some_picture()), 752, 480).error.find("752x480"), std::string::npos);
}

// Twenty bytes can announce an image of a gigabyte.
TEST(DecodeImage, RefusesAJpegOfAnotherSizeByItsHeader) {
  image_t message = jpeg_message(0, some_picture());
  const std::array<uint8_t, 2> frame{0xFF, 0xC0};
  const auto at = std::search(message.data.begin(), message.data.end(), frame.begin(), frame.end());
  ASSERT_NE(at, message.data.end());
  std::fill_n(at + 5, 4, uint8_t{0x7F});
  const DecodedImage decoded = decode_image(message, 640, 480);
  EXPECT_NE(decoded.error.find("32639x32639"), std::string::npos) << decoded.error;
}

TEST(DecodeImage, ReadsProgressiveJpegs) {
  image_t message = jpeg_message(0, some_picture());
  cv::imencode(".jpg", some_picture(), message.data, {cv::IMWRITE_JPEG_PROGRESSIVE, 1});
  message.size = static_cast<int32_t>(message.data.size());
  EXPECT_TRUE(decode_image(message, 640, 480).ok()) << decode_image(message).error;
}

TEST(DecodeImage, LeavesPixelsWhereTheyLieWhateverTheOrientationTagSays) {
  image_t message = jpeg_message(0, some_picture());
  const cv::Mat plain = decode_image(message).grey;
  // APP1 of 34 bytes: Exif, big endian, one entry: orientation 6, a quarter turn.
  const std::array<uint8_t, 36> tag{0xFF, 0xE1, 0, 34, 'E', 'x', 'i', 'f', 0, 0, 'M', 'M', 0, 42, 0, 0, 0, 8,
                                    0,    1,    1, 18, 0,   3,   0,   0,   0, 1, 0,   6,   0, 0,  0, 0, 0, 0};
  message.data.insert(message.data.begin() + 2, tag.begin(), tag.end());
  message.size = static_cast<int32_t>(message.data.size());
  const DecodedImage tagged = decode_image(message, 640, 480);
  ASSERT_TRUE(tagged.ok()) << tagged.error;
  EXPECT_EQ(cv::norm(tagged.grey, plain, cv::NORM_INF), 0);
}

class VioServiceTest : public testing::Test {
 protected:
  VioServiceTest() : bus_("memq://") {
    std::ofstream aircraft(folder_.path() / "aircraft.yaml");
    aircraft << "camera: {width: 640, height: 480, fx: 850, fy: 850, cx: 319.5, cy: 239.5, model: radtan, "
                "distortion: [0, 0, 0, 0]}\n"
                "extrinsics: {p_B_C: [0.08, 0.01, -0.05], R_B_C: [0, -1, 0, -1, 0, 0, 0, 0, -1]}\n"
                "imu: {rate_hz: 200, gravity: 9.81}\n";
    write_vio("estimator: {window: 12}\n");
    bus_.subscribe(channel::kVioState, &VioServiceTest::on_state, this);
    bus_.subscribe(channel::kVioKeyframe, &VioServiceTest::on_keyframe, this);
    bus_.subscribe(channel::kKeyframeImage, &VioServiceTest::on_image_part, this);
  }

  void write_vio(const std::string& text) { std::ofstream(folder_.path() / "vio.yaml") << text; }

  void drain() {
    while (bus_.handleTimeout(0) > 0) {
    }
  }

  void send_imu(double t) {
    const ImuSample sample = flight_.imu(t, 9.81);
    imu_t message{};
    message.utime = sample.utime;
    for (int k = 0; k < 3; ++k) {
      message.angular_rate[k] = sample.gyro[k];
      message.specific_force[k] = sample.accel[k];
    }
    bus_.publish(channel::kImu, &message);
    drain();
  }

  void on_state(const lcm::ReceiveBuffer*, const std::string&, const vio_state_t* message) {
    states_.push_back(*message);
  }
  void on_image_part(const lcm::ReceiveBuffer*, const std::string&, const keyframe_image_t* message) {
    ASSERT_TRUE(images_.add(*message));
    if (images_.has(message->utime))
      pictures_[message->utime] = decode_image(images_.find(message->utime).front()).grey;
  }
  void on_keyframe(const lcm::ReceiveBuffer*, const std::string&, const vio_keyframe_t* message) {
    keyframes_.push_back(*message);
  }

  test::TemporaryFolder folder_;
  lcm::LCM bus_;
  Trajectory flight_ = survey_flight(40, 2.0);
  std::vector<vio_state_t> states_;
  std::vector<vio_keyframe_t> keyframes_;
  std::map<int64_t, cv::Mat> pictures_;  // of the keyframes, by utime, from their parts
  ImageAssembler images_{640, 480};
};

TEST_F(VioServiceTest, SpeaksTheContractOfItsMessagesAndSurvivesBadOnes) {
  Node node({"vio"}, bus_);
  VioService service(node, folder_.path());
  const TexturedGround ground(60, 0.06, 1);
  for (int k = 0; k <= 3010; ++k) {  // past the last image by as much as the time offset may grow to
    const double t = 0.005 * k;
    if (k % 20 == 0) {
      const cv::Mat picture = ground.picture(flight_, t);
      const image_t good = grey_message(t, picture);
      bus_.publish(channel::kCamera, &good);
      if (k % 200 == 0) {
        image_t bad = jpeg_message(t, picture);
        bad.data.resize(bad.data.size() / 3);
        bad.size = static_cast<int32_t>(bad.data.size());
        bus_.publish(channel::kCamera, &bad);
        const image_t small = grey_message(t, picture(cv::Rect(0, 0, 320, 240)).clone());
        bus_.publish(channel::kCamera, &small);
        imu_t broken{};
        broken.utime = to_utime(t) - 10'000'000;
        broken.specific_force[0] = std::numeric_limits<double>::quiet_NaN();
        bus_.publish(channel::kImu, &broken);
        broken.specific_force[0] = 0;
        bus_.publish(channel::kImu, &broken);
        const char noise[] = "no message";
        bus_.publish(channel::kImu, noise, sizeof noise);
      }
    }
    send_imu(t);
  }
  ASSERT_EQ(states_.size(), 151u);  // one per good image
  EXPECT_EQ(states_.front().status, int8_t{vio_state_t::INITIALISING});
  EXPECT_TRUE(std::isnan(states_.front().p_W_B[0]));
  EXPECT_TRUE(std::isnan(states_.front().pose_covariance[0]));
  EXPECT_EQ(states_.back().status, int8_t{vio_state_t::TRACKING});
  EXPECT_EQ(states_.back().session, 1000);  // the second of the first image
  EXPECT_EQ(states_.back().processing_ms, 0) << "a replay must repeat";
  EXPECT_NEAR(states_.back().height_above_ground, 40, 6);
  ASSERT_GT(keyframes_.size(), 3u);
  for (size_t k = 0; k < keyframes_.size(); ++k) {
    EXPECT_EQ(keyframes_[k].id, static_cast<int>(k));
    EXPECT_GT(keyframes_[k].num_features, 20);
    const cv::Mat picture = ground.picture(flight_, 1e-6 * static_cast<double>(keyframes_[k].utime - to_utime(0)));
    ASSERT_TRUE(pictures_.contains(keyframes_[k].utime)) << "keyframe " << k << " came without its image";
    EXPECT_EQ(cv::norm(pictures_[keyframes_[k].utime], picture, cv::NORM_INF), 0);
    EXPECT_EQ(std::isnan(keyframes_[k].relative_covariance[0]), k == 0);
  }
  EXPECT_GT(node.health().counter("rejected.camera"), 20);
  EXPECT_GT(node.health().counter("rejected.imu.not_finite"), 10);
  EXPECT_GT(node.health().counter("rejected.imu.order"), 10);
}

TEST_F(VioServiceTest, SaysWhenImagesDoNotArrive) {
  Node node({"vio"}, bus_);
  VioService service(node, folder_.path());
  for (int k = 0; k < 20; ++k) {
    if (k == 10 || k == 15 || k == 16) continue;
    const image_t image = grey_message(0.1 * k, some_picture());
    bus_.publish(channel::kCamera, &image);
    drain();
  }
  EXPECT_EQ(node.health().counter("rejected.camera.missed"), 3);
}

TEST_F(VioServiceTest, EndsItsSessionOnRequest) {
  Node node({"vio"}, bus_);
  VioService service(node, folder_.path());
  const TexturedGround ground(60, 0.06, 1);
  const auto fly = [&](int from, int to) {
    for (int k = from; k < to; ++k) {
      const double t = 0.005 * k;
      if (k % 20 == 0) {
        const image_t picture = grey_message(t, ground.picture(flight_, t));
        bus_.publish(channel::kCamera, &picture);
      }
      send_imu(t);
    }
  };
  fly(0, 2400);
  ASSERT_EQ(states_.back().status, int8_t{vio_state_t::TRACKING});
  vio_reset_t request{};
  request.utime = to_utime(12);
  request.reason = "somebody\x1b[2J";
  for (int i = 0; i < 3; ++i) bus_.publish(channel::kVioReset, &request);
  fly(2400, 2440);
  EXPECT_EQ(states_.back().status, int8_t{vio_state_t::INITIALISING});
  EXPECT_EQ(states_.back().session, 1001);
  EXPECT_NE(node.health().message().find("somebody [2J"), std::string::npos) << node.health().message();
  EXPECT_EQ(node.health().counter("resets"), 1);
  EXPECT_EQ(node.health().counter("rejected.reset.too_soon"), 2);
}

TEST_F(VioServiceTest, NamesAMisspeltKey) {
  write_vio("estimator: {windw: 12}\n");
  Node node({"vio"}, bus_);
  try {
    VioService service(node, folder_.path());
    FAIL() << "a misspelt key passed";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("windw"), std::string::npos);
  }
}

}  // namespace
}  // namespace orthonav::vio
