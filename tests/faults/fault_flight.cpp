// Flies one flight once for each fault, through processes on a bus of its own, in real time, and prints a table: what
// was lost, how long until the aircraft knew its place again, which services had to be restarted.
// tools/benchmark/faults makes the flight and runs it. A fault strikes after --strike seconds. A service that ends is
// restarted after 0.5 s, as its unit does; ingest goes on where the flight would be by then.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/truth_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "tests/faults/vandal.h"
#include "tests/support/bus_client.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::faults {
namespace {

using namespace std::chrono_literals;
using Clock = std::chrono::steady_clock;
using test::ChildProcess;

constexpr double kBigLoss = 1e9;

struct Arguments {
  std::filesystem::path config, log, map;
  std::filesystem::path twice;       // the same flight with twice the images, or none
  std::filesystem::path other;       // another flight at the same time, or none
  std::filesystem::path small_disk;  // a folder on a file system that a recording of the flight fills, or none
  std::filesystem::path raster;      // what `map` was built from, or none
  std::filesystem::path faketime;    // libfaketime, or none
  double strike = 25, length = 55;
  int garbage = 1'000'000, absurd = 100'000;
  std::vector<std::string> only;
};

struct Row {
  double silent_s = 0;      // longest time without NAV_STATE from the strike on
  double recovered_s = -1;  // from the strike to the last moment without a map-aided position; -1: never again
  double rmse_m = 0;        // fusion, 3D, while map-aided
  double rmse_of_all_m = 0;
  int states = 0;        // NAV_STATE after the strike
  int fixes = 0;         // valid ones after the strike
  int restarted = 0;     // services that were started again
  int other_deaths = 0;  // services that ended without having been killed
  int resets = 0;        // growth of the reset counter from the strike on
};

class Flight {
 public:
  explicit Flight(const Arguments& arguments, const std::filesystem::path& log)
      : arguments_(arguments),
        log_(log),
        nav_(bus_, channel::kNavState),
        truth_(bus_, channel::kTruth),
        keyframes_(bus_, channel::kVioKeyframe),
        fixes_(bus_, channel::kMapFix) {
    start("map_server", {"--map", arguments_.map});
    start("registration");
    start("fusion", {"--memory", folder_ / "fusion.memory"});
    start("vio", {"--memory", folder_ / "vio.memory"});
    start("ingest", {"--log", log_, "--wait-for", "map_server,registration,fusion,vio"});
  }

  void kill(const std::string& service) {
    killed_.insert(service);
    if (service == "ingest")
      running_.at(service).arguments = {test::program("orthonav-ingest"), "--config", arguments_.config, "--log",
                                        excerpt(log_, arguments_.length, true)};
    running_.at(service).process->signal(SIGKILL);
  }
  void give(const std::string& service, const std::string& option, const std::string& value) {
    auto& arguments = running_.at(service).arguments;
    *std::next(std::find(arguments.begin(), arguments.end(), option)) = value;
  }
  void signal(const std::string& service, int number) { running_.at(service).process->signal(number); }
  void start_second_ingest(const std::filesystem::path& log) { start("ingest", {"--log", log}, "second ingest"); }
  // The sensors of a flight beside this one's, for so long. Their time is the present, half a second ahead: theirs are
  // taken, this flight's come late.
  void start_second_ingest(const std::filesystem::path& log, double seconds) {
    start_second_ingest(excerpt(log, seconds, false));
  }
  void start_logger(const std::filesystem::path& out) {
    running_["logger"].arguments = {"/usr/bin/lcm-logger", "--force", out};
    running_["logger"].process = launch("logger");
  }

  // Hears the bus and restarts what ended, for so long.
  void pass(double seconds) {
    const auto end = Clock::now() + std::chrono::duration<double>(seconds);
    while (Clock::now() < end) hear(10);
  }
  void hear(int timeout_ms) {
    const size_t before = nav_.messages.size();
    bus_.handleTimeout(timeout_ms);
    const auto forged = std::remove_if(nav_.messages.begin() + static_cast<std::ptrdiff_t>(before), nav_.messages.end(),
                                       [](const nav_state_t& m) { return m.processing_ms == kForged; });
    nav_.messages.erase(forged, nav_.messages.end());
    for (size_t i = before; i < nav_.messages.size(); ++i) heard_.push_back(Clock::now());
    for (auto& [name, service] : running_) {
      if (service.restart_at) {
        if (Clock::now() >= *service.restart_at) {
          service.restart_at.reset();
          service.process = launch(name);
          ++row_.restarted;
        }
      } else if (!service.process->running()) {
        const bool killed = killed_.erase(name) != 0;
        if (!killed && name.find("ingest") != std::string::npos) continue;  // at its log's end
        if (!killed) ++row_.other_deaths;
        service.restart_at = Clock::now() + 500ms;
      }
    }
  }
  bool begin() {
    return test::handle_until(
        bus_, [&] { return !truth_.messages.empty(); }, 60s);
  }

  lcm::LCM& bus() { return bus_; }
  int64_t utime() const { return nav_.messages.empty() ? 0 : nav_.messages.back().utime; }
  int32_t session() const { return nav_.messages.empty() ? 0 : nav_.messages.back().session; }
  int32_t keyframe() const { return keyframes_.messages.empty() ? 0 : keyframes_.messages.back().id; }

  void strike() {
    strike_ = Clock::now();
    first_after_ = nav_.messages.size();
    first_fix_after_ = fixes_.messages.size();
  }
  double since_strike() const { return std::chrono::duration<double>(Clock::now() - strike_).count(); }

  Row result() {
    const auto since = [&](Clock::time_point t) { return std::chrono::duration<double>(t - strike_).count(); };
    double last = 0;
    for (size_t i = first_after_; i < nav_.messages.size(); ++i) {
      const double time = since(heard_[i]);
      row_.silent_s = std::max(row_.silent_s, time - last);
      last = time;
    }
    const double end = since(Clock::now());
    row_.silent_s = std::max(row_.silent_s, end - last > 3 ? end - last : 0.0);
    // The flight may end before the fault's program does: only silence of more than 3 s at the end counts.
    double lost_until = 0;
    for (size_t i = first_after_; i < nav_.messages.size(); ++i) {
      const bool gap = i > first_after_ && since(heard_[i]) - since(heard_[i - 1]) > 0.5;
      if (nav_.messages[i].mode != nav_state_t::MAP_AIDED || gap) lost_until = since(heard_[i]);
    }
    const bool aided = !nav_.messages.empty() && nav_.messages.back().mode == nav_state_t::MAP_AIDED;
    row_.recovered_s = aided && nav_.messages.size() > first_after_ ? lost_until : -1;
    if (first_after_ > 0 && first_after_ < nav_.messages.size()) {
      row_.resets = nav_.messages.back().reset_counter - nav_.messages[first_after_ - 1].reset_counter;
    }
    row_.rmse_m = rmse(true);
    row_.rmse_of_all_m = rmse(false);
    row_.states = static_cast<int>(nav_.messages.size() - first_after_);
    row_.fixes =
        static_cast<int>(std::count_if(fixes_.messages.begin() + static_cast<std::ptrdiff_t>(first_fix_after_),
                                       fixes_.messages.end(), [](const map_fix_t& f) { return f.valid != 0; }));
    return row_;
  }

 private:
  struct Running {
    std::unique_ptr<ChildProcess> process;
    std::vector<std::string> arguments;
    std::string program;
    std::optional<Clock::time_point> restart_at;
  };

  void start(const std::string& service, std::vector<std::string> more = {}, const std::string& name = "") {
    std::string program = "orthonav-" + service;
    std::replace(program.begin(), program.end(), '_', '-');
    std::vector<std::string> arguments{test::program(program), "--config", arguments_.config};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const std::string key = name.empty() ? service : name;
    running_[key].arguments = arguments;
    running_[key].process = launch(key);
  }
  std::unique_ptr<ChildProcess> launch(const std::string& name) const {
    return std::make_unique<ChildProcess>(running_.at(name).arguments, folder_ / (name + ".txt"));
  }

  // A flight from 0.7 s after now on (a service takes 0.2 s to start, or 0.5 s more to be started again), for so long,
  // as a log: with its truth, or without.
  std::filesystem::path excerpt(const std::filesystem::path& log, double seconds, bool with_truth) const {
    auto file = folder_ / "excerpt.lcm";
    LogReader reader(log);
    LogWriter writer(file);
    const int64_t from = (truth_.messages.empty() ? 0 : truth_.messages.back().utime) + 700'000;
    const int64_t until = from + std::llround(1e6 * seconds);
    while (const auto event = reader.next()) {
      if (event->utime < from || event->utime > until) continue;
      if (!with_truth && event->channel == channel::kTruth) continue;
      writer.write(event->utime, event->channel, event->data.data(), event->data.size());
    }
    return file;
  }

  // Of the positions that are map-aided, or of all there are, m.
  double rmse(bool aided_only) const {
    if (truth_.messages.empty()) return kBigLoss;
    std::map<int64_t, const truth_t*> truth;
    for (const auto& t : truth_.messages) truth[t.utime] = &t;
    double sum = 0;
    int count = 0;
    for (const auto& n : nav_.messages) {
      if (std::isnan(n.latitude_deg) || (aided_only && n.mode != nav_state_t::MAP_AIDED)) continue;
      const auto it = truth.find(n.utime);
      if (it == truth.end()) continue;
      const EnuFrame frame(
          Geodetic{it->second->latitude_deg, it->second->longitude_deg, it->second->ellipsoidal_height});
      sum += frame.to_enu({n.latitude_deg, n.longitude_deg, n.ellipsoidal_height}).squaredNorm();
      ++count;
    }
    return count > 0 ? std::sqrt(sum / count) : kBigLoss;
  }

  const Arguments& arguments_;
  const std::filesystem::path log_;
  test::TemporaryFolder folder_;
  lcm::LCM bus_;
  test::Collector<nav_state_t> nav_;
  test::Collector<truth_t> truth_;
  test::Collector<vio_keyframe_t> keyframes_;
  test::Collector<map_fix_t> fixes_;
  std::vector<Clock::time_point> heard_;
  std::map<std::string, Running> running_;
  std::set<std::string> killed_;
  Clock::time_point strike_{};
  size_t first_after_ = 0;
  size_t first_fix_after_ = 0;
  Row row_;
};

struct Fault {
  std::string name;
  std::function<void(Flight&)> strike;
  std::filesystem::path log{};           // another one than the flight's
  std::function<void()> before = [] {};  // the services start
  std::function<void()> after = [] {};   // they have ended
};

// `count` messages, evenly over the rest of the flight but 5 s, so that it shows how the flight goes on.
void flood(Flight& flight, const Arguments& arguments, int count, const std::function<void()>& publish) {
  const double duration = std::max(1.0, arguments.length - arguments.strike - 5);
  for (int i = 0; i < count; ++i) {
    publish();
    if (i % 50 != 0) continue;
    do {
      flight.hear(0);
    } while (flight.since_strike() < duration * i / count);
  }
}

// Writes to a file until its disk is full.
void fill(const std::filesystem::path& file) {
  std::ofstream stream(file, std::ios::binary);
  const std::string block(1 << 16, '\0');
  while (stream.write(block.data(), static_cast<std::streamsize>(block.size())).flush()) {
  }
}
void empty(const std::filesystem::path& folder) {
  for (const auto& entry : std::filesystem::directory_iterator(folder)) std::filesystem::remove_all(entry);
}

// The log with every second image left out.
std::filesystem::path half_the_images(const std::filesystem::path& log, const std::filesystem::path& out) {
  LogReader reader(log);
  LogWriter writer(out);
  int images = 0;
  while (const auto event = reader.next()) {
    if (event->channel == channel::kCamera && ++images % 2 == 0) continue;
    writer.write(event->utime, event->channel, event->data.data(), event->data.size());
  }
  return out;
}

std::vector<Fault> all_faults(const Arguments& arguments, const std::filesystem::path& folder) {
  std::vector<Fault> faults{{"none", [](Flight&) {}}};
  for (const char* service : {"ingest", "vio", "map_server", "registration", "fusion"}) {
    faults.push_back({fmt::format("kill -9 {}", service), [service](Flight& f) { f.kill(service); }});
  }
  // Two that share a board of deploy/boards/three.yaml, and the two that remember where the aircraft is.
  for (const auto& [one, other] : std::vector<std::pair<const char*, const char*>>{
           {"ingest", "vio"}, {"registration", "fusion"}, {"vio", "fusion"}}) {
    faults.push_back({fmt::format("kill -9 {} and {}", one, other), [one = one, other = other](Flight& f) {
                        f.kill(one);
                        f.kill(other);
                      }});
  }
  for (const char* service : {"vio", "map_server", "registration", "fusion"}) {
    faults.push_back({fmt::format("SIGSTOP {} for 5 s", service), [service](Flight& f) {
                        f.signal(service, SIGSTOP);
                        f.pass(5);
                        f.signal(service, SIGCONT);
                      }});
  }
  faults.push_back(
      {"second ingest, from the flight's start", [&arguments](Flight& f) { f.start_second_ingest(arguments.log); }});
  faults.push_back({"second ingest, the same sensors for 10 s",
                    [&arguments](Flight& f) { f.start_second_ingest(arguments.log, 10); }});
  if (!arguments.other.empty()) {
    faults.push_back({"second ingest, another aircraft's sensors for 10 s",
                      [&arguments](Flight& f) { f.start_second_ingest(arguments.other, 10); }});
  }
  faults.push_back({fmt::format("{} garbage messages", arguments.garbage), [&arguments](Flight& f) {
                      std::mt19937_64 random(1);
                      flood(f, arguments, arguments.garbage, [&] { publish_garbage(f.bus(), random); });
                    }});
  faults.push_back({fmt::format("{} absurd messages", arguments.absurd), [&arguments](Flight& f) {
                      std::mt19937_64 random(1);
                      flood(f, arguments, arguments.absurd,
                            [&] { publish_absurd(f.bus(), random, f.utime(), f.session(), f.keyframe()); });
                    }});
  faults.push_back({"half the images", [](Flight&) {}, half_the_images(arguments.log, folder / "half.lcm")});
  if (!arguments.twice.empty()) faults.push_back({"twice the images", [](Flight&) {}, arguments.twice});
  if (!arguments.small_disk.empty()) {
    faults.push_back({"disk full under the recorder",
                      [&arguments](Flight& f) { f.start_logger(arguments.small_disk / "flight.lcm"); },
                      {},
                      [&arguments] { empty(arguments.small_disk); }});
  }
  if (!arguments.small_disk.empty() && !arguments.raster.empty()) {
    faults.push_back({"map cache on a full disk for 10 s",
                      [&arguments](Flight& f) {
                        const auto raster = arguments.small_disk / arguments.raster.filename();
                        const auto ballast = arguments.small_disk / "ballast";
                        std::filesystem::copy_file(arguments.raster, raster);
                        const auto heights = std::filesystem::path(arguments.raster).replace_extension(".dem.tif");
                        std::filesystem::copy_file(heights, arguments.small_disk / heights.filename());
                        fill(ballast);
                        f.give("map_server", "--map", raster);
                        f.kill("map_server");
                        f.pass(10);
                        std::filesystem::remove(ballast);
                      },
                      {},
                      [&arguments] { empty(arguments.small_disk); }});
  }
  if (!arguments.faketime.empty()) {
    const auto offset = folder / "offset";
    const auto say = [offset](const char* text) { std::ofstream(offset) << text << std::endl; };
    for (const auto& [name, step] : {std::pair("on", "+3600"), std::pair("back", "-3600")}) {
      faults.push_back({fmt::format("wall clock one hour {}", name),
                        [say, step = step](Flight&) { say(step); },
                        {},
                        [say, offset, &arguments] {
                          say("+0");
                          setenv("FAKETIME_TIMESTAMP_FILE", offset.c_str(), 1);
                          setenv("FAKETIME_NO_CACHE", "1", 1);
                          setenv("FAKETIME_DONT_FAKE_MONOTONIC", "1", 1);
                          setenv("LD_PRELOAD", arguments.faketime.c_str(), 1);
                        },
                        [] { unsetenv("LD_PRELOAD"); }});
    }
  }
  return faults;
}

void fly(const Arguments& arguments) {
  fmt::print(
      "| fault | longest silence of NAV_STATE (s) | map-aided again after (s) | RMSE (m) | of all positions | "
      "NAV_STATE | "
      "fixes | restarted | others that ended | resets |\n|---|---|---|---|---|---|---|---|---|---|\n");
  const test::TemporaryFolder folder;
  for (const Fault& fault : all_faults(arguments, folder.path())) {
    const bool chosen =
        arguments.only.empty() || std::any_of(arguments.only.begin(), arguments.only.end(),
                                              [&](auto& o) { return fault.name.find(o) != std::string::npos; });
    if (!chosen) continue;
    fault.before();
    Flight flight(arguments, fault.log.empty() ? arguments.log : fault.log);
    if (!flight.begin()) throw std::runtime_error("the flight does not begin");
    const auto end = Clock::now() + std::chrono::duration<double>(arguments.length);
    flight.pass(arguments.strike);
    flight.strike();
    fault.strike(flight);
    flight.pass(std::chrono::duration<double>(end - Clock::now()).count());
    const Row row = flight.result();
    fault.after();
    fmt::print("| {} | {:.1f} | {} | {:.2f} | {:.2f} | {} | {} | {} | {} | {} |\n", fault.name, row.silent_s,
               row.recovered_s < 0 ? "never" : fmt::format("{:.1f}", row.recovered_s), row.rmse_m, row.rmse_of_all_m,
               row.states, row.fixes, row.restarted, row.other_deaths, row.resets);
    std::fflush(stdout);
  }
}

}  // namespace
}  // namespace orthonav::faults

int main(int argc, char** argv) {
  CLI::App app{"Flies one flight once for each fault and prints a table."};
  orthonav::faults::Arguments arguments;
  app.add_option("--config", arguments.config)->required()->check(CLI::ExistingDirectory);
  app.add_option("--log", arguments.log)->required()->check(CLI::ExistingFile);
  app.add_option("--map", arguments.map)->required()->check(CLI::ExistingFile);
  app.add_option("--twice", arguments.twice, "the flight with twice the images")->check(CLI::ExistingFile);
  app.add_option("--other", arguments.other, "another flight at the same time")->check(CLI::ExistingFile);
  app.add_option("--small-disk", arguments.small_disk, "folder that a recording fills")->check(CLI::ExistingDirectory);
  app.add_option("--raster", arguments.raster, "what the map was built from")->check(CLI::ExistingFile);
  app.add_option("--faketime", arguments.faketime, "libfaketime.so.1")->check(CLI::ExistingFile);
  app.add_option("--strike", arguments.strike, "s into the flight")->capture_default_str();
  app.add_option("--length", arguments.length, "s of the flight that are flown")->capture_default_str();
  app.add_option("--garbage", arguments.garbage, "messages of the flood")->capture_default_str();
  app.add_option("--absurd", arguments.absurd, "messages of the flood")->capture_default_str();
  app.add_option("--only", arguments.only, "faults whose name contains one of these")->delimiter(',');
  CLI11_PARSE(app, argc, argv);
  try {
    orthonav::faults::fly(arguments);
  } catch (const std::exception& error) {
    fmt::print(stderr, "fault_flight: {}\n", error.what());
    return 1;
  }
  return 0;
}
