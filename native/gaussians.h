// Kernels over Gaussians before the projection: splatted features and their gradients.
#pragma once
#include "kernels.h"

#include <stdint.h>

namespace polarguide {

struct HarmonicsArgs {
    int degree;
    const float *means, *center, *dc, *rest; // [N,3] [3] [N,3] [N,15,3]
    float *out;                              // [N,3]
    const float *grad_out;
    float *grad_means, *grad_dc, *grad_rest; // those of means and rest may be null: not requested
    bool streams;                            // grad_rest does not fit into caches
};
POLARGUIDE_DECLARE(void harmonics_forward(const HarmonicsArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void harmonics_backward(const HarmonicsArgs &a, int64_t begin, int64_t end))

// Shortest axes of Gaussians, turned outward, their gradient, and rays mirrored at them.
struct AxesArgs {
    const float *means, *quaternions, *log_scales, *center; // [N,3] [N,4] [N,3] [3]
    const float *outward;                                   // [N,3] or null
    float grazing;                                          // cosine below which `outward` decides
    const float *normals;                                   // [N,3], read by mirrored_forward
    float *out;                                             // [N,3]
    const float *grad_out;
    float *grad_quaternions;
};
POLARGUIDE_DECLARE(void axes_forward(const AxesArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void axes_backward(const AxesArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void mirrored_forward(const AxesArgs &a, int64_t begin, int64_t end))

// Input of a rasterizer from the parameters: scales, opacities and rows of features. Features are color and, if present, normal,
// strength, local light, further channels and depth. Color, normal and light are compact arrays of the current Gaussians.
struct SplatArgs {
    int channels, further_channels;                    // D, and K further channels
    const float *means, *center, *forward;             // [N,3]; [3] camera center; [3] optical axis, null without depth
    const float *log_scales, *opacity_logits;          // [N,3] [N]
    const float *color, *normals, *light;              // [N,3]; the latter two may be null
    const float *strength_logits, *metalness;          // [N]; each may be null
    const float *further;                              // [N,K], may be null
    float *scales, *opacities, *features;              // [N,3] [N] [N,D]
    const float *grad_scales, *grad_opacities, *grad_features;
    const float *grad_means, *grad_quaternions;        // from the rasterizer
    const float *by_color, *by_normals;                // [N,3] of means, [N,4] of quaternions; the latter may be null
    float *to_color, *to_normals, *to_light, *to_depth; // [N,3], [N]
    float *to_means, *to_quaternions, *to_log_scales, *to_opacity_logits, *to_strength_logits, *to_further;
};
POLARGUIDE_DECLARE(void splat_assemble(const SplatArgs &a, int64_t begin, int64_t end))
// Computes gradients of color, normals, light, depth, strength and further channels from the gradient of the features.
POLARGUIDE_DECLARE(void splat_split(const SplatArgs &a, int64_t begin, int64_t end))
// Computes gradients of means, quaternions, scales and opacities; `by_color` and `by_normals` are parts of them.
POLARGUIDE_DECLARE(void splat_join(const SplatArgs &a, int64_t begin, int64_t end))

// Shortest scales of visible Gaussians.
struct ShortestArgs {
    const float *log_scales, *radii; // [N,3] [N], 0 if not visible
    float factor;
    float *gradient; // [N,3]: factor times the gradient of their sum
};
// Adds their sum and number to `sum` and `count`.
POLARGUIDE_DECLARE(void shortest_sum(const ShortestArgs &a, int64_t begin, int64_t end, double *sum, double *count))
POLARGUIDE_DECLARE(void shortest_gradient(const ShortestArgs &a, int64_t begin, int64_t end))

} // namespace polarguide
