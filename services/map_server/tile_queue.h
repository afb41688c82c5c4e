// What the map server still has to send, in the order it was asked for; what is asked for twice is sent once.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>
#include <unordered_set>

namespace orthonav::map_server {

struct TileRequest {
  int level = 0;
  int tile = 0;
  int part = -1;  // -1: the whole tile
};

// Not thread-safe.
class TileQueue {
 public:
  enum class Outcome { kQueued, kCoalesced, kFull };

  // At most `capacity` requests wait; whoever is refused asks again.
  explicit TileQueue(size_t capacity) : capacity_(capacity) {}

  Outcome add(const TileRequest& request);
  bool empty() const { return queue_.empty(); }
  size_t size() const { return queue_.size(); }
  const TileRequest& front() const { return queue_.front(); }
  void pop();

 private:
  static uint64_t key(const TileRequest& request);

  size_t capacity_;
  std::deque<TileRequest> queue_;
  std::unordered_set<uint64_t> waiting_;
};

}  // namespace orthonav::map_server
