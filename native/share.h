// Work shared among the threads of a pool.

#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>

namespace mpmjax {

// Threads that run what is scheduled, at some time.
class Pool {
 public:
  virtual ~Pool() = default;
  virtual int threads() const = 0;
  virtual void schedule(std::function<void()> task) const = 0;
};

// Calls run(0), ..., run(count - 1), each once, on this thread and on those of the pool that come in time, and returns
// when all are done. This thread takes whatever nobody else has begun, so it never waits for a thread that is held by
// another program or by a caller that waits too.
void share(const Pool& pool, int64_t count, const std::function<void(int64_t)>& run);

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
