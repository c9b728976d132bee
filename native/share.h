// Work shared among the threads of a pool.

#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>

namespace mpmjax {

// Threads that run what is scheduled, at some time.
class Pool {
 public:
  virtual ~Pool() = default;
  virtual int threads() const = 0;
  virtual void schedule(std::function<void()> task) const = 0;
};

// How often a thread looks whether the others are done before it sleeps, which takes some tens of microseconds at most.
// To be woken may take as long, and shares are of about the same length.
constexpr int kSpins = 1000;

inline void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#endif
}

// Outlives the call that made it: helpers that come late find that nothing is left.
struct Work {
  std::atomic<int64_t> next{0}, done{0};
  int64_t count;
  const std::function<void(int64_t)>* run;  // valid until all is done
  std::mutex mutex;
  std::condition_variable changed;

  void help() {
    for (int64_t i; (i = next.fetch_add(1)) < count;) {
      (*run)(i);
      if (done.fetch_add(1) + 1 == count) {
        const std::lock_guard<std::mutex> lock(mutex);
        changed.notify_one();
      }
    }
  }
};

// Calls run(0), ..., run(count - 1), each once, on this thread and on those of the pool that come in time, and returns
// when all are done. This thread takes whatever nobody else has begun, so it never waits for a thread that is held by
// another program or by a caller that waits too.
inline void share(const Pool& pool, int64_t count, const std::function<void(int64_t)>& run) {
  const int64_t helpers = std::min<int64_t>(pool.threads(), count) - 1;
  if (helpers <= 0) {
    for (int64_t i = 0; i < count; ++i) run(i);
    return;
  }
  const auto work = std::make_shared<Work>();
  work->count = count;
  work->run = &run;
  for (int64_t i = 0; i < helpers; ++i) pool.schedule([work] { work->help(); });
  work->help();
  for (int k = 0; k < kSpins; ++k) {
    if (work->done.load() == count) return;
    pause();
  }
  std::unique_lock<std::mutex> lock(work->mutex);
  work->changed.wait(lock, [&] { return work->done.load() == count; });
}

// Calls run(m, first, last) for parts, of so many, of what each member m of a batch has.
template <class Run>
void share_parts(const Pool& pool, int64_t batch, int64_t count, int64_t each, const Run& run) {
  const int64_t parts = (count + each - 1) / each;
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t first = i % parts * each;
    run(i / parts, first, std::min(count, first + each));
  });
}

}  // namespace mpmjax
