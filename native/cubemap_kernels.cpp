// The seamless cubemap.
#include "image.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

struct Tap {
    const int32_t *border; // of the top-left texel
    float fu, fv, major;   // fractions, and the length of the major axis
    int face, axis_s, axis_t, axis_m;
    float sign_s, sign_t, sign_m, s, t;
};

// OpenGL's faces +x -x +y -y +z -z: which component is s and t, with which sign.
constexpr int s_axis[6] = {2, 2, 0, 0, 0, 0}, t_axis[6] = {1, 1, 2, 2, 1, 1};
constexpr float s_sign[6] = {-1, 1, 1, 1, 1, -1}, t_sign[6] = {-1, -1, 1, -1, -1, -1};

POLARGUIDE_INLINE Tap tap_of(const CubemapArgs &a, const float *d) {
    const float ax = fabsf(d[0]), ay = fabsf(d[1]), az = fabsf(d[2]);
    Tap p;
    p.axis_m = ax >= ay && ax >= az ? 0 : ay >= az ? 1 : 2;
    p.face = 2 * p.axis_m + (d[p.axis_m] < 0.0f);
    p.sign_m = d[p.axis_m] < 0.0f ? -1.0f : 1.0f;
    p.axis_s = s_axis[p.face], p.axis_t = t_axis[p.face], p.sign_s = s_sign[p.face], p.sign_t = t_sign[p.face];
    p.major = fabsf(d[p.axis_m]);
    const float inverse = p.major > 1e-20f ? 1.0f / p.major : 0.0f;
    p.s = p.sign_s * d[p.axis_s] * inverse, p.t = p.sign_t * d[p.axis_t] * inverse;
    const float half = 0.5f * float(a.resolution);
    // Texel centres at half-integers; one is added for the border row and column.
    const float u = (p.s + 1.0f) * half + 0.5f, v = (p.t + 1.0f) * half + 0.5f;
    float u0 = floorf(u), v0 = floorf(v);
    const float top = float(a.resolution);
    u0 = u0 >= 0.0f ? (u0 < top ? u0 : top) : 0.0f, v0 = v0 >= 0.0f ? (v0 < top ? v0 : top) : 0.0f;
    p.fu = u - u0, p.fv = v - v0;
    const int64_t width = a.resolution + 2;
    p.border = a.border + (int64_t(p.face) * width + int64_t(v0)) * width + int64_t(u0);
    return p;
}

POLARGUIDE_INLINE void texels(const CubemapArgs &a, const Tap &p, const float **t) {
    const int width = a.resolution + 2;
    t[0] = a.texture + int64_t(p.border[0]) * a.channels, t[1] = a.texture + int64_t(p.border[1]) * a.channels;
    t[2] = a.texture + int64_t(p.border[width]) * a.channels, t[3] = a.texture + int64_t(p.border[width + 1]) * a.channels;
}

} // namespace

void cubemap_forward(const CubemapArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const Tap p = tap_of(a, a.directions + 3 * i);
        const float *t[4];
        texels(a, p, t);
        const float w[4] = {(1 - p.fu) * (1 - p.fv), p.fu * (1 - p.fv), (1 - p.fu) * p.fv, p.fu * p.fv};
        for (int c = 0; c < a.channels; ++c)
            a.out[i * a.channels + c] = w[0] * t[0][c] + w[1] * t[1][c] + w[2] * t[2][c] + w[3] * t[3][c];
    }
}

void cubemap_backward_directions(const CubemapArgs &a, int64_t begin, int64_t end) {
    const float half = 0.5f * float(a.resolution);
    for (int64_t i = begin; i < end; ++i) {
        const Tap p = tap_of(a, a.directions + 3 * i);
        const float *t[4], *g = a.grad_out + i * a.channels;
        texels(a, p, t);
        float by_u = 0.0f, by_v = 0.0f;
        for (int c = 0; c < a.channels; ++c) {
            by_u += g[c] * ((t[1][c] - t[0][c]) * (1 - p.fv) + (t[3][c] - t[2][c]) * p.fv);
            by_v += g[c] * ((t[2][c] - t[0][c]) * (1 - p.fu) + (t[3][c] - t[1][c]) * p.fu);
        }
        const float inverse = p.major > 1e-20f ? half / p.major : 0.0f;
        float *out = a.grad_directions + 3 * i;
        out[p.axis_s] = by_u * inverse * p.sign_s;
        out[p.axis_t] = by_v * inverse * p.sign_t;
        out[p.axis_m] = -(by_u * p.s + by_v * p.t) * inverse * p.sign_m;
    }
}

void cubemap_backward_texture(const CubemapArgs &a, int64_t begin, int64_t end) {
    const int width = a.resolution + 2;
    for (int64_t i = begin; i < end; ++i) {
        const Tap p = tap_of(a, a.directions + 3 * i);
        const int32_t at[4] = {p.border[0], p.border[1], p.border[width], p.border[width + 1]};
        const float w[4] = {(1 - p.fu) * (1 - p.fv), p.fu * (1 - p.fv), (1 - p.fu) * p.fv, p.fu * p.fv};
        const float *g = a.grad_out + i * a.channels;
        for (int k = 0; k < 4; ++k)
            for (int c = 0; c < a.channels; ++c) a.grad_texture[int64_t(at[k]) * a.channels + c] += w[k] * g[c];
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
