// A small thread pool with passive waits: idle workers sleep, so two processes on one machine do not
// fight for cores by spinning. Work is cut in fixed chunks; results never depend on the number of threads.
#pragma once
#include <stdint.h>

namespace polarguide {

// body(context, begin, end, worker) is called for disjoint [begin, end) ranges that cover [0, count),
// each at most `chunk` long. `worker` is in [0, thread_count()). Returns when all of them are done.
using Body = void (*)(void *context, int64_t begin, int64_t end, int worker);
void parallel_for(int64_t count, int64_t chunk, Body body, void *context);

int thread_count();
void set_thread_count(int threads); // at least 1; 0 restores the default (POLARGUIDE_THREADS, else the cores we may use)

// The same for a callable object.
template <class F> inline void parallel_chunks(int64_t count, int64_t chunk, F &f) {
    parallel_for(count, chunk, [](void *c, int64_t b, int64_t e, int w) { (*static_cast<F *>(c))(b, e, w); }, &f);
}

} // namespace polarguide
