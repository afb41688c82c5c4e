// Keeps a message from tomorrow off a subscriber: one forged or broken stamp would make every true one look old.
//
// A stream's time moves on by seconds, so a stamp more than 30 s from the newest accepted one is refused; when three in
// a row agree with each other, the stream has a new time (another flight, a clock set right) and it is taken over. Not
// for channels with several publishers whose clocks differ.
#pragma once

#include <cstdint>

namespace orthonav {

class TimeGuard {
 public:
  // Whether a message of this time, microseconds, may pass.
  bool accept(int64_t utime);

 private:
  int64_t newest_ = 0;  // accepted; 0: none yet
  int64_t refused_ = 0;
  int refused_in_a_row_ = 0;
};

}  // namespace orthonav
