// Rays mirrored at blended normals, and their gradient.
#pragma once
#include "simd.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float shortest_normal = 1e-3f;

// Blended normals and rays of some pixels.
struct Mirror {
    reg ray[3], normal[3], inverse; // unit, and 1 / length
    ireg short_;                    // length below the floor, which then is the divisor
    reg along;                      // ray . normal
};

POLARGUIDE_INLINE Mirror mirror_of(const reg *ray, const reg *blended) {
    Mirror m;
    const reg squared = blended[0] * blended[0] + blended[1] * blended[1] + blended[2] * blended[2];
    m.short_ = squared < shortest_normal * shortest_normal;
    m.inverse = 1.0f / (m.short_ ? reg_splat(shortest_normal) : square_root(squared));
    m.along = reg{};
    for (int k = 0; k < 3; ++k) {
        m.ray[k] = ray[k], m.normal[k] = blended[k] * m.inverse;
        m.along += m.ray[k] * m.normal[k];
    }
    return m;
}

POLARGUIDE_INLINE void mirrored_ray(const Mirror &m, reg *out) {
    for (int k = 0; k < 3; ++k) out[k] = m.ray[k] - 2.0f * m.along * m.normal[k];
}

// Computes the gradient of the blended normal from the gradient of `along`.
POLARGUIDE_INLINE void normal_by_along(const Mirror &m, reg by_along, reg *to) {
    for (int k = 0; k < 3; ++k)
        to[k] = by_along * m.inverse * (m.ray[k] - (m.short_ ? reg{} : m.along * m.normal[k]));
}

// Computes the gradient of the blended normal from the gradient of the mirrored ray.
POLARGUIDE_INLINE void normal_by_mirrored(const Mirror &m, const reg *g, reg *to) {
    reg by_unit[3], radial = {};
    const reg across = g[0] * m.normal[0] + g[1] * m.normal[1] + g[2] * m.normal[2];
    for (int k = 0; k < 3; ++k) {
        by_unit[k] = -2.0f * (m.along * g[k] + across * m.ray[k]);
        radial += by_unit[k] * m.normal[k];
    }
    for (int k = 0; k < 3; ++k) to[k] = m.inverse * (by_unit[k] - (m.short_ ? reg{} : radial * m.normal[k]));
}

POLARGUIDE_INLINE int count_at(int64_t i, int64_t end) { return end - i < reg_lanes ? int(end - i) : reg_lanes; }

} // namespace
} // namespace POLARGUIDE_ISA
} // namespace polarguide
