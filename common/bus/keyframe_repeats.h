// Tells a keyframe that has come before. VIO_KEYFRAME is published twice, a moment apart: it takes several packets, the
// chain of motions needs every link, and nobody asks for one again.
// Not thread-safe.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <tuple>

#include "orthonav/vio_keyframe_t.hpp"

namespace orthonav {

class KeyframeRepeats {
 public:
  // Whether `keyframe` is one of the last eight. By time, session and number: a forged number alone hides nothing.
  bool add(const vio_keyframe_t& keyframe) {
    const Key key{keyframe.utime, keyframe.session, keyframe.id};
    if (std::find(last_.begin(), last_.end(), key) != last_.end()) return true;
    last_[next_++ % last_.size()] = key;
    return false;
  }

 private:
  using Key = std::tuple<int64_t, int32_t, int32_t>;
  std::array<Key, 8> last_{};
  size_t next_ = 0;
};

}  // namespace orthonav
