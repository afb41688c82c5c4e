// The records that Linux IIO writes into a device's buffer: which channels are in them, where, and how they are coded.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace orthonav::ingest {

// How one channel is coded in a record: `[be|le]:[s|u]bits/storagebits>>shift`, as in scan_elements/*_type.
struct IioType {
  bool big_endian = false;
  bool is_signed = false;
  int bits = 0;     // that mean something, 1..64
  int storage = 0;  // 8, 16, 32 or 64
  int shift = 0;    // to the right, before the bits are taken

  // Throws std::runtime_error saying what is wrong with the text.
  static IioType parse(const std::string& text);
  // The number at `bytes`, which holds storage / 8 bytes.
  int64_t decode(const uint8_t* bytes) const;
};

struct IioChannel {
  std::string name;  // as in_anglvel_x or in_timestamp
  int index = 0;     // its place in the order of the record
  IioType type;
  double scale = 1;  // value = (number + offset) * scale, in IIO's units
  double offset = 0;
  size_t position = 0;  // of its first byte in the record
};

// Puts the channels in order, each aligned to its own size; returns the record's length in bytes, which is a multiple
// of the largest one.
size_t lay_out(std::vector<IioChannel>& channels);

// Reads what `device` (a folder like /sys/bus/iio/devices/iio:device0) says of the channel. Throws std::runtime_error
// naming the file that is missing or makes no sense. Scale and offset are the axis's own, or else those of its kind
// (in_anglvel_scale), or else 1 and 0.
IioChannel read_channel(const std::filesystem::path& device, const std::string& name);

// The first line of a file. Throws std::runtime_error naming it.
std::string read_line(const std::filesystem::path& file);

}  // namespace orthonav::ingest
