// Every message's decoder, and what the services make of a message before they believe it. The first byte says which
// type the rest is to be.
#include <cstdlib>
#include <vector>

#include "common/bus/image_parts.h"
#include "common/camera/image_decode.h"
#include "orthonav/altitude_t.hpp"
#include "orthonav/compass_t.hpp"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/health_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/magnetometer_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_request_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/place_hypotheses_t.hpp"
#include "orthonav/position_hint_t.hpp"
#include "orthonav/truth_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_reset_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "services/ingest/validator.h"
#include "services/registration/keyframe_message.h"
#include "services/registration/map/map_message.h"

namespace {

using namespace orthonav;

// The fingerprint that a type's messages begin with is put in place, so that the fuzzer gets behind it.
template <class Msg>
bool decode(const uint8_t* data, size_t size, Msg& message) {
  static const std::vector<uint8_t> kEmpty = [] {
    const Msg empty{};
    std::vector<uint8_t> bytes(static_cast<size_t>(empty.getEncodedSize()));
    empty.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
    return bytes;
  }();
  std::vector<uint8_t> bytes(kEmpty.begin(), kEmpty.begin() + 8);
  bytes.insert(bytes.end(), data, data + size);
  if (message.decode(bytes.data(), 0, static_cast<int>(bytes.size())) < 0) return false;
  // What was decoded can be encoded again, in no more bytes than it came in.
  std::vector<uint8_t> again(static_cast<size_t>(message.getEncodedSize()));
  if (again.size() > bytes.size() || message.encode(again.data(), 0, static_cast<int>(again.size())) < 0) std::abort();
  return true;
}

template <class Msg>
void only_decode(const uint8_t* data, size_t size) {
  Msg message{};
  decode(data, size, message);
}

template <class Msg>
void validate(const uint8_t* data, size_t size) {
  Msg message{};
  if (!decode(data, size, message)) return;
  ingest::Validator validator;
  validator.check(ingest::SensorMessage(message));
}

void image(const uint8_t* data, size_t size) {
  image_t message{};
  if (!decode(data, size, message)) return;
  ingest::Validator().check(ingest::SensorMessage(message));
  // Small pictures say as much about the checks as large ones, in less time.
  if (int64_t{message.width} * message.height <= 1 << 20) decode_image(message);
  decode_image(message, 64, 48);
}

// Two parts, of one image or of two.
void image_part(const uint8_t* data, size_t size) {
  const size_t half = size / 2;
  ImageAssembler assembler(64, 48);
  for (size_t begin : {size_t{0}, half}) {
    keyframe_image_t part{};
    if (!decode(data + begin, begin == 0 ? half : size - half, part)) continue;
    assembler.add(part);
    for (const image_t& whole : assembler.find(part.utime)) decode_image(whole, 64, 48);
    assembler.describe(part.utime);
  }
}

void keyframe(const uint8_t* data, size_t size) {
  vio_keyframe_t message{};
  if (decode(data, size, message)) registration::keyframe_of(message);
}

// A map on offer, then a tile of it.
void map(const uint8_t* data, size_t size) {
  const size_t half = size / 2;
  map_info_t info{};
  if (!decode(data, half, info) || !registration::problem_of(info).empty()) return;
  registration::MapClient client{registration::MapClientOptions{}};
  client.offer(registration::level_of(info));
  client.see(0.3);
  client.move({0, 0}, {10, 0}, 5);
  registration::next_request(client, "fuzz", 1);
  map_tile_t tile{};
  if (decode(data + half, size - half, tile)) registration::add_tile(client, tile, 2);
  client.take_ready();
  client.waiting_for();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  if (size == 0) return 0;
  using Try = void (*)(const uint8_t*, size_t);
  static constexpr Try kTypes[] = {image,
                                   keyframe,
                                   map,
                                   validate<imu_t>,
                                   validate<compass_t>,
                                   validate<magnetometer_t>,
                                   validate<altitude_t>,
                                   validate<gnss_reference_t>,
                                   validate<truth_t>,
                                   only_decode<vio_state_t>,
                                   only_decode<map_info_t>,
                                   only_decode<map_tile_t>,
                                   only_decode<map_tile_request_t>,
                                   only_decode<map_fix_t>,
                                   only_decode<nav_state_t>,
                                   only_decode<health_t>,
                                   only_decode<vio_reset_t>,
                                   only_decode<place_hypotheses_t>,
                                   only_decode<position_hint_t>,
                                   image_part};
  kTypes[data[0] % std::size(kTypes)](data + 1, size - 1);
  return 0;
}
