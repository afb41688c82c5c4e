// Keeps a message from tomorrow off a subscriber: one forged or broken stamp would make every true one look old.
//
// A time before 1970 or after 2255 is none. A stream's time moves on by seconds, so a stamp more than 30 s from the
// newest accepted one is refused. Stamps that agree with each other are taken over as the stream's new time (another
// flight, a clock set right) when there are three in a row and they span `proof`, with none of the accepted time
// between them: a stream that is alive cannot be displaced by a flood. Not for channels with several publishers whose
// clocks differ.
#pragma once

#include <cstdint>

namespace orthonav {

class TimeGuard {
 public:
  // In microseconds: longer than the pauses of a stream; 0 for what comes when it is asked for, hours apart.
  explicit TimeGuard(int64_t proof = 2'000'000) : proof_(proof) {}

  // Whether a message of this time, microseconds, may pass.
  bool accept(int64_t utime);

 private:
  int64_t proof_;
  int64_t newest_ = 0;         // accepted; 0: none yet
  int64_t first_refused_ = 0;  // of those in a row that agree
  int64_t refused_ = 0;        // the newest of them
  int refused_in_a_row_ = 0;
};

}  // namespace orthonav
