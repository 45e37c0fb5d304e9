#include "tile_lists.h"

#include "parallel.h"

#include <algorithm>
#include <cstring>
#include <vector>

namespace polarguide {
namespace {

// Sorts visible Gaussians by depth, ties by index, with a radix sort on the bits of the positive depths.
std::vector<int32_t> depth_order(const float *depth, const int32_t *touched, int64_t count) {
    std::vector<int32_t> order, other;
    std::vector<uint32_t> keys, other_keys;
    order.reserve(size_t(count)), keys.reserve(size_t(count)); // visible Gaussians have positive depths, whose bits have the same order
    for (int64_t g = 0; g < count; ++g)
        if (touched[g] > 0) {
            uint32_t key;
            std::memcpy(&key, depth + g, 4);
            order.push_back(int32_t(g)), keys.push_back(key);
        }
    other.resize(order.size()), other_keys.resize(keys.size());
    // Depths of a picture usually differ by a factor below some hundred. With the minimum subtracted, two digits suffice.
    uint32_t least = ~0u, most = 0;
    for (uint32_t k : keys) least = std::min(least, k), most = std::max(most, k);
    for (uint32_t &k : keys) k -= least;
    int bits = 1;
    while (bits < 32 && (most - least) >> bits) ++bits;
    const int digit = bits <= 26 ? 13 : 11, buckets = 1 << digit;
    std::vector<int64_t> begin(static_cast<size_t>(buckets));
    for (int shift = 0; shift < bits; shift += digit) {
        std::fill(begin.begin(), begin.end(), 0);
        for (uint32_t k : keys) ++begin[(k >> shift) & (buckets - 1)];
        int64_t sum = 0;
        for (auto &b : begin) {
            int64_t n = b;
            b = sum, sum += n;
        }
        for (size_t i = 0; i < keys.size(); ++i) {
            int64_t to = begin[(keys[i] >> shift) & (buckets - 1)]++;
            other[size_t(to)] = order[i], other_keys[size_t(to)] = keys[i];
        }
        order.swap(other), keys.swap(other_keys);
    }
    return order;
}

// Runs of tiles, sorted by row.
struct Rows {
    struct Run {
        int32_t gaussian;
        uint16_t begin, end; // columns
    };
    Buffer<Run> runs;
    Buffer<int64_t> numbers;                     // number of the first tile of each run (see TileLists::sort), for the backward pass
    std::vector<int64_t> begin, instances_begin; // [rows + 1] first run of each row, and first instance of its tiles
};

Rows sort_into_rows(const Workers &workers, const TileEmitArgs &emitted, const std::vector<int32_t> &order,
                    const int64_t *first, int64_t rows, bool for_backward) {
    Rows out;
    // The order is divided into parts, one per thread. In each row, runs of a part follow runs of the previous parts.
    const int64_t parts = workers.count(), length = (int64_t(order.size()) + parts - 1) / parts;
    const int64_t *offset = emitted.offset;
    auto each = [&](int64_t part, auto &&body) { // body(Gaussian, its runs, their number)
        constexpr int64_t ahead = 12; // neighbors in depth are scattered in memory, so they are prefetched
        const int64_t end = std::min(int64_t(order.size()), (part + 1) * length);
        for (int64_t k = part * length; k < end; ++k) {
            if (k + 2 * ahead < end) {
                const int32_t later = order[size_t(k + 2 * ahead)];
                __builtin_prefetch(offset + later), __builtin_prefetch(emitted.count + later), __builtin_prefetch(first + later);
            }
            if (k + ahead < end) __builtin_prefetch(emitted.runs + offset[order[size_t(k + ahead)]]);
            const int32_t g = order[size_t(k)];
            body(g, emitted.runs + offset[g], emitted.count[g]);
        }
    };
    std::vector<int64_t> next(size_t(parts * rows), 0), touched(next); // runs: their number, then the place of the next one
    auto count = [&](int64_t part, int64_t, int) {
        int64_t *runs_here = next.data() + part * rows, *tiles_here = touched.data() + part * rows;
        each(part, [&](int32_t, const TileRun *runs, int32_t n) {
            for (int32_t i = 0; i < n; ++i) ++runs_here[runs[i].row], tiles_here[runs[i].row] += runs[i].end - runs[i].begin;
        });
    };
    workers.chunks(parts, 1, count);
    int64_t runs = 0, tiles = 0;
    out.begin.assign(1, 0), out.instances_begin.assign(1, 0);
    for (int64_t row = 0; row < rows; ++row) {
        for (int64_t here = row; here < parts * rows; here += rows) {
            const int64_t n = next[size_t(here)];
            next[size_t(here)] = runs, runs += n, tiles += touched[size_t(here)];
        }
        out.begin.push_back(runs), out.instances_begin.push_back(tiles);
    }
    out.runs.resize(runs);
    if (for_backward) out.numbers.resize(runs);
    auto place = [&](int64_t part, int64_t, int) {
        int64_t *here = next.data() + part * rows;
        each(part, [&](int32_t g, const TileRun *its, int32_t n) {
            int64_t number = first[g];
            for (int32_t i = 0; i < n; ++i) {
                const int64_t slot = here[its[i].row]++;
                out.runs.get()[slot] = {g, its[i].begin, its[i].end};
                if (for_backward) out.numbers.get()[slot] = number;
                number += its[i].end - its[i].begin;
            }
        });
    };
    workers.chunks(parts, 1, place);
    return out;
}

} // namespace

// The lists of one row fit into a cache, unlike the lists of a whole picture.
void TileLists::sort(const TileEmitArgs &emitted, const float *depth, const int64_t *first, int64_t count, int tiles_x,
                     int tiles_y, bool for_backward) {
    const Workers workers;
    const Rows rows = sort_into_rows(workers, emitted, depth_order(depth, emitted.touched, count), first, tiles_y, for_backward);
    const int64_t listed = rows.instances_begin.back();
    gaussians_.resize(listed), begin_.resize(int64_t(tiles_x) * tiles_y + 1);
    if (for_backward) instances_.resize(listed);
    begin_.get()[int64_t(tiles_x) * tiles_y] = listed;
    const int64_t slots = tiles_x + 1 + 8; // eight more, so that two workers never write to the same cache line
    std::vector<int64_t> longest(size_t(tiles_y), 0), memory(size_t(workers.count() * slots));
    auto sort_row = [&](int64_t row, int64_t, int worker) {
        const Rows::Run *runs = rows.runs.get();
        const int64_t begin = rows.begin[size_t(row)], end = rows.begin[size_t(row) + 1];
        int64_t *next = memory.data() + worker * slots; // difference to the previous tile, then the place of the next instance
        std::fill_n(next, tiles_x + 1, 0);
        for (int64_t k = begin; k < end; ++k) ++next[runs[k].begin], --next[runs[k].end];
        int64_t here = 0, to = rows.instances_begin[size_t(row)];
        for (int column = 0; column < tiles_x; ++column) {
            here += next[column], longest[size_t(row)] = std::max(longest[size_t(row)], here);
            next[column] = begin_.get()[row * tiles_x + column] = to, to += here;
        }
        int32_t *gaussians = gaussians_.get();
        int64_t *instances = instances_.get();
        for (int64_t k = begin; k < end; ++k) {
            const Rows::Run run = runs[k];
            if (for_backward)
                for (int64_t column = run.begin, n = rows.numbers.get()[k]; column < run.end; ++column, ++n) instances[next[column]] = n;
            for (int64_t column = run.begin; column < run.end; ++column) gaussians[next[column]++] = run.gaussian;
        }
    };
    workers.chunks(tiles_y, 1, sort_row);
    longest_ = *std::max_element(longest.begin(), longest.end());
}

} // namespace polarguide
