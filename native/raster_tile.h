// Tile in both passes of the blending: its gathered Gaussians, its blocks, and the coverage of a Gaussian in them.
#pragma once
#include "peak.h"
#include "raster.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float maximum_alpha = 0.99f;
constexpr float minimum_transmittance = 1e-4f;
constexpr float natural = 0.693147181f;

alignas(64) const float lane_x[16] = {-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f,
                                      -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f};
alignas(64) const float lane_y[16] = {-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f,
                                      .5f,   .5f,   .5f,   .5f,   1.5f, 1.5f, 1.5f, 1.5f};

// Returns the blocks (one bit each) of a tile in which log2(alpha) of a Gaussian can reach the threshold. `row` is relative to the
// tile center; for `to_y` and `to_x` see `peak_inside`.
POLARGUIDE_INLINE uint32_t touched_blocks(const float *row, float to_y, float to_x) {
    uint32_t blocks = 0;
    for (int l = 0; l < lanes; l += reg_lanes) {
        const reg bx = reg_load(lane_x + l) * 4.0f - row[0], by = reg_load(lane_y + l) * 4.0f - row[1];
        const reg peak = peak_inside(row, to_y, to_x, bx - 1.5f, bx + 1.5f, by - 1.5f, by + 1.5f);
        blocks |= bits(at_least(peak, reg_splat(log2_minimum - 1e-4f))) << l;
    }
    return blocks;
}

struct Tile {
    const float *rows;      // [count, channels + 6]
    const uint16_t *blocks; // [count] blocks of the tile that each touches
    int count;
    int x0, y0;
    float center_x, center_y;
};

POLARGUIDE_INLINE Tile open_tile(const RasterArgs &a, int64_t tile, const float *rows, const uint16_t *blocks) {
    Tile t;
    t.rows = rows, t.blocks = blocks;
    t.count = int(a.tile_begin[tile + 1] - a.tile_begin[tile]);
    t.x0 = int(tile % a.tiles_x) * tile_size, t.y0 = int(tile / a.tiles_x) * tile_size;
    t.center_x = float(t.x0) + 8.0f, t.center_y = float(t.y0) + 8.0f;
    return t;
}

// True if a Gaussian's features keep their order, so that the compiler knows the length of the copy.
template <int D> POLARGUIDE_INLINE bool in_order(const RasterArgs &a) { return a.in_order && a.channels_real == D; }

// Gathers the Gaussians of the tile into contiguous rows and finds the blocks that they touch.
template <int D> POLARGUIDE_INLINE Tile gather_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const int64_t begin = a.tile_begin[tile];
    float *rows = a.rows ? a.rows + begin * (D + 6) : s.rows;
    uint16_t *blocks = a.blocks ? a.blocks + begin : s.blocks;
    const Tile t = open_tile(a, tile, rows, blocks);
    const int real = a.channels_real;
    constexpr int ahead = 12; // neighbors in depth are scattered in memory, so they are prefetched
    for (int i = 0; i < t.count; ++i) {
        if (i + ahead < t.count) {
            const int64_t next = a.gaussians[begin + i + ahead];
            __builtin_prefetch(a.screen + next * screen_values);
            __builtin_prefetch(a.features + next * real);
            __builtin_prefetch(a.features + next * real + real - 1);
        }
        const int64_t g = a.gaussians[begin + i];
        const float *screen = a.screen + g * screen_values, *features = a.features + g * real;
        float *row = rows + int64_t(i) * (D + 6);
        row[0] = screen[0] - t.center_x, row[1] = screen[1] - t.center_y;
        __builtin_memcpy(row + 2, screen + 2, 4 * sizeof(float));
        if (in_order<D>(a)) {
            __builtin_memcpy(row + 6, features, D * sizeof(float));
        } else {
            for (int k = 0; k < real; ++k) row[6 + k] = features[a.permutation[k]];
            for (int k = real; k < D; ++k) row[6 + k] = 0.0f;
        }
        blocks[i] = uint16_t(touched_blocks(row, screen[6], screen[7]));
    }
    return t;
}

// Returns the tile in the backward pass, from the data of the forward pass.
template <int D> POLARGUIDE_INLINE Tile reopen_tile(const RasterArgs &a, int64_t tile) {
    const int64_t begin = a.tile_begin[tile];
    return open_tile(a, tile, a.rows + begin * (D + 6), a.blocks + begin);
}

struct Block {
    int x, y;                 // first pixel
    float center_x, center_y; // relative to the tile center
};
POLARGUIDE_INLINE bool open_block(const RasterArgs &a, const Tile &t, int block, Block *out) {
    int bx = (block & 3) * 4, by = (block >> 2) * 4;
    out->x = t.x0 + bx, out->y = t.y0 + by;
    out->center_x = float(bx) - 6.0f, out->center_y = float(by) - 6.0f;
    return out->x < a.width && out->y < a.height;
}

// Pixels of a block, one per lane of a register, from the l-th on: centers relative to the tile center.
struct Pixels {
    reg x, y;
};
POLARGUIDE_INLINE Pixels pixels_from(const Block &b, int l) {
    return {reg_load(lane_x + l) + b.center_x, reg_load(lane_y + l) + b.center_y};
}

struct Alpha {
    reg value;      // 0 if the Gaussian does not contribute
    lane_mask free; // true if alpha is below its maximum
};
POLARGUIDE_INLINE Alpha alpha_at(const float *row, const Pixels &p) {
    Alpha r;
    const reg dx = p.x - row[0], dy = p.y - row[1];
    const reg e = (dx * row[2] + dy * row[3]) * dx + ((dy * row[4]) * dy + row[5]);
    const reg alpha = exp2_looked_up(e), most = reg_splat(maximum_alpha); // undefined far below the threshold, where it is not used
    r.free = at_least(most, alpha);
    r.value = where(at_least(e, reg_splat(log2_minimum)), min(alpha, most));
    return r;
}

// Blends one more Gaussian at some pixels with a transmittance, which remains low after the end of a pixel.
struct Blended {
    reg weight, live; // 0 after the end of the pixel; transmittance behind the Gaussian
    lane_mask go;     // true before the end of the pixel
};
POLARGUIDE_INLINE Blended blended(reg live, reg alpha) {
    Blended r;
    const reg share = live * alpha;
    r.live = live - share;
    r.go = at_least(r.live, reg_splat(minimum_transmittance));
    r.weight = where(r.go, share);
    return r;
}

} // namespace
} // namespace POLARGUIDE_ISA
} // namespace polarguide

#define POLARGUIDE_BY_CHANNELS(function)                                                                               \
    switch (a.channels) {                                                                                              \
    case 3: return function<3>(a, tile, s);                                                                            \
    case 4: return function<4>(a, tile, s);                                                                            \
    case 7: return function<7>(a, tile, s);                                                                            \
    case 8: return function<8>(a, tile, s);                                                                            \
    case 11: return function<11>(a, tile, s);                                                                          \
    case 12: return function<12>(a, tile, s);                                                                          \
    case 16: return function<16>(a, tile, s);                                                                          \
    default: return function<32>(a, tile, s);                                                                          \
    }
