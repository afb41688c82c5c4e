#include "services/map_server/map_builder.h"

#include <algorithm>
#include <deque>
#include <fstream>
#include <future>
#include <memory>
#include <set>
#include <thread>

#include <fmt/format.h>
#include <malloc.h>
#include <opencv2/core/utility.hpp>
#include <spdlog/spdlog.h>

#include "common/geo/raster.h"

namespace orthonav::map_server {
namespace {

constexpr int kKeptBytes = 256 << 20;

// Keeps OpenCV to the calling thread while it lives.
class OneThread {
 public:
  OneThread() : before_(cv::getNumThreads()) { cv::setNumThreads(1); }
  ~OneThread() { cv::setNumThreads(before_); }
  OneThread(const OneThread&) = delete;
  OneThread& operator=(const OneThread&) = delete;

 private:
  int before_;
};

void add_file(Checksum& checksum, const std::filesystem::path& file) {
  std::ifstream in(file, std::ios::binary);
  if (!in) throw MapDatabaseError(fmt::format("cannot read {}", file.string()));
  std::vector<char> buffer(1 << 20);
  while (in) {
    in.read(buffer.data(), static_cast<std::streamsize>(buffer.size()));
    checksum.add(buffer.data(), static_cast<size_t>(in.gcount()));
  }
  if (in.bad()) throw MapDatabaseError(fmt::format("cannot read {}", file.string()));
}

void add_raster(Checksum& checksum, const std::filesystem::path& raster) {
  for (const auto& file : raster_files(raster)) add_file(checksum, file);
}

std::string fingerprint_of_level(const std::string& map, size_t level) {
  if (level == 0) return map;
  Checksum checksum;
  checksum.add(fmt::format("{} level {}", map, level));
  return fmt::format("{:016x}", checksum.value());
}

// Why the database cannot be used for this fingerprint; empty when it can. Its tiles are read if `verify`.
std::string unusable(const std::filesystem::path& file, const std::string& fingerprint, bool verify) {
  if (!std::filesystem::exists(file)) return file.string() + " does not exist";
  try {
    const MapDatabase database(file);
    if (database.levels().front().fingerprint != fingerprint) {
      return file.string() + " was made of another raster or with other parameters";
    }
    if (verify) database.verify();
  } catch (const MapDatabaseError& error) {
    return error.what();
  }
  return {};
}

}  // namespace

std::string build_fingerprint(const std::filesystem::path& raster, const BuildOptions& options) {
  Checksum checksum;
  checksum.add(fmt::format("onmap 5 {} {} {} {} {} {} {} {} {}", name_of(options.features), options.keypoint_stride,
                           options.keypoint_size, options.metres_per_pixel, options.tile_size_m,
                           options.max_invalid_fraction, options.min_contrast, options.levels,
                           options.ground_height_m));
  add_raster(checksum, raster);
  if (const auto model = elevation_model(raster, options)) {
    checksum.add("elevation");
    add_raster(checksum, *model);
  }
  return fmt::format("{:016x}", checksum.value());
}

std::vector<MapDescription> build_map(const std::filesystem::path& raster, const BuildOptions& options,
                                      const std::filesystem::path& out,
                                      const std::function<void(const BuildProgress&)>& progress) {
  // Each core works on a block of its own: OpenCV's threads would only wait for each other.
  const OneThread opencv;
  // Each block needs the same pictures again: memory given back to the kernel after each costs a tenth of the time.
  mallopt(M_MMAP_THRESHOLD, kKeptBytes);
  mallopt(M_TRIM_THRESHOLD, kKeptBytes);
  std::vector<std::unique_ptr<BlockBuilder>> builders;
  for (unsigned i = 0; i < std::max(1U, std::thread::hardware_concurrency()); ++i) {
    builders.push_back(std::make_unique<BlockBuilder>(raster, options));
  }
  const std::string fingerprint = build_fingerprint(raster, options);
  std::vector<MapDescription> levels = builders.front()->levels();
  for (size_t i = 0; i < levels.size(); ++i) levels[i].fingerprint = fingerprint_of_level(fingerprint, i);
  const std::vector<Block> blocks = builders.front()->blocks();
  MapDatabaseWriter writer(out, levels);
  // The lock is ours now: another program may have finished while this one waited for it.
  if (writer.num_blocks() == 0 && unusable(out, fingerprint, true).empty()) {
    writer.discard();
    return MapDatabase(out).levels();
  }
  BuildProgress state;
  state.done = state.resumed = writer.num_blocks();
  state.total = static_cast<int64_t>(blocks.size());
  if (progress) progress(state);

  // Blocks are written in their order, and a builder gets its next block when its last has been written, so that as
  // many blocks are in memory as there are builders.
  std::deque<std::future<BlockFeatures>> working;
  const auto write_next = [&] {
    const BlockFeatures block = working.front().get();
    working.pop_front();
    writer.count_left_out(block.level, block.without_data, block.without_texture);
    writer.write_block(block.tiles);
    ++state.done;
    if (progress) progress(state);
  };
  for (auto i = static_cast<size_t>(state.resumed); i < blocks.size(); ++i) {
    if (working.size() == builders.size()) write_next();
    working.push_back(std::async(std::launch::async, [&builder = *builders[i % builders.size()], &block = blocks[i]] {
      return builder.build(block);
    }));
  }
  while (!working.empty()) write_next();
  if (writer.levels().front().num_features == 0) {
    writer.discard();
    throw MapDatabaseError(fmt::format("{}: no point of the raster has data and texture around it", raster.string()));
  }
  writer.finish();
  MapDatabase(out).verify();
  return writer.levels();
}

std::filesystem::path prepare_map(const std::filesystem::path& map, const BuildOptions& options,
                                  const std::function<void(const BuildProgress&)>& progress) {
  if (map.extension() == ".onmap") return map;
  std::filesystem::path cache = fmt::format("{}.{}.onmap", map.string(), name_of(options.features));
  const std::string problem = unusable(cache, build_fingerprint(map, options), false);
  if (problem.empty()) return cache;
  spdlog::info("building the database of {}: {}", map.string(), problem);
  build_map(map, options, cache, progress);
  return cache;
}

}  // namespace orthonav::map_server
