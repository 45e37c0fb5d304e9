// The photometric loss: sRGB, L1 and SSIM of a picture, and the gradient with respect to the linear prediction.
#include "image.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr int reach = 5; // the window has 2 * reach + 1 taps
alignas(64) const float tap[11] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                                   0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
constexpr float c1 = 0.0001f, c2 = 0.0009f;

// log2 of positive normal numbers, relative error about 1e-7 in what is raised to it.
POLARGUIDE_INLINE vf log2_of(vf x) {
    vi raw = as_int(x);
    vi exponent = (raw - 0x3f3504f3) >> 23; // mantissa to [sqrt(1/2), sqrt(2))
    vf m = as_float(raw - (exponent << 23));
    vf s = (m - 1.0f) / (m + 1.0f), q = s * s;
    vf series = s * (((((q * 0.111111111f + 0.142857143f) * q + 0.2f) * q + 0.333333333f) * q) + 1.0f);
    return __builtin_convertvector(exponent, vf) + series * 2.88539008f;
}

// Shown value of a linear one, and the slope; beyond [0, 1] the slope at the boundary (see photometric_gradient).
POLARGUIDE_INLINE void show(vf x, vf *value, vf *slope) {
    vf u = clamp(x, vf{}, splat(1.0f));
    vf safe = max(u, splat(0.0031308f));
    vf power = exp2(log2_of(safe) * (1.0f / 2.4f)) * 1.055f;
    vi dark = u <= splat(0.0031308f);
    *value = dark ? u * 12.92f : power - 0.055f;
    *slope = dark ? splat(12.92f) : power / (safe * 2.4f);
}

POLARGUIDE_INLINE int64_t plane(const PhotometricArgs &a, int channel) { return int64_t(channel) * a.width * a.height; }

// out[x] = sum of taps over in[x - 5 .. x + 5], zero outside [0, width).
POLARGUIDE_INLINE void blur_row(const float *padded, float *out, int width) {
    int x = 0;
    for (; x + lanes <= width; x += lanes) {
        vf sum = vf{};
        for (int t = 0; t < 11; ++t) sum += load(padded + x + t) * tap[t];
        store(out + x, sum);
    }
    for (; x < width; ++x) {
        float sum = 0.0f;
        for (int t = 0; t < 11; ++t) sum += padded[x + t] * tap[t];
        out[x] = sum;
    }
}

// The vertical blur of a plane at sixteen columns of row y.
POLARGUIDE_INLINE vf blur_column(const float *rows, int64_t stride, int y, int height) {
    vf sum = vf{};
    const int first = y < reach ? reach - y : 0, last = y + reach >= height ? height - 1 - y + reach : 10;
    for (int t = first; t <= last; ++t) sum += load(rows + (y + t - reach) * stride) * tap[t];
    return sum;
}

} // namespace

void photometric_show(const PhotometricArgs &a, int64_t begin, int64_t end) {
    float line[5][4096 + 2 * lanes];
    const int w = a.width;
    for (int64_t y = begin; y < end; ++y) {
        double l1 = 0.0;
        for (int c = 0; c < 3; ++c) {
            float *shown = a.shown + plane(a, c) + y * w, *slope = a.slope + plane(a, c) + y * w;
            float *goal = a.goal + plane(a, c) + y * w;
            const float *p = a.prediction + y * w * 3 + c, *t = a.target + y * w * 3 + c;
            for (int x = 0; x < w; x += lanes) {
                alignas(64) float in[lanes] = {0}, v[lanes], s[lanes];
                const int n = w - x < lanes ? w - x : lanes;
                for (int l = 0; l < n; ++l) in[l] = p[3 * (x + l)];
                vf value, derivative;
                show(load(in), &value, &derivative);
                store(v, value), store(s, derivative);
                for (int l = 0; l < n; ++l) {
                    shown[x + l] = v[l], slope[x + l] = s[l], goal[x + l] = t[3 * (x + l)];
                    l1 += double(a.weight ? a.weight[y * w + x + l] : 1.0f) * double(fabsf(v[l] - t[3 * (x + l)]));
                }
            }
            for (int k = 0; k < 5; ++k)
                for (int x = 0; x < reach; ++x) line[k][x] = line[k][reach + w + x] = 0.0f;
            for (int x = 0; x < w; ++x) {
                const float u = shown[x], v = goal[x];
                line[0][reach + x] = u, line[1][reach + x] = v;
                line[2][reach + x] = u * u, line[3][reach + x] = v * v, line[4][reach + x] = u * v;
            }
            for (int k = 0; k < 5; ++k) blur_row(line[k], a.rows[k] + plane(a, c) + y * w, w);
        }
        a.row_l1[y] = l1;
    }
}

void photometric_statistics(const PhotometricArgs &a, int64_t begin, int64_t end) {
    const int w = a.width, h = a.height;
    for (int64_t y = begin; y < end; ++y) {
        double total = 0.0;
        for (int c = 0; c < 3; ++c)
            for (int x = 0; x < w; x += lanes) {
                const int64_t at = plane(a, c) + x, here = at + y * w;
                vf m[5];
                for (int k = 0; k < 5; ++k) m[k] = blur_column(a.rows[k] + at, w, int(y), h);
                vf a1 = m[0] * m[1] * 2.0f + c1, a2 = (m[4] - m[0] * m[1]) * 2.0f + c2;
                vf b1 = m[0] * m[0] + m[1] * m[1] + c1;
                vf b2 = (m[2] - m[0] * m[0]) + (m[3] - m[1] * m[1]) + c2;
                vf inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
                vf by_xy = a1 * inverse * 2.0f, by_xx = -s / b2;
                vf by_mean = m[1] * a2 * inverse * 2.0f - s * m[0] * 2.0f / b1 - by_xx * m[0] * 2.0f - by_xy * m[1];
                alignas(64) float values[4][lanes];
                store(values[0], by_mean), store(values[1], by_xx), store(values[2], by_xy), store(values[3], s);
                const int n = w - x < lanes ? w - x : lanes;
                for (int l = 0; l < n; ++l) {
                    const float weight = a.weight ? a.weight[y * w + x + l] : 1.0f;
                    for (int k = 0; k < 3; ++k) a.parts[k][here + l] = values[k][l] * weight;
                    total += double(weight * values[3][l]);
                }
            }
        a.row_ssim[y] = total;
    }
}

void photometric_spread(const PhotometricArgs &a, int64_t begin, int64_t end) {
    float line[4096 + 2 * lanes];
    const int w = a.width;
    for (int64_t y = begin; y < end; ++y)
        for (int c = 0; c < 3; ++c)
            for (int k = 0; k < 3; ++k) {
                const float *in = a.parts[k] + plane(a, c) + y * w;
                for (int x = 0; x < reach; ++x) line[x] = line[reach + w + x] = 0.0f;
                for (int x = 0; x < w; ++x) line[reach + x] = in[x];
                blur_row(line, a.rows[k] + plane(a, c) + y * w, w);
            }
}

void photometric_gradient(const PhotometricArgs &a, int64_t begin, int64_t end) {
    const int w = a.width, h = a.height;
    const float for_l1 = (1.0f - a.ssim_weight) * a.inverse_count, for_ssim = -a.ssim_weight * a.inverse_count;
    for (int64_t y = begin; y < end; ++y)
        for (int c = 0; c < 3; ++c)
            for (int x = 0; x < w; x += lanes) {
                const int64_t at = plane(a, c) + x, here = at + y * w;
                vf part[3];
                for (int k = 0; k < 3; ++k) part[k] = blur_column(a.rows[k] + at, w, int(y), h);
                vf shown = load(a.shown + here), goal = load(a.goal + here), slope = load(a.slope + here);
                vf difference = shown - goal;
                vf sign = difference > vf{} ? splat(1.0f) : difference < vf{} ? splat(-1.0f) : vf{};
                alignas(64) float l1[lanes], ssim[lanes], slopes[lanes];
                store(l1, sign * for_l1);
                store(ssim, (part[0] + shown * part[1] * 2.0f + goal * part[2]) * for_ssim);
                store(slopes, slope);
                const int n = w - x < lanes ? w - x : lanes;
                for (int l = 0; l < n; ++l) {
                    const int64_t pixel = (y * w + x + l) * 3 + c;
                    const float weight = a.weight ? a.weight[y * w + x + l] : 1.0f;
                    const float g = l1[l] * weight + ssim[l], p = a.prediction[pixel];
                    // Outside [0, 1] only a gradient that brings the value back passes.
                    const bool stuck = (p < 0.0f && g > 0.0f) || (p > 1.0f && g < 0.0f);
                    a.gradient[pixel] = stuck ? 0.0f : g * slopes[l];
                }
            }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
