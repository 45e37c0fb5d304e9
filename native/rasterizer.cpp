#include "rasterizer.h"

#include "parallel.h"

#include <algorithm>
#include <cstring>

namespace polarguide {
namespace {

constexpr int64_t gaussian_chunk = 512;

// Order of the visible Gaussians by depth, ties by index: a radix sort on the bits of the (positive) depths.
std::vector<int32_t> depth_order(const float *depth, const int32_t *touched, int64_t count) {
    std::vector<int32_t> order, other;
    std::vector<uint32_t> keys, other_keys;
    order.reserve(size_t(count)), keys.reserve(size_t(count)); // touched: its depth is positive, and ordered as its bits
    for (int64_t g = 0; g < count; ++g)
        if (touched[g] > 0) {
            uint32_t key;
            std::memcpy(&key, depth + g, 4);
            order.push_back(int32_t(g)), keys.push_back(key);
        }
    other.resize(order.size()), other_keys.resize(keys.size());
    // Depths of one picture mostly differ by a factor of some hundred: less the least of them, two digits are enough.
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

} // namespace

int padded_channels(int channels) {
    for (int d : {3, 4, 7, 8, 11, 12, 16, 32})
        if (channels <= d) return d;
    return 0;
}

Rasterizer::Rasterizer(const PinholeCamera &camera, std::vector<int32_t> permutation, int statistic_channels)
    : camera_(camera), permutation_(std::move(permutation)), statistic_channels_(statistic_channels),
      channels_(padded_channels(int(permutation_.size()))), tiles_x_((camera.width + tile_size - 1) / tile_size),
      tiles_y_((camera.height + tile_size - 1) / tile_size) {}

void Rasterizer::bin(int64_t count, bool for_backward) {
    // Candidate tiles of each Gaussian's box, of which it keeps those it really touches.
    std::vector<int64_t> offset(size_t(count) + 1, 0);
    for (int64_t g = 0; g < count; ++g) {
        const int32_t *b = box_.get() + 4 * g;
        offset[size_t(g) + 1] = offset[size_t(g)] + int64_t(b[1] - b[0]) * (b[3] - b[2]);
    }
    Buffer<int32_t> tiles, touched;
    tiles.resize(offset[size_t(count)] + 1), touched.resize(count);
    TileEmitArgs args{screen_.get(), box_.get(), offset.data(), tiles_x_, tiles.get(), touched.get()};
    auto emit = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(emit_tiles)(args, b, e); };
    parallel_chunks(count, gaussian_chunk, emit);

    instance_begin_.resize(count + 1);
    int64_t *first = instance_begin_.get();
    first[0] = 0;
    for (int64_t g = 0; g < count; ++g) first[g + 1] = first[g] + touched.get()[g];
    instance_count_ = first[count];
    gaussians_.resize(instance_count_);
    if (for_backward) instances_.resize(instance_count_);
    sort_into_tiles(depth_order(depth_.get(), touched.get(), count), tiles.get(), offset.data(), touched.get(), for_backward);
}

void Rasterizer::sort_into_tiles(const std::vector<int32_t> &order, const int32_t *tiles, const int64_t *offset,
                                 const int32_t *touched, bool for_backward) {
    // The order is cut into parts, one a thread. What a part has in a tile comes behind what the parts before it have
    // there, so that the result is the same for any number of them.
    const int64_t tile_count = int64_t(tiles_x_) * tiles_y_, parts = thread_count();
    const int64_t length = (int64_t(order.size()) + parts - 1) / parts;
    std::vector<int64_t> next(size_t(parts * tile_count), 0); // first how many, then where the next goes
    const int64_t *first = instance_begin_.get();
    auto each = [&](int64_t part, auto &&body) { // body(Gaussian, the tiles it touches, how many)
        constexpr int64_t ahead = 12; // neighbors in depth lie anywhere in memory: asked for before they are needed
        const int64_t end = std::min(int64_t(order.size()), (part + 1) * length);
        for (int64_t k = part * length; k < end; ++k) {
            if (k + 2 * ahead < end) {
                const int32_t later = order[size_t(k + 2 * ahead)];
                __builtin_prefetch(offset + later), __builtin_prefetch(touched + later), __builtin_prefetch(first + later);
            }
            if (k + ahead < end) __builtin_prefetch(tiles + offset[order[size_t(k + ahead)]]);
            const int32_t g = order[size_t(k)];
            body(g, tiles + offset[g], touched[g]);
        }
    };
    auto count = [&](int64_t part, int64_t, int) {
        int64_t *here = next.data() + part * tile_count;
        each(part, [&](int32_t, const int32_t *t, int32_t n) {
            for (int32_t i = 0; i < n; ++i) ++here[t[i]];
        });
    };
    parallel_chunks(parts, 1, count);
    tile_begin_.resize(tile_count + 1);
    int64_t sum = 0;
    longest_ = 0;
    for (int64_t t = 0; t < tile_count; ++t) {
        tile_begin_.get()[t] = sum;
        for (int64_t part = 0; part < parts; ++part) {
            const int64_t n = next[size_t(part * tile_count + t)];
            next[size_t(part * tile_count + t)] = sum, sum += n;
        }
        longest_ = std::max(longest_, sum - tile_begin_.get()[t]);
    }
    tile_begin_.get()[tile_count] = sum;
    auto place = [&](int64_t part, int64_t, int) {
        int64_t *here = next.data() + part * tile_count;
        each(part, [&](int32_t g, const int32_t *t, int32_t n) {
            for (int32_t i = 0; i < n; ++i) {
                const int64_t slot = here[t[i]]++;
                gaussians_.get()[slot] = g;
                if (for_backward) instances_.get()[slot] = first[g] + i;
            }
        });
    };
    parallel_chunks(parts, 1, place);
}

RasterArgs Rasterizer::raster_args(const GaussianInputs &in) const {
    RasterArgs a{};
    a.channels = channels_, a.channels_real = in.channels;
    a.width = camera_.width, a.height = camera_.height, a.tiles_x = tiles_x_, a.tiles_y = tiles_y_;
    a.screen = screen_.get(), a.features = in.features, a.permutation = permutation_.data();
    a.in_order = std::is_sorted(permutation_.begin(), permutation_.end());
    a.tile_begin = tile_begin_.get(), a.gaussians = gaussians_.get();
    if (kept_) {
        a.instances = instances_.get(), a.rows = rows_.get(), a.blocks = blocks_.get();
        a.transmittance = transmittance_.get();
    }
    a.statistic_channels = statistic_channels_;
    return a;
}

template <class F> void Rasterizer::for_tiles(F &&body) {
    // Each worker gets its own scratch, allocated when it sees its first tile.
    struct Worker {
        Buffer<float> rows, moments;
        Buffer<uint16_t> blocks;
        Buffer<int32_t> list;
        RasterScratch scratch{};
    };
    std::vector<Worker> workers(static_cast<size_t>(thread_count()));
    auto run = [&](int64_t begin, int64_t end, int worker) {
        Worker &w = workers[size_t(worker)];
        if (!w.scratch.rows) {
            w.rows.resize(longest_ * (channels_ + 6) + 16), w.blocks.resize(longest_ + 16), w.list.resize(longest_ + 16);
            w.moments.resize(longest_ * std::max(channels_ + 9, 16) + 32);
            w.scratch = {w.rows.get(), w.blocks.get(), w.list.get(), w.moments.get()};
        }
        for (int64_t tile = begin; tile < end; ++tile) body(tile, w.scratch);
    };
    parallel_chunks(int64_t(tiles_x_) * tiles_y_, 2, run);
}

void Rasterizer::project(const GaussianInputs &in, float *radius, bool for_backward) {
    screen_.resize(in.count * screen_values), depth_.resize(in.count), box_.resize(in.count * 4);
    ProjectArgs project_args{in.count, in.means, in.quaternions, in.scales, in.opacities, camera_,
                             screen_.get(), depth_.get(), radius, box_.get()};
    auto project_chunk = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(project)(project_args, b, e); };
    parallel_chunks(in.count, gaussian_chunk, project_chunk);
    bin(in.count, for_backward);
}

void Rasterizer::forward(const GaussianInputs &in, float *out, float *alpha, float *radius, bool count_pairs,
                         bool for_backward) {
    project(in, radius, for_backward);
    kept_ = for_backward;
    if (kept_) {
        rows_.resize(instance_count_ * (channels_ + 6) + 16), blocks_.resize(instance_count_ + 16);
        transmittance_.resize(int64_t(camera_.width) * camera_.height);
    }
    RasterArgs args = raster_args(in);
    args.out = out, args.alpha = alpha;
    std::vector<int64_t> pairs;
    if (count_pairs) pairs.assign(size_t(tiles_x_) * size_t(tiles_y_), 0), args.pairs = pairs.data();
    for_tiles([&](int64_t tile, const RasterScratch &s) { POLARGUIDE_DISPATCH(raster_forward)(args, tile, s); });
    pairs_ = 0;
    for (int64_t n : pairs) pairs_ += n;
}

void Rasterizer::surface(const GaussianInputs &in, float width, float *out) {
    Buffer<float> radius;
    radius.resize(in.count);
    project(in, radius.get(), false);
    kept_ = false;
    RasterArgs args = raster_args(in);
    args.out = out, args.surface_width = width;
    for_tiles([&](int64_t tile, const RasterScratch &s) { POLARGUIDE_DISPATCH(raster_surface)(args, tile, s); });
}

void Rasterizer::backward(const GaussianInputs &in, const float *out, const float *grad_out, const float *grad_alpha,
                          const StillGradient &still, const Gradients &gradients) {
    Buffer<float> rows;
    rows.resize(instance_count_ * (channels_ + instance_extra) + 16);
    RasterArgs args = raster_args(in);
    args.out = const_cast<float *>(out), args.grad_out = grad_out, args.grad_alpha = grad_alpha;
    args.grad_still = still.values, args.still = still.of_channel.data(), args.still_count = still.count;
    args.grad_instances = rows.get();
    if (!gradients.statistic) args.statistic_channels = 0;
    for_tiles([&](int64_t tile, const RasterScratch &s) { POLARGUIDE_DISPATCH(raster_backward)(args, tile, s); });
    ProjectBackwardArgs back{};
    back.forward = {in.count, in.means, in.quaternions, in.scales, in.opacities, camera_,
                    nullptr, nullptr, nullptr, nullptr};
    back.channels = channels_, back.channels_real = in.channels, back.permutation = permutation_.data();
    back.instance_begin = instance_begin_.get(), back.grad_instances = rows.get();
    back.grad_means = gradients.means, back.grad_quaternions = gradients.quaternions;
    back.grad_scales = gradients.scales, back.grad_opacities = gradients.opacities;
    back.grad_features = gradients.features;
    back.statistic = gradients.statistic;
    auto chunk = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(project_backward)(back, b, e); };
    parallel_chunks(in.count, gaussian_chunk, chunk);
}

} // namespace polarguide
