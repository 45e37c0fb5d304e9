// Terms of the loss that compare pixels of the G-buffer with measurements, each with its gradient.
#pragma once
#include "kernels.h"

#include <stdint.h>

namespace polarguide {

// Common arguments of the terms: normals blended in world axes, and their gradient, to which each term adds. The sum of a term has
// parts, one per `pixels_per_part` pixels or per row, so that it does not depend on the number of threads.
struct TermArgs {
    const float *normal; // [P,3] world, any length
    float *grad_normal;  // [P,3], added to
    const float *weight; // [P]; null: 1
    float factor;        // on the term
    double *parts;       // sums of weight * distance
};
constexpr int64_t pixels_per_part = 2048;

// Distance of the polarization of two layers on a smooth dielectric from K measurements. A measurement is the product of an
// analyzer (a0, a1, a2) and a Stokes vector: sum over measurements and colors of |a . S - measured|.
struct PolarizationArgs {
    TermArgs term;
    const float *rays, *rotation;     // [P,3] unit, camera axes; [3,3] world to camera
    const float *specular, *diffuse;  // [P,3] half of their contributions to S0
    const float *metal;               // [P,6] the part of specular that metals add, and it times its degree of
                                      // polarization over sin^2; null: none
    const float *measured;            // [K,P,3]
    const float *analyzers;           // [K,3]
    int64_t count;                    // P
    int measurements;                 // K
    float refractive_index;
    const float *index; // [P] of each pixel; null: equal for all pixels
    float *grad_specular, *grad_diffuse; // [P,3], written
    float *grad_metal;                   // [P,6], written; null without metal
};
POLARGUIDE_DECLARE(void polarization_term(const PolarizationArgs &a, int64_t begin, int64_t end))

// 1 - cosine of the normal with a direction, or with `plane` the absolute cosine. Normals shorter than 0.01 have less weight.
struct DirectionArgs {
    TermArgs term;
    const float *direction; // [P,3] unit, world
    bool plane;
};
POLARGUIDE_DECLARE(void direction_term(const DirectionArgs &a, int64_t begin, int64_t end))

// alpha - n . n_depth, with normals from central differences of the depth; without the border.
struct ConsistencyArgs {
    TermArgs term;
    int width, height;
    const float *rays, *rotation; // as above
    const float *depth, *alpha;   // [H,W]
    float *upward, *downward;     // [H,W]: contributions of a row to the gradient of the depth in the rows above and below
    float *grad_depth;            // [H,W], written
};
// Number of floats in a line of a worker's scratch, and in the whole scratch.
inline int64_t consistency_room(int64_t width) { return width + 96; }
inline int64_t consistency_scratch(int64_t width) { return 11 * consistency_room(width); }
POLARGUIDE_DECLARE(void consistency_term(const ConsistencyArgs &a, int64_t begin, int64_t end, float *scratch))
POLARGUIDE_DECLARE(void consistency_gather(const ConsistencyArgs &a, int64_t begin, int64_t end))

} // namespace polarguide
