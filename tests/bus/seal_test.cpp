// The authenticated mode: the seal itself, and a service that runs with a key.
#include "common/bus/seal.h"

#include <filesystem>
#include <fstream>
#include <optional>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <lcm/lcm-cpp.hpp>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "orthonav/health_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "tests/support/bus_client.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using testing::HasSubstr;
namespace fs = std::filesystem;

constexpr int64_t kNow = 1'700'000'000'000'000;

BusKey key_of(uint8_t byte) {
  BusKey key{};
  key.fill(byte);
  return key;
}

std::vector<uint8_t> sealed(Sealer& sealer, const std::string& channel = "IMU", int64_t now = kNow) {
  std::vector<uint8_t> message{1, 2, 3, 4};
  sealer.seal(channel, now, message);
  return message;
}

std::string refusal(SealChecker& checker, const std::vector<uint8_t>& message, const std::string& channel = "IMU",
                    int64_t now = kNow) {
  return checker.refusal(channel, now, message.data(), message.size());
}

TEST(Seal, PassesOnceWithItsKeyAndChannel) {
  Sealer sealer(key_of(1));
  SealChecker checker(key_of(1)), stranger(key_of(2));
  const auto message = sealed(sealer);
  EXPECT_EQ(message.size(), 4 + kSealBytes);
  EXPECT_THAT(refusal(stranger, message), HasSubstr("another key"));
  EXPECT_THAT(refusal(checker, message, "MAP_FIX"), HasSubstr("another key"));
  EXPECT_EQ(refusal(checker, message), "");
  EXPECT_THAT(refusal(checker, message), HasSubstr("replay"));
}

TEST(Seal, ASenderIsForgottenForANewOneOnly) {
  SealChecker checker(key_of(1));
  Sealer first(key_of(1));
  const auto old = sealed(first, "IMU", kNow - 1'000'000);
  ASSERT_EQ(refusal(checker, old), "");
  std::optional<Sealer> last;
  for (int i = 1; i < 1000; ++i) {
    last.emplace(key_of(1));
    ASSERT_EQ(refusal(checker, sealed(*last)), "");
  }
  // The table is full now.
  EXPECT_EQ(refusal(checker, sealed(*last)), "");
  EXPECT_THAT(refusal(checker, old), HasSubstr("replay"));
}

TEST(Seal, AnyChangedBitIsRefused) {
  Sealer sealer(key_of(1));
  SealChecker checker(key_of(1));
  const auto message = sealed(sealer);
  for (size_t bit = 0; bit < 8 * message.size(); ++bit) {
    auto changed = message;
    changed[bit / 8] = static_cast<uint8_t>(changed[bit / 8] ^ (1U << bit % 8));
    EXPECT_NE(refusal(checker, changed), "") << "bit " << bit;
  }
  EXPECT_EQ(refusal(checker, message), "") << "what was refused leaves no trace";
}

TEST(Seal, TooShortOrUnsealedIsRefused) {
  SealChecker checker(key_of(1));
  for (size_t size = 0; size < 100; ++size)
    EXPECT_THAT(refusal(checker, std::vector<uint8_t>(size, 0)), HasSubstr("not sealed"));
}

TEST(Seal, MessagesMayOvertakeEachOtherButNotComeTwiceOrLate) {
  Sealer sealer(key_of(1));
  SealChecker checker(key_of(1));
  std::vector<std::vector<uint8_t>> messages;
  for (int i = 0; i < 200; ++i) messages.push_back(sealed(sealer));
  EXPECT_EQ(refusal(checker, messages[150]), "");
  EXPECT_EQ(refusal(checker, messages[149]), "");
  EXPECT_EQ(refusal(checker, messages[87]), "") << "63 behind";
  EXPECT_NE(refusal(checker, messages[86]), "") << "64 behind";
  EXPECT_NE(refusal(checker, messages[149]), "");
  EXPECT_EQ(refusal(checker, messages[199]), "");
  EXPECT_NE(refusal(checker, messages[150]), "");
}

TEST(Seal, OldIsRefusedAlsoFromASenderNobodyHeard) {
  Sealer sealer(key_of(1));
  SealChecker checker(key_of(1));
  EXPECT_THAT(refusal(checker, sealed(sealer), "IMU", kNow + 11'000'000), HasSubstr("11.0 s ago"));
  EXPECT_NE(refusal(checker, sealed(sealer), "IMU", kNow - 11'000'000), "");
  EXPECT_EQ(refusal(checker, sealed(sealer), "IMU", kNow + 9'000'000), "");
}

class KeyFile : public testing::Test {
 protected:
  fs::path write(const std::string& text, fs::perms permissions = fs::perms::owner_read) const {
    fs::path file = folder_ / "key";
    fs::remove(file);
    std::ofstream(file) << text;
    fs::permissions(file, permissions);
    return file;
  }
  std::string error_of(const fs::path& file) const {
    try {
      read_bus_key(file);
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    return "";
  }
  test::TemporaryFolder folder_;
};

TEST_F(KeyFile, Is64DigitsThatNotEverybodyReads) {
  const std::string digits(64, 'a');
  EXPECT_EQ(read_bus_key(write(digits + "\n")), key_of(0xaa));
  EXPECT_THAT(error_of(write(digits.substr(1))), HasSubstr("64 hexadecimal digits"));
  EXPECT_THAT(error_of(write(digits + "a")), HasSubstr("64 hexadecimal digits"));
  EXPECT_THAT(error_of(write("x" + digits.substr(1))), HasSubstr("64 hexadecimal digits"));
  EXPECT_THAT(error_of(write(digits, fs::perms::owner_read | fs::perms::others_read)), HasSubstr("chmod"));
  EXPECT_THAT(error_of(folder_ / "none"), HasSubstr("none: cannot be read"));
}

// Fusion as a process with a key; the test is vio, a forger, and somebody who recorded the bus.
class SealedBus : public KeyFile {
 protected:
  void start() {
    const fs::path file = write(std::string(64, 'a'));
    fusion_.emplace(std::vector<std::string>{test::program("orthonav-fusion"), "--config",
                                             test::source_tree() / "config" / "quick", "--bus-key", file});
    ASSERT_TRUE(test::handle_until(bus_, [&] { return !health_.messages.empty(); }));
  }
  static int64_t wall_time() {
    return std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::system_clock::now().time_since_epoch())
        .count();
  }
  std::vector<uint8_t> state() {
    vio_state_t m{};
    m.utime = wall_time();
    m.q_W_B[0] = 1;
    std::vector<uint8_t> bytes(static_cast<size_t>(m.getEncodedSize()));
    m.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
    return bytes;
  }
  void publish(const std::vector<uint8_t>& bytes) {
    bus_.publish(channel::kVioState, bytes.data(), static_cast<unsigned>(bytes.size()));
  }
  bool counts(const std::string& counter, double value) {
    return test::handle_until(bus_, [&] {
      for (const auto& c : health_.messages.back().counters) {
        if (c.name == counter && c.value == value) return true;
      }
      return false;
    });
  }

  lcm::LCM bus_;
  test::Collector<health_t> health_{bus_, channel::kHealth};
  std::optional<test::ChildProcess> fusion_;
};

TEST_F(SealedBus, AServiceWithAKeyHearsOnlyWhatIsSealedFreshAndNew) {
  start();
  Sealer vio(key_of(0xaa)), forger(key_of(0xbb));
  auto bytes = state();
  vio.seal(channel::kVioState, wall_time(), bytes);
  publish(bytes);
  ASSERT_TRUE(counts("received.VIO_STATE", 1));

  publish(bytes);
  ASSERT_TRUE(counts("rejected.seal.VIO_STATE", 1)) << "replayed";
  publish(state());
  ASSERT_TRUE(counts("rejected.seal.VIO_STATE", 2)) << "not sealed";
  auto forged = state();
  forger.seal(channel::kVioState, wall_time(), forged);
  publish(forged);
  ASSERT_TRUE(counts("rejected.seal.VIO_STATE", 3)) << "another key";
  auto old = state();
  Sealer(key_of(0xaa)).seal(channel::kVioState, wall_time() - 3'600'000'000, old);
  publish(old);
  ASSERT_TRUE(counts("rejected.seal.VIO_STATE", 4)) << "recorded an hour ago";
  EXPECT_THAT(health_.messages.back().message, HasSubstr("VIO_STATE: a message was sealed 3600"));

  bytes = state();
  vio.seal(channel::kVioState, wall_time(), bytes);
  publish(bytes);
  EXPECT_TRUE(counts("received.VIO_STATE", 2));
}

class RawCollector {
 public:
  RawCollector(lcm::LCM& bus, const std::string& channel) { bus.subscribe(channel, &RawCollector::receive, this); }
  std::vector<uint8_t> last;

 private:
  void receive(const lcm::ReceiveBuffer* buffer, const std::string&) {
    const auto* bytes = static_cast<const uint8_t*>(buffer->data);
    last.assign(bytes, bytes + buffer->data_size);
  }
};

TEST_F(SealedBus, WhatAServiceSaysIsSealedAndReadByProgramsWithoutTheKey) {
  RawCollector raw(bus_, channel::kHealth);
  start();
  EXPECT_EQ(health_.messages.back().service, "fusion");
  SealChecker checker(key_of(0xaa));
  EXPECT_EQ(checker.refusal(channel::kHealth, wall_time(), raw.last.data(), raw.last.size()), "");
}

// The node itself listens to heartbeats, for the other boards' clocks; so does ingest, which waits for services.
TEST_F(SealedBus, WhatTwoPartsOfAServiceListenToReachesBoth) {
  start();
  Node node({.service = "a", .key_file = folder_ / "key"});
  bool heard = false;
  node.subscribe<health_t>(channel::kHealth, Delivery::kAll, [&](const health_t& m) {
    heard = heard || m.service == "fusion";
    if (heard) node.stop();
  });
  node.every(test::kPatience, [&] { node.stop(); });
  node.run();
  EXPECT_TRUE(heard);
}

TEST_F(SealedBus, ABadKeyEndsTheServiceWithTheFileAtFault) {
  const fs::path file = write("abc");
  test::ChildProcess fusion(
      {test::program("orthonav-fusion"), "--config", test::source_tree() / "config" / "quick", "--bus-key", file},
      folder_ / "output.txt");
  EXPECT_EQ(fusion.wait_exit(test::kPatience), 1);
  std::ifstream stream(folder_ / "output.txt");
  const std::string output((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  EXPECT_THAT(output, HasSubstr(file.string()));
}

}  // namespace
}  // namespace orthonav
