// Spherical harmonics (the 3DGS release's order and signs) and the seamless cubemap.
#include "image.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float sh0 = 0.28209479f, sh1 = 0.48860251f;
constexpr float sh2[5] = {1.09254843f, -1.09254843f, 0.31539157f, -1.09254843f, 0.54627422f};
constexpr float sh3[7] = {-0.59004359f, 2.89061144f, -0.45704580f, 0.37317633f, -0.45704580f, 1.44530572f, -0.59004359f};

// Basis functions 1..15 at a unit direction.
POLARGUIDE_INLINE void basis(int degree, float x, float y, float z, float *b) {
    b[0] = -sh1 * y, b[1] = sh1 * z, b[2] = -sh1 * x;
    if (degree < 2) return;
    const float xx = x * x, yy = y * y, zz = z * z;
    b[3] = sh2[0] * x * y, b[4] = sh2[1] * y * z, b[5] = sh2[2] * (2 * zz - xx - yy);
    b[6] = sh2[3] * x * z, b[7] = sh2[4] * (xx - yy);
    if (degree < 3) return;
    b[8] = sh3[0] * y * (3 * xx - yy), b[9] = sh3[1] * x * y * z, b[10] = sh3[2] * y * (4 * zz - xx - yy);
    b[11] = sh3[3] * z * (2 * zz - 3 * xx - 3 * yy), b[12] = sh3[4] * x * (4 * zz - xx - yy);
    b[13] = sh3[5] * z * (xx - yy), b[14] = sh3[6] * x * (xx - 3 * yy);
}

// Gradient with respect to the direction of sum_k s[k] * basis_k.
POLARGUIDE_INLINE void basis_gradient(int degree, float x, float y, float z, const float *s, float *g) {
    g[0] = -sh1 * s[2], g[1] = -sh1 * s[0], g[2] = sh1 * s[1];
    if (degree < 2) return;
    g[0] += sh2[0] * y * s[3] - 2 * sh2[2] * x * s[5] + sh2[3] * z * s[6] + 2 * sh2[4] * x * s[7];
    g[1] += sh2[0] * x * s[3] + sh2[1] * z * s[4] - 2 * sh2[2] * y * s[5] - 2 * sh2[4] * y * s[7];
    g[2] += sh2[1] * y * s[4] + 4 * sh2[2] * z * s[5] + sh2[3] * x * s[6];
    if (degree < 3) return;
    const float xx = x * x, yy = y * y, zz = z * z;
    g[0] += 6 * sh3[0] * x * y * s[8] + sh3[1] * y * z * s[9] - 2 * sh3[2] * x * y * s[10] - 6 * sh3[3] * x * z * s[11] +
            sh3[4] * (4 * zz - 3 * xx - yy) * s[12] + 2 * sh3[5] * x * z * s[13] + 3 * sh3[6] * (xx - yy) * s[14];
    g[1] += 3 * sh3[0] * (xx - yy) * s[8] + sh3[1] * x * z * s[9] + sh3[2] * (4 * zz - xx - 3 * yy) * s[10] -
            6 * sh3[3] * y * z * s[11] - 2 * sh3[4] * x * y * s[12] - 2 * sh3[5] * y * z * s[13] - 6 * sh3[6] * x * y * s[14];
    g[2] += sh3[1] * x * y * s[9] + 8 * sh3[2] * y * z * s[10] + 3 * sh3[3] * (2 * zz - xx - yy) * s[11] +
            8 * sh3[4] * x * z * s[12] + sh3[5] * (xx - yy) * s[13];
}

POLARGUIDE_INLINE float direction(const HarmonicsArgs &a, int64_t g, float *d) {
    float squared = 0.0f;
    for (int i = 0; i < 3; ++i) d[i] = a.means[3 * g + i] - a.centre[i], squared += d[i] * d[i];
    const float inverse = squared > 1e-24f ? 1.0f / sqrtf(squared) : 0.0f;
    for (int i = 0; i < 3; ++i) d[i] *= inverse;
    return inverse;
}

} // namespace

void harmonics_forward(const HarmonicsArgs &a, int64_t begin, int64_t end) {
    const int used = (a.degree + 1) * (a.degree + 1) - 1;
    for (int64_t g = begin; g < end; ++g) {
        float d[3], b[15];
        float *out = a.out + 3 * g;
        for (int c = 0; c < 3; ++c) out[c] = sh0 * a.dc[3 * g + c];
        if (!used) continue;
        direction(a, g, d);
        basis(a.degree, d[0], d[1], d[2], b);
        const float *rest = a.rest + 45 * g;
        for (int k = 0; k < used; ++k)
            for (int c = 0; c < 3; ++c) out[c] += b[k] * rest[3 * k + c];
    }
}

void harmonics_backward(const HarmonicsArgs &a, int64_t begin, int64_t end) {
    const int used = (a.degree + 1) * (a.degree + 1) - 1;
    for (int64_t n = begin; n < end; ++n) {
        const float *g = a.grad_out + 3 * n, *rest = a.rest + 45 * n;
        float *to_rest = a.grad_rest + 45 * n, *to_mean = a.grad_means + 3 * n;
        for (int c = 0; c < 3; ++c) a.grad_dc[3 * n + c] = sh0 * g[c], to_mean[c] = 0.0f;
        for (int k = 3 * used; k < 45; ++k) to_rest[k] = 0.0f;
        if (!used) continue;
        float d[3], b[15], s[15], by_direction[3];
        const float inverse = direction(a, n, d);
        basis(a.degree, d[0], d[1], d[2], b);
        for (int k = 0; k < used; ++k) {
            s[k] = rest[3 * k] * g[0] + rest[3 * k + 1] * g[1] + rest[3 * k + 2] * g[2];
            for (int c = 0; c < 3; ++c) to_rest[3 * k + c] = b[k] * g[c];
        }
        basis_gradient(a.degree, d[0], d[1], d[2], s, by_direction);
        const float along = by_direction[0] * d[0] + by_direction[1] * d[1] + by_direction[2] * d[2];
        for (int i = 0; i < 3; ++i) to_mean[i] = (by_direction[i] - along * d[i]) * inverse;
    }
}

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
