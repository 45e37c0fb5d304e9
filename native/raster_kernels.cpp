// Blending of a tile, forward. See raster.h for the definition.
#include "raster_tile.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

// Writes channels and transmittance of a block's pixels to the picture.
template <int D> POLARGUIDE_INLINE void write_block(const RasterArgs &a, const Block &b, const float (*values)[16]) {
    const int real = a.channels_real;
    const int rows = a.height - b.y < 4 ? a.height - b.y : 4, columns = a.width - b.x < 4 ? a.width - b.x : 4;
    for (int j = 0; j < rows; ++j) {
        const int64_t first = int64_t(b.y + j) * a.width + b.x;
        for (int i = 0; i < columns; ++i) {
            float *out = a.out + (first + i) * real;
            if (in_order<D>(a))
                for (int k = 0; k < D; ++k) out[k] = values[k][4 * j + i];
            else
                for (int k = 0; k < real; ++k) out[a.permutation[k]] = values[k][4 * j + i];
            a.alpha[first + i] = 1.0f - values[D][4 * j + i];
        }
        if (a.transmittance) __builtin_memcpy(a.transmittance + first, values[D] + 4 * j, sizeof(float) * columns);
    }
}

template <int D> void forward_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const Tile t = gather_tile<D>(a, tile, s);
    int64_t pairs = 0;
    for (int block = 0; block < 16; ++block) {
        Block b;
        if (!open_block(a, t, block, &b)) continue;
        const int n = positions_of_bit(t.blocks, t.count, block, s.list);
        alignas(64) float values[D + 1][16];
        for (int l = 0; l < lanes; l += reg_lanes) {
            const Pixels pixels = pixels_from(b, l);
            reg acc[D] = {};
            reg live = reg_splat(1.0f), final = live; // transmittance; `live` remains low after the end of a pixel
            for (int i = 0; i < n; ++i) {
                const float *row = t.rows + int64_t(s.list[i]) * (D + 6);
                const Blended next = blended(live, alpha_at(row, pixels).value);
                for (int k = 0; k < D; ++k) acc[k] += next.weight * row[6 + k];
                if (__builtin_expect(a.pairs != nullptr, 0)) pairs += __builtin_popcount(bits(next.weight > 0.0f));
                final = where(next.go, next.live, final);
                live = next.live;
                if (!any(next.go)) break;
            }
            for (int k = 0; k < D; ++k) reg_store(values[k] + l, acc[k]);
            reg_store(values[D] + l, final);
        }
        write_block<D>(a, b, values);
    }
    if (a.pairs) a.pairs[tile] = pairs;
}

} // namespace

void raster_forward(const RasterArgs &a, int64_t tile, const RasterScratch &s) { POLARGUIDE_BY_CHANNELS(forward_tile) }

int64_t first_not_finite(const float *values, int64_t count) {
    int64_t i = 0;
    for (; i + reg_lanes <= count; i += reg_lanes) {
        const reg x = reg_load(values + i), zero = x - x; // NaN for NaN and infinity
        if (any(~(zero == reg{}))) break;
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
