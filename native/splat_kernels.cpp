// Input of a rasterizer from the parameters of Gaussians (rows of features, scales and opacities), and its gradient.
#include "gaussians.h"
#include "raster.h"
#include "simd.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float log2_e = 1.44269504f, largest = 83.0f; // e^83 is about the maximum of exp2

// NaN stays; too large values become infinite, as for any exponential.
POLARGUIDE_INLINE reg exponential(reg x) {
    const reg bounded = x < -largest ? reg_splat(-largest) : x > largest ? reg_splat(largest) : x;
    const reg value = exp2(bounded * log2_e);
    return x != x ? x : x > largest ? reg_splat(__builtin_inff()) : value;
}
POLARGUIDE_INLINE reg logistic(reg x) {
    const reg bounded = x < -80.0f ? reg_splat(-80.0f) : x > 80.0f ? reg_splat(80.0f) : x;
    const reg value = 1.0f / (1.0f + exp2(bounded * -log2_e));
    return x != x ? x : value;
}

// Features of sixteen Gaussians as columns, and their rows. A row is written in vectors of sixteen floats. Floats beyond its
// end belong to the next row, which is written later. At most `room` floats are touched.
struct Columns {
    static constexpr int tiles = (max_channels + lanes - 1) / lanes;
    alignas(64) float value[tiles * lanes * lanes];

    float *at(int channel) { return value + lanes * channel; }

    void store_rows(int channels, int n, int64_t room, float *rows) const {
        alignas(64) float turned[tiles][lanes * lanes];
        const int used = (channels + lanes - 1) / lanes;
        for (int t = 0; t < used; ++t) transpose16(value + lanes * lanes * t, turned[t]);
        for (int l = 0; l < n; ++l)
            for (int t = 0; t < used; ++t) {
                const int64_t to = int64_t(channels) * l + lanes * t;
                const float *from = turned[t] + lanes * l;
                if (to + lanes <= room) store(rows + to, load(from));
                else
                    for (int k = 0; k < lanes && lanes * t + k < channels; ++k) rows[to + k] = from[k];
            }
    }
    void load_rows(int channels, int n, int64_t room, const float *rows) {
        alignas(64) float spare[lanes * max_channels];
        int64_t stride = channels;
        const int used = (channels + lanes - 1) / lanes;
        if (stride * (lanes - 1) + lanes * used > room || n < lanes) {
            for (int l = 0; l < lanes; ++l)
                for (int k = 0; k < max_channels; ++k)
                    spare[max_channels * l + k] = l < n && k < channels ? rows[stride * l + k] : 0.0f;
            rows = spare, stride = max_channels;
        }
        for (int t = 0; t < used; ++t) transpose16(rows + lanes * t, stride, value + lanes * lanes * t, lanes);
    }
};

// First feature of each kind in a row; -1 without this kind.
struct Layout {
    int normals, strength, light, further, depth;
};
POLARGUIDE_INLINE Layout layout_of(const SplatArgs &a) {
    int next = 3;
    const auto take = [&next](bool given, int count) {
        const int first = given ? next : -1;
        next += given ? count : 0;
        return first;
    };
    Layout l;
    l.normals = take(a.normals || a.to_normals, 3);
    l.strength = take(a.strength_logits, 1);
    l.light = take(a.light || a.to_light, 3);
    l.further = take(a.further_channels > 0, a.further_channels);
    l.depth = take(a.forward, 1);
    return l;
}

// Loads 3 columns from rows of a compact array, for registers smaller than a block.
POLARGUIDE_INLINE void spread3(const float *rows, int n, float *columns, int from) {
    reg c[3];
    load_columns<3>(rows, n, c);
    for (int k = 0; k < 3; ++k) reg_store(columns + lanes * k + from, c[k]);
}
POLARGUIDE_INLINE void gather3(const float *columns, int from, int n, float *rows) {
    const reg c[3] = {reg_load(columns + from), reg_load(columns + lanes + from), reg_load(columns + 2 * lanes + from)};
    store_columns<3>(rows, n, c);
}
POLARGUIDE_INLINE reg load1(const float *values, int n) {
    reg c[1];
    load_columns<1>(values, n, c);
    return c[0];
}
POLARGUIDE_INLINE void store1(float *values, int n, reg x) { store_columns<1>(values, n, &x); }

POLARGUIDE_INLINE reg body_of(const SplatArgs &a, int64_t i, int n) {
    return a.metalness ? 1.0f - load1(a.metalness + i, n) : reg_splat(1.0f);
}

} // namespace

void splat_assemble(const SplatArgs &a, int64_t begin, int64_t end) {
    const Layout at = layout_of(a);
    Columns c;
    for (int64_t first = begin; first < end; first += lanes) {
        const int rows = end - first < lanes ? int(end - first) : lanes;
        for (int r = 0; r < rows; r += reg_lanes) {
            const int64_t i = first + r;
            const int n = rows - r < reg_lanes ? rows - r : reg_lanes;
            const reg body = body_of(a, i, n);
            reg x[3];
            load_columns<3>(a.color + 3 * i, n, x);
            for (int k = 0; k < 3; ++k) {
                const reg sum = x[k] + 0.5f;
                // A clamped color is a negative zero, which gets no gradient.
                reg_store(c.at(k) + r, (sum < 0.0f ? -reg{} : sum) * body);
            }
            if (at.normals >= 0) spread3(a.normals + 3 * i, n, c.at(at.normals), r);
            if (at.strength >= 0) reg_store(c.at(at.strength) + r, logistic(load1(a.strength_logits + i, n)) * body);
            if (at.light >= 0) spread3(a.light + 3 * i, n, c.at(at.light), r);
            if (at.depth >= 0) {
                load_columns<3>(a.means + 3 * i, n, x);
                reg depth = {};
                for (int k = 0; k < 3; ++k) depth += (x[k] - a.center[k]) * a.forward[k];
                reg_store(c.at(at.depth) + r, depth);
            }
            load_columns<3>(a.log_scales + 3 * i, n, x);
            for (reg &scale : x) scale = exponential(scale);
            store_columns<3>(a.scales + 3 * i, n, x);
            store1(a.opacities + i, n, logistic(load1(a.opacity_logits + i, n)));
        }
        for (int k = 0; k < a.further_channels; ++k)
            for (int l = 0; l < rows; ++l) c.at(at.further + k)[l] = a.further[a.further_channels * (first + l) + k];
        c.store_rows(a.channels, rows, (end - first) * a.channels, a.features + a.channels * first);
    }
}

void splat_split(const SplatArgs &a, int64_t begin, int64_t end) {
    const Layout at = layout_of(a);
    Columns g, shown;
    for (int64_t first = begin; first < end; first += lanes) {
        const int rows = end - first < lanes ? int(end - first) : lanes;
        const int64_t room = (end - first) * a.channels;
        g.load_rows(a.channels, rows, room, a.grad_features + a.channels * first);
        shown.load_rows(a.channels, rows, room, a.features + a.channels * first);
        for (int r = 0; r < rows; r += reg_lanes) {
            const int64_t i = first + r;
            const int n = rows - r < reg_lanes ? rows - r : reg_lanes;
            const reg body = body_of(a, i, n);
            for (int k = 0; k < 3; ++k) {
                const ireg sign = (ireg)reg_load(shown.at(k) + r) < 0;
                reg_store(g.at(k) + r, sign ? reg{} : reg_load(g.at(k) + r) * body);
            }
            gather3(g.at(0), r, n, a.to_color + 3 * i);
            if (at.normals >= 0) gather3(g.at(at.normals), r, n, a.to_normals + 3 * i);
            if (at.light >= 0) gather3(g.at(at.light), r, n, a.to_light + 3 * i);
            if (at.depth >= 0) store1(a.to_depth + i, n, reg_load(g.at(at.depth) + r));
            if (at.strength >= 0) {
                const reg s = logistic(load1(a.strength_logits + i, n));
                store1(a.to_strength_logits + i, n, reg_load(g.at(at.strength) + r) * body * s * (1.0f - s));
            }
        }
        for (int k = 0; k < a.further_channels; ++k)
            for (int l = 0; l < rows; ++l) a.to_further[a.further_channels * (first + l) + k] = g.at(at.further + k)[l];
    }
}

void splat_join(const SplatArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = end - i < reg_lanes ? int(end - i) : reg_lanes;
        reg sum[4], part[4];
        load_columns<3>(a.grad_means + 3 * i, n, sum);
        load_columns<3>(a.by_color + 3 * i, n, part);
        const reg depth = a.to_depth ? load1(a.to_depth + i, n) : reg{};
        for (int k = 0; k < 3; ++k) sum[k] += part[k] + (a.to_depth ? depth * a.forward[k] : reg{});
        store_columns<3>(a.to_means + 3 * i, n, sum);
        load_columns<4>(a.grad_quaternions + 4 * i, n, sum);
        if (a.by_normals) {
            load_columns<4>(a.by_normals + 4 * i, n, part);
            for (int k = 0; k < 4; ++k) sum[k] += part[k];
        }
        store_columns<4>(a.to_quaternions + 4 * i, n, sum);
        load_columns<3>(a.grad_scales + 3 * i, n, sum);
        load_columns<3>(a.scales + 3 * i, n, part);
        for (int k = 0; k < 3; ++k) sum[k] *= part[k];
        store_columns<3>(a.to_log_scales + 3 * i, n, sum);
        const reg opacity = load1(a.opacities + i, n);
        store1(a.to_opacity_logits + i, n, load1(a.grad_opacities + i, n) * opacity * (1.0f - opacity));
    }
}

namespace {

POLARGUIDE_INLINE reg shortest_of(const ShortestArgs &a, int64_t i, int n, ireg *first, ireg *second) {
    reg s[3];
    load_columns<3>(a.log_scales + 3 * i, n, s);
    *first = (s[0] <= s[1]) & (s[0] <= s[2]), *second = ~*first & (s[1] <= s[2]);
    const reg least = *first ? s[0] : *second ? s[1] : s[2];
    return load1(a.radii + i, n) > 0.0f ? exponential(least) : reg{};
}

} // namespace

void shortest_sum(const ShortestArgs &a, int64_t begin, int64_t end, double *sum, double *count) {
    reg total = {}, seen = {};
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = end - i < reg_lanes ? int(end - i) : reg_lanes;
        ireg first, second;
        total += shortest_of(a, i, n, &first, &second);
        seen += load1(a.radii + i, n) > 0.0f ? reg_splat(1.0f) : reg{};
    }
    for (int l = 0; l < reg_lanes; ++l) *sum += double(total[l]), *count += double(seen[l]);
}

void shortest_gradient(const ShortestArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = end - i < reg_lanes ? int(end - i) : reg_lanes;
        ireg first, second;
        const reg value = shortest_of(a, i, n, &first, &second) * a.factor;
        const reg to[3] = {first ? value : reg{}, second ? value : reg{}, first | second ? reg{} : value};
        store_columns<3>(a.gradient + 3 * i, n, to);
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
