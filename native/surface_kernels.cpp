// Means over Gaussians around the median depth of a pixel. See src/polarguide/raster/surface.py for the definition.
#include "raster_tile.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr int surface_channels = 4, depth_at = 6 + surface_channels - 1; // three channels of the caller, then camera depth

// Computes blended weights of the Gaussians in `list` at some pixels and returns the number of rows; `total` is their sum.
POLARGUIDE_INLINE int blended_weights(const Tile &t, const int32_t *list, int count, const Pixels &pixels, float *weights,
                                      reg *total) {
    reg live = reg_splat(1.0f), sum = reg{};
    for (int i = 0; i < count; ++i) {
        const Alpha at = alpha_at(t.rows + int64_t(list[i]) * (surface_channels + 6), pixels);
        const Blended next = blended(live, at.value);
        reg_store(weights + int64_t(i) * reg_lanes, next.weight);
        sum += next.weight;
        live = next.live;
        if (!any(next.go)) {
            count = i + 1;
            break;
        }
    }
    *total = sum;
    return count;
}

POLARGUIDE_INLINE reg median_depth(const Tile &t, const int32_t *list, int count, const float *weights, reg total) {
    reg upto = reg{}, median = reg_splat(1.0f);
    ireg open = total > 0.0f;
    for (int i = 0; i < count && any(open); ++i) {
        const reg weight = reg_load(weights + int64_t(i) * reg_lanes);
        upto += weight;
        const ireg here = open & (weight > 0.0f) & (upto + upto >= total);
        median = here ? reg_splat(t.rows[int64_t(list[i]) * (surface_channels + 6) + depth_at]) : median;
        open &= ~here;
    }
    return median;
}

} // namespace

void raster_surface(const RasterArgs &a, int64_t tile, const RasterScratch &s) {
    const Tile t = gather_tile<surface_channels>(a, tile, s);
    const float sharp = 1.0f / a.surface_width, half_log2_e = 0.72134752f;
    float *weights = s.moments;
    for (int block = 0; block < 16; ++block) {
        Block b;
        if (!open_block(a, t, block, &b)) continue;
        const int32_t *list = s.list;
        const int listed = positions_of_bit(t.blocks, t.count, block, s.list);
        alignas(64) float values[surface_channels][16];
        for (int l = 0; l < lanes; l += reg_lanes) {
            reg total, acc[surface_channels] = {}, sum = reg{};
            const int count = blended_weights(t, list, listed, pixels_from(b, l), weights, &total);
            const reg median = median_depth(t, list, count, weights, total);
            for (int i = 0; i < count; ++i) {
                const float *row = t.rows + int64_t(list[i]) * (surface_channels + 6);
                const reg off = (median * (1.0f / row[depth_at]) - 1.0f) * sharp;
                const reg near = exp2(max(off * off * -half_log2_e, reg_splat(-60.0f)));
                const reg weight = reg_load(weights + int64_t(i) * reg_lanes) * near;
                for (int k = 0; k < surface_channels; ++k) acc[k] += weight * row[6 + k];
                sum += weight;
            }
            const reg scale = total > 0.0f ? 1.0f / sum : reg{};
            for (int k = 0; k < surface_channels; ++k) reg_store(values[k] + l, total > 0.0f ? acc[k] * scale : reg{});
        }
        const int rows = a.height - b.y < 4 ? a.height - b.y : 4, columns = a.width - b.x < 4 ? a.width - b.x : 4;
        for (int j = 0; j < rows; ++j)
            for (int i = 0; i < columns; ++i) {
                float *out = a.out + (int64_t(b.y + j) * a.width + b.x + i) * surface_channels;
                for (int k = 0; k < surface_channels; ++k) out[k] = values[k][4 * j + i];
            }
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
