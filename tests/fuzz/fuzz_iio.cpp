// The type of a channel of an IIO device, and a record read with it.
#include <stdexcept>
#include <string>
#include <vector>

#include "services/ingest/iio_scan.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace orthonav::ingest;
  std::vector<IioChannel> channels;
  std::string text(reinterpret_cast<const char*>(data), size);
  for (size_t at = 0; at < text.size();) {
    const size_t end = std::min(text.find('\n', at), text.size());
    try {
      IioChannel channel;
      channel.index = static_cast<int>(end);
      channel.type = IioType::parse(text.substr(at, end - at));
      channels.push_back(channel);
    } catch (const std::runtime_error&) {
      // No type.
    }
    at = end + 1;
  }
  const std::vector<uint8_t> record(lay_out(channels), 0xA5);
  for (const IioChannel& channel : channels) channel.type.decode(record.data() + channel.position);
  return 0;
}
