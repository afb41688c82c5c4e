// YAML into typed structs, with file and line in every error.
//
// A service declares a plain options struct with defaults at its members and reads it with one call per
// member. A key that is in the file but that nobody read is an error (a misspelt key must not pass silently):
// call finish() on every node after reading it. Not thread-safe.
#pragma once

#include <filesystem>
#include <functional>
#include <memory>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

namespace YAML {
class Node;
}

namespace orthonav {

class ConfigError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// A key as it was read: what the file says in place of the default.
struct ConfigRead {
  std::filesystem::path file;  // the one that it was read for
  std::string key;             // from the top: a.b
  std::string given;           // the default
  std::string read;
  bool in_file = false;
};

class ConfigNode {
 public:
  // Calls `observer` at each read until it is set to none; for tests that compare files with defaults. Of all nodes,
  // not thread-safe.
  static void observe(std::function<void(const ConfigRead&)> observer);

  // Reads a YAML file whose top level is a map. Throws ConfigError when it is missing or malformed.
  static ConfigNode load(const std::filesystem::path& file);

  // The same from text, for tests; `name` stands for the file in errors.
  static ConfigNode parse(const std::string& text, const std::string& name);

  // Lays another map over this one: its keys win. `file` stands for its origin in errors. Only for the top node.
  void overlay(const YAML::Node& map, const std::filesystem::path& file);

  ~ConfigNode();
  ConfigNode(ConfigNode&&) noexcept;
  ConfigNode& operator=(ConfigNode&&) noexcept;

  bool has(const std::string& key) const;

  // Child map under `key`. Throws when it is absent (required) or not a map. child_or_empty gives an empty map
  // when it is absent, so that all defaults apply.
  ConfigNode child(const std::string& key);
  ConfigNode child_or_empty(const std::string& key);

  // Reads `key` into `value` if present, else leaves the default. T is bool, int, int64_t, double, std::string,
  // std::vector<double> or std::vector<std::string>. Throws ConfigError when the value has another type.
  template <class T>
  void read(const std::string& key, T& value);

  // The same, but the key must be there.
  template <class T>
  void require(const std::string& key, T& value);

  // A double that must lie in [low, high].
  void read(const std::string& key, double& value, double low, double high);
  void read(const std::string& key, int& value, int low, int high);

  // A path; a relative one is taken from the folder of the configuration file.
  void read_path(const std::string& key, std::filesystem::path& value);

  // Throws ConfigError naming the first key that was not read, and the known keys.
  void finish() const;

  // "file:line: key 'a.b': what", for errors found by the caller.
  [[noreturn]] void fail(const std::string& key, const std::string& what) const;

 private:
  struct Impl;
  explicit ConfigNode(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace orthonav
