#include "services/registration/registration_service.h"

#include <algorithm>
#include <fstream>
#include <limits>
#include <set>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <opencv2/imgcodecs.hpp>

#include "common/bus/channels.h"
#include "common/bus/image_parts.h"
#include "orthonav/health_t.hpp"
#include "orthonav/map_tile_request_t.hpp"
#include "orthonav/place_hypotheses_t.hpp"
#include "orthonav/position_hint_t.hpp"
#include "tests/faults/vandal.h"
#include "tests/registration/synthetic_flight.h"
#include "tests/support/bus_client.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

constexpr int64_t kStart = 1'700'000'000'000'000;
const double kNan = std::numeric_limits<double>::quiet_NaN();

// A map server of the test's own, which loses what the test wants lost.
class FakeMapServer {
 public:
  FakeMapServer(lcm::LCM& bus, const std::string& fingerprint, const MapFeatures& features)
      : bus_(bus), features_(features) {
    info_ = {};
    info_.map_name = fingerprint + ".onmap";
    info_.fingerprint = fingerprint;
    info_.anchor_latitude_deg = 48;
    info_.anchor_longitude_deg = 11;
    info_.anchor_height = 500;
    info_.metres_per_pixel = SyntheticGround::kSigma;
    info_.num_features = static_cast<int64_t>(features.positions.size());
    info_.descriptor_size = 128;
    info_.keypoint_size = 8;
    info_.keypoint_stride = 10;
    info_.features = "grid";
    info_.num_levels = 1;
    info_.map_fingerprint = fingerprint;
    info_.tile_size = 45;
    info_.east_max = 180;
    info_.north_min = -180;
    info_.tile_columns = 4;
    info_.tile_rows = 4;
    bus.subscribe(channel::kMapTileRequest, &FakeMapServer::handle, this);
  }

  void announce() { bus_.publish(channel::kMapInfo, &info_); }

  map_info_t info_;
  int lose_every = 0;  // every so many parts is lost
  bool running = true;
  int requests = 0;

 private:
  void handle(const lcm::ReceiveBuffer*, const std::string&, const map_tile_request_t* request) {
    if (!running || request->fingerprint != info_.fingerprint) return;
    ++requests;
    for (size_t k = 0; k < request->tile.size(); ++k) {
      const int tile = request->tile[k];
      std::vector<size_t> rows;
      for (size_t i = 0; i < features_.positions.size(); ++i) {
        const Eigen::Vector3f& p = features_.positions[i];
        const int column = static_cast<int>(p.x() / 45);
        const int row = static_cast<int>((p.y() + 180) / 45);
        if (row * 4 + column == tile) rows.push_back(i);
      }
      for (int part = 0; part < 2; ++part) {
        map_tile_t message{};
        message.fingerprint = info_.fingerprint;
        message.tile = tile;
        message.part = part;
        message.num_parts = 2;
        message.descriptor_size = 128;
        if (request->part[k] >= 0 && request->part[k] != part) continue;
        for (size_t i = static_cast<size_t>(part); i < rows.size(); i += 2) {
          const Eigen::Vector3f& p = features_.positions[rows[i]];
          message.position.push_back({p.x(), p.y(), p.z()});
          const uchar* d = features_.descriptors.ptr(static_cast<int>(rows[i]));
          message.descriptors.insert(message.descriptors.end(), d, d + 128);
        }
        message.num_features = static_cast<int32_t>(message.position.size());
        message.num_bytes = static_cast<int32_t>(message.descriptors.size());
        ++sent_;
        if (lose_every > 0 && sent_ % lose_every == 0) continue;
        bus_.publish(channel::kMapTile, &message);
      }
    }
  }

  lcm::LCM& bus_;
  MapFeatures features_;
  int sent_ = 0;
};

class RegistrationOnTheBus : public testing::Test {
 protected:
  explicit RegistrationOnTheBus(const std::string& method = "paper") {
    std::ofstream(folder_ / "registration.yaml") << "method: " << method << "\n";
    std::ofstream(folder_ / "aircraft.yaml")
        << "magnetic_declination_deg: 4\nimu: {gravity: 9.81}\n"
           "camera: {width: 320, height: 240, fx: 400, fy: 400, cx: 161.5, cy: 118.2, model: radtan, "
           "distortion: [-0.11, 0.09, 0.0003, -0.0002]}\n";
    service_ = std::make_unique<RegistrationService>(node_, folder_.path());
  }

  void pump() {
    while (bus_.handleTimeout(0) > 0) {
    }
  }
  // Time passes in steps of 10 ms, as the data of a replay would have it.
  void pass(double seconds) {
    for (int i = 0; i < std::lround(seconds * 100); ++i) {
      now_ += 10'000;
      node_.advance(now_);
      pump();
    }
  }
  void fetch_map() {
    server_.announce();
    pump();
    pass(3);
  }

  void send_compass(int64_t utime, double true_heading_value) {
    compass_t compass{};
    compass.utime = utime;
    compass.heading = true_heading_value - 4 * M_PI / 180;
    compass.heading_stddev = 0.05;
    bus_.publish(channel::kCompass, &compass);
    pump();
  }
  image_t image_message(int64_t utime, const cv::Mat& picture) const {
    image_t image{};
    image.utime = utime;
    image.width = picture.cols;
    image.height = picture.rows;
    image.pixelformat = image_t::PIXEL_FORMAT_MJPEG;
    cv::imencode(".jpg", picture, image.data, {cv::IMWRITE_JPEG_QUALITY, 95});
    image.size = static_cast<int32_t>(image.data.size());
    return image;
  }
  vio_keyframe_t keyframe_message(int64_t utime, int id) const {
    const Keyframe& keyframe = capture_.keyframe;
    vio_keyframe_t message{};
    message.utime = utime;
    message.session = 3;
    message.id = id;
    Eigen::Map<Eigen::Vector3d>(message.p_W_B) = keyframe.p_W_B;
    Eigen::Map<Eigen::Vector3d>(message.p_B_C) = keyframe.extrinsics.p_B_C;
    const Eigen::Quaterniond q_B_C(keyframe.extrinsics.R_B_C);
    const auto fill = [](double* out, const Eigen::Quaterniond& q) {
      out[0] = q.w();
      out[1] = q.x();
      out[2] = q.y();
      out[3] = q.z();
    };
    fill(message.q_W_B, keyframe.q_W_B);
    fill(message.q_B_C, q_B_C);
    message.height_above_ground = keyframe.height_above_ground;
    for (const TrackedPoint& point : keyframe.points) {
      vio_feature_t feature{};
      feature.id = point.id;
      feature.pixel[0] = static_cast<float>(point.pixel.x());
      feature.pixel[1] = static_cast<float>(point.pixel.y());
      Eigen::Map<Eigen::Vector3d>(feature.ray_C) = point.ray_C;
      Eigen::Map<Eigen::Vector3d>(feature.p_W) = point.p_W;
      feature.reprojection_error = 0.5F;
      message.features.push_back(feature);
    }
    message.num_features = static_cast<int32_t>(message.features.size());
    return message;
  }
  // Image and compass of the capture around `utime`, and the keyframe.
  void send_all(int64_t utime, int id) {
    const image_t image = image_message(utime, capture_.image);
    bus_.publish(channel::kCamera, &image);
    send_compass(utime - 50'000, capture_.heading.value - 0.02);
    const vio_keyframe_t keyframe = keyframe_message(utime, id);
    bus_.publish(channel::kVioKeyframe, &keyframe);
    pump();
    send_compass(utime + 50'000, capture_.heading.value + 0.02);
  }
  void expect_fix(const map_fix_t& fix) const {
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_LT((Eigen::Vector3d(fix.p_G_B) - capture_.p_G_B).norm(), 1.0);
  }

  test::TemporaryFolder folder_;
  lcm::LCM bus_{"memq://"};
  Node node_{{.service = "registration"}, bus_};
  SyntheticGround ground_{1};
  Capture capture_ = ground_.capture({95, -80, 60}, 1.2, 0.03, -0.04);
  FakeMapServer server_{bus_, "aaaaaaaaaaaaaaaa", ground_.grid_features(8)};
  test::Collector<map_fix_t> fixes_{bus_, channel::kMapFix};
  std::unique_ptr<RegistrationService> service_;
  int64_t now_ = kStart;
};

TEST_F(RegistrationOnTheBus, FetchesTheMapAndSaysWhereAKeyframeIs) {
  EXPECT_THAT(node_.health().message(), HasSubstr("MAP_INFO"));
  fetch_map();
  EXPECT_THAT(node_.health().message(), HasSubstr("COMPASS"));
  send_all(kStart + 5'000'000, 17);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  const map_fix_t& fix = fixes_.messages.front();
  expect_fix(fix);
  EXPECT_EQ(fix.utime, kStart + 5'000'000);
  EXPECT_EQ(fix.session, 3);
  EXPECT_EQ(fix.keyframe_id, 17);
  EXPECT_EQ(fix.method, "paper");
  EXPECT_EQ(fix.map_fingerprint, "aaaaaaaaaaaaaaaa");
  // Declination was applied and the compass interpolated at the keyframe's time.
  EXPECT_NEAR(fix.heading, 1.2, 1e-9);
  EXPECT_NEAR(fix.heading_stddev, 0.05, 1e-9);
  EXPECT_EQ(fix.total_ms, 0) << "a replay must repeat";
  EXPECT_EQ(fix.matches.size(), static_cast<size_t>(fix.num_inliers));
  const EnuFrame frame({48, 11, 500});
  EXPECT_LT(
      (frame.to_enu({fix.latitude_deg, fix.longitude_deg, fix.ellipsoidal_height}) - Eigen::Vector3d(fix.p_G_B)).norm(),
      1e-6);
  EXPECT_GT(fix.position_covariance[0], 0);
  pass(1);
  EXPECT_EQ(node_.health().state(), Health::State::kOk);
}

TEST_F(RegistrationOnTheBus, AsksAgainForPartsThatWereLost) {
  server_.lose_every = 3;
  fetch_map();
  pass(10);
  EXPECT_EQ(node_.health().counter("map.features"), static_cast<double>(server_.info_.num_features));
  EXPECT_GT(node_.health().counter("map.tiles_asked_again"), 3);
  send_all(now_, 1);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  expect_fix(fixes_.messages.front());
}

TEST_F(RegistrationOnTheBus, GoesOnWithoutATileThatTheServerRefuses) {
  server_.running = false;
  server_.announce();
  pump();
  map_tile_t refused{};
  refused.fingerprint = "aaaaaaaaaaaaaaaa";
  refused.tile = 0;  // far from where the capture looks
  bus_.publish(channel::kMapTile, &refused);
  pump();
  EXPECT_EQ(node_.health().counter("rejected.map_tile_refused"), 1);
  server_.running = true;
  pass(3);
  send_all(now_, 1);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  expect_fix(fixes_.messages.front());
}

TEST_F(RegistrationOnTheBus, WaitsForAServerThatStartsLaterOrStopsAnswering) {
  pass(2);
  send_all(now_, 1);
  EXPECT_EQ(fixes_.messages.size(), 0u);
  EXPECT_EQ(node_.health().counter("keyframes.before_map"), 1);
  server_.running = false;
  fetch_map();
  EXPECT_THAT(node_.health().message(), HasSubstr("0 of 16 tiles"));
  server_.running = true;
  pass(3);
  send_all(now_, 2);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  expect_fix(fixes_.messages.front());
}

TEST_F(RegistrationOnTheBus, GoesOnWithAnotherMap) {
  fetch_map();
  server_.running = false;
  FakeMapServer other(bus_, "bbbbbbbbbbbbbbbb", SyntheticGround(2).grid_features(8));
  other.announce();
  pump();
  EXPECT_THAT(node_.health().message(), HasSubstr("fetching the map"));
  pass(3);
  send_all(now_, 1);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  EXPECT_EQ(fixes_.messages[0].map_fingerprint, "bbbbbbbbbbbbbbbb");
  EXPECT_FALSE(fixes_.messages[0].valid);
  EXPECT_THAT(fixes_.messages[0].reason, HasSubstr("inliers"));
}

TEST_F(RegistrationOnTheBus, SaysThatAMapIsOfNoUse) {
  server_.info_.features = "rootsift";
  server_.announce();
  pump();
  EXPECT_EQ(node_.health().state(), Health::State::kFailed);
  EXPECT_THAT(node_.health().message(), HasSubstr("features: grid"));
  server_.info_.features = "grid";
  server_.info_.num_features = 1LL << 40;
  server_.info_.fingerprint = server_.info_.map_fingerprint = "huge";
  server_.announce();
  pump();
  EXPECT_THAT(node_.health().message(), HasSubstr("memory_mb"));
  server_.info_.num_features = 5;
  server_.info_.metres_per_pixel = kNan;
  server_.info_.fingerprint = server_.info_.map_fingerprint = "nan";
  server_.announce();
  pump();
  EXPECT_EQ(node_.health().state(), Health::State::kFailed);
}

TEST_F(RegistrationOnTheBus, CountsACompassThatIsNoNumber) {
  fetch_map();
  for (int i = 0; i < 3; ++i) send_compass(now_ + i * 100'000, kNan);
  EXPECT_EQ(node_.health().counter("rejected.compass"), 3);
  const image_t image = image_message(now_, capture_.image);
  bus_.publish(channel::kCamera, &image);
  vio_keyframe_t keyframe = keyframe_message(now_, 1);
  bus_.publish(channel::kVioKeyframe, &keyframe);
  pump();
  EXPECT_EQ(fixes_.messages.size(), 0u) << "the compass may still come";
  const image_t later = image_message(now_ + 400'000, capture_.image);
  bus_.publish(channel::kCamera, &later);
  pump();
  ASSERT_EQ(fixes_.messages.size(), 1u);
  EXPECT_FALSE(fixes_.messages[0].valid);
  EXPECT_THAT(fixes_.messages[0].reason, HasSubstr("compass"));
  EXPECT_TRUE(std::isnan(fixes_.messages[0].p_G_B[0]));
  EXPECT_TRUE(std::isnan(fixes_.messages[0].heading));
}

TEST_F(RegistrationOnTheBus, SurvivesEveryKindOfBadKeyframe) {
  fetch_map();
  int expected = 0;
  const auto refused = [&](const image_t* image, const vio_keyframe_t& keyframe) {
    if (image != nullptr) bus_.publish(channel::kCamera, image);
    send_compass(keyframe.utime - 10'000, 1.2);
    bus_.publish(channel::kVioKeyframe, &keyframe);
    pump();
    send_compass(keyframe.utime + 10'000, 1.2);
    // An image that is missing or damaged may still come.
    if (fixes_.messages.size() == static_cast<size_t>(expected)) send_compass(keyframe.utime + 510'000, 1.2);
    ++expected;
    EXPECT_EQ(fixes_.messages.size(), static_cast<size_t>(expected));
    EXPECT_FALSE(fixes_.messages.back().valid);
    return fixes_.messages.back().reason;
  };
  int64_t t = now_;
  const auto next = [&] { return t += 1'000'000; };

  EXPECT_THAT(refused(nullptr, keyframe_message(next(), 0)),
              HasSubstr("no image of the keyframe's time: no part came"));
  EXPECT_EQ(node_.health().counter("rejected.keyframe.no_image"), 1);

  image_t image = image_message(next(), capture_.image);
  image.data.resize(image.data.size() / 2);
  image.size = static_cast<int32_t>(image.data.size());
  EXPECT_THAT(refused(&image, keyframe_message(t, 1)), HasSubstr("truncated"));

  image = image_message(next(), capture_.image(cv::Rect(0, 0, 200, 200)).clone());
  EXPECT_THAT(refused(&image, keyframe_message(t, 2)), HasSubstr("no part came"));
  EXPECT_EQ(node_.health().counter("rejected.camera"), 1);
  EXPECT_EQ(node_.health().counter("rejected.keyframe.no_image"), 3);

  vio_keyframe_t keyframe = keyframe_message(next(), 3);
  keyframe.height_above_ground = kNan;
  image = image_message(t, capture_.image);
  EXPECT_THAT(refused(&image, keyframe), HasSubstr("height"));

  keyframe = keyframe_message(next(), 4);
  keyframe.p_W_B[0] = kNan;
  image = image_message(t, capture_.image);
  EXPECT_THAT(refused(&image, keyframe), HasSubstr("pose"));

  keyframe = keyframe_message(next(), 5);
  std::fill(std::begin(keyframe.q_B_C), std::end(keyframe.q_B_C), 0.0);
  image = image_message(t, capture_.image);
  EXPECT_NE(refused(&image, keyframe), "");

  keyframe = keyframe_message(next(), 6);
  keyframe.features.clear();
  keyframe.num_features = 0;
  image = image_message(t, capture_.image);
  EXPECT_THAT(refused(&image, keyframe), HasSubstr("0 usable points"));

  // And after all this, a good one.
  send_all(next(), 7);
  expect_fix(fixes_.messages.back());
}

// Of the image on CAMERA any lost packet costs all.
TEST_F(RegistrationOnTheBus, TakesAnImageFromItsPartsAsSoonAsAllAreThere) {
  fetch_map();
  const std::vector<keyframe_image_t> parts = parts_of(image_message(now_, capture_.image));
  const vio_keyframe_t keyframe = keyframe_message(now_, 1);
  const auto send = [&](size_t without) {
    bus_.publish(channel::kVioKeyframe, &keyframe);
    for (size_t k = 0; k < parts.size(); ++k) {
      if (k != without) bus_.publish(channel::kKeyframeImage, &parts[k]);
    }
    pump();
  };
  send_compass(now_ - 10'000, capture_.heading.value);
  send_compass(now_ + 10'000, capture_.heading.value);
  // Somebody else's, which comes first.
  image_t forged = image_message(now_, capture_.image);
  forged.data.resize(1000);
  bus_.publish(channel::kKeyframeImage, &parts_of(forged).front());
  send(3);
  EXPECT_EQ(fixes_.messages.size(), 0U);
  send(0);
  ASSERT_EQ(fixes_.messages.size(), 1U);
  expect_fix(fixes_.messages.front());
  keyframe_image_t wrong = parts.front();
  wrong.width = 1;
  bus_.publish(channel::kKeyframeImage, &wrong);
  pump();
  EXPECT_EQ(node_.health().counter("rejected.keyframe_image"), 1);
}

TEST_F(RegistrationOnTheBus, SaysHowMuchOfAnImageCame) {
  fetch_map();
  const std::vector<keyframe_image_t> parts = parts_of(image_message(now_, capture_.image));
  const vio_keyframe_t keyframe = keyframe_message(now_, 1);
  bus_.publish(channel::kVioKeyframe, &keyframe);
  for (size_t k = 1; k < parts.size(); ++k) bus_.publish(channel::kKeyframeImage, &parts[k]);
  send_compass(now_, capture_.heading.value);
  send_compass(now_ + 490'000, capture_.heading.value);
  EXPECT_EQ(fixes_.messages.size(), 0U);
  send_compass(now_ + 510'000, capture_.heading.value);
  ASSERT_EQ(fixes_.messages.size(), 1U);
  EXPECT_EQ(fixes_.messages.front().reason,
            fmt::format("no image of the keyframe's time: {} of {} parts came", parts.size() - 1, parts.size()));
}

TEST_F(RegistrationOnTheBus, CountsMalformedTiles) {
  server_.running = false;
  server_.announce();
  pump();
  map_tile_t tile{};
  tile.fingerprint = "aaaaaaaaaaaaaaaa";
  tile.tile = 99;
  tile.num_parts = 1;
  bus_.publish(channel::kMapTile, &tile);
  tile.tile = 0;
  tile.num_features = 3;
  tile.position.assign(3, {0.0F, 0.0F, 0.0F});
  tile.num_bytes = 7;
  tile.descriptors.resize(7);
  bus_.publish(channel::kMapTile, &tile);
  pump();
  EXPECT_EQ(node_.health().counter("rejected.map_tile"), 2);
}

TEST(RegistrationService, NamesWhatIsWrongWithItsConfiguration) {
  lcm::LCM bus("memq://");
  Node node({.service = "registration"}, bus);
  const test::TemporaryFolder folder;
  const auto error = [&]() -> std::string {
    try {
      const RegistrationService service(node, folder.path());
    } catch (const ConfigError& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_THAT(error(), HasSubstr("registration.yaml"));
  std::ofstream(folder / "registration.yaml") << "retry_mss: 3\n";
  std::ofstream(folder / "aircraft.yaml") << "{}\n";
  EXPECT_THAT(error(), HasSubstr("retry_mss"));
  std::ofstream(folder / "registration.yaml") << "{}\n";
  EXPECT_THAT(error(), HasSubstr("camera"));
}

TEST_F(RegistrationOnTheBus, AFloodOfAbsurdMessagesCostsNoFixAfterIt) {
  fetch_map();
  send_all(now_, 1);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  std::mt19937_64 random(1);
  for (int id = 2; id < 20; ++id) {
    // A keyframe a second, an image and a heading every tenth of it, a hundred absurd messages for each.
    for (int i = 0; i < 10; ++i) {
      pass(0.1);
      const image_t image = image_message(now_, capture_.image);
      bus_.publish(channel::kCamera, &image);
      send_compass(now_, capture_.heading.value);
      for (int k = 0; k < 100; ++k) faults::publish_absurd(bus_, random, now_, 3, id);
      pump();
    }
    send_all(now_ + 50'000, id);
    now_ += 100'000;
  }
  fixes_.messages.clear();
  pass(1);
  server_.announce();
  send_all(now_, 20);
  const auto is_own = [](const map_fix_t& fix) { return fix.keyframe_id == 20; };
  const auto found = std::find_if(fixes_.messages.begin(), fixes_.messages.end(), is_own);
  ASSERT_NE(found, fixes_.messages.end());
  expect_fix(*found);
  EXPECT_GT(node_.health().counter("map.rejected"), 0);
  EXPECT_GT(node_.health().counter("rejected.nav.implausible"), 0);
}

TEST_F(RegistrationOnTheBus, AMapOfNoUseDoesNotDisplaceTheOneInUse) {
  fetch_map();
  map_info_t other = server_.info_;
  other.fingerprint = other.map_fingerprint = "nan";
  other.metres_per_pixel = kNan;
  bus_.publish(channel::kMapInfo, &other);
  pump();
  EXPECT_EQ(node_.health().counter("rejected.map_info"), 1);
  send_all(now_, 1);
  ASSERT_EQ(fixes_.messages.size(), 1u);
  expect_fix(fixes_.messages.front());
}

TEST_F(RegistrationOnTheBus, AHintIsTakenByEveryMethodAndRefusedByNameWhereItSaysNothing) {
  fetch_map();
  send_all(now_, 1);
  pass(1);
  test::Collector<health_t> heartbeats(bus_, channel::kHealth);
  position_hint_t hint{};
  hint.latitude_deg = 48;
  hint.longitude_deg = 11;
  hint.radius = 50;
  bus_.publish(channel::kPositionHint, &hint);
  pass(2);
  EXPECT_EQ(node_.health().counter("hints.received"), 1);
  EXPECT_EQ(node_.health().counter("rejected.hint"), 0);
  hint.radius = -1;
  bus_.publish(channel::kPositionHint, &hint);
  pass(2);
  EXPECT_EQ(node_.health().counter("rejected.hint"), 1);
  ASSERT_FALSE(heartbeats.messages.empty());
  EXPECT_THAT(heartbeats.messages.back().message, HasSubstr("radius -1 m"));
}

// The method that orthonav ships with.
class SubmapOnTheBus : public RegistrationOnTheBus {
 protected:
  SubmapOnTheBus() : RegistrationOnTheBus("submap") {}
  // The keyframes of a flight east, a second apart.
  void fly(int keyframes) {
    for (int i = 0; i < keyframes; ++i) {
      capture_ = fields_.capture({60.0 + 10 * ++flown_, -80, 60}, 1.2, 0.03, -0.04);
      pass(1);
      send_all(now_, flown_);
    }
  }
  SyntheticFields fields_{1};
  FakeMapServer fields_server_{bus_, "cccccccccccccccc", described_map(fields_)};
  test::Collector<place_hypotheses_t> places_{bus_, channel::kPlaceHypotheses};
  int flown_ = 0;
};

TEST_F(SubmapOnTheBus, SaysWhichPlacesItConsidersUntilOneIsSureAndTakesAHint) {
  fields_server_.info_.features = "rootsift";
  fields_server_.info_.keypoint_size = 12;
  fields_server_.announce();
  pump();
  pass(3);
  position_hint_t hint{};
  const EnuFrame frame({48, 11, 500});
  const Geodetic there = frame.to_geodetic({75, -75, 0});
  hint.latitude_deg = there.latitude_deg;
  hint.longitude_deg = there.longitude_deg;
  hint.radius = 60;
  bus_.publish(channel::kPositionHint, &hint);
  hint.radius = -1;
  bus_.publish(channel::kPositionHint, &hint);
  pump();
  EXPECT_EQ(node_.health().counter("hints.received"), 2);
  EXPECT_EQ(node_.health().counter("rejected.hint"), 1);
  fly(4);
  ASSERT_EQ(fixes_.messages.size(), 4u);
  const map_fix_t& fix = fixes_.messages.back();
  expect_fix(fix);
  EXPECT_GT(fix.log_odds, std::log(999.0));
  EXPECT_GE(fix.num_hypotheses, 1);
  ASSERT_EQ(places_.messages.size(), 4u) << "keyframes come a second apart";
  const place_hypotheses_t& places = places_.messages.back();
  EXPECT_EQ(places.utime, fix.utime);
  ASSERT_GE(places.num_hypotheses, 1);
  EXPECT_GT(places.hypotheses[0].probability, 0.999);
  const Eigen::Vector3d en = frame.to_enu({places.hypotheses[0].latitude_deg, places.hypotheses[0].longitude_deg, 500});
  EXPECT_LT((en - capture_.p_G_B).head<2>().norm(), 5);
  EXPECT_NEAR(node_.health().counter("place.probability"), places.hypotheses[0].probability, 1e-9);
}

}  // namespace
}  // namespace orthonav::registration
