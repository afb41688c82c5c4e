// What config/default says is what the code does without it: a user reads the one, tests and benchmarks run the other.
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/config/config.h"
#include "services/fusion/options.h"
#include "services/map_server/options.h"
#include "services/output/options.h"
#include "services/registration/registration_service.h"
#include "services/vio/options.h"

namespace orthonav {
namespace {

const std::filesystem::path kFolder = std::filesystem::path(ORTHONAV_SOURCE) / "config/default";

// The keys of the file whose value is not the default, or that it does not have, as a person would look for them.
std::vector<std::string> differences(const std::string& file, const std::function<void()>& load) {
  std::vector<std::string> result;
  int reads = 0;
  ConfigNode::observe([&](const ConfigRead& read) {
    if (read.file.filename() != file) return;
    ++reads;
    if (!read.in_file) result.push_back(file + " has no " + read.key + ": " + read.given);
    if (read.given != read.read) result.push_back(file + " " + read.key + ": " + read.read + ", code: " + read.given);
  });
  load();
  ConfigNode::observe({});
  EXPECT_GT(reads, 3) << file;
  return result;
}

using testing::IsEmpty;

TEST(Defaults, OfFusionAreThoseOfTheCode) {
  EXPECT_THAT(differences("fusion.yaml", [] { fusion::FusionOptions::load(kFolder); }), IsEmpty());
}
TEST(Defaults, OfRegistrationAreThoseOfTheCode) {
  EXPECT_THAT(differences("registration.yaml", [] { registration::RegistrationService::read(kFolder); }), IsEmpty());
}
TEST(Defaults, OfVioAreThoseOfTheCode) {
  EXPECT_THAT(differences("vio.yaml", [] { vio::load_setup(kFolder); }), IsEmpty());
}
TEST(Defaults, OfTheMapServerAreThoseOfTheCode) {
  EXPECT_THAT(differences("map_server.yaml", [] { map_server::ServerOptions::from_config(kFolder); }), IsEmpty());
}
TEST(Defaults, OfTheOutputAreThoseOfTheCode) {
  EXPECT_THAT(differences("output.yaml", [] { output::OutputOptions::load(kFolder / "output.yaml"); }), IsEmpty());
}

}  // namespace
}  // namespace orthonav
