// The front end on images that are broken in the ways that images are.
#include "services/vio/tracker.h"

#include <functional>
#include <map>
#include <set>

#include <gtest/gtest.h>
#include <opencv2/imgproc.hpp>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/vio/reference_patch.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

const TexturedGround& ground() {
  static const TexturedGround instance(60, 0.06, 2);
  return instance;
}

const Trajectory& flight() {
  static const Trajectory instance = survey_flight(40, 3.0);
  return instance;
}

Eigen::Matrix3d camera_turn(double from, double to) {
  const Eigen::Matrix3d R_B_C = downward_camera().R_B_C;
  return (flight().attitude(to).toRotationMatrix() * R_B_C).transpose() * flight().attitude(from).toRotationMatrix() *
         R_B_C;
}

using Change = std::function<cv::Mat(int, const cv::Mat&)>;

// Runs 20 frames; of those after frame 10, the share of features that frame 9 had too, and the errors of the tracks.
struct Outcome {
  size_t before = 0, kept = 0, last = 0;
  double worst = 0;  // pixels
};

Outcome run(const Change& change) {
  Tracker tracker(test_camera(), {});
  std::map<int64_t, Eigen::Vector3d> where;  // first sight on the ground
  std::set<int64_t> ids;
  Outcome result;
  for (int k = 0; k < 20; ++k) {
    const double t = 0.1 * k;
    const auto& features = tracker.track(change(k, ground().picture(flight(), t)),
                                         k == 0 ? Eigen::Matrix3d::Identity() : camera_turn(t - 0.1, t), true);
    const Eigen::Quaterniond q = flight().attitude(t);
    const Eigen::Vector3d p_C = flight().position(t) + q * downward_camera().p_B_C;
    for (const TrackedFeature& feature : features) {
      if (where.count(feature.id) == 0) {
        const Eigen::Vector3d ray = q * (downward_camera().R_B_C * feature.ray);
        where[feature.id] = p_C - p_C.z() / ray.z() * ray;
      }
      const Eigen::Vector3d seen = downward_camera().R_B_C.transpose() * (q.conjugate() * (where[feature.id] - p_C));
      result.worst = std::max(result.worst, (*test_camera().project(seen) - feature.pixel).norm());
    }
    if (k == 9) {
      for (const TrackedFeature& feature : features) ids.insert(feature.id);
      result.before = ids.size();
    }
    if (k == 19) {
      for (const TrackedFeature& feature : features) result.kept += ids.count(feature.id);
      result.last = features.size();
    }
  }
  return result;
}

TEST(Tracker, FollowsFeaturesToAFractionOfAPixel) {
  const Outcome result = run([](int, const cv::Mat& image) { return image; });
  EXPECT_GT(result.before, 120u);
  EXPECT_GT(2 * result.kept, result.before);
  EXPECT_LT(result.worst, 2.0);
}

TEST(Tracker, ErrorsDoNotAddUpAlongATrack) {
  constexpr int kFrames = 40;
  cv::RNG random(3);
  const auto sensor_noise = [&](const cv::Mat& image) {
    cv::Mat noise(image.size(), CV_16S), noisy;
    random.fill(noise, cv::RNG::NORMAL, 0, 2);
    cv::add(image, noise, noisy, cv::noArray(), CV_8U);
    return noisy;
  };
  Tracker tracker(test_camera(), {});
  std::map<int64_t, Eigen::Vector3d> where;  // second sight on the ground: the first is at a whole pixel
  std::map<int64_t, int> age;
  std::vector<double> errors;  // of tracks of at least 25 images
  for (int k = 0; k < kFrames; ++k) {
    const double t = 0.1 * k;
    const auto& features = tracker.track(sensor_noise(ground().picture(flight(), t)),
                                         k == 0 ? Eigen::Matrix3d::Identity() : camera_turn(t - 0.1, t), true);
    const Eigen::Quaterniond q = flight().attitude(t);
    const Eigen::Vector3d p_C = flight().position(t) + q * downward_camera().p_B_C;
    for (const TrackedFeature& feature : features) {
      if (++age[feature.id] == 2) {
        const Eigen::Vector3d ray = q * (downward_camera().R_B_C * feature.ray);
        where[feature.id] = p_C - p_C.z() / ray.z() * ray;
      }
      if (age[feature.id] < 25) continue;
      const Eigen::Vector3d seen = downward_camera().R_B_C.transpose() * (q.conjugate() * (where[feature.id] - p_C));
      errors.push_back((*test_camera().project(seen) - feature.pixel).norm());
    }
  }
  ASSERT_GT(errors.size(), 300u);
  EXPECT_LT(median(errors), 0.08) << "followed from image to image alone it is three times as much";
}

TEST(ReferencePatch, IsFoundAgainToAFractionOfAPixelAfterATurn) {
  const CameraModel camera = test_camera();
  const cv::Mat image = ground().picture(flight(), 0);
  // The camera turns about its axis, so every pixel turns about the principal point.
  const Eigen::Matrix3d R = so3_exp({0, 0, 0.5}).toRotationMatrix();
  const CameraParameters& c = camera.parameters();
  const cv::Matx23d turn(R(0, 0), R(0, 1), c.cx - R(0, 0) * c.cx - R(0, 1) * c.cy,  //
                         R(1, 0), R(1, 1), c.cy - R(1, 0) * c.cx - R(1, 1) * c.cy);
  cv::Mat turned;
  cv::warpAffine(image, turned, turn, image.size(), cv::INTER_CUBIC);
  int found = 0;
  for (int v = 180; v < 300; v += 12) {
    for (int u = 200; u < 440; u += 12) {
      auto patch = ReferencePatch::make(image, Eigen::Vector2d(u, v), camera);
      if (!patch) continue;
      patch->turn(R);
      const Eigen::Vector2d expected = *camera.project(R * *camera.unproject(Eigen::Vector2d(u, v)));
      Eigen::Vector2d pixel = expected + Eigen::Vector2d(0.5, -0.4);
      if (patch->align(turned, camera, *camera.unproject(pixel), pixel) != ReferencePatch::Result::kAligned) continue;
      ++found;
      EXPECT_LT((pixel - expected).norm(), 0.12);
    }
  }
  EXPECT_GT(found, 100);
}

TEST(ReferencePatch, RefusesWhatLooksOtherwiseAndWhatIsCut) {
  const CameraModel camera = test_camera();
  const cv::Mat image = ground().picture(flight(), 0);
  const cv::Mat other = TexturedGround(60, 0.06, 99).picture(flight(), 0);
  const Eigen::Vector2d middle(320, 240);
  const auto patch = ReferencePatch::make(image, middle, camera);
  ASSERT_TRUE(patch.has_value());
  Eigen::Vector2d pixel = middle;
  EXPECT_EQ(patch->align(other, camera, *camera.unproject(pixel), pixel), ReferencePatch::Result::kUnlike);
  EXPECT_EQ(pixel, middle);
  pixel = {5, 240};
  EXPECT_EQ(patch->align(image, camera, *camera.unproject(pixel), pixel), ReferencePatch::Result::kAtTheBorder);
  EXPECT_FALSE(ReferencePatch::make(image, {5, 240}, camera).has_value());
  EXPECT_FALSE(ReferencePatch::make(cv::Mat(480, 640, CV_8U, cv::Scalar(90)), middle, camera).has_value());
}

TEST(Tracker, SurvivesAJumpOfTheExposure) {
  const Outcome result = run([](int k, const cv::Mat& image) {
    cv::Mat out;
    image.convertTo(out, CV_8U, k >= 10 ? 0.55 : 1.0, k >= 10 ? 25 : 0);
    return out;
  });
  EXPECT_GT(2 * result.kept, result.before);
}

TEST(Tracker, PassesOverABlurredImageAndAFlash) {
  const Outcome clean = run([](int, const cv::Mat& image) { return image; });
  const Outcome result = run([](int k, const cv::Mat& image) {
    cv::Mat out = image;
    if (k == 11) cv::GaussianBlur(image, out, {}, 25);
    if (k == 14) out = cv::Mat(image.size(), CV_8U, cv::Scalar(255));
    return out;
  });
  EXPECT_GT(result.kept, clean.kept / 2);
  EXPECT_LT(result.worst, 3.0);
}

TEST(Tracker, FollowsDespiteAWrongGyroscope) {
  Tracker tracker(test_camera(), {});
  size_t kept = 0;
  std::set<int64_t> ids;
  for (int k = 0; k < 8; ++k) {
    const double t = 0.1 * k;
    const auto& features =
        tracker.track(ground().picture(flight(), t), so3_exp({0.3, -0.2, 0.4}).toRotationMatrix(), false);
    if (k == 2) {
      for (const TrackedFeature& feature : features) ids.insert(feature.id);
    }
    if (k == 7) {
      for (const TrackedFeature& feature : features) kept += ids.count(feature.id);
    }
  }
  EXPECT_GT(2 * kept, ids.size());
}

// Whatever the image shows, the work is bounded: by the features, which are bounded, and the cells, which are.
TEST(Tracker, BoundsItsFeaturesOnWaterHazeAndNight) {
  cv::RNG random(1);
  const auto noise = [&](double level, double sigma) {
    cv::Mat out(480, 640, CV_8U);
    random.fill(out, cv::RNG::NORMAL, level, sigma);
    return out;
  };
  const std::map<std::string, std::function<cv::Mat(int)>> scenes = {
      {"night", [&](int) { return noise(4, 1.2); }},
      {"haze",
       [&](int k) {
         cv::Mat out;
         ground().picture(flight(), 0.1 * k).convertTo(out, CV_8U, 0.02, 150);
         return out;
       }},
      {"water",
       [&](int) {
         cv::Mat out = noise(90, 40);
         cv::GaussianBlur(out, out, {}, 3);
         return out;
       }},
      {"snow", [&](int) { return noise(128, 60); }},
  };
  for (const auto& [name, scene] : scenes) {
    Tracker tracker(test_camera(), {});
    size_t steady = 0;
    int64_t newest = 0;
    for (int k = 0; k < 12; ++k) {
      const auto& features = tracker.track(scene(k), Eigen::Matrix3d::Identity(), true);
      EXPECT_LE(features.size(), static_cast<size_t>(TrackerOptions{}.max_features)) << name;
      if (k == 11) {
        for (const TrackedFeature& feature : features) {
          steady += feature.id < newest ? 1 : 0;
        }
      }
      for (const TrackedFeature& feature : features) newest = std::max(newest, feature.id);
    }
    // Nothing of these scenes can be followed, and nothing is said to be.
    if (name != "haze") {
      EXPECT_LT(steady, 30u) << name;
    }
  }
}

TEST(Tracker, SpreadsFeaturesOverTheImage) {
  Tracker tracker(test_camera(), {});
  cv::Mat image = ground().picture(flight(), 0);
  // One corner of the image has ten times the contrast of the rest.
  cv::Mat faint;
  image.convertTo(faint, CV_8U, 0.3, 90);
  image(cv::Rect(0, 0, 160, 120)).copyTo(faint(cv::Rect(0, 0, 160, 120)));
  int quadrants[4] = {};
  for (const TrackedFeature& feature : tracker.track(faint, Eigen::Matrix3d::Identity(), true)) {
    ++quadrants[(feature.pixel.x() > 320 ? 1 : 0) + (feature.pixel.y() > 240 ? 2 : 0)];
  }
  for (const int count : quadrants) EXPECT_GT(count, 20);
}

// How much of the image the tracks cover in each picture of a motion: of 8 x 6 parts, those with a track, at the least;
// and how near two tracks come.
struct Cover {
  double least = 1;
  double nearest = INFINITY;  // pixels
  size_t most = 0;            // tracks
};

Cover cover(const Trajectory& motion, double duration) {
  Tracker tracker(test_camera(), {});
  const auto attitude_of_camera = [&](double t) {
    return Eigen::Matrix3d(motion.attitude(t).toRotationMatrix() * downward_camera().R_B_C);
  };
  Cover result;
  for (double t = 0; t < duration; t += 0.1) {
    const Eigen::Matrix3d R = attitude_of_camera(t).transpose() * attitude_of_camera(t - 0.1);
    const auto& features = tracker.track(ground().picture(motion, t), R, true);
    const ImageGrid parts({640, 480}, 37);
    const std::vector<int> occupancy = parts.occupancy(features);
    const auto empty = std::count(occupancy.begin(), occupancy.end(), 0);
    result.least = std::min(result.least, 1 - static_cast<double>(empty) / parts.size());
    result.most = std::max(result.most, features.size());
    for (size_t i = 0; i < features.size(); ++i) {
      for (size_t k = 0; k < i; ++k) {
        result.nearest = std::min(result.nearest, (features[i].pixel - features[k].pixel).norm());
      }
    }
  }
  return result;
}

TEST(Tracker, TracksCoverTheImageWhateverTheMotion) {
  const auto still = [](double) { return Eigen::Vector3d::Zero(); };
  const std::map<std::string, Trajectory> motions = {
      {"climb", {[](double t) { return Eigen::Vector3d(0, 0, 12 + 3 * t); }, still}},
      {"descent", {[](double t) { return Eigen::Vector3d(0, 0, 50 - 3 * t); }, still}},
      {"spin",
       {[](double) { return Eigen::Vector3d(0, 0, 40); }, [](double t) { return Eigen::Vector3d(0, 0, 1.2 * t); }}},
      {"bank and back",
       {[](double t) { return Eigen::Vector3d(4 * t, 0, 40); },
        [](double t) { return Eigen::Vector3d(0.4 * std::sin(t), 0, 0); }}},
  };
  for (const auto& [name, motion] : motions) {
    const Cover found = cover(motion, 12);
    EXPECT_GT(found.least, 0.8) << name;
    EXPECT_GT(found.nearest, 12) << name;
    EXPECT_LE(found.most, static_cast<size_t>(TrackerOptions{}.max_features)) << name;
  }
}

}  // namespace
}  // namespace orthonav::vio
