// Reflection of metals (shading.metal), added to the layers of dielectrics, and its gradient. Fresnel's equations of a
// conductor (optics.conductor) have forward derivatives with respect to the cosine and the reflectance.
#include "image.h"
#include "mirror.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float least_reflectance = 0.1f, largest_reflectance = 0.985f;

// Value with its derivatives with respect to the cosine and the reflectance.
struct Dual {
    reg v, c, r;
};
POLARGUIDE_INLINE Dual constant(float v) { return {reg_splat(v), reg{}, reg{}}; }
POLARGUIDE_INLINE Dual operator+(Dual a, Dual b) { return {a.v + b.v, a.c + b.c, a.r + b.r}; }
POLARGUIDE_INLINE Dual operator-(Dual a, Dual b) { return {a.v - b.v, a.c - b.c, a.r - b.r}; }
POLARGUIDE_INLINE Dual operator*(Dual a, Dual b) { return {a.v * b.v, a.c * b.v + a.v * b.c, a.r * b.v + a.v * b.r}; }
POLARGUIDE_INLINE Dual operator*(float a, Dual b) { return {a * b.v, a * b.c, a * b.r}; }
POLARGUIDE_INLINE Dual operator/(Dual a, Dual b) {
    const reg inverse = 1.0f / b.v, v = a.v * inverse;
    return {v, (a.c - v * b.c) * inverse, (a.r - v * b.r) * inverse};
}
POLARGUIDE_INLINE Dual root(Dual a) {
    const reg v = square_root(a.v), half = 0.5f / v;
    return {v, half * a.c, half * a.r};
}
POLARGUIDE_INLINE Dual where(ireg chosen, Dual a, Dual b) {
    return {chosen ? a.v : b.v, chosen ? a.c : b.c, chosen ? a.r : b.r};
}

struct Conductor {
    Dual mean, slope; // reflectance for unpolarized light; degree of polarization over sin^2
};

POLARGUIDE_INLINE Dual within(reg given, float low, float high, bool cosine) {
    const reg kept = given < low ? reg_splat(low) : given > high ? reg_splat(high) : given; // NaN stays
    const reg passes = (given >= low) & (given <= high) ? reg_splat(1.0f) : reg{};
    return {kept, cosine ? passes : reg{}, cosine ? reg{} : passes};
}

POLARGUIDE_INLINE Conductor conductor(reg cosine, reg reflectance) {
    const Dual c = within(cosine, 0.0f, 1.0f, true), one = constant(1.0f), c2 = c * c, sine2 = one - c2;
    const Dual r = within(reflectance, least_reflectance, largest_reflectance, false);
    const Dual n = constant(2.1f) - 1.9f * r, n2 = n * n;
    const Dual k2 = ((n + one) * (n + one) * r - (n - one) * (n - one)) / (one - r);
    const Dual real = n2 - k2 - sine2, squared = root(real * real + 4.0f * (n2 * k2));
    const ireg negative = real.v < 0.0f;
    const Dual larger = root(0.5f * (squared + where(negative, -1.0f * real, real)));
    const Dual half = where(negative, root(n2 * k2) / larger, larger); // the real part of the root
    const Dual y = 2.0f * (half * c), sum = squared + c2, s = (sum - y) / (sum + y);
    const Dual x = c2 * squared + sine2 * sine2, across = y * sine2;
    return {0.5f * (s + s * ((x - across) / (x + across))), y / x};
}

// Loads columns `first` to `first` + W of some pixels; rows from n on are zero.
template <int W> POLARGUIDE_INLINE void gather(const float *rows, int stride, int first, const int64_t *at, int n, reg *columns) {
    alignas(64) float t[W][reg_lanes] = {};
    for (int l = 0; l < n; ++l)
        for (int k = 0; k < W; ++k) t[k][l] = rows[stride * at[l] + first + k];
    __builtin_memcpy(columns, t, sizeof t);
}
template <int W> POLARGUIDE_INLINE void add(const reg *columns, const int64_t *at, int n, int stride, int first, float *rows) {
    for (int l = 0; l < n; ++l)
        for (int k = 0; k < W; ++k) rows[stride * at[l] + first + k] += columns[k][l];
}

// Inputs of some pixels, starting at the i-th.
struct Metal {
    reg share, inverse, given[3], reflectance[3], light[3]; // `given`: blended values; reflectance: divided by the share
    ireg shows;                                             // at least the least share
    Mirror mirror;
};

POLARGUIDE_INLINE Metal metal_at(const MetalArgs &a, int64_t i, int n) {
    Metal m;
    reg ray[3], blended[3];
    const int64_t *at = a.pixels + i;
    gather<3>(a.features, a.channels, 3, at, n, blended), gather<3>(a.rays, 3, 0, at, n, ray);
    gather<3>(a.features, a.channels, a.first, at, n, m.given), gather<3>(a.light, 3, 0, at, n, m.light);
    gather<1>(a.features, a.channels, a.first + 3, at, n, &m.share);
    m.mirror = mirror_of(ray, blended);
    m.shows = m.share >= a.least_share;
    m.inverse = 1.0f / (m.shows ? m.share : reg_splat(a.least_share));
    for (int k = 0; k < 3; ++k) m.reflectance[k] = m.given[k] * m.inverse;
    return m;
}

} // namespace

void metal_layers(const MetalArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        const Metal m = metal_at(a, i, n);
        reg reflected[3], slope[3];
        for (int k = 0; k < 3; ++k) {
            const Conductor found = conductor(-m.mirror.along, m.reflectance[k]);
            reflected[k] = m.share * found.mean.v * m.light[k], slope[k] = found.slope.v;
        }
        store_columns<1>(a.share + i, n, &m.share), store_columns<3>(a.reflected + 3 * i, n, reflected);
        store_columns<3>(a.slope + 3 * i, n, slope);
        add<3>(reflected, a.pixels + i, n, 3, 0, a.final_picture), add<3>(reflected, a.pixels + i, n, 3, 0, a.specular);
    }
}

// Adds the gradient of the light, and computes those of the blended normal, reflectance and share.
void metal_backward(const MetalArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        const int64_t *at = a.pixels + i;
        const Metal m = metal_at(a, i, n);
        reg by[3] = {}, by_slope[3] = {}, to_light[3], to_metal[4], to_normal[3], part[3];
        if (a.grad_reflected) load_columns<3>(a.grad_reflected + 3 * i, n, by);
        if (a.grad_slope) load_columns<3>(a.grad_slope + 3 * i, n, by_slope);
        for (const float *layer : a.grad_layers) {
            if (!layer) continue;
            gather<3>(layer, 3, 0, at, n, part);
            for (int k = 0; k < 3; ++k) by[k] += part[k];
        }
        reg by_share = {}, by_inverse = {}, by_cosine = {};
        for (int k = 0; k < 3; ++k) {
            const Conductor found = conductor(-m.mirror.along, m.reflectance[k]);
            const reg by_mean = m.share * m.light[k] * by[k];
            to_light[k] = m.share * found.mean.v * by[k];
            by_share += found.mean.v * m.light[k] * by[k];
            by_cosine += by_mean * found.mean.c + by_slope[k] * found.slope.c;
            const reg by_reflectance = by_mean * found.mean.r + by_slope[k] * found.slope.r;
            to_metal[k] = by_reflectance * m.inverse, by_inverse += by_reflectance * m.given[k];
        }
        to_metal[3] = by_share - (m.shows ? by_inverse * m.inverse * m.inverse : reg{});
        normal_by_along(m.mirror, -by_cosine, to_normal);
        add<3>(to_light, at, n, 3, 0, a.grad_light);
        store_columns<3>(a.grad_normal + 3 * i, n, to_normal), store_columns<4>(a.grad_metal + 4 * i, n, to_metal);
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
