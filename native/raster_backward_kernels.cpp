// Blending of a tile, backward. See raster.h for the definition.
#include "raster_tile.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

// Gradients of one block, one pixel per lane.
template <int D> struct BlockGradients {
    // Gradients of the picture, and gradients of the features alone, which do not move Gaussians or change their opacity.
    alignas(64) float g[D][16], own[D][16];
    const float (*features)[16];
    // Sum of weight * (feature . g) over the Gaussians that remain: for all channels and alpha, and for channels of the statistic
    // alone.
    alignas(64) float remaining[16], remaining_statistic[16];
};
template <int D>
POLARGUIDE_INLINE void load_gradients(const RasterArgs &a, const Block &b, BlockGradients<D> *r) {
    for (int k = 0; k < D; ++k) store(r->g[k], vf{});
    if (a.grad_still)
        for (int k = 0; k < D; ++k) store(r->own[k], vf{});
    r->features = a.grad_still ? r->own : r->g;
    store(r->remaining, vf{}), store(r->remaining_statistic, vf{});
    const int real = a.channels_real;
    const int rows = a.height - b.y < 4 ? a.height - b.y : 4, columns = a.width - b.x < 4 ? a.width - b.x : 4;
    for (int j = 0; j < rows; ++j)
        for (int i = 0; i < columns; ++i) {
            int64_t pixel = int64_t(b.y + j) * a.width + b.x + i;
            const float *g = a.grad_out + pixel * real, *out = a.out + pixel * real;
            float sum = 0.0f;
            for (int k = 0; k < real; ++k) {
                int channel = a.permutation[k];
                r->g[k][4 * j + i] = g[channel];
                if (a.grad_still) {
                    const int still = a.still[channel];
                    r->own[k][4 * j + i] = g[channel] + (still < 0 ? 0.0f : a.grad_still[pixel * a.still_count + still]);
                }
                sum += g[channel] * out[channel];
                if (k + 1 == a.statistic_channels) r->remaining_statistic[4 * j + i] = sum;
            }
            r->remaining[4 * j + i] = sum - a.grad_alpha[pixel] * a.transmittance[pixel];
        }
}

// Batch of up to sixteen Gaussians of one block: per-pixel weights and exponent gradients, one row each.
struct Batch {
    alignas(64) float weight[16][16], value[16][16], statistic[16][16];
    int32_t local[16];
    int size = 0;
};

// Computes moments 1, x, y, xx, xy, yy of a block's pixels about the tile center, one Gaussian per lane of a register
// (transposed: v[16 * pixel] is the first one).
POLARGUIDE_INLINE void moments(const float *v, float x, float y, bool second, reg *m) {
    reg column[4], row[4], xy = {};
    for (int i = 0; i < 4; ++i) column[i] = reg_load(v + 16 * i);
    for (int j = 0; j < 4; ++j) {
        const float *at = v + 64 * j;
        const reg p0 = reg_load(at), p1 = reg_load(at + 16), p2 = reg_load(at + 32), p3 = reg_load(at + 48);
        row[j] = (p0 + p1) + (p2 + p3);
        if (j) column[0] += p0, column[1] += p1, column[2] += p2, column[3] += p3;
        if (second) xy += (float(j) - 1.5f) * ((p3 - p0) * 1.5f + (p2 - p1) * 0.5f);
    }
    m[0] = (row[0] + row[1]) + (row[2] + row[3]);
    const reg mx = (column[3] - column[0]) * 1.5f + (column[2] - column[1]) * 0.5f;
    const reg my = (row[3] - row[0]) * 1.5f + (row[2] - row[1]) * 0.5f;
    m[1] = mx + m[0] * x, m[2] = my + m[0] * y;
    if (!second) return;
    const reg xx = (column[0] + column[3]) * 2.25f + (column[1] + column[2]) * 0.25f;
    const reg yy = (row[0] + row[3]) * 2.25f + (row[1] + row[2]) * 0.25f;
    m[3] = xx + (mx + m[1]) * x;
    m[4] = xy + mx * y + m[2] * x;
    m[5] = yy + (my + m[2]) * y;
}

// Adds the sums of a batch to the rows of the tile: D feature gradients, six moments of the exponent gradient, and three
// moments of the statistic's gradient.
template <int D, bool S>
__attribute__((noinline)) void flush(Batch &batch, const BlockGradients<D> &gradients, float x, float y, float *rows) {
    constexpr int quantities = D + (S ? 9 : 6), stride = D + 9, groups = (quantities + 15) / 16;
    alignas(64) float t[16 * 16];
    alignas(64) float sums[groups * 16][16];
    for (int i = batch.size; i < 16; ++i) {
        store(batch.weight[i], vf{}), store(batch.value[i], vf{});
        if (S) store(batch.statistic[i], vf{});
    }
    transpose16(batch.weight[0], t);
    constexpr int step = 4; // channels per iteration: independent chains, few registers
    for (int l = 0; l < lanes; l += reg_lanes)
        for (int k0 = 0; k0 < D; k0 += step) {
            reg acc[step] = {};
            for (int p = 0; p < 16; ++p) {
                const reg w = reg_load(t + 16 * p + l);
                for (int k = 0; k < step; ++k)
                    if (k0 + k < D) acc[k] += w * gradients.features[k0 + k][p];
            }
            for (int k = 0; k < step; ++k)
                if (k0 + k < D) reg_store(sums[k0 + k] + l, acc[k]);
        }
    reg m[6];
    transpose16(batch.value[0], t);
    for (int l = 0; l < lanes; l += reg_lanes) {
        moments(t + l, x, y, true, m);
        for (int q = 0; q < 6; ++q) reg_store(sums[D + q] + l, m[q]);
    }
    if (S) transpose16(batch.statistic[0], t);
    for (int l = 0; S && l < lanes; l += reg_lanes) {
        moments(t + l, x, y, false, m);
        for (int q = 0; q < 3; ++q) reg_store(sums[D + 6 + q] + l, m[q]);
    }
    for (int group = 0; group < groups; ++group) {
        const int first = group * 16, used = quantities - first < 16 ? quantities - first : 16;
        if (used <= 4) {
            for (int i = 0; i < batch.size; ++i)
                for (int q = first; q < first + used; ++q) rows[int64_t(batch.local[i]) * stride + q] += sums[q][i];
            continue;
        }
        for (int q = first + used; q < first + 16; ++q) store(sums[q], vf{});
        transpose16(sums[first], t);
        for (int i = 0; i < batch.size; ++i) {
            float *row = rows + int64_t(batch.local[i]) * stride + first; // rows have space for a whole vector at the end
            store(row, load(row) + load(t + 16 * i));
        }
    }
    batch.size = 0;
}

// Statistic channels: none, the first three, or the number in the arguments.
enum { statistic_none = 0, statistic_three = 3, statistic_any = -1 };

template <int D, int S>
POLARGUIDE_INLINE void backward_block(const RasterArgs &a, const Tile &t, int count, const Block &b, const RasterScratch &s) {
    constexpr int parts = lanes / reg_lanes; // registers per block of pixels
    BlockGradients<D> gradients;
    load_gradients<D>(a, b, &gradients);
    Pixels pixels[parts];
    reg live[parts], remaining[parts], remaining_statistic[parts];
    for (int p = 0; p < parts; ++p) {
        pixels[p] = pixels_from(b, p * reg_lanes), live[p] = reg_splat(1.0f);
        remaining[p] = reg_load(gradients.remaining + p * reg_lanes);
        remaining_statistic[p] = reg_load(gradients.remaining_statistic + p * reg_lanes);
    }
    Batch batch;
    for (int i = 0; i < count; ++i) {
        const float *row = t.rows + int64_t(s.list[i]) * (D + 6);
        bool going = false;
        for (int p = 0; p < parts; ++p) {
            const int l = p * reg_lanes;
            const Alpha at = alpha_at(row, pixels[p]);
            const Blended next = blended(live[p], at.value);
            reg dot = {}, dot_statistic = {};
            if (S == statistic_any)
                for (int k = 0; k < a.statistic_channels; ++k) dot_statistic += row[6 + k] * reg_load(gradients.g[k] + l);
            for (int k = 0; k < D; ++k) {
                if (k == S && S) dot_statistic = dot;
                dot += row[6 + k] * reg_load(gradients.g[k] + l);
            }
            if (D == S) dot_statistic = dot;
            remaining[p] -= next.weight * dot;
            const reg inverse = reciprocal(1.0f - at.value);
            const reg factor = where(lane_mask(next.go & at.free), at.value);
            reg_store(batch.weight[batch.size] + l, next.weight);
            reg_store(batch.value[batch.size] + l, (live[p] * dot - remaining[p] * inverse) * factor);
            if (S) {
                remaining_statistic[p] -= next.weight * dot_statistic;
                reg_store(batch.statistic[batch.size] + l,
                          (live[p] * dot_statistic - remaining_statistic[p] * inverse) * factor);
            }
            live[p] = next.live;
            going |= any(next.go);
        }
        batch.local[batch.size++] = s.list[i];
        if (batch.size == 16) flush<D, S != 0>(batch, gradients, b.center_x, b.center_y, s.moments);
        if (!going) break;
    }
    if (batch.size) flush<D, S != 0>(batch, gradients, b.center_x, b.center_y, s.moments);
}

template <int D, int S> void backward_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const Tile t = reopen_tile<D>(a, tile);
    constexpr int stride = D + 9, out_stride = D + instance_extra, ahead = 8;
    for (int64_t i = 0; i < int64_t(t.count) * stride; ++i) s.moments[i] = 0.0f;
    for (int block = 0; block < 16; ++block) {
        Block b;
        if (!open_block(a, t, block, &b)) continue;
        const int count = positions_of_bit(t.blocks, t.count, block, s.list);
        if (count) backward_block<D, S>(a, t, count, b, s);
    }
    int64_t begin = a.tile_begin[tile];
    for (int i = 0; i < t.count; ++i) {
        if (i + ahead < t.count) {
            const float *next = a.grad_instances + a.instances[begin + i + ahead] * out_stride;
            __builtin_prefetch(next, 1), __builtin_prefetch(next + out_stride - 1, 1);
        }
        const float *row = t.rows + int64_t(i) * (D + 6), *m = s.moments + int64_t(i) * stride;
        float *out = a.grad_instances + a.instances[begin + i] * out_stride;
        for (int k = 0; k < D; ++k) out[k] = m[k];
        m += D, out += D;
        const float ux = row[0], uy = row[1];
        // conic of the natural exponent -(a dx^2 + 2 b dx dy + c dy^2) / 2
        const float ca = -2.0f * natural * row[2], cb = -natural * row[3], cc = -2.0f * natural * row[4];
        const float x = m[1] - ux * m[0], y = m[2] - uy * m[0];
        out[0] = ca * x + cb * y;
        out[1] = cb * x + cc * y;
        out[2] = -0.5f * (m[3] - ux * (m[1] + x));
        out[3] = -(m[4] - ux * m[2] - uy * x);
        out[4] = -0.5f * (m[5] - uy * (m[2] + y));
        out[5] = m[0];
        if (S) {
            const float sx = m[7] - ux * m[6], sy = m[8] - uy * m[6];
            out[6] = ca * sx + cb * sy, out[7] = cb * sx + cc * sy;
        } else {
            out[6] = out[7] = 0.0f;
        }
    }
}

template <int D> void backward_any(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    if (a.statistic_channels == 0)
        backward_tile<D, statistic_none>(a, tile, s);
    else if (a.statistic_channels == 3)
        backward_tile<D, statistic_three>(a, tile, s);
    else
        backward_tile<D, statistic_any>(a, tile, s);
}

} // namespace

void raster_backward(const RasterArgs &a, int64_t tile, const RasterScratch &s) { POLARGUIDE_BY_CHANNELS(backward_any) }

} // namespace POLARGUIDE_ISA
} // namespace polarguide
