#include "common/config/config.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <yaml-cpp/yaml.h>

namespace orthonav {

namespace {

// A file may extend another: the layers of one map, the most specific first.
struct Layer {
  YAML::Node node;
  std::filesystem::path file;
};

std::string where(const Layer& layer, const YAML::Node& node) {
  const YAML::Mark mark = node.Mark();
  return mark.is_null() ? layer.file.string() : fmt::format("{}:{}", layer.file.string(), mark.line + 1);
}

std::vector<Layer> load_layers(const std::filesystem::path& file, int depth);

std::vector<Layer> with_base(YAML::Node top, const std::filesystem::path& file, int depth) {
  if (top.IsNull()) top = YAML::Node(YAML::NodeType::Map);
  if (!top.IsMap()) throw ConfigError(fmt::format("{}: the file must be a map of keys to values", file.string()));
  std::vector<Layer> layers{{top, file}};
  if (const YAML::Node base = top["extends"]; base.IsDefined()) {
    if (depth >= 8) throw ConfigError(fmt::format("{}: 'extends' goes round in a circle", file.string()));
    for (auto& layer : load_layers(file.parent_path() / base.as<std::string>(), depth + 1)) layers.push_back(layer);
  }
  return layers;
}

std::vector<Layer> load_layers(const std::filesystem::path& file, int depth) {
  if (!std::filesystem::is_regular_file(file)) {
    throw ConfigError(fmt::format("{}: no such configuration file", file.string()));
  }
  try {
    return with_base(YAML::LoadFile(file.string()), file, depth);
  } catch (const YAML::Exception& error) {
    throw ConfigError(fmt::format("{}:{}: {}", file.string(), error.mark.line + 1, error.msg));
  }
}

std::function<void(const ConfigRead&)>& observer() {
  static std::function<void(const ConfigRead&)> instance;
  return instance;
}

// As far as files are written: angles are in degrees there.
template <class T>
std::string text_of(const T& value) {
  if constexpr (std::is_same_v<T, double>) return fmt::format("{:.6g}", value);
  return fmt::format("{}", value);
}

template <class T>
constexpr const char* type_name() {
  if constexpr (std::is_same_v<T, bool>) return "true or false";
  if constexpr (std::is_same_v<T, int> || std::is_same_v<T, int64_t>) return "a whole number";
  if constexpr (std::is_same_v<T, double>) return "a number";
  if constexpr (std::is_same_v<T, std::string>) return "a text";
  if constexpr (std::is_same_v<T, std::vector<double>>) return "a list of numbers";
  return "a list of texts";
}

}  // namespace

struct ConfigNode::Impl {
  std::vector<Layer> layers;
  std::string path;  // keys from the top, with a trailing dot
  std::set<std::string> known;

  std::filesystem::path file() const { return layers.empty() ? std::filesystem::path() : layers.front().file; }

  // The most specific layer that has the key.
  const Layer* find(const std::string& key) {
    known.insert(key);
    for (const Layer& layer : layers) {
      const YAML::Node& node = layer.node;
      if (node[key].IsDefined()) return &layer;
    }
    return nullptr;
  }
};

ConfigNode::ConfigNode(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
ConfigNode::~ConfigNode() = default;
ConfigNode::ConfigNode(ConfigNode&&) noexcept = default;
ConfigNode& ConfigNode::operator=(ConfigNode&&) noexcept = default;

ConfigNode ConfigNode::load(const std::filesystem::path& file) {
  auto impl = std::make_unique<Impl>();
  impl->layers = load_layers(file, 0);
  impl->known.insert("extends");
  return ConfigNode(std::move(impl));
}

ConfigNode ConfigNode::parse(const std::string& text, const std::string& name) {
  auto impl = std::make_unique<Impl>();
  try {
    impl->layers = with_base(YAML::Load(text), name, 0);
  } catch (const YAML::Exception& error) {
    throw ConfigError(fmt::format("{}:{}: {}", name, error.mark.line + 1, error.msg));
  }
  impl->known.insert("extends");
  return ConfigNode(std::move(impl));
}

void ConfigNode::overlay(const YAML::Node& map, const std::filesystem::path& file) {
  impl_->layers.insert(impl_->layers.begin(), {map, file});
}

bool ConfigNode::has(const std::string& key) const {
  return impl_->find(key) != nullptr;
}

ConfigNode ConfigNode::child_or_empty(const std::string& key) {
  impl_->known.insert(key);
  auto child = std::make_unique<Impl>();
  child->path = impl_->path + key + ".";
  for (const Layer& layer : impl_->layers) {
    const YAML::Node& parent = layer.node;
    const YAML::Node node = parent[key];
    if (!node.IsDefined() || node.IsNull()) continue;
    if (!node.IsMap()) fail(key, "must be a map of keys to values");
    child->layers.push_back({node, layer.file});
  }
  if (child->layers.empty() && !impl_->layers.empty()) {
    child->layers.push_back({YAML::Node(YAML::NodeType::Map), impl_->layers.front().file});
  }
  return ConfigNode(std::move(child));
}

ConfigNode ConfigNode::child(const std::string& key) {
  if (!has(key)) fail(key, "is missing");
  return child_or_empty(key);
}

void ConfigNode::observe(std::function<void(const ConfigRead&)> each) {
  observer() = std::move(each);
}

template <class T>
void ConfigNode::read(const std::string& key, T& value) {
  const Layer* layer = impl_->find(key);
  const std::string given = observer() ? text_of(value) : "";
  if (layer == nullptr) {
    if (observer()) observer()({impl_->file(), impl_->path + key, given, given, false});
    return;
  }
  const YAML::Node& parent = layer->node;
  try {
    value = parent[key].as<T>();
  } catch (const YAML::Exception&) {
    fail(key, fmt::format("must be {}", type_name<T>()));
  }
  if constexpr (std::is_same_v<T, double>) {
    if (std::isnan(value)) fail(key, "must not be NaN");
  }
  if (observer()) observer()({impl_->file(), impl_->path + key, given, text_of(value), true});
}

template <class T>
void ConfigNode::require(const std::string& key, T& value) {
  if (!has(key)) fail(key, fmt::format("is missing: it must be {}", type_name<T>()));
  read(key, value);
}

void ConfigNode::read(const std::string& key, double& value, double low, double high) {
  read(key, value);
  if (value < low || value > high) fail(key, fmt::format("must lie in [{}, {}], not {}", low, high, value));
}

void ConfigNode::read(const std::string& key, int& value, int low, int high) {
  read(key, value);
  if (value < low || value > high) fail(key, fmt::format("must lie in [{}, {}], not {}", low, high, value));
}

void ConfigNode::read_path(const std::string& key, std::filesystem::path& value) {
  std::string text;
  read(key, text);
  if (text.empty()) return;
  const std::filesystem::path path(text);
  value = path.is_absolute() ? path : impl_->find(key)->file.parent_path() / path;
}

void ConfigNode::finish() const {
  for (const Layer& layer : impl_->layers) {
    for (const auto& entry : layer.node) {
      const auto key = entry.first.as<std::string>(std::string());
      if (impl_->known.count(key) != 0) continue;
      throw ConfigError(fmt::format("{}: unknown key '{}{}'; known here: {}", where(layer, entry.first), impl_->path,
                                    key, fmt::join(impl_->known, ", ")));
    }
  }
}

void ConfigNode::fail(const std::string& key, const std::string& what) const {
  const Layer* layer = impl_->find(key);
  std::string place = impl_->layers.empty() ? std::string("configuration") : impl_->layers.front().file.string();
  if (layer != nullptr) {
    const YAML::Node& parent = layer->node;
    place = where(*layer, parent[key]);
  }
  throw ConfigError(fmt::format("{}: key '{}{}' {}", place, impl_->path, key, what));
}

template void ConfigNode::read(const std::string&, bool&);
template void ConfigNode::read(const std::string&, int&);
template void ConfigNode::read(const std::string&, int64_t&);
template void ConfigNode::read(const std::string&, double&);
template void ConfigNode::read(const std::string&, std::string&);
template void ConfigNode::read(const std::string&, std::vector<double>&);
template void ConfigNode::read(const std::string&, std::vector<std::string>&);
template void ConfigNode::require(const std::string&, bool&);
template void ConfigNode::require(const std::string&, int&);
template void ConfigNode::require(const std::string&, int64_t&);
template void ConfigNode::require(const std::string&, double&);
template void ConfigNode::require(const std::string&, std::string&);
template void ConfigNode::require(const std::string&, std::vector<double>&);
template void ConfigNode::require(const std::string&, std::vector<std::string>&);

}  // namespace orthonav
