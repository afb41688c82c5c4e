#include "services/map_server/tile_queue.h"

namespace orthonav::map_server {

// Levels are below 16, parts below 2^24: tiles of a hundred million features.
uint64_t TileQueue::key(const TileRequest& request) {
  return static_cast<uint64_t>(static_cast<uint32_t>(request.tile)) << 32 | static_cast<uint64_t>(request.level) << 28 |
         (static_cast<uint64_t>(static_cast<uint32_t>(request.part)) & 0xfff'ffff);
}

TileQueue::Outcome TileQueue::add(const TileRequest& request) {
  const TileRequest whole{request.level, request.tile, -1};
  if (waiting_.contains(key(request)) || waiting_.contains(key(whole))) return Outcome::kCoalesced;
  if (queue_.size() >= capacity_) return Outcome::kFull;
  queue_.push_back(request);
  waiting_.insert(key(request));
  return Outcome::kQueued;
}

void TileQueue::pop() {
  waiting_.erase(key(queue_.front()));
  queue_.pop_front();
}

}  // namespace orthonav::map_server
