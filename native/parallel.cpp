#include "parallel.h"

#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif
#include <unistd.h>

namespace polarguide {
namespace {

int default_threads() {
    if (const char *text = std::getenv("POLARGUIDE_THREADS")) {
        int n = std::atoi(text);
        if (n >= 1) return n;
    }
#if defined(__linux__)
    cpu_set_t set;
    CPU_ZERO(&set);
    if (sched_getaffinity(0, sizeof(set), &set) == 0) return CPU_COUNT(&set) > 0 ? CPU_COUNT(&set) : 1;
#endif
    unsigned n = std::thread::hardware_concurrency();
    return n ? int(n) : 1;
}

class Pool {
  public:
    explicit Pool(int threads) : threads_(threads), owner_(getpid()) {
        for (int worker = 1; worker < threads; ++worker)
            workers_.emplace_back([this, worker] { serve(worker); });
    }
    ~Pool() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stopping_ = true;
        }
        start_.notify_all();
        for (auto &t : workers_) t.join();
    }
    int threads() const { return threads_; }
    bool forked() const { return owner_ != getpid(); }

    void run(int64_t count, int64_t chunk, Body body, void *context) {
        std::lock_guard<std::mutex> one_job(job_mutex_);
        {
            std::lock_guard<std::mutex> lock(mutex_);
            count_ = count, chunk_ = chunk, body_ = body, context_ = context;
            next_.store(0, std::memory_order_relaxed);
            pending_ = threads_ - 1;
            ++generation_;
        }
        start_.notify_all();
        work(0);
        std::unique_lock<std::mutex> lock(mutex_);
        done_.wait(lock, [this] { return pending_ == 0; });
    }

  private:
    void work(int worker) {
        for (;;) {
            int64_t begin = next_.fetch_add(chunk_, std::memory_order_relaxed);
            if (begin >= count_) return;
            int64_t end = begin + chunk_ < count_ ? begin + chunk_ : count_;
            body_(context_, begin, end, worker);
        }
    }
    void serve(int worker) {
        uint64_t seen = 0;
        for (;;) {
            {
                std::unique_lock<std::mutex> lock(mutex_);
                start_.wait(lock, [&] { return stopping_ || generation_ != seen; });
                if (stopping_) return;
                seen = generation_;
            }
            work(worker);
            std::lock_guard<std::mutex> lock(mutex_);
            if (--pending_ == 0) done_.notify_one();
        }
    }

    const int threads_;
    const pid_t owner_;
    std::vector<std::thread> workers_;
    std::mutex job_mutex_, mutex_;
    std::condition_variable start_, done_;
    std::atomic<int64_t> next_{0};
    int64_t count_ = 0, chunk_ = 1;
    Body body_ = nullptr;
    void *context_ = nullptr;
    int pending_ = 0;
    uint64_t generation_ = 0;
    bool stopping_ = false;
};

std::mutex pool_mutex;
std::shared_ptr<Pool> pool;
int requested = 0;

std::shared_ptr<Pool> current_pool() {
    std::lock_guard<std::mutex> lock(pool_mutex);
    if (pool && pool->forked()) new std::shared_ptr<Pool>(std::move(pool)); // its threads live in the parent: leak it
    if (!pool) pool = std::make_shared<Pool>(requested > 0 ? requested : default_threads());
    return pool;
}

} // namespace

int thread_count() { return current_pool()->threads(); }

void set_thread_count(int threads) {
    std::lock_guard<std::mutex> lock(pool_mutex);
    requested = threads > 0 ? threads : 0;
    if (pool && pool->forked()) new std::shared_ptr<Pool>(std::move(pool));
    pool.reset();
}

void parallel_for(int64_t count, int64_t chunk, Body body, void *context) {
    if (count <= 0) return;
    auto p = current_pool();
    if (p->threads() == 1 || count <= chunk) {
        for (int64_t begin = 0; begin < count; begin += chunk)
            body(context, begin, begin + chunk < count ? begin + chunk : count, 0);
        return;
    }
    p->run(count, chunk, body, context);
}

} // namespace polarguide
