// Kernels of pictures: photometric loss, cubemap look-up, the layers of a G-buffer.
#pragma once
#include "kernels.h"

#include <stdint.h>

namespace polarguide {

// Photometric loss of one picture, in passes over rows. Planes are [height][stride] of interleaved colors, zero beyond
// 3 * width; `stride` is a multiple of 16. Each worker has its own `scratch`, see photometric_scratch.
struct PhotometricArgs {
    int width, height;
    int64_t stride;
    const float *prediction;          // [H,W,3] linear
    const float *target;              // [H,W,3] display values
    const float *weight;              // [H,W] or null
    float ssim_weight, inverse_count; // 1 / (3 * sum of weights)
    float *shown, *goal;              // planes: sRGB of the clipped prediction; target
    float *parts[3];                  // planes: derivatives of the SSIM sum with respect to the means of x, xx and xy
    double *row_l1, *row_squares, *row_ssim; // [height]
    float *gradient;                  // [H,W,3]; null: not requested
};
constexpr int photometric_margin = 16; // floats on both sides of a scratch line
inline int64_t photometric_scratch(int64_t stride) { return 9 * (stride + 2 * photometric_margin); }
POLARGUIDE_DECLARE(void photometric_show(const PhotometricArgs &a, int64_t begin, int64_t end, float *scratch))
POLARGUIDE_DECLARE(void photometric_statistics(const PhotometricArgs &a, int64_t begin, int64_t end, float *scratch))
POLARGUIDE_DECLARE(void photometric_gradient(const PhotometricArgs &a, int64_t begin, int64_t end, float *scratch))

// Seamless bilinear look-up in a cubemap, and its gradients with respect to directions and texels.
struct CubemapArgs {
    int resolution, channels;
    const float *texture;    // [6,R,R,C]
    const float *directions; // [P,3]
    float *out;              // [P,C]
    const float *grad_out;   // [P,C]
    float *grad_directions;  // [P,3]
};
POLARGUIDE_DECLARE(void cubemap_forward(const CubemapArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void cubemap_backward_directions(const CubemapArgs &a, int64_t begin, int64_t end))
// Adds to `sums` [6,R,R,C], in the order of the directions.
POLARGUIDE_DECLARE(void cubemap_backward_texture(const CubemapArgs &a, int64_t begin, int64_t end, float *sums))

// Look-up between the mip levels of a cubemap, linear in the level. `begin` is the first value of each level in the gradients of
// all texels, which are stored one level after the other.
constexpr int most_mip_levels = 16, largest_mip_channels = 64;
struct MipArgs {
    int levels, channels;
    int resolution[most_mip_levels];
    int64_t begin[most_mip_levels];
    const float *textures[most_mip_levels];  // [6,R,R,C] each
    const float *directions, *level;         // [P,3] [P]
    float *out;                              // [P,C]
    const float *grad_out;                   // [P,C]
    const float *grad_light;                 // [P,C]: replaces grad_out for textures and level; may be the same array
    float *grad_directions, *grad_level;     // [P,3] [P]
};
POLARGUIDE_DECLARE(void mips_forward(const MipArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void mips_backward(const MipArgs &a, int64_t begin, int64_t end))
// Adds to `sums`, in the order of the directions.
POLARGUIDE_DECLARE(void mips_backward_textures(const MipArgs &a, int64_t begin, int64_t end, float *sums))

// Directions rotated to other axes: rows times the rotation.
struct TurnArgs {
    const float *rotation, *directions; // [9] row-major, [P,3]
    float *out;                         // [P,3]
};
POLARGUIDE_DECLARE(void turn(const TurnArgs &a, int64_t begin, int64_t end))

// Deferred reflection per pixel. Features are base color, normal, strength and, with `local`, three channels of light; others
// may follow. `seen` is the result of the look-up of `directions`.
struct ReflectArgs {
    int channels;
    bool fresnel, local; // fresnel: Fresnel's weight and radiance between mip levels; else lerp and logistic function
    float refractive_index;
    int index;             // channel of its offset; -1: no such channel
    int roughness;         // channel of blended roughness; -1: all surfaces are mirrors
    float blur;            // mip levels from a mirror to a roughness of 1
    const float *alpha;    // [P]; null without roughness
    float *level;          // [P] of the look-up; null: not requested
    const float *features; // [P,D]
    const float *rays;     // [P,3] unit
    const float *seen;     // [P,3]
    float *directions;     // [P,3]
    float *along;          // [P] ray . normal
    float *final_picture, *specular, *diffuse, *reflection;
    // Each may be null. The held gradients are of the same layers, but do not contribute to the normal's gradient.
    const float *grad_final, *grad_specular, *grad_diffuse, *grad_reflection, *grad_held_specular, *grad_held_diffuse;
    const float *grad_directions, *grad_level;
    float *grad_seen, *grad_texels, *grad_features; // gradients of the look-up without and with the held ones
};
POLARGUIDE_DECLARE(void reflect_directions(const ReflectArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void reflect_layers(const ReflectArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void reflect_backward_layers(const ReflectArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void reflect_backward_directions(const ReflectArgs &a, int64_t begin, int64_t end))

// Contribution of metals to the layers (shading.metal) at K pixels. Channels from `first` on are reflectance times metalness, and
// metalness. `light` is the mirrored light of all surfaces.
struct MetalArgs {
    int channels, first;
    float least_share;
    const float *features, *rays, *light; // [P,D] [P,3] [P,3]
    const int64_t *pixels;                // [K] ascending
    float *share, *reflected, *slope;     // [K] [K,3] [K,3]
    float *final_picture, *specular;      // [P,3], added to
    const float *grad_layers[3];          // [P,3] each, of the layers it was added to; may be null
    const float *grad_reflected, *grad_slope; // [K,3] each, may be null
    float *grad_light;                        // [P,3], added to
    float *grad_normal, *grad_metal;          // [K,3] [K,4]
};
POLARGUIDE_DECLARE(void metal_layers(const MetalArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void metal_backward(const MetalArgs &a, int64_t begin, int64_t end))

// Normal and depth of a G-buffer: channels 3 to 5, and the last channel over alpha.
struct GBufferArgs {
    int channels;
    const float *features, *alpha; // [P,D] [P]
    float *normal, *depth;         // [P,3] [P]; depth may be null
    const float *grad_features, *grad_normal, *grad_depth; // each may be null
    float *to_features, *to_alpha;                         // [P,D]; [P], null without depth
};
POLARGUIDE_DECLARE(void gbuffer_split(const GBufferArgs &a, int64_t begin, int64_t end))
POLARGUIDE_DECLARE(void gbuffer_join(const GBufferArgs &a, int64_t begin, int64_t end))

} // namespace polarguide
