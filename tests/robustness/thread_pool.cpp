// The thread pool without Python, for ThreadSanitizer: work of many sizes, from several callers, while the number of
// threads changes. Every sum has to be right.
#include "parallel.h"

#include <atomic>
#include <cstdio>
#include <random>
#include <thread>
#include <vector>

using namespace polarguide;

namespace {

bool covers(int64_t count, int64_t chunk) {
    std::vector<int64_t> seen(size_t(count), 0);
    std::atomic<bool> bounds{true};
    auto body = [&](int64_t begin, int64_t end, int worker) {
        if (begin < 0 || end > count || end - begin > chunk || worker < 0) bounds = false;
        for (int64_t i = begin; i < end; ++i) ++seen[size_t(i)];
    };
    parallel_chunks(count, chunk, body);
    for (int64_t times : seen)
        if (times != 1) return false;
    return bounds;
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
        }
    }
    set_thread_count(3);
    std::atomic<bool> together{true};
    std::vector<std::thread> callers;
    for (int caller = 0; caller < 3; ++caller)
        callers.emplace_back([&together, caller] {
            for (int round = 0; round < 100; ++round)
                if (!covers(100 + 13 * round + caller, 7)) together = false;
        });
    for (std::thread &caller : callers) caller.join();
    std::printf("thread pool: %s\n", right && together ? "right" : "WRONG");
    return right && together ? 0 : 1;
}
