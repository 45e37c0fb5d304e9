// The thread pool without Python, for ThreadSanitizer: work of many sizes, from several callers, while the number of
// threads changes, and work that throws. Every sum has to be right, and every exception has to arrive.
#include "parallel.h"

#include <atomic>
#include <cstdio>
#include <random>
#include <stdexcept>
#include <thread>
#include <vector>

using namespace polarguide;

namespace {

bool covers(int64_t count, int64_t chunk) {
    const Workers workers;
    std::vector<int64_t> seen(size_t(count), 0), of_worker(size_t(workers.count()), 0);
    std::atomic<bool> bounds{true};
    auto body = [&](int64_t begin, int64_t end, int worker) {
        if (begin < 0 || end > count || end - begin > chunk || worker < 0 || worker >= workers.count()) {
            bounds = false;
            return;
        }
        of_worker[size_t(worker)] += end - begin;
        for (int64_t i = begin; i < end; ++i) ++seen[size_t(i)];
    };
    workers.chunks(count, chunk, body);
    for (int64_t times : seen)
        if (times != 1) return false;
    for (int64_t done : of_worker) count -= done;
    return bounds && count == 0;
}

// Whether what the ranges from `first` on throw arrives, after every worker has left what lives here.
bool throws(int64_t count, int64_t chunk, int64_t first) {
    std::atomic<int> inside{0};
    auto body = [&](int64_t begin, int64_t, int) {
        ++inside;
        if (begin >= first) {
            --inside;
            throw std::runtime_error("expected");
        }
        std::this_thread::yield();
        --inside;
    };
    try {
        parallel_chunks(count, chunk, body);
    } catch (const std::runtime_error &) {
        return inside == 0;
    }
    return false;
}

} // namespace

int main() {
    std::mt19937 random(0);
    bool right = true;
    for (int threads : {1, 2, 4, 7, 0}) {
        set_thread_count(threads);
        for (int round = 0; round < 200; ++round) {
            const int64_t count = int64_t(random() % 5000), chunk = 1 + int64_t(random() % 97);
            right = covers(count, chunk) && right;
            right = throws(1 + count, chunk, int64_t(random()) % (1 + count) / chunk * chunk) && right;
        }
    }
    set_thread_count(3);
    std::atomic<bool> together{true};
    std::atomic<bool> working{true};
    std::thread other([&working] {
        while (working)
            for (int threads : {1, 8, 3}) set_thread_count(threads), std::this_thread::yield();
    });
    std::vector<std::thread> callers;
    for (int caller = 0; caller < 3; ++caller)
        callers.emplace_back([&together, caller] {
            for (int round = 0; round < 100; ++round)
                if (!covers(100 + 13 * round + caller, 7) || !throws(100 + round, 7, 7 * caller)) together = false;
        });
    for (std::thread &caller : callers) caller.join();
    working = false;
    other.join();
    std::printf("thread pool: %s\n", right && together ? "right" : "WRONG");
    return right && together ? 0 : 1;
}
