// orthonav-status on a bus with real services.
#include <fstream>

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using namespace std::chrono_literals;
using test::ChildProcess;
using test::program;

TEST(StatusProcess, ShowsARunningServiceAndMissesAnAbsentOne) {
  const test::TemporaryFolder folder;
  ChildProcess fusion({program("orthonav-fusion"), "--config", test::source_tree() / "config" / "quick"});
  ChildProcess starting({program("orthonav-status"), "--json", "--expect", "fusion"}, folder / "status.json");
  // It has no odometry to fuse: STARTING.
  EXPECT_EQ(starting.wait_exit(20s), 1);
  const auto rows = nlohmann::json::parse(std::ifstream(folder / "status.json"));
  ASSERT_EQ(rows.size(), 1u);
  EXPECT_EQ(rows[0]["service"], "fusion");
  EXPECT_EQ(rows[0]["state"], "STARTING");
  EXPECT_GT(rows[0]["memory_mb"].get<double>(), 5);
  EXPECT_GT(rows[0]["out_hz"].get<double>() + rows[0]["in_hz"].get<double>(), 0);

  ChildProcess missing({program("orthonav-status"), "--seconds", "1.2", "--expect", "fusion,vio"},
                       folder / "table.txt");
  EXPECT_EQ(missing.wait_exit(20s), 2);
  std::ifstream stream(folder / "table.txt");
  const std::string table((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  EXPECT_NE(table.find("MISSING"), std::string::npos) << table;
}

TEST(StatusProcess, ABusThatCannotBeJoinedHasAnExitCodeOfItsOwn) {
  ChildProcess status({program("orthonav-status"), "--lcm-url", "nonsense://here"});
  EXPECT_EQ(status.wait_exit(20s), 3);
}

}  // namespace
}  // namespace orthonav
