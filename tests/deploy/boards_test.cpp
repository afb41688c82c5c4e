#include "tools/boards/boards.h"

#include <fstream>
#include <iterator>
#include <stdexcept>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/config/config.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::boards {
namespace {

using testing::HasSubstr;

class Boards : public testing::Test {
 protected:
  std::string error_of(const std::string& text) const {
    std::ofstream(folder_ / "boards.yaml") << text;
    try {
      load(folder_ / "boards.yaml");
    } catch (const ConfigError& error) {
      return error.what();
    }
    return "no error";
  }
  test::TemporaryFolder folder_;
};

TEST_F(Boards, EveryShippedFilePlacesTheWholeChain) {
  int files = 0;
  for (const auto& entry : std::filesystem::directory_iterator(test::source_tree() / "deploy" / "boards")) {
    EXPECT_NO_THROW(load(entry.path())) << entry.path();
    ++files;
  }
  EXPECT_GE(files, 3);
  const auto three = load(test::source_tree() / "deploy" / "boards" / "three.yaml");
  ASSERT_EQ(three.size(), 3u);
  EXPECT_EQ(three[0].services, (std::vector<std::string>{"ingest", "vio"}));
}

TEST_F(Boards, AServiceOnTwoBoardsOnNoneOrUnknownIsAnErrorWithItsName) {
  const std::string rest = "{address: 10.0.0.1, services: [ingest, vio, map_server, registration, fusion]}";
  EXPECT_EQ(error_of("boards: [a]\na: " + rest), "no error");
  EXPECT_THAT(error_of("boards: [a, b]\na: " + rest + "\nb: {address: 10.0.0.2, services: [vio]}"),
              testing::AllOf(HasSubstr("boards.yaml:3"), HasSubstr("vio runs on a already")));
  EXPECT_THAT(error_of("boards: [a]\na: {address: 10.0.0.1, services: [ingest, vio, map_server, fusion]}"),
              HasSubstr("registration runs on no board"));
  EXPECT_THAT(error_of("boards: [a]\na: {address: 10.0.0.1, services: [pilot]}"), HasSubstr("'pilot'"));
  EXPECT_THAT(error_of("boards: [../a]\n"), HasSubstr("no name"));
  const std::string with_output =
      "{address: 10.0.0.1, services: [ingest, vio, map_server, registration, fusion, output]}";
  EXPECT_EQ(error_of("boards: [a]\na: " + with_output), "no error");
  EXPECT_THAT(error_of("boards: [a, b]\na: " + with_output + "\nb: {address: 10.0.0.2, services: [output]}"),
              HasSubstr("output runs on a already"));
  EXPECT_THAT(error_of("boards: [a]\nb: {}\na: " + rest), HasSubstr("'b'"));
}

TEST_F(Boards, TheTargetOfABoardWantsItsServices) {
  const std::string unit = target_unit({"eyes", "10.0.0.1", {"ingest", "map_server"}}, "three.yaml");
  EXPECT_THAT(unit, HasSubstr("Wants=orthonav-ingest.service orthonav-map-server.service\n"));
}

TEST_F(Boards, TheirFirewallIsTheExampleWithTheirAddressesInterfaceAndPort) {
  const auto deploy = test::source_tree() / "deploy";
  std::ifstream stream(deploy / "etc" / "orthonav.nft");
  const std::string example((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  EXPECT_EQ(firewall(load(deploy / "boards" / "three.yaml"), "eth0", 7667), example);
  const std::string other = firewall({{"a", "10.0.0.8", {}}, {"b", "10.0.0.9", {}}}, "can1", 7700);
  EXPECT_THAT(other, testing::AllOf(HasSubstr("define bus = \"can1\"\n"), HasSubstr("define port = 7700\n"),
                                    HasSubstr("define boards = { 10.0.0.8, 10.0.0.9 }\n")));
  EXPECT_THAT(other, testing::Not(testing::AnyOf(HasSubstr("eth0\"\n"), HasSubstr("10.77.0"), HasSubstr("7667"))));
}

TEST_F(Boards, ThePortOfABusIsTakenFromItsUrl) {
  EXPECT_EQ(port_of("udpm://239.255.76.67:7700?ttl=1&recv_buf_size=1"), 7700);
  EXPECT_EQ(port_of("udpm://239.255.76.67:7667"), 7667);
  for (const char* none : {"memq://", "udpm://239.255.76.67", "udpm://239.255.76.67:http", "udpm://239.255.76.67:7667x",
                           "udpm://239.255.76.67:70000", ""}) {
    EXPECT_THROW(port_of(none), std::invalid_argument) << none;
  }
}

}  // namespace
}  // namespace orthonav::boards
