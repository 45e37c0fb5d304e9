#include "rasterizer.h"

#include "parallel.h"

#include <algorithm>

namespace polarguide {
namespace {

constexpr int64_t gaussian_chunk = 512;

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
    // Find the tiles that each Gaussian touches within its box: one run per row.
    std::vector<int64_t> offset(size_t(count) + 1, 0);
    for (int64_t g = 0; g < count; ++g) offset[size_t(g) + 1] = offset[size_t(g)] + box_.get()[4 * g + 3] - box_.get()[4 * g + 2];
    Buffer<TileRun> runs;
    Buffer<int32_t> run_count, touched;
    runs.resize(offset[size_t(count)] + 1), run_count.resize(count), touched.resize(count);
    TileEmitArgs args{screen_.get(), box_.get(), offset.data(), runs.get(), run_count.get(), touched.get()};
    auto emit = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(emit_tiles)(args, b, e); };
    parallel_chunks(count, gaussian_chunk, emit);

    instance_begin_.resize(count + 1);
    int64_t *first = instance_begin_.get();
    first[0] = 0;
    for (int64_t g = 0; g < count; ++g) first[g + 1] = first[g] + touched.get()[g];
    instance_count_ = first[count];
    lists_.sort(args, depth_.get(), first, count, tiles_x_, tiles_y_, for_backward);
}

RasterArgs Rasterizer::raster_args(const GaussianInputs &in) const {
    RasterArgs a{};
    a.channels = channels_, a.channels_real = in.channels;
    a.width = camera_.width, a.height = camera_.height, a.tiles_x = tiles_x_, a.tiles_y = tiles_y_;
    a.screen = screen_.get(), a.features = in.features, a.permutation = permutation_.data();
    a.in_order = std::is_sorted(permutation_.begin(), permutation_.end());
    a.tile_begin = lists_.begin(), a.gaussians = lists_.gaussians();
    if (kept_) {
        a.instances = lists_.instances(), a.rows = rows_.get(), a.blocks = blocks_.get();
        a.transmittance = transmittance_.get();
    }
    a.statistic_channels = statistic_channels_;
    return a;
}

template <class F> void Rasterizer::for_tiles(F &&body) {
    struct Memory {
        Buffer<float> rows, moments;
        Buffer<uint16_t> blocks;
        Buffer<int32_t> list;
    };
    const Workers workers;
    std::vector<Memory> memory(static_cast<size_t>(workers.count()));
    const int64_t longest = lists_.longest();
    for (Memory &m : memory) {
        m.rows.resize(longest * (channels_ + 6) + 16), m.blocks.resize(longest + 16), m.list.resize(longest + 16);
        m.moments.resize(longest * std::max(channels_ + 9, 16) + 32);
    }
    auto run = [&](int64_t begin, int64_t end, int worker) {
        const Memory &m = memory[size_t(worker)];
        const RasterScratch scratch{m.rows.get(), m.blocks.get(), m.list.get(), m.moments.get()};
        for (int64_t tile = begin; tile < end; ++tile) body(tile, scratch);
    };
    workers.chunks(int64_t(tiles_x_) * tiles_y_, 2, run);
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
