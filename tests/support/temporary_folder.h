// A folder of the test's own that goes when the test does.
#pragma once

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>

namespace orthonav::test {

class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "orthonav-XXXXXX").string();
    if (mkdtemp(name.data()) == nullptr) throw std::runtime_error("no temporary folder");
    path_ = name;
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;

  const std::filesystem::path& path() const { return path_; }
  std::filesystem::path operator/(const std::string& name) const { return path_ / name; }
  // Writes a file of it, and gives its place.
  std::filesystem::path write(const std::string& name, const std::string& text) const {
    std::ofstream file(path_ / name, std::ios::binary);
    if (!(file << text << std::flush)) throw std::runtime_error(name + ": cannot be written");
    return path_ / name;
  }

 private:
  std::filesystem::path path_;
};

}  // namespace orthonav::test
