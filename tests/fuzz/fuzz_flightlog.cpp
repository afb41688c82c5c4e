// A recorded flight, as ingest and the replay read it.
#include "services/ingest/log_source.h"
#include "tests/fuzz/scratch_file.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  orthonav::ingest::LogSource source(orthonav::fuzz::scratch_file("flight.lcm", data, size));
  while (source.next()) source.progress();
  return 0;
}
