#include "share.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>

namespace mpmjax {
namespace {

// How often a thread looks whether the others are done before it sleeps, which takes some tens of microseconds at most.
// To be woken may take as long, and shares are of about the same length.
constexpr int kSpins = 1000;

void pause() {
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

}  // namespace

void share(const Pool& pool, int64_t count, const std::function<void(int64_t)>& run) {
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

}  // namespace mpmjax
