// Blending of a tile, forward. See raster.h for the definition.
#include "raster_tile.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

template <int D> void forward_tile(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const Tile t = gather_tile<D>(a, tile, s);
    const int real = a.channels_real;
    int64_t pairs = 0;
    for (int block = 0; block < 16; ++block) {
        Block b;
        if (!open_block(a, t, block, &b)) continue;
        const int n = positions_of_bit(t.blocks, t.count, block, s.list);
        alignas(64) float values[D + 1][16];
        for (int l = 0; l < lanes; l += reg_lanes) {
            const Pixels pixels = pixels_from(b, l);
            reg acc[D] = {};
            reg live = reg_splat(1.0f), final = live; // transmittance; `live` never rises again where a pixel has ended
            for (int i = 0; i < n; ++i) {
                const float *row = t.rows + int64_t(s.list[i]) * (D + 6);
                const Alpha at = alpha_at(row, pixels);
                const reg next = live - live * at.value;
                const ireg go = next >= minimum_transmittance;
                const reg weight = go ? live * at.value : reg{};
                for (int k = 0; k < D; ++k) acc[k] += weight * row[6 + k];
                if (__builtin_expect(a.pairs != nullptr, 0)) pairs += __builtin_popcount(bits(weight > 0.0f));
                final = go ? next : final;
                live = next;
                if (!any(go)) break;
            }
            for (int k = 0; k < D; ++k) reg_store(values[k] + l, acc[k]);
            reg_store(values[D] + l, final);
        }
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
