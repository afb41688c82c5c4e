#include "tools/status/fleet.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

namespace orthonav::status {

namespace {

constexpr int64_t kLostAfter = 3'000'000;  // microseconds
// A flood of made-up services must not eat the memory.
constexpr size_t kMostServices = 200;

double counter(const health_t& health, const std::string& name) {
  for (const auto& c : health.counters) {
    if (c.name == name) return c.value;
  }
  return 0;
}

double sum(const health_t& health, const std::string& prefix) {
  double total = 0;
  for (const auto& c : health.counters) {
    if (c.name.starts_with(prefix)) total += c.value;
  }
  return total;
}

double largest(const health_t& health, const std::string& prefix) {
  double value = 0;
  for (const auto& c : health.counters) {
    if (c.name.starts_with(prefix) && std::abs(c.value) > std::abs(value)) value = c.value;
  }
  return value;
}

const char* name_of(int8_t state) {
  switch (state) {
    case health_t::STARTING:
      return "STARTING";
    case health_t::OK:
      return "OK";
    case health_t::DEGRADED:
      return "DEGRADED";
    case health_t::FAILED:
      return "FAILED";
  }
  return "UNKNOWN";
}

// Control characters of a message from the bus must not reach the terminal, and there are some beyond ASCII.
std::string printable(std::string text) {
  std::replace_if(
      text.begin(), text.end(), [](unsigned char c) { return c < 0x20 || c > 0x7e; }, ' ');
  return text;
}

const char* colour_of(const std::string& state) {
  if (state == "OK") return "\033[32m";
  return state == "STARTING" || state == "DEGRADED" ? "\033[33m" : "\033[31m";
}

}  // namespace

void Fleet::add(const health_t& heartbeat, int64_t now) {
  const std::string key = heartbeat.service + "@" + heartbeat.host;
  if (!entries_.contains(key) && entries_.size() >= kMostServices) return;
  Entry& entry = entries_[key];
  // A restarted service counts from zero.
  const bool same = entry.received != 0 && entry.newest.pid == heartbeat.pid && heartbeat.uptime > entry.newest.uptime;
  // A heartbeat sent at once on a change of state is too close to the one before for a rate.
  if (same && heartbeat.uptime - entry.newest.uptime > 0.5) {
    entry.before = entry.newest;
    entry.has_before = true;
  } else if (!same) {
    entry.has_before = false;
  }
  entry.newest = heartbeat;
  entry.received = now;
}

std::vector<Row> Fleet::rows(int64_t now) const {
  std::vector<Row> rows;
  for (const auto& [key, entry] : entries_) {
    const health_t& h = entry.newest;
    Row row;
    row.service = printable(h.service);
    row.host = printable(h.host);
    row.version = printable(h.version);
    row.state = now - entry.received > kLostAfter ? "LOST" : name_of(h.state);
    row.message = printable(h.message);
    row.pid = h.pid;
    row.uptime = h.uptime;
    row.cpu_percent = counter(h, "cpu.percent");
    row.memory_mb = counter(h, "memory.bytes") * 1e-6;
    row.latency_ms = largest(h, "latency_ms.");
    row.rejected = sum(h, "rejected.");
    row.skew_ms = largest(h, "clock.skew_ms.");
    if (entry.has_before) {
      const health_t& before = entry.before;
      const double elapsed = h.uptime - before.uptime;
      const auto rate = [&](const char* prefix) { return (sum(h, prefix) - sum(before, prefix)) / elapsed; };
      row.in_hz = rate("received.");
      row.out_hz = rate("published.");
      row.rejected_hz = rate("rejected.");
    }
    rows.push_back(row);
  }
  for (const std::string& service : expected_) {
    if (std::any_of(rows.begin(), rows.end(), [&](const Row& row) { return row.service == service; })) continue;
    Row row;
    row.service = service;
    row.state = "MISSING";
    row.message = "no heartbeat: is it running, and on this bus?";
    rows.push_back(row);
  }
  return rows;
}

Verdict Fleet::verdict(int64_t now) const {
  const auto all = rows(now);
  if (all.empty()) return Verdict::kBad;
  Verdict worst = Verdict::kOk;
  for (const Row& row : all) {
    if (row.state == "OK") continue;
    const bool waiting = row.state == "STARTING" || row.state == "DEGRADED";
    worst = std::max(worst, waiting ? Verdict::kNotReady : Verdict::kBad);
  }
  return worst;
}

std::string to_text(const std::vector<Row>& rows, bool colour) {
  std::string text = fmt::format("{:<13} {:<10} {:<9} {:>8} {:>6} {:>7} {:>7} {:>7} {:>8} {:>8} {:>7} {:>8} {:<8} {}\n",
                                 "SERVICE", "HOST", "STATE", "UP s", "CPU %", "MEM MB", "IN Hz", "OUT Hz", "SLOW ms",
                                 "REFUSED", "/s", "SKEW ms", "VERSION", "LAST ERROR");
  for (const Row& r : rows) {
    text += fmt::format(
        "{:<13} {:<10} {}{:<9}{} {:>8.0f} {:>6.1f} {:>7.1f} {:>7.1f} {:>7.1f} {:>8.1f} {:>8.0f} {:>7.1f} "
        "{:>8.1f} {:<8} {}\n",
        r.service, r.host, colour ? colour_of(r.state) : "", r.state, colour ? "\033[0m" : "", r.uptime, r.cpu_percent,
        r.memory_mb, r.in_hz, r.out_hz, r.latency_ms, r.rejected, r.rejected_hz, r.skew_ms, r.version, r.message);
  }
  return text;
}

std::string to_json(const std::vector<Row>& rows) {
  nlohmann::json array = nlohmann::json::array();
  for (const Row& r : rows) {
    array.push_back({{"service", r.service},
                     {"host", r.host},
                     {"version", r.version},
                     {"state", r.state},
                     {"message", r.message},
                     {"pid", r.pid},
                     {"uptime", r.uptime},
                     {"cpu_percent", r.cpu_percent},
                     {"memory_mb", r.memory_mb},
                     {"in_hz", r.in_hz},
                     {"out_hz", r.out_hz},
                     {"latency_ms", r.latency_ms},
                     {"rejected", r.rejected},
                     {"rejected_hz", r.rejected_hz},
                     {"skew_ms", r.skew_ms}});
  }
  return array.dump(2, ' ', false, nlohmann::json::error_handler_t::replace) + "\n";
}

}  // namespace orthonav::status
