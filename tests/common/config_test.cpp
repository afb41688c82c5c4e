#include "common/config/config.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using testing::HasSubstr;

template <class F>
std::string error_of(F f) {
  try {
    f();
  } catch (const ConfigError& error) {
    return error.what();
  }
  return "no error";
}

TEST(Config, MisspeltKeyIsAnErrorWithFileAndLine) {
  auto node = ConfigNode::parse("rate: 10\nwindw: 5\n", "vio.yaml");
  int rate = 0, window = 10;
  node.read("rate", rate);
  node.read("window", window);
  EXPECT_EQ(rate, 10);
  const std::string error = error_of([&] { node.finish(); });
  EXPECT_THAT(error, HasSubstr("vio.yaml:2"));
  EXPECT_THAT(error, HasSubstr("'windw'"));
  EXPECT_THAT(error, HasSubstr("window"));
}

TEST(Config, WrongTypeAndRangeNameTheKeyAndLine) {
  auto node = ConfigNode::parse("a:\n  b: fast\n  c: 7\n", "x.yaml");
  auto child = node.child("a");
  double b = 0, c = 0;
  EXPECT_THAT(error_of([&] { child.read("b", b); }), testing::AllOf(HasSubstr("x.yaml:2"), HasSubstr("'a.b'")));
  EXPECT_THAT(error_of([&] { child.read("c", c, 0, 5); }), HasSubstr("[0, 5]"));
}

TEST(Config, MissingRequiredKeyIsNamed) {
  auto node = ConfigNode::parse("a: 1\n", "x.yaml");
  std::string value;
  EXPECT_THAT(error_of([&] { node.require("name", value); }), HasSubstr("'name' is missing"));
}

TEST(Config, MalformedFileNamesTheLine) {
  EXPECT_THAT(error_of([] { ConfigNode::parse("a: [1, 2\nb: 3\n", "x.yaml"); }), HasSubstr("x.yaml:"));
  EXPECT_THAT(error_of([] { ConfigNode::load("/nonexistent/x.yaml"); }), HasSubstr("/nonexistent/x.yaml"));
}

class ConfigFiles : public testing::Test {
 protected:
  void SetUp() override { std::filesystem::create_directories(folder_ / "base"); }
  test::TemporaryFolder folder_;
};

TEST_F(ConfigFiles, ExtendsOverlaysKeyByKey) {
  folder_.write("base/vio.yaml", "window: 10\ntracker:\n  features: 150\n  quality: 0.01\nmap: m.tif\n");
  folder_.write("vio.yaml", "extends: base/vio.yaml\ntracker:\n  features: 200\n");
  auto node = ConfigNode::load(folder_ / "vio.yaml");
  int window = 0, features = 0;
  double quality = 0;
  std::filesystem::path map;
  node.read("window", window);
  node.read_path("map", map);
  auto tracker = node.child("tracker");
  tracker.read("features", features);
  tracker.read("quality", quality);
  tracker.finish();
  node.finish();
  EXPECT_EQ(window, 10);
  EXPECT_EQ(features, 200);
  EXPECT_EQ(quality, 0.01);
  // A path is relative to the file that says it.
  EXPECT_EQ(map, folder_ / "base" / "m.tif");
}

TEST_F(ConfigFiles, MisspeltKeyInTheBaseNamesTheBase) {
  folder_.write("base/a.yaml", "good: 1\nbd: 2\n");
  folder_.write("a.yaml", "extends: base/a.yaml\n");
  auto node = ConfigNode::load(folder_ / "a.yaml");
  int good = 0;
  node.read("good", good);
  EXPECT_THAT(error_of([&] { node.finish(); }), HasSubstr("base/a.yaml:2"));
}

TEST_F(ConfigFiles, AKeyThatIsNoWordIsAnErrorLikeAMisspeltOne) {
  folder_.write("a.yaml", "good: 1\n? [a, b]\n: 2\n");
  auto node = ConfigNode::load(folder_ / "a.yaml");
  int good = 0;
  node.read("good", good);
  EXPECT_THAT(error_of([&] { node.finish(); }), HasSubstr("a.yaml:2"));
}

TEST_F(ConfigFiles, CircularExtendsIsAnError) {
  folder_.write("a.yaml", "extends: b.yaml\n");
  folder_.write("b.yaml", "extends: a.yaml\n");
  EXPECT_THAT(error_of([&] { ConfigNode::load(folder_ / "a.yaml"); }), HasSubstr("circle"));
}

}  // namespace
}  // namespace orthonav
