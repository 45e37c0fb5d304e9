// Photometric loss: sRGB, L1 and SSIM of a picture, and the gradient with respect to the linear prediction.
//
// Rows are interleaved (red, green, blue, red, ...), so a horizontal tap is three floats away. SSIM needs the blurred moments
// x, y, xx + yy and xy. The vertical blur of a row computes the products, so no picture of them is stored.
#include "image.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr int reach = 5, taps = 11, moments = 4, colors = 3;
constexpr float tap[taps] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                             0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
constexpr float c1 = 0.0001f, c2 = 0.0009f; // (0.01)^2 and (0.03)^2 for a range of 1
constexpr float knee = 0.0031308f;          // sRGB is linear below

// sRGB of the clipped value, exactly 1 for saturated values, so that the loss of a saturated target is 0. NaN stays NaN.
POLARGUIDE_INLINE reg show(reg x) {
    const reg u = clamp(x, reg{}, reg_splat(1.0f));
    const reg curved = exp2(log2(max(u, reg_splat(knee))) * (1.0f / 2.4f)) * 1.055f - 0.055f;
    const reg value = u <= knee ? u * 12.92f : u == 1.0f ? u : curved;
    return x != x ? x : value;
}

// Slope of sRGB at the clipped value, computed from its sRGB.
POLARGUIDE_INLINE reg slope_of(reg x, reg shown) {
    const reg u = clamp(x, reg{}, reg_splat(1.0f));
    return u <= knee ? reg_splat(12.92f) : (shown + 0.055f) * reciprocal(max(u, reg_splat(knee)) * 2.4f);
}

// The last vector of a row may be short; missing lanes are zero.
POLARGUIDE_INLINE reg load_some(const float *p, int64_t n) {
    if (n >= reg_lanes) return reg_load(p);
    alignas(64) float t[reg_lanes] = {};
    for (int64_t l = 0; l < n; ++l) t[l] = p[l];
    return reg_load(t);
}
POLARGUIDE_INLINE void store_some(float *p, int64_t n, reg x) {
    if (n >= reg_lanes) return reg_store(p, x);
    alignas(64) float t[reg_lanes];
    reg_store(t, x);
    for (int64_t l = 0; l < n; ++l) p[l] = t[l];
}

POLARGUIDE_INLINE double sum_of(reg x) {
    double sum = 0.0;
    for (int l = 0; l < reg_lanes; ++l) sum += double(x[l]);
    return sum;
}

// Weights of row y, repeated for each color; zero in the padding.
POLARGUIDE_INLINE void spread_weights(const PhotometricArgs &a, int64_t y, float *line) {
    for (int x = 0; x < a.width; ++x)
        for (int c = 0; c < colors; ++c) line[colors * x + c] = a.weight ? a.weight[y * a.width + x] : 1.0f;
    for (int64_t x = int64_t(colors) * a.width; x < a.stride; ++x) line[x] = 0.0f;
}

// Scratch of a worker: lines with a margin of zeros for the taps on both sides.
struct Lines {
    float *line[moments], *blurred[moments], *weight;
};
POLARGUIDE_INLINE Lines lay_out(const PhotometricArgs &a, float *scratch) {
    const int64_t room = a.stride + 2 * photometric_margin;
    Lines l;
    for (int k = 0; k < moments; ++k) {
        float *start = scratch + k * room;
        for (int i = 0; i < photometric_margin; ++i) start[i] = start[photometric_margin + a.stride + i] = 0.0f;
        l.line[k] = start + photometric_margin;
        l.blurred[k] = scratch + (moments + k) * room;
    }
    l.weight = scratch + 2 * moments * room;
    return l;
}

// Rows of the window within the picture: y - reach + first .. y - reach + last.
struct Window {
    int first, last;
};
POLARGUIDE_INLINE Window window_of(int64_t y, int height) {
    return {y < reach ? int(reach - y) : 0, y + reach >= height ? int(height - 1 - y) + reach : taps - 1};
}

// Vertical blur of the four moments of row y.
void blur_moments(const PhotometricArgs &a, int64_t y, const Lines &l) {
    const Window w = window_of(y, a.height);
    for (int64_t x = 0; x < a.stride; x += reg_lanes) {
        const float *px = a.shown + (y - reach + w.first) * a.stride + x, *py = a.goal + (px - a.shown);
        reg mx = {}, my = {}, squares = {}, product = {};
        for (int t = w.first; t <= w.last; ++t, px += a.stride, py += a.stride) {
            const reg u = reg_load(px), v = reg_load(py), tu = u * tap[t], tv = v * tap[t];
            mx += tu, my += tv;
            squares += tu * u, squares += tv * v;
            product += tu * v;
        }
        reg_store(l.line[0] + x, mx), reg_store(l.line[1] + x, my), reg_store(l.line[2] + x, squares), reg_store(l.line[3] + x, product);
    }
}

// Vertical blur of the three derivatives at row y.
void blur_parts(const PhotometricArgs &a, int64_t y, const Lines &l) {
    const Window w = window_of(y, a.height);
    for (int64_t x = 0; x < a.stride; x += reg_lanes) {
        const int64_t top = (y - reach + w.first) * a.stride + x;
        const float *p0 = a.parts[0] + top, *p1 = a.parts[1] + top, *p2 = a.parts[2] + top;
        reg s0 = {}, s1 = {}, s2 = {};
        for (int t = w.first; t <= w.last; ++t, p0 += a.stride, p1 += a.stride, p2 += a.stride)
            s0 += reg_load(p0) * tap[t], s1 += reg_load(p1) * tap[t], s2 += reg_load(p2) * tap[t];
        reg_store(l.line[0] + x, s0), reg_store(l.line[1] + x, s1), reg_store(l.line[2] + x, s2);
    }
}

void blur_line(const float *line, float *out, int64_t stride) {
    for (int64_t x = 0; x < stride; x += reg_lanes) {
        reg sum = reg_load(line + x) * tap[reach];
        for (int t = 1; t <= reach; ++t)
            sum += (reg_load(line + x - colors * t) + reg_load(line + x + colors * t)) * tap[reach + t];
        reg_store(out + x, sum);
    }
}

} // namespace

void photometric_show(const PhotometricArgs &a, int64_t begin, int64_t end, float *scratch) {
    const int64_t used = int64_t(colors) * a.width;
    const Lines l = lay_out(a, scratch);
    for (int64_t y = begin; y < end; ++y) {
        if (a.weight || y == begin) spread_weights(a, y, l.weight);
        reg sum = {}, squares = {};
        for (int64_t x = 0; x < a.stride; x += reg_lanes) {
            const reg value = show(load_some(a.prediction + y * used + x, used - x));
            const reg goal = load_some(a.target + y * used + x, used - x), d = value - goal;
            reg_store(a.shown + y * a.stride + x, value), reg_store(a.goal + y * a.stride + x, goal);
            const reg weight = reg_load(l.weight + x);
            sum += (d < reg{} ? -d : d) * weight, squares += d * d * weight;
        }
        a.row_l1[y] = sum_of(sum), a.row_squares[y] = sum_of(squares);
    }
}

void photometric_statistics(const PhotometricArgs &a, int64_t begin, int64_t end, float *scratch) {
    const Lines l = lay_out(a, scratch);
    for (int64_t y = begin; y < end; ++y) {
        if (a.weight || y == begin) spread_weights(a, y, l.weight);
        blur_moments(a, y, l);
        for (int k = 0; k < moments; ++k) blur_line(l.line[k], l.blurred[k], a.stride);
        reg sum = reg{};
        for (int64_t x = 0; x < a.stride; x += reg_lanes) {
            const reg mx = reg_load(l.blurred[0] + x), my = reg_load(l.blurred[1] + x), weight = reg_load(l.weight + x);
            const reg both = mx * my, a1 = both * 2.0f + c1, a2 = (reg_load(l.blurred[3] + x) - both) * 2.0f + c2;
            const reg means = mx * mx + my * my, b1 = means + c1, b2 = reg_load(l.blurred[2] + x) - means + c2;
            const reg inverse = reciprocal(b1 * b2), s = a1 * a2 * inverse;
            const reg by_xy = a1 * inverse * 2.0f, by_xx = -s * b1 * inverse; // -s / b2
            const reg by_mean = (my * (a2 - a1) * inverse - s * mx * b2 * inverse - by_xx * mx) * 2.0f;
            const auto left_out = weight == 0.0f; // also prevents NaN in the padding
            sum += left_out ? reg{} : s * weight;
            if (!a.gradient) continue;
            const int64_t at = y * a.stride + x;
            reg_store(a.parts[0] + at, left_out ? reg{} : by_mean * weight);
            reg_store(a.parts[1] + at, left_out ? reg{} : by_xx * weight);
            reg_store(a.parts[2] + at, left_out ? reg{} : by_xy * weight);
        }
        a.row_ssim[y] = sum_of(sum);
    }
}

void photometric_gradient(const PhotometricArgs &a, int64_t begin, int64_t end, float *scratch) {
    const int64_t used = int64_t(colors) * a.width;
    const reg for_l1 = reg_splat((1.0f - a.ssim_weight) * a.inverse_count), for_ssim = reg_splat(-a.ssim_weight * a.inverse_count);
    const Lines l = lay_out(a, scratch);
    for (int64_t y = begin; y < end; ++y) {
        if (a.weight || y == begin) spread_weights(a, y, l.weight);
        blur_parts(a, y, l);
        for (int k = 0; k < 3; ++k) blur_line(l.line[k], l.blurred[k], a.stride);
        for (int64_t x = 0; x < a.stride && x < used; x += reg_lanes) {
            const reg shown = reg_load(a.shown + y * a.stride + x), goal = reg_load(a.goal + y * a.stride + x);
            const reg d = shown - goal, pull = d > reg{} ? for_l1 : d < reg{} ? -for_l1 : reg{};
            const reg spread = reg_load(l.blurred[0] + x) + shown * reg_load(l.blurred[1] + x) * 2.0f + goal * reg_load(l.blurred[2] + x);
            const reg g = pull * reg_load(l.weight + x) + spread * for_ssim;
            const reg p = load_some(a.prediction + y * used + x, used - x);
            // Outside [0, 1] only a gradient toward the range passes.
            const auto stuck = ((p < 0.0f) & (g > 0.0f)) | ((p > 1.0f) & (g < 0.0f));
            store_some(a.gradient + y * used + x, used - x, stuck ? reg{} : g * slope_of(p, shown));
        }
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
