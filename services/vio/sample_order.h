// Which samples of one sensor follow each other, where some are stamped wrongly.
//
// A sample that is not later than the newest one, or later by more than `longest_gap`, does not follow it. Either its
// stamp is wrong or the newest one's was, and what comes next tells: such samples wait, and are refused as soon as one
// comes that does follow. Where they follow each other for `proof_time` and nothing else comes, they are the sensor's
// time from now on: a gap has ended, or the clock has been set, or the newest sample was stamped in the future.
// Without this a single stamp in the future would make a sensor deaf until the process is started anew.
// Not thread-safe.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

namespace orthonav::vio {

template <class Sample>  // with a member `utime`, microseconds
class SampleOrder {
 public:
  struct Taken {
    std::vector<Sample> samples;  // to use now, in order; mostly the one given
    bool stepped_back = false;    // samples given out before from the first of these on were not the sensor's time
    int out_of_order = 0;         // refused now: not later than what came before them
    int in_future = 0;            // refused now: later than what came after them
  };

  // Both in microseconds.
  SampleOrder(int64_t longest_gap, int64_t proof_time) : longest_gap_(longest_gap), proof_time_(proof_time) {}

  Taken add(Sample sample) {
    Taken taken;
    const int64_t utime = sample.utime;
    if (!begun_ || follows(newest_, utime)) {
      refuse(taken);
      newest_ = utime;
      begun_ = true;
      taken.samples.push_back(std::move(sample));
      return taken;
    }
    if (!waiting_.empty() && !follows(waiting_.back().utime, utime)) refuse(taken);
    waiting_.push_back(std::move(sample));
    if (utime - waiting_.front().utime < proof_time_) return taken;
    taken.stepped_back = waiting_.front().utime <= newest_;
    newest_ = utime;
    taken.samples = std::exchange(waiting_, {});
    return taken;
  }

 private:
  bool follows(int64_t before, int64_t utime) const { return utime > before && utime - before <= longest_gap_; }

  void refuse(Taken& taken) {
    for (const Sample& sample : waiting_) ++(sample.utime > newest_ ? taken.in_future : taken.out_of_order);
    waiting_.clear();
  }

  int64_t longest_gap_, proof_time_;
  bool begun_ = false;
  int64_t newest_ = 0;
  std::vector<Sample> waiting_;
};

}  // namespace orthonav::vio
