// Work done by several threads and handed on in order.
#pragma once

#include <condition_variable>
#include <exception>
#include <map>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace orthonav::simulate {

// Calls make(i) for i in 0 .. count - 1 on `threads` threads, and consume(i, result) on the caller's thread in order
// of i. At most `threads` * 4 results wait. The first exception of either stops the work and is thrown here.
template <class Make, class Consume>
void ordered_parallel(size_t count, int threads, Make&& make, Consume&& consume) {
  using Result = decltype(make(size_t{0}));
  std::mutex mutex;
  std::condition_variable changed;
  std::map<size_t, Result> ready;
  std::exception_ptr error;
  size_t next_to_make = 0, next_to_consume = 0;
  bool stop = false;
  const size_t ahead = static_cast<size_t>(threads) * 4;

  const auto worker = [&] {
    std::unique_lock lock(mutex);
    while (true) {
      changed.wait(lock, [&] { return stop || next_to_make >= count || next_to_make < next_to_consume + ahead; });
      if (stop || next_to_make >= count) return;
      const size_t index = next_to_make++;
      lock.unlock();
      try {
        Result result = make(index);
        lock.lock();
        ready.emplace(index, std::move(result));
      } catch (...) {
        if (!lock.owns_lock()) lock.lock();
        if (!error) error = std::current_exception();
        stop = true;
      }
      changed.notify_all();
    }
  };

  std::vector<std::thread> workers;
  workers.reserve(static_cast<size_t>(threads));
  for (int i = 0; i < threads; ++i) workers.emplace_back(worker);
  {
    std::unique_lock lock(mutex);
    while (next_to_consume < count) {
      changed.wait(lock, [&] { return stop || (!ready.empty() && ready.begin()->first == next_to_consume); });
      if (stop) break;
      const auto first = ready.begin();
      Result result = std::move(first->second);
      ready.erase(first);
      lock.unlock();
      try {
        consume(next_to_consume, std::move(result));
        lock.lock();
      } catch (...) {
        lock.lock();
        error = std::current_exception();
        stop = true;
        break;
      }
      ++next_to_consume;
      changed.notify_all();
    }
  }
  changed.notify_all();
  for (std::thread& thread : workers) thread.join();
  if (error) std::rethrow_exception(error);
}

}  // namespace orthonav::simulate
