// Thread pool with passive waits: idle workers sleep, so two processes on one machine do not compete for cores by spinning.
// Work is divided into fixed chunks, so results do not depend on the number of threads.
#pragma once
#include <memory>
#include <stdint.h>

namespace polarguide {

class Pool;

// Threads of some work. Their number is fixed during the lifetime of this object, even if another thread changes the setting,
// so that memory for each worker has the size for `count` threads.
class Workers {
  public:
    Workers(); // with the current number of threads
    int count() const;

    // Calls f(begin, end, worker) for disjoint ranges [begin, end) that cover [0, count), each at most `chunk` long. `worker` is in
    // [0, count()). Returns when all ranges are done. After an exception, the remaining ranges are skipped, and the first exception
    // is rethrown when all workers have stopped.
    template <class F> void chunks(int64_t count, int64_t chunk, F &f) const {
        run(count, chunk, [](void *c, int64_t b, int64_t e, int w) { (*static_cast<F *>(c))(b, e, w); }, &f);
    }

  private:
    using Body = void (*)(void *context, int64_t begin, int64_t end, int worker);
    void run(int64_t count, int64_t chunk, Body body, void *context) const;

    std::shared_ptr<Pool> pool_;
};

int thread_count();
void set_thread_count(int threads); // at least 1; 0 restores the default (POLARGUIDE_THREADS, else the available cores)

// For work without memory per worker.
template <class F> inline void parallel_chunks(int64_t count, int64_t chunk, F &f) { Workers().chunks(count, chunk, f); }

} // namespace polarguide
