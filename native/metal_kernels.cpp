// Fresnel's equations of a metal per pixel and color (optics.conductor), with derivatives by forward differentiation.
#include "image.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float least_reflectance = 0.1f, largest_reflectance = 0.985f;

// A value and its derivatives by the cosine and by the reflectance.
struct Dual {
    float v, c, r;
};
inline Dual constant(float v) { return {v, 0.0f, 0.0f}; }
inline Dual operator+(Dual a, Dual b) { return {a.v + b.v, a.c + b.c, a.r + b.r}; }
inline Dual operator-(Dual a, Dual b) { return {a.v - b.v, a.c - b.c, a.r - b.r}; }
inline Dual operator*(Dual a, Dual b) { return {a.v * b.v, a.c * b.v + a.v * b.c, a.r * b.v + a.v * b.r}; }
inline Dual operator*(float a, Dual b) { return {a * b.v, a * b.c, a * b.r}; }
inline Dual operator/(Dual a, Dual b) {
    const float inverse = 1.0f / b.v, v = a.v * inverse;
    return {v, (a.c - v * b.c) * inverse, (a.r - v * b.r) * inverse};
}
inline Dual root(Dual a) {
    const float v = sqrtf(a.v), half = 0.5f / v;
    return {v, half * a.c, half * a.r};
}

} // namespace

void conductor_values(const ConductorArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float given = a.cosine[i], within = given < 0.0f ? 0.0f : given > 1.0f ? 1.0f : given;
        const Dual c{within, within == given ? 1.0f : 0.0f, 0.0f}, c2 = c * c, sine2 = constant(1.0f) - c2;
        for (int k = 0; k < 3; ++k) {
            const int64_t at = 3 * i + k;
            const float raw = a.reflectance[at];
            const float kept = raw < least_reflectance ? least_reflectance : raw > largest_reflectance ? largest_reflectance : raw;
            const Dual r{kept, 0.0f, kept == raw ? 1.0f : 0.0f}, one = constant(1.0f);
            const Dual n = constant(2.1f) - 1.9f * r, n2 = n * n;
            const Dual k2 = ((n + one) * (n + one) * r - (n - one) * (n - one)) / (one - r);
            const Dual real = n2 - k2 - sine2, squared = root(real * real + 4.0f * (n2 * k2));
            const Dual size = real.v < 0.0f ? -1.0f * real : real, larger = root(0.5f * (squared + size));
            const Dual half = real.v < 0.0f ? root(n2 * k2) / larger : larger; // the real part of the root
            const Dual y = 2.0f * (half * c), sum = squared + c2, s = (sum - y) / (sum + y);
            const Dual x = c2 * squared + sine2 * sine2, across = y * sine2;
            const Dual mean = 0.5f * (s + s * ((x - across) / (x + across))), slope = y / x;
            a.mean[at] = mean.v, a.slope[at] = slope.v;
            if (!a.derivatives) continue;
            float *to = a.derivatives + 4 * at;
            to[0] = mean.c, to[1] = mean.r, to[2] = slope.c, to[3] = slope.r;
        }
    }
}

void conductor_backward(const ConductorArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        float by_cosine = 0.0f;
        for (int k = 0; k < 3; ++k) {
            const int64_t at = 3 * i + k;
            const float *by = a.derivatives + 4 * at;
            const float mean = a.grad_mean ? a.grad_mean[at] : 0.0f, slope = a.grad_slope ? a.grad_slope[at] : 0.0f;
            by_cosine += mean * by[0] + slope * by[2];
            a.grad_reflectance[at] = mean * by[1] + slope * by[3];
        }
        a.grad_cosine[i] = by_cosine;
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
