#include "services/map_server/map_database_writer.h"

#include <cerrno>
#include <cstring>
#include <stdexcept>
#include <system_error>

#include <fcntl.h>
#include <fmt/format.h>
#include <spdlog/spdlog.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

namespace orthonav::map_server {
namespace {

constexpr uint64_t kBlockMagic = 0x31'4b'43'4f'4c'42'4e'4fULL;

struct WrittenTile {
  uint64_t entry;  // in the index
  TileEntry place;
};
static_assert(std::is_trivially_copyable_v<WrittenTile> && sizeof(WrittenTile) == 32);

// The journal's first bytes: whose it is.
std::string journal_head(const std::vector<MapDescription>& levels) {
  std::string head = fmt::format("onmap journal {} {} ", levels.size(), onmap::head_bytes(levels));
  for (const MapDescription& level : levels) head += level.fingerprint;
  return head;
}

}  // namespace

// One record of the journal: these numbers, `left_out`, `tiles` and a checksum of all.
struct MapDatabaseWriter::Block {
  struct Numbers {
    uint64_t magic = kBlockMagic;
    uint64_t number = 0;
    uint64_t num_tiles = 0;
    uint64_t end = 0;  // of the data
  };
  Numbers numbers;
  std::vector<int64_t> left_out;
  std::vector<WrittenTile> tiles;

  uint64_t checksum() const {
    Checksum sum;
    sum.add(&numbers, sizeof(numbers));
    sum.add(left_out.data(), left_out.size() * sizeof(int64_t));
    sum.add(tiles.data(), tiles.size() * sizeof(WrittenTile));
    return sum.value();
  }
};

MapDatabaseWriter::MapDatabaseWriter(const std::filesystem::path& file, const std::vector<MapDescription>& levels)
    : file_(file),
      unfinished_(file.string() + ".unfinished"),
      journal_file_(file.string() + ".journal"),
      levels_(levels),
      left_out_(2 * levels.size(), 0) {
  if (levels_.empty() || levels_.size() > onmap::kMaxLevels) throw std::logic_error("a map has 1 to 16 levels");
  int64_t num_tiles = 0;
  for (MapDescription& level : levels_) {
    if (level.fingerprint.size() != 16) throw std::logic_error("a fingerprint has 16 digits");
    level.num_features = level.num_without_data = level.num_without_texture = 0;
    num_tiles += static_cast<int64_t>(level.tile_columns) * level.tile_rows;
  }
  if (num_tiles > onmap::kMaxTiles) {
    throw MapDatabaseError(fmt::format("{} tiles are too many: raise tile_size_m", num_tiles));
  }
  index_.resize(static_cast<size_t>(num_tiles));
  end_ = onmap::head_bytes(levels_);
  lock();
  resume();
}

MapDatabaseWriter::~MapDatabaseWriter() {
  if (num_blocks_ == 0) discard();  // nothing to go on from
}

MapDatabaseWriter::Lock::~Lock() {
  if (fd >= 0) ::close(fd);
}

void MapDatabaseWriter::fail(const std::string& what) const {
  throw MapDatabaseError(
      fmt::format("cannot {} map database {}: {}", what, file_.string(), std::generic_category().message(errno)));
}

void MapDatabaseWriter::fail_to_write() const {
  throw MapDatabaseError(fmt::format("cannot write map database {}: is the disk full?", file_.string()));
}

// The journal is the lock. Whoever held it before may have finished and removed it meanwhile: then the name belongs to
// another file, or to none, than the one that is locked now.
void MapDatabaseWriter::lock() {
  for (;;) {
    lock_.fd = ::open(journal_file_.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
    if (lock_.fd < 0) fail("create");
    if (::flock(lock_.fd, LOCK_EX | LOCK_NB) != 0) {
      spdlog::info("waiting for another program that builds {}", file_.string());
      if (::flock(lock_.fd, LOCK_EX) != 0) fail("lock");
    }
    struct stat locked {};
    struct stat named {};
    if (::fstat(lock_.fd, &locked) == 0 && ::stat(journal_file_.c_str(), &named) == 0 &&
        locked.st_ino == named.st_ino) {
      return;
    }
    ::close(lock_.fd);
  }
}

bool MapDatabaseWriter::read_block(std::ifstream& journal, std::ifstream& data, Block& block) const {
  block.left_out.resize(left_out_.size());
  if (!journal.read(reinterpret_cast<char*>(&block.numbers), sizeof(block.numbers)) ||
      block.numbers.magic != kBlockMagic || block.numbers.num_tiles > index_.size()) {
    return false;
  }
  block.tiles.resize(block.numbers.num_tiles);
  uint64_t checksum = 0;
  if (!journal.read(reinterpret_cast<char*>(block.left_out.data()),
                    static_cast<std::streamsize>(block.left_out.size() * sizeof(int64_t))) ||
      !journal.read(reinterpret_cast<char*>(block.tiles.data()),
                    static_cast<std::streamsize>(block.tiles.size() * sizeof(WrittenTile))) ||
      !journal.read(reinterpret_cast<char*>(&checksum), sizeof(checksum)) || checksum != block.checksum()) {
    return false;
  }
  std::string bytes;
  for (const WrittenTile& tile : block.tiles) {
    bytes.resize(tile.place.count * onmap::kFeatureBytes);
    data.seekg(static_cast<std::streamoff>(tile.place.offset));
    if (!data.read(bytes.data(), static_cast<std::streamsize>(bytes.size())) ||
        onmap::checksum_of(bytes.data(), bytes.size()) != tile.place.checksum) {
      return false;
    }
  }
  return true;
}

void MapDatabaseWriter::apply(const Block& block) {
  for (const WrittenTile& tile : block.tiles) index_[tile.entry] = tile.place;
  size_t entry = 0;
  for (size_t i = 0; i < levels_.size(); ++i) {
    const size_t next = entry + static_cast<size_t>(levels_[i].num_tiles());
    for (const WrittenTile& tile : block.tiles) {
      if (tile.entry >= entry && tile.entry < next) levels_[i].num_features += static_cast<int64_t>(tile.place.count);
    }
    levels_[i].num_without_data += block.left_out[2 * i];
    levels_[i].num_without_texture += block.left_out[2 * i + 1];
    entry = next;
  }
  end_ = block.numbers.end;
  ++num_blocks_;
}

void MapDatabaseWriter::resume() {
  const std::string head = journal_head(levels_);
  std::string found(head.size(), '\0');
  std::ifstream journal(journal_file_, std::ios::binary);
  uint64_t good = 0;  // bytes of the journal
  if (journal.read(found.data(), static_cast<std::streamsize>(found.size())) && found == head) {
    good = head.size();
    std::ifstream data(unfinished_, std::ios::binary);
    for (Block block; read_block(journal, data, block); block = {}) {
      apply(block);
      good = static_cast<uint64_t>(journal.tellg());
    }
  }
  if (good == 0) {
    std::ofstream fresh(journal_file_, std::ios::binary | std::ios::trunc);
    fresh << head;
    fresh.close();
    if (!fresh) fail_to_write();
    good = head.size();
  }
  std::ofstream(unfinished_, std::ios::binary | std::ios::app).close();  // made where it is missing
  // What a kill left half written goes; the head's room is filled at the end.
  if (::truncate(journal_file_.c_str(), static_cast<off_t>(good)) != 0 ||
      ::truncate(unfinished_.c_str(), static_cast<off_t>(end_)) != 0) {
    fail("create");
  }
  data_.open(unfinished_, std::ios::binary | std::ios::in | std::ios::out | std::ios::ate);
  journal_.open(journal_file_, std::ios::binary | std::ios::app);
  if (!data_ || !journal_) fail("create");
  if (num_blocks_ > 0) spdlog::info("{}: going on after {} finished blocks", file_.string(), num_blocks_);
}

size_t MapDatabaseWriter::entry_of(int level, int index) const {
  const MapDescription& description = levels_.at(static_cast<size_t>(level));
  if (index < 0 || index >= description.num_tiles()) throw std::logic_error("no such tile");
  auto entry = static_cast<size_t>(index);
  for (int i = 0; i < level; ++i) entry += static_cast<size_t>(levels_[static_cast<size_t>(i)].num_tiles());
  return entry;
}

void MapDatabaseWriter::count_left_out(int level, int64_t without_data, int64_t without_texture) {
  left_out_.at(2 * static_cast<size_t>(level)) += without_data;
  left_out_.at(2 * static_cast<size_t>(level) + 1) += without_texture;
}

void MapDatabaseWriter::write_block(const std::vector<NumberedTile>& tiles) {
  Block block;
  block.numbers.number = static_cast<uint64_t>(num_blocks_);
  block.left_out = left_out_;
  left_out_.assign(left_out_.size(), 0);
  uint64_t end = end_;
  for (const NumberedTile& tile : tiles) {
    const size_t entry = entry_of(tile.level, tile.index);
    if (index_[entry].offset != 0) throw std::logic_error("tile written twice");
    const std::string bytes = onmap::pack(tile.features);
    block.tiles.push_back(
        {entry, {end, tile.features.positions.size(), onmap::checksum_of(bytes.data(), bytes.size())}});
    data_.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    end += bytes.size();
  }
  block.numbers.num_tiles = block.tiles.size();
  block.numbers.end = end;
  // The journal must never promise what is not in the file yet.
  data_.flush();
  const uint64_t checksum = block.checksum();
  journal_.write(reinterpret_cast<const char*>(&block.numbers), sizeof(block.numbers));
  journal_.write(reinterpret_cast<const char*>(block.left_out.data()),
                 static_cast<std::streamsize>(block.left_out.size() * sizeof(int64_t)));
  journal_.write(reinterpret_cast<const char*>(block.tiles.data()),
                 static_cast<std::streamsize>(block.tiles.size() * sizeof(WrittenTile)));
  journal_.write(reinterpret_cast<const char*>(&checksum), sizeof(checksum));
  journal_.flush();
  if (!data_ || !journal_) fail_to_write();
  apply(block);
}

void MapDatabaseWriter::finish() {
  for (TileEntry& entry : index_) {
    if (entry.offset == 0) entry = {onmap::head_bytes(levels_), 0, onmap::checksum_of(nullptr, 0)};
  }
  const std::string head = onmap::head_of(levels_, index_, end_);
  data_.seekp(0);
  data_.write(head.data(), static_cast<std::streamsize>(head.size()));
  data_.close();
  if (!data_) fail_to_write();
  std::error_code error;
  std::filesystem::rename(unfinished_, file_, error);
  if (error) throw MapDatabaseError(fmt::format("cannot write map database {}: {}", file_.string(), error.message()));
  discard();
}

void MapDatabaseWriter::discard() {
  std::error_code ignored;
  std::filesystem::remove(unfinished_, ignored);
  std::filesystem::remove(journal_file_, ignored);
}

}  // namespace orthonav::map_server
