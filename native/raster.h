// Splatting of 3D Gaussians with D feature channels: data between the stages.
//
// Definition, the same as in the reference implementation (src/polarguide/raster/reference.py): EWA projection with a blur of
// 0.1 px^2, alpha = min(0.99, opacity * exp(-quadratic / 2)), Gaussians in order of camera depth (ties by index). Contributions
// below 1/255 are dropped. A pixel ends before the Gaussian that would reduce its transmittance below 1e-4.
#pragma once
#include "kernels.h"

#include <stdint.h>

namespace polarguide {

constexpr int tile_size = 16;   // pixels; a tile is 4 x 4 blocks of 4 x 4 pixels, and one block is one vector
constexpr int max_channels = 32;
constexpr int screen_values = 8; // per Gaussian: x, y, factors of the exponent, and slopes to its maximum (see ProjectArgs)
constexpr int instance_extra = 8; // per instance, after the D feature gradients: x y, conic a b c, opacity, statistic x y

struct PinholeCamera {
    float rotation[9], translation[3]; // world to camera, row-major
    float fx, fy, cx, cy;
    int width, height;
    float near_plane;
};

struct ProjectArgs {
    int64_t count;
    const float *means, *quaternions, *scales, *opacities; // [N,3] [N,4] [N,3] [N]
    PinholeCamera camera;
    // Output. A row of `screen` begins with x, y (pixels), A, B, C, L, where log2(alpha) = A dx^2 + B dx dy + C dy^2 + L.
    // Its last two values are the slope dy / dx of the maximum for a given dx, and the slope dx / dy for a given dy.
    float *screen;  // [N,8]
    float *depth;   // [N]
    float *radius;  // [N] three standard deviations of the wider axis in pixels; 0 if culled
    int32_t *box;   // [N,4] first tile and last tile plus one in x and y; empty if culled
};

// Adjacent tiles of one row. A Gaussian touches one run per row, because an ellipse is convex.
struct TileRun {
    uint16_t row, begin, end; // columns; the end is not included
};

struct TileEmitArgs {
    const float *screen;
    const int32_t *box;
    const int64_t *offset;  // [N] first run of each Gaussian
    TileRun *runs;          // [rows of tiles of all boxes] touched tiles of each Gaussian, from its offset on
    int32_t *count;         // [N] number of runs
    int32_t *touched;       // [N] number of tiles
};

struct RasterArgs {
    int channels;     // D of this instantiation (padded)
    int channels_real;
    int width, height, tiles_x, tiles_y;
    const float *screen;            // [N,8]
    const float *features;          // [N, channels_real]
    const int32_t *permutation;     // [channels_real] statistic channels first
    bool in_order;                  // the permutation is the identity
    const int64_t *tile_begin;      // [tiles + 1]
    const int32_t *gaussians;       // [instances] by tile, in depth order
    const int64_t *instances;       // [instances] row in the buffer of instance gradients; for the backward pass
    // Data of the forward pass for the backward pass; null without a backward pass.
    float *rows;                    // [instances, channels + 6] by tile: x, y relative to its center, A, B, C, L, features
    uint16_t *blocks;               // [instances] one bit for each block of the tile that the Gaussian touches
    // Forward, out
    float *out;                     // [H,W,channels_real]
    float *alpha;                   // [H,W]
    float *transmittance;           // [H,W], for the backward pass; null without a backward pass
    int64_t *pairs;                 // optional [tiles]: contributing pixel-Gaussian pairs
    float surface_width;            // standard deviation around the median depth, as a share of this depth
    // Backward, in (out and transmittance are read)
    const float *grad_out, *grad_alpha; // [H,W,channels_real], [H,W]
    const float *grad_still;            // [H,W,still_count] gradient of the features alone; may be null
    const int32_t *still;               // [channels_real] channel of grad_still for each channel; -1: none
    int still_count;
    int statistic_channels;
    float *grad_instances;          // [instances, channels + instance_extra]
};

struct ProjectBackwardArgs {
    ProjectArgs forward;
    int channels, channels_real;
    const int32_t *permutation;
    const int64_t *instance_begin; // [N + 1]
    const float *grad_instances;
    float *grad_means, *grad_quaternions, *grad_scales, *grad_opacities, *grad_features;
    float *statistic; // [N,2] or null
};

// Scratch of one worker, with the size of the longest tile list.
struct RasterScratch {
    float *rows;      // [n, channels + 6] Gaussians of the tile, unless stored for the backward pass
    uint16_t *blocks; // [n] blocks that they touch, likewise
    int32_t *list;    // [n] Gaussians that touch one block
    float *moments;   // [n, channels + 9], or [n, 16]
};

POLARGUIDE_DECLARE(void project(const ProjectArgs &args, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void emit_tiles(const TileEmitArgs &args, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void raster_forward(const RasterArgs &args, int64_t tile, const RasterScratch &scratch))
POLARGUIDE_DECLARE(void raster_surface(const RasterArgs &args, int64_t tile, const RasterScratch &scratch))
POLARGUIDE_DECLARE(void raster_backward(const RasterArgs &args, int64_t tile, const RasterScratch &scratch))
POLARGUIDE_DECLARE(void project_backward(const ProjectBackwardArgs &args, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(int64_t first_not_finite(const float *values, int64_t count)) // index, or -1
POLARGUIDE_DECLARE(float fma_burst(int64_t rounds)) // 512 fused multiply-adds of 16 lanes per round
constexpr int64_t fma_burst_flops = 2 * 16 * 512;

// Returns the smallest compiled number of channels that is at least `channels`, or 0.
int padded_channels(int channels);

} // namespace polarguide
