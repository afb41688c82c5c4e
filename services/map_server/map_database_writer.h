// Writes a map database block by block, so that a build that was killed goes on where it stopped.
//
// Two files stand beside the database while it is made: FILE.unfinished, which takes the database's name when it is
// complete, and FILE.journal, which says after each block what of the first is good. A writer that finds them verifies
// the tiles of every block in the journal and keeps the blocks up to the first that does not hold. A journal of another
// map (raster, parameters, format) is put aside. The finished file is the same, byte for byte, however often its build
// was broken off.
#pragma once

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <vector>

#include "services/map_server/map_database.h"

namespace orthonav::map_server {

struct NumberedTile {
  int level = 0;
  int index = 0;
  TileFeatures features;
};

// Not thread-safe.
class MapDatabaseWriter {
 public:
  // `levels` with their counts 0, the finest first. Waits while another program writes the same file. Throws
  // MapDatabaseError when the files cannot be created.
  MapDatabaseWriter(const std::filesystem::path& file, const std::vector<MapDescription>& levels);
  ~MapDatabaseWriter();
  MapDatabaseWriter(const MapDatabaseWriter&) = delete;
  MapDatabaseWriter& operator=(const MapDatabaseWriter&) = delete;

  // Blocks that an earlier writer finished: the next to be written has this number.
  int64_t num_blocks() const { return num_blocks_; }

  // What of a level was left out in the block being written.
  void count_left_out(int level, int64_t without_data, int64_t without_texture);

  // Ends a block. Each tile at most once; tiles never written are empty. Throws MapDatabaseError when writing failed.
  void write_block(const std::vector<NumberedTile>& tiles);

  // Throws MapDatabaseError when writing failed, for instance on a full disk.
  void finish();

  // Removes what is unfinished: for a build that can never succeed.
  void discard();

  const std::vector<MapDescription>& levels() const { return levels_; }

 private:
  struct Block;
  // An open file that is locked; let go with the writer, also one whose construction failed.
  struct Lock {
    int fd = -1;
    ~Lock();
  };
  void lock();
  void resume();
  bool read_block(std::ifstream& journal, std::ifstream& data, Block& block) const;
  void apply(const Block& block);
  size_t entry_of(int level, int index) const;
  [[noreturn]] void fail(const std::string& what) const;
  [[noreturn]] void fail_to_write() const;

  std::filesystem::path file_;
  std::filesystem::path unfinished_;
  std::filesystem::path journal_file_;
  std::vector<MapDescription> levels_;
  std::vector<TileEntry> index_;
  std::vector<int64_t> left_out_;  // of the block being written: two numbers a level
  std::ofstream data_;
  std::ofstream journal_;
  Lock lock_;
  uint64_t end_ = 0;
  int64_t num_blocks_ = 0;
};

}  // namespace orthonav::map_server
