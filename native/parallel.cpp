#include "parallel.h"

#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif
#if defined(_WIN32)
#include <process.h>
#define getpid _getpid
#else
#include <unistd.h>
#endif

#if defined(__linux__) && defined(__GLIBCXX__)
// libstdc++ 12 has two equivalent versions of this function; older systems have the older one.
__asm__(".symver _ZNSt18condition_variable4waitERSt11unique_lockISt5mutexE, "
        "_ZNSt18condition_variable4waitERSt11unique_lockISt5mutexE@GLIBCXX_3.4.11");
#endif

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

} // namespace

class Pool {
  public:
    using Body = void (*)(void *context, int64_t begin, int64_t end, int worker);

    explicit Pool(int threads) : threads_(threads), owner_(getpid()) {
        try {
            for (int worker = 1; worker < threads; ++worker)
                workers_.emplace_back([this, worker] { serve(worker); });
        } catch (const std::system_error &) { // started threads must be joined, otherwise the process ends
            stop();
            throw std::runtime_error("can't start new thread"); // Python's message
        } catch (...) {
            stop();
            throw;
        }
    }
    ~Pool() { stop(); }
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
        std::exception_ptr error;
        { // After any exception: `context` must outlive all workers.
            std::unique_lock<std::mutex> lock(mutex_);
            done_.wait(lock, [this] { return pending_ == 0; });
            std::swap(error, error_);
        }
        if (error) std::rethrow_exception(error);
    }

  private:
    void work(int worker) {
        try {
            for (;;) {
                int64_t begin = next_.fetch_add(chunk_, std::memory_order_relaxed);
                if (begin >= count_) return;
                int64_t end = begin + chunk_ < count_ ? begin + chunk_ : count_;
                body_(context_, begin, end, worker);
            }
        } catch (...) {
            std::lock_guard<std::mutex> lock(mutex_);
            if (!error_) error_ = std::current_exception();
            next_.store(count_, std::memory_order_relaxed); // the other workers skip the remaining ranges
        }
    }
    void stop() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stopping_ = true;
        }
        start_.notify_all();
        for (auto &t : workers_) t.join();
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
    std::exception_ptr error_; // first exception of a job
    int pending_ = 0;
    uint64_t generation_ = 0;
    bool stopping_ = false;
};

namespace {

std::mutex pool_mutex;
std::shared_ptr<Pool> pool;
int requested = 0;

std::shared_ptr<Pool> current_pool() {
    std::lock_guard<std::mutex> lock(pool_mutex);
    if (pool && pool->forked()) new std::shared_ptr<Pool>(std::move(pool)); // its threads belong to the parent process, so it is leaked
    if (!pool) pool = std::make_shared<Pool>(requested > 0 ? requested : default_threads());
    return pool;
}

} // namespace

Workers::Workers() : pool_(current_pool()) {}

int Workers::count() const { return pool_->threads(); }

void Workers::run(int64_t count, int64_t chunk, Body body, void *context) const {
    if (count <= 0) return;
    if (pool_->threads() == 1 || count <= chunk) {
        for (int64_t begin = 0; begin < count; begin += chunk)
            body(context, begin, begin + chunk < count ? begin + chunk : count, 0);
        return;
    }
    pool_->run(count, chunk, body, context);
}

int thread_count() { return Workers().count(); }

void set_thread_count(int threads) {
    std::lock_guard<std::mutex> lock(pool_mutex);
    requested = threads > 0 ? threads : 0;
    if (pool && pool->forked()) new std::shared_ptr<Pool>(std::move(pool));
    pool.reset();
}

} // namespace polarguide
