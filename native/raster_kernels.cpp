// Blending of a tile, forward and backward. See raster.h for the definition.
#include "raster.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float log2_minimum = -7.99435344f; // log2(1 / 255)
constexpr float maximum_alpha = 0.99f;
constexpr float minimum_transmittance = 1e-4f;
constexpr float natural = 0.693147181f;

alignas(64) const float lane_x[16] = {-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f,
                                      -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f};
alignas(64) const float lane_y[16] = {-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f,
                                      .5f,   .5f,   .5f,   .5f,   1.5f, 1.5f, 1.5f, 1.5f};

// The blocks (one bit each) of a tile in which log2(alpha) of a Gaussian can reach the threshold. The maximum of the
// concave exponent over a block lies on one of the two sides that face the center. `row` is relative to the tile center.
POLARGUIDE_INLINE uint32_t touched_blocks(const float *row) {
    vf bx = load(lane_x) * 4.0f - row[0], by = load(lane_y) * 4.0f - row[1];
    vf x0 = bx - 1.5f, x1 = bx + 1.5f, y0 = by - 1.5f, y1 = by + 1.5f;
    vf zero = vf{};
    vf cx = clamp(zero, x0, x1), cy = clamp(zero, y0, y1);
    vf a = splat(row[2]), b = splat(row[3]), c = splat(row[4]);
    float half_ac = -0.5f * row[3];
    vf ey = clamp(cx * (half_ac / row[4]), y0, y1), ex = clamp(cy * (half_ac / row[2]), x0, x1);
    vf q1 = a * cx * cx + b * cx * ey + c * ey * ey, q2 = a * ex * ex + b * ex * cy + c * cy * cy;
    return bits(max(q1, q2) + row[5] >= splat(log2_minimum - 1e-4f));
}

struct Tile {
    int count;
    int x0, y0;
    float center_x, center_y;
    int list_sizes[16];
};

// Gathers the tile's Gaussians into contiguous rows and sorts them into one list per block.
template <int D> POLARGUIDE_INLINE Tile open_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    Tile t;
    int64_t begin = a.tile_begin[tile];
    t.count = int(a.tile_begin[tile + 1] - begin);
    t.x0 = int(tile % a.tiles_x) * tile_size, t.y0 = int(tile / a.tiles_x) * tile_size;
    t.center_x = float(t.x0) + 8.0f, t.center_y = float(t.y0) + 8.0f;
    int sizes[16] = {0};
    const int n = t.count, real = a.channels_real;
    for (int i = 0; i < n; ++i) {
        int64_t g = a.gaussians[begin + i];
        const float *screen = a.screen + g * screen_values, *features = a.features + g * real;
        float *row = s.rows + int64_t(i) * (D + 6);
        row[0] = screen[0] - t.center_x, row[1] = screen[1] - t.center_y;
        for (int k = 2; k < 6; ++k) row[k] = screen[k];
        for (int k = 0; k < real; ++k) row[6 + k] = features[a.permutation[k]];
        for (int k = real; k < D; ++k) row[6 + k] = 0.0f;
        for (uint32_t m = touched_blocks(row); m; m &= m - 1) {
            int block = __builtin_ctz(m);
            s.lists[int64_t(block) * n + sizes[block]++] = i;
        }
    }
    for (int b = 0; b < 16; ++b) t.list_sizes[b] = sizes[b];
    return t;
}

struct Block {
    int x, y;   // first pixel
    vf px, py;  // pixel centers relative to the tile center
};
POLARGUIDE_INLINE bool open_block(const RasterArgs &a, const Tile &t, int block, Block *out) {
    int bx = (block & 3) * 4, by = (block >> 2) * 4;
    out->x = t.x0 + bx, out->y = t.y0 + by;
    out->px = load(lane_x) + (float(bx) - 6.0f), out->py = load(lane_y) + (float(by) - 6.0f);
    return out->x < a.width && out->y < a.height;
}

struct Alpha {
    vf dx, dy, value; // value is 0 where the Gaussian does not contribute
    vi capped;
};
POLARGUIDE_INLINE Alpha alpha_at(const float *row, const Block &b) {
    Alpha r;
    r.dx = b.px - row[0], r.dy = b.py - row[1];
    vf e = (r.dx * row[2] + r.dy * row[3]) * r.dx + (r.dy * row[4]) * r.dy + row[5];
    vi keep = e >= splat(log2_minimum);
    vf alpha = exp2(max(e, splat(-30.0f)));
    r.capped = alpha > splat(maximum_alpha);
    alpha = min(alpha, splat(maximum_alpha));
    r.value = keep ? alpha : vf{};
    return r;
}

template <int D> void forward_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const Tile t = open_tile<D>(a, tile, s);
    const int real = a.channels_real;
    int64_t pairs = 0;
    for (int block = 0; block < 16; ++block) {
        Block b;
        if (!open_block(a, t, block, &b)) continue;
        vf acc[D];
        for (int k = 0; k < D; ++k) acc[k] = vf{};
        vf live = splat(1.0f), final = live; // transmittance; `live` turns 0 where a pixel has ended
        const int32_t *list = s.lists + int64_t(block) * t.count;
        for (int i = 0, n = t.list_sizes[block]; i < n; ++i) {
            const float *row = s.rows + int64_t(list[i]) * (D + 6);
            Alpha at = alpha_at(row, b);
            vf next = live - live * at.value;
            vi go = next >= splat(minimum_transmittance);
            vf weight = go ? live * at.value : vf{};
            for (int k = 0; k < D; ++k) acc[k] += weight * row[6 + k];
            if (__builtin_expect(a.pairs != nullptr, 0)) pairs += __builtin_popcount(bits(weight > vf{}));
            final = go ? next : final;
            live = go ? next : vf{};
            if (!any(go)) break;
        }
        alignas(64) float values[D + 1][16];
        for (int k = 0; k < D; ++k) store(values[k], acc[k]);
        store(values[D], final);
        const int rows = a.height - b.y < 4 ? a.height - b.y : 4, columns = a.width - b.x < 4 ? a.width - b.x : 4;
        for (int j = 0; j < rows; ++j)
            for (int i = 0; i < columns; ++i) {
                int64_t pixel = int64_t(b.y + j) * a.width + b.x + i;
                float *out = a.out + pixel * real;
                for (int k = 0; k < real; ++k) out[a.permutation[k]] = values[k][4 * j + i];
                a.transmittance[pixel] = values[D][4 * j + i];
                a.alpha[pixel] = 1.0f - values[D][4 * j + i];
            }
    }
    if (a.pairs) a.pairs[tile] = pairs;
}

// Gradients of one block, loaded pixel-wise into lanes.
template <int D> struct BlockGradients {
    alignas(64) float g[D][16];
    vf remaining;           // sum over what is not yet passed of weight * (feature . g), all channels, and the alpha output
    vf remaining_statistic; // the same for the statistic channels alone
};
template <int D>
POLARGUIDE_INLINE void load_gradients(const RasterArgs &a, const Block &b, BlockGradients<D> *r) {
    alignas(64) float total[16] = {0}, statistic[16] = {0};
    for (int k = 0; k < D; ++k) store(r->g[k], vf{});
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
                sum += g[channel] * out[channel];
                if (k + 1 == a.statistic_channels) statistic[4 * j + i] = sum;
            }
            total[4 * j + i] = sum - a.grad_alpha[pixel] * a.transmittance[pixel];
        }
    r->remaining = load(total), r->remaining_statistic = load(statistic);
}

// A batch of up to sixteen Gaussians of one block: per-pixel weights and exponent gradients, one row each.
struct Batch {
    alignas(64) float weight[16][16], value[16][16], statistic[16][16];
    int32_t local[16];
    int size = 0;
};

// Moments 1, x, y, xx, xy, yy of a block's pixels (transposed: v[pixel] holds sixteen Gaussians), about the tile center.
POLARGUIDE_INLINE void moments(const float *v, float x, float y, bool second, vf *m) {
    vf column[4], row[4], xy = vf{};
    for (int i = 0; i < 4; ++i) column[i] = load(v + 16 * i);
    for (int j = 0; j < 4; ++j) {
        vf p0 = load(v + 64 * j), p1 = load(v + 64 * j + 16), p2 = load(v + 64 * j + 32), p3 = load(v + 64 * j + 48);
        row[j] = (p0 + p1) + (p2 + p3);
        if (j) column[0] += p0, column[1] += p1, column[2] += p2, column[3] += p3;
        if (second) xy += (float(j) - 1.5f) * ((p3 - p0) * 1.5f + (p2 - p1) * 0.5f);
    }
    m[0] = (row[0] + row[1]) + (row[2] + row[3]);
    vf mx = (column[3] - column[0]) * 1.5f + (column[2] - column[1]) * 0.5f;
    vf my = (row[3] - row[0]) * 1.5f + (row[2] - row[1]) * 0.5f;
    m[1] = mx + m[0] * x, m[2] = my + m[0] * y;
    if (!second) return;
    vf xx = (column[0] + column[3]) * 2.25f + (column[1] + column[2]) * 0.25f;
    vf yy = (row[0] + row[3]) * 2.25f + (row[1] + row[2]) * 0.25f;
    m[3] = xx + (mx + m[1]) * x;
    m[4] = xy + mx * y + m[2] * x;
    m[5] = yy + (my + m[2]) * y;
}

// Adds the sums of a batch to the tile's rows: D feature gradients, six moments of the exponent gradient, three of the
// statistic's.
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
    constexpr int step = 4; // channels at a time: independent chains, few registers
    for (int k0 = 0; k0 < D; k0 += step) {
        vf acc[step] = {};
        for (int p = 0; p < 16; ++p) {
            vf w = load(t + 16 * p);
            for (int k = 0; k < step; ++k)
                if (k0 + k < D) acc[k] += w * gradients.g[k0 + k][p];
        }
        for (int k = 0; k < step; ++k)
            if (k0 + k < D) store(sums[k0 + k], acc[k]);
    }
    vf m[6];
    transpose16(batch.value[0], t);
    moments(t, x, y, true, m);
    for (int q = 0; q < 6; ++q) store(sums[D + q], m[q]);
    if (S) {
        transpose16(batch.statistic[0], t);
        moments(t, x, y, false, m);
        for (int q = 0; q < 3; ++q) store(sums[D + 6 + q], m[q]);
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
            float *row = rows + int64_t(batch.local[i]) * stride + first; // rows have room for a whole vector at the end
            store(row, load(row) + load(t + 16 * i));
        }
    }
    batch.size = 0;
}

// Statistic channels: none, the first three, or as many as the arguments say.
enum { statistic_none = 0, statistic_three = 3, statistic_any = -1 };

template <int D, int S>
POLARGUIDE_INLINE void backward_block(const RasterArgs &a, const Tile &t, int block, const Block &b, const RasterScratch &s) {
    BlockGradients<D> gradients;
    load_gradients<D>(a, b, &gradients);
    vf remaining = gradients.remaining, remaining_statistic = gradients.remaining_statistic;
    vf live = splat(1.0f);
    const float x = float((block & 3) * 4) - 6.0f, y = float((block >> 2) * 4) - 6.0f;
    Batch batch;
    const int32_t *list = s.lists + int64_t(block) * t.count;
    for (int i = 0, n = t.list_sizes[block]; i < n; ++i) {
        const float *row = s.rows + int64_t(list[i]) * (D + 6);
        Alpha at = alpha_at(row, b);
        vf next = live - live * at.value;
        vi go = next >= splat(minimum_transmittance);
        vf weight = go ? live * at.value : vf{};
        vf dot = vf{}, dot_statistic = vf{};
        if (S == statistic_any) {
            for (int k = 0; k < a.statistic_channels; ++k) dot_statistic += row[6 + k] * load(gradients.g[k]);
            for (int k = 0; k < D; ++k) dot += row[6 + k] * load(gradients.g[k]);
        } else {
            for (int k = 0; k < D; ++k) {
                if (k == S && S) dot_statistic = dot;
                dot += row[6 + k] * load(gradients.g[k]);
            }
            if (D == S) dot_statistic = dot;
        }
        remaining -= weight * dot;
        vf inverse = reciprocal(1.0f - at.value);
        vi pass = go & ~at.capped;
        vf factor = pass ? at.value : vf{};
        vf slot = (live * dot - remaining * inverse) * factor;
        store(batch.weight[batch.size], weight);
        store(batch.value[batch.size], slot);
        if (S) {
            remaining_statistic -= weight * dot_statistic;
            store(batch.statistic[batch.size], (live * dot_statistic - remaining_statistic * inverse) * factor);
        }
        batch.local[batch.size++] = list[i];
        if (batch.size == 16) flush<D, S != 0>(batch, gradients, x, y, s.moments);
        live = go ? next : vf{};
        if (!any(go)) break;
    }
    if (batch.size) flush<D, S != 0>(batch, gradients, x, y, s.moments);
}

template <int D, int S> void backward_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const Tile t = open_tile<D>(a, tile, s);
    constexpr int stride = D + 9, out_stride = D + instance_extra;
    for (int64_t i = 0; i < int64_t(t.count) * stride; ++i) s.moments[i] = 0.0f;
    for (int block = 0; block < 16; ++block) {
        Block b;
        if (t.list_sizes[block] && open_block(a, t, block, &b)) backward_block<D, S>(a, t, block, b, s);
    }
    int64_t begin = a.tile_begin[tile];
    for (int i = 0; i < t.count; ++i) {
        const float *row = s.rows + int64_t(i) * (D + 6), *m = s.moments + int64_t(i) * stride;
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

#define POLARGUIDE_BY_CHANNELS(function)                                                                               \
    switch (a.channels) {                                                                                              \
    case 3: return function<3>(a, tile, s);                                                                            \
    case 4: return function<4>(a, tile, s);                                                                            \
    case 7: return function<7>(a, tile, s);                                                                            \
    case 8: return function<8>(a, tile, s);                                                                            \
    case 12: return function<12>(a, tile, s);                                                                          \
    case 16: return function<16>(a, tile, s);                                                                          \
    default: return function<32>(a, tile, s);                                                                          \
    }

void raster_forward(const RasterArgs &a, int64_t tile, const RasterScratch &s) { POLARGUIDE_BY_CHANNELS(forward_tile) }
void raster_backward(const RasterArgs &a, int64_t tile, const RasterScratch &s) { POLARGUIDE_BY_CHANNELS(backward_any) }

int64_t first_not_finite(const float *values, int64_t count) {
    int64_t i = 0;
    for (; i + lanes <= count; i += lanes) {
        vf x = load(values + i);
        vf zero = x - x; // NaN for NaN and infinity
        if (any(~(zero == vf{}))) break;
    }
    for (; i < count; ++i)
        if (!(values[i] - values[i] == 0.0f)) return i;
    return -1;
}

float fma_burst(int64_t rounds) {
    vf acc[16];
    for (int i = 0; i < 16; ++i) acc[i] = splat(float(i) * 1e-3f);
    vf a = splat(0.999f), b = splat(1e-4f);
    for (int64_t r = 0; r < rounds; ++r)
        for (int j = 0; j < 32; ++j)
            for (int i = 0; i < 16; ++i) acc[i] = acc[i] * a + b;
    vf sum = vf{};
    for (int i = 0; i < 16; ++i) sum += acc[i];
    return sum[0];
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
