// A small thread pool with passive waits: idle workers sleep, so two processes on one machine do not
// fight for cores by spinning. Work is cut in fixed chunks; results never depend on the number of threads.
#pragma once
#include <memory>
#include <stdint.h>

namespace polarguide {

class Pool;

// The threads that some work is done by. They stay the same for as long as this lives, whatever others set meanwhile: memory
// for each worker is sized by the `count` of the very threads that it is for.
class Workers {
  public:
    Workers(); // those that are set now
    int count() const;

    // f(begin, end, worker) is called for disjoint [begin, end) ranges that cover [0, count), each at most `chunk` long.
    // `worker` is in [0, count()). Returns when all of them are done. The first exception that one throws is thrown here
    // after all workers have stopped; ranges that nobody has begun by then are left out.
    template <class F> void chunks(int64_t count, int64_t chunk, F &f) const {
        run(count, chunk, [](void *c, int64_t b, int64_t e, int w) { (*static_cast<F *>(c))(b, e, w); }, &f);
    }

  private:
    using Body = void (*)(void *context, int64_t begin, int64_t end, int worker);
    void run(int64_t count, int64_t chunk, Body body, void *context) const;

    std::shared_ptr<Pool> pool_;
};

int thread_count();
void set_thread_count(int threads); // at least 1; 0 restores the default (POLARGUIDE_THREADS, else the cores we may use)

// For work that needs no memory for each worker.
template <class F> inline void parallel_chunks(int64_t count, int64_t chunk, F &f) { Workers().chunks(count, chunk, f); }

} // namespace polarguide
