// What sealing and checking a message costs, by its size in bytes: an IMU sample, a part of a tile, a JPEG, a raw
// image.
#include <benchmark/benchmark.h>

#include "common/bus/seal.h"

namespace {

void SealAndCheck(benchmark::State& state) {
  const orthonav::BusKey key{};
  orthonav::Sealer sealer(key);
  orthonav::SealChecker checker(key);
  const std::vector<uint8_t> message(static_cast<size_t>(state.range(0)), 7);
  for ([[maybe_unused]] auto _ : state) {
    std::vector<uint8_t> sealed = message;
    sealer.seal("CAMERA", 1, sealed);
    benchmark::DoNotOptimize(checker.refusal("CAMERA", 1, sealed.data(), sealed.size()));
  }
}
BENCHMARK(SealAndCheck)->Arg(68)->Arg(1400)->Arg(60'000)->Arg(307'200)->Unit(benchmark::kMicrosecond);

}  // namespace

BENCHMARK_MAIN();
