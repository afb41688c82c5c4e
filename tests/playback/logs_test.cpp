// The committed flight of logs/, against the results committed with it: a change of behaviour shows here first.
// After a change that is meant: logs/make, and a look at the diff of logs/expected.
#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <map>
#include <regex>
#include <sstream>
#include <string>
#include <vector>

#include <gtest/gtest.h>
#include <lcm/lcm-cpp.hpp>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "tests/support/child_process.h"
#include "tests/support/flight_speed.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using namespace std::chrono_literals;
using test::ChildProcess;
namespace fs = std::filesystem;

// Another processor's arithmetic (no AVX2 and FMA in OpenCV) moves a position of this flight by up to 0.13 m and a
// number of the table by up to 0.05; another BLAS, AVX-512 or the number of threads by nothing. A fix gained or lost
// moves positions by a metre or more.
constexpr double kOtherMachine = 0.5;        // m, of a position
constexpr double kOtherMachineNumber = 0.2;  // of a number of the table
constexpr double kOtherMachineRatio = 0.1;
// Live, a keyframe may be given up and a fix come some frames later.
constexpr double kLive = 2.0;  // m

using Position = std::array<double, 3>;     // m in G
using Track = std::map<int64_t, Position>;  // by milliseconds

fs::path logs() {
  return test::source_tree() / "logs";
}

Track read_track(const fs::path& file) {
  Track track;
  std::ifstream in(file);
  std::string line;
  while (std::getline(in, line)) {
    std::istringstream numbers(line);
    double time = 0;
    Position p{};
    if (numbers >> time >> p[0] >> p[1] >> p[2]) track[std::llround(time * 1e3)] = p;
  }
  return track;
}

// How far the track is from `p` at `time`, between its neighbours; infinite where it has a hole of more than 0.5 s.
double distance(const Track& track, int64_t time, const Position& p) {
  const auto after = track.lower_bound(time);
  if (after == track.end()) return INFINITY;
  const auto before = after->first == time ? after : after == track.begin() ? track.end() : std::prev(after);
  if (before == track.end() || after->first - before->first > 500) return INFINITY;
  const double part =
      after == before ? 0.0
                      : static_cast<double>(time - before->first) / static_cast<double>(after->first - before->first);
  double sum = 0;
  for (size_t i = 0; i < 3; ++i) sum += std::pow(before->second[i] * (1 - part) + after->second[i] * part - p[i], 2);
  return std::sqrt(sum);
}

// A line of orthonav-evaluate's table with its numbers taken out, and the numbers.
struct Line {
  std::string words;
  std::vector<double> numbers;
};

std::vector<Line> read_table(const fs::path& file) {
  static const std::regex kNumber(R"((^|[ (])-?[0-9]+(\.[0-9]+)?)");
  std::vector<Line> lines;
  std::ifstream in(file);
  std::string text;
  while (std::getline(in, text)) {
    if (lines.empty() && text.rfind("Position error", 0) != 0) continue;  // what libraries say before it
    if (text.find(" ms") != std::string::npos) continue;                  // the machine's
    Line line;
    for (std::sregex_iterator it(text.begin(), text.end(), kNumber), end; it != end; ++it) {
      line.numbers.push_back(std::stod(it->str().substr(it->str().find_first_not_of(" ("))));
    }
    std::istringstream words(std::regex_replace(text, kNumber, "$1#"));
    for (std::string word; words >> word;) line.words += word + " ";
    lines.push_back(line);
  }
  return lines;
}

class CommittedFlight : public testing::Test {
 protected:
  void SetUp() override {
    for (const char* map : {"flight.map.tif", "flight.map.dem.tif"}) fs::copy_file(logs() / map, folder_ / map);
    expected_ = read_track(logs() / "expected" / "fusion.txt");
    ASSERT_GT(expected_.size(), 10u);
  }

  void run(const std::vector<std::string>& arguments, std::chrono::milliseconds patience) const {
    ChildProcess process(arguments, folder_ / "output.txt");
    ASSERT_EQ(process.wait_exit(patience), 0) << arguments[0];
  }
  // Evaluates a flown log into folder_ / "table.txt" and its track.
  Track track_of(const fs::path& flown) const {
    ChildProcess process({test::program("orthonav-evaluate"), flown, "--tum", folder_ / "tum"}, folder_ / "table.txt");
    EXPECT_EQ(process.wait_exit(60s), 0);
    return read_track(folder_ / "tum" / "fusion.tum");
  }
  // The distance within which the track keeps to `part` of the expected positions.
  double within(const Track& track, double part) const {
    std::vector<double> distances;
    for (const auto& [time, p] : expected_) distances.push_back(distance(track, time, p));
    std::sort(distances.begin(), distances.end());
    return distances[static_cast<size_t>(part * static_cast<double>(distances.size() - 1))];
  }

  test::TemporaryFolder folder_;
  Track expected_;
};

TEST_F(CommittedFlight, AReplayGivesTheCommittedPositionsAndTable) {
  const fs::path out = folder_ / "out.lcm";
  run({test::program("orthonav-replay"), "--config", logs() / "scenario", "--log", logs() / "flight.lcm", "--map",
       folder_ / "flight.map.tif", "--out", out},
      120s);
  const char* hint = "meant? then run logs/make and commit logs/expected";
  EXPECT_LT(within(track_of(out), 1.0), kOtherMachine) << hint;

  const auto expected = read_table(logs() / "expected" / "table.txt"), table = read_table(folder_ / "table.txt");
  ASSERT_EQ(table.size(), expected.size()) << hint;
  for (size_t i = 0; i < table.size(); ++i) {
    ASSERT_EQ(table[i].words, expected[i].words) << hint;
    ASSERT_EQ(table[i].numbers.size(), expected[i].numbers.size()) << hint;
    for (size_t k = 0; k < table[i].numbers.size(); ++k) {
      const double wanted = expected[i].numbers[k];
      EXPECT_NEAR(table[i].numbers[k], wanted, std::max(kOtherMachineNumber, kOtherMachineRatio * std::abs(wanted)))
          << table[i].words << "number " << k << ": " << hint;
    }
  }
}

TEST_F(CommittedFlight, ProcessesOverUdpInRealTimeKeepToItWithinTwoMetres) {
  const fs::path out = folder_ / "out.lcm";
  run({test::source_tree() / "deploy" / "fly", logs() / "scenario", logs() / "flight.lcm", folder_ / "flight.map.tif",
       out, test::flight_speed()},
      test::flown(120s));
  EXPECT_LT(within(track_of(out), 0.85), kLive);
}

// Through LCM's own file provider comes, byte by byte and in order, what our reader gives the replay above.
TEST_F(CommittedFlight, LcmsFileProviderPlaysTheSameMessages) {
  LogReader reader(logs() / "flight.lcm");
  lcm::LCM player("file://" + (logs() / "flight.lcm").string() + "?speed=0");
  ASSERT_TRUE(player.good());
  struct Heard {
    std::string channel;
    std::vector<uint8_t> data;
  } heard;
  player.subscribeFunction(
      ".*",
      +[](const lcm::ReceiveBuffer* buffer, const std::string& channel, Heard* into) {
        const auto* bytes = static_cast<const uint8_t*>(buffer->data);
        *into = {channel, {bytes, bytes + buffer->data_size}};
      },
      &heard);
  size_t messages = 0;
  while (player.handle() == 0) {
    const auto event = reader.next();
    ASSERT_TRUE(event) << messages;
    ASSERT_EQ(heard.channel, event->channel) << messages;
    ASSERT_EQ(heard.data, event->data) << messages;
    ++messages;
  }
  EXPECT_FALSE(reader.next());
  EXPECT_GT(messages, 5000u);
}

}  // namespace
}  // namespace orthonav
