// Work shared among the threads of a pool.

#pragma once

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

}  // namespace mpmjax
