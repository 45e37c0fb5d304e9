// Spherical harmonics to degree 3 in the order and with the signs of the 3DGS release, sixteen Gaussians at a time.
#include "gaussians.h"
#include "simd.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr int rest_values = 45; // fifteen coefficients, three channels
// As in src/polarguide/gaussians/harmonics.py.
constexpr float sh0 = 0.28209479f, sh1 = 0.48860251f;
constexpr float sh2[5] = {1.09254843f, -1.09254843f, 0.31539157f, -1.09254843f, 0.54627422f};
constexpr float sh3[7] = {-0.59004359f, 2.89061144f, -0.45704580f, 0.37317633f, -0.45704580f, 1.44530572f, -0.59004359f};

// Columns of `rest` that a degree reads and writes: tiles of sixteen, which may overlap but stay within the row.
template <int D> struct Columns;
template <> struct Columns<0> {
    static constexpr int used = 0, tiles = 0, first[1] = {0};
};
template <> struct Columns<1> {
    static constexpr int used = 3, tiles = 1, first[1] = {0};
};
template <> struct Columns<2> {
    static constexpr int used = 8, tiles = 2, first[2] = {0, 8};
};
template <> struct Columns<3> {
    static constexpr int used = 15, tiles = 3, first[3] = {0, 16, 29};
};

// Basis functions 1.. at unit directions.
template <int D> POLARGUIDE_INLINE void basis(vf x, vf y, vf z, vf *b) {
    if (D < 1) return;
    b[0] = y * -sh1, b[1] = z * sh1, b[2] = x * -sh1;
    if (D < 2) return;
    const vf xx = x * x, yy = y * y, zz = z * z;
    b[3] = x * y * sh2[0], b[4] = y * z * sh2[1], b[5] = (zz * 2.0f - xx - yy) * sh2[2];
    b[6] = x * z * sh2[3], b[7] = (xx - yy) * sh2[4];
    if (D < 3) return;
    b[8] = y * (xx * 3.0f - yy) * sh3[0], b[9] = x * y * z * sh3[1], b[10] = y * (zz * 4.0f - xx - yy) * sh3[2];
    b[11] = z * (zz * 2.0f - xx * 3.0f - yy * 3.0f) * sh3[3], b[12] = x * (zz * 4.0f - xx - yy) * sh3[4];
    b[13] = z * (xx - yy) * sh3[5], b[14] = x * (xx - yy * 3.0f) * sh3[6];
}

// Computes the gradient of sum_k s[k] * basis_k with respect to the direction.
template <int D> POLARGUIDE_INLINE void basis_gradient(vf x, vf y, vf z, const vf *s, vf *g) {
    g[0] = s[2] * -sh1, g[1] = s[0] * -sh1, g[2] = s[1] * sh1;
    if (D < 2) return;
    const vf s3 = s[3] * sh2[0], s4 = s[4] * sh2[1], s5 = s[5] * (2 * sh2[2]), s6 = s[6] * sh2[3], s7 = s[7] * (2 * sh2[4]);
    g[0] += y * s3 - x * s5 + z * s6 + x * s7;
    g[1] += x * s3 + z * s4 - y * s5 - y * s7;
    g[2] += y * s4 + z * s5 * 2.0f + x * s6;
    if (D < 3) return;
    const vf xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const vf s8 = s[8] * (3 * sh3[0]), s9 = s[9] * sh3[1], s10 = s[10] * sh3[2], s11 = s[11] * (3 * sh3[3]);
    const vf s12 = s[12] * sh3[4], s13 = s[13] * sh3[5], s14 = s[14] * (3 * sh3[6]);
    g[0] += xy * s8 * 2.0f + yz * s9 - xy * s10 * 2.0f - xz * s11 * 2.0f + (zz * 4.0f - xx * 3.0f - yy) * s12 +
            xz * s13 * 2.0f + (xx - yy) * s14;
    g[1] += (xx - yy) * s8 + xz * s9 + (zz * 4.0f - xx - yy * 3.0f) * s10 - yz * s11 * 2.0f - xy * s12 * 2.0f -
            yz * s13 * 2.0f - xy * s14 * 2.0f;
    g[2] += xy * s9 + yz * s10 * 8.0f + (zz * 2.0f - xx - yy) * s11 + xz * s12 * 8.0f + (xx - yy) * s13;
}

// Prefetches the rows of `rest` two blocks of sixteen ahead (1: for writing). A transposition needs the 45 cache lines of a
// block at once, which the processor does not predict.
template <int Write> POLARGUIDE_INLINE void ask_ahead(const float *rest) {
    constexpr int block = lanes * rest_values;
    for (int i = 2 * block; i < 3 * block; i += 16) __builtin_prefetch(rest + i, Write);
}

// Transposes the used columns of sixteen rows of `rest` to vectors and back. `spare` has sixteen rows for a last, short block.
template <int D> POLARGUIDE_INLINE void load_rest(const float *rest, int n, float *spare, float *columns) {
    if (n < lanes) {
        for (int i = 0; i < n * rest_values; ++i) spare[i] = rest[i];
        for (int i = n * rest_values; i < lanes * rest_values; ++i) spare[i] = 0.0f;
        rest = spare;
    }
    ask_ahead<0>(rest);
    for (int t = 0; t < Columns<D>::tiles; ++t) {
        const int first = Columns<D>::first[t];
        transpose16(rest + first, rest_values, columns + first * lanes, lanes);
    }
}
template <int D> POLARGUIDE_INLINE void store_rest(float *rest, int n, bool streams, float *spare, const float *columns) {
    float *out = n < lanes || streams ? spare : rest;
    if (!streams) ask_ahead<1>(rest);
    for (int t = 0; t < Columns<D>::tiles; ++t) {
        const int first = Columns<D>::first[t];
        transpose16(columns + first * lanes, lanes, out + first, rest_values);
    }
    constexpr int kept = Columns<D>::used * 3;
    for (int l = 0; l < lanes && kept < rest_values; ++l)
        for (int i = kept; i < rest_values; ++i) out[l * rest_values + i] = 0.0f;
    if (n < lanes)
        for (int i = 0; i < n * rest_values; ++i) rest[i] = spare[i];
    else if (streams)
        for (int i = 0; i < lanes * rest_values; i += lanes) stream(rest + i, load(spare + i));
}

// Computes unit directions from the center, zero for a Gaussian at the center. Returns 1 / distance.
POLARGUIDE_INLINE vf directions(const HarmonicsArgs &a, int64_t first, int n, vf *d) {
    load_columns<3>(a.means + 3 * first, n, d);
    for (int i = 0; i < 3; ++i) d[i] -= a.center[i];
    const vf squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    const vf inverse = squared <= 1e-24f ? vf{} : 1.0f / square_root(squared);
    for (int i = 0; i < 3; ++i) d[i] *= inverse;
    return inverse;
}

template <int D> void forward(const HarmonicsArgs &a, int64_t begin, int64_t end) {
    alignas(64) float columns[48 * lanes], spare[lanes * rest_values];
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = end - first < lanes ? int(end - first) : lanes;
        vf out[3];
        load_columns<3>(a.dc + 3 * first, n, out);
        for (int c = 0; c < 3; ++c) out[c] *= sh0;
        if (D > 0) {
            vf d[3], b[15];
            directions(a, first, n, d);
            basis<D>(d[0], d[1], d[2], b);
            load_rest<D>(a.rest + rest_values * first, n, spare, columns);
            for (int k = 0; k < Columns<D>::used; ++k)
                for (int c = 0; c < 3; ++c) out[c] += b[k] * load(columns + (3 * k + c) * lanes);
        }
        store_columns<3>(a.out + 3 * first, n, out);
    }
}

template <int D> void backward(const HarmonicsArgs &a, int64_t begin, int64_t end) {
    const bool streams = a.streams && a.grad_rest && reinterpret_cast<uintptr_t>(a.grad_rest + rest_values * begin) % 64 == 0;
    alignas(64) float columns[48 * lanes], spare[lanes * rest_values];
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = end - first < lanes ? int(end - first) : lanes;
        vf g[3], to_dc[3], to_means[3] = {};
        load_columns<3>(a.grad_out + 3 * first, n, g);
        for (int c = 0; c < 3; ++c) to_dc[c] = g[c] * sh0;
        if (D > 0) {
            vf d[3], b[15];
            const vf inverse = directions(a, first, n, d);
            if (a.grad_means) {
                vf s[15], by_direction[3];
                load_rest<D>(a.rest + rest_values * first, n, spare, columns);
                for (int k = 0; k < Columns<D>::used; ++k) {
                    const float *at = columns + 3 * k * lanes;
                    s[k] = load(at) * g[0] + load(at + lanes) * g[1] + load(at + 2 * lanes) * g[2];
                }
                basis_gradient<D>(d[0], d[1], d[2], s, by_direction);
                const vf along = by_direction[0] * d[0] + by_direction[1] * d[1] + by_direction[2] * d[2];
                for (int i = 0; i < 3; ++i) to_means[i] = (by_direction[i] - along * d[i]) * inverse;
            }
            if (a.grad_rest) {
                basis<D>(d[0], d[1], d[2], b);
                for (int k = 0; k < Columns<D>::used; ++k)
                    for (int c = 0; c < 3; ++c) store(columns + (3 * k + c) * lanes, b[k] * g[c]);
            }
        }
        store_columns<3>(a.grad_dc + 3 * first, n, to_dc);
        if (a.grad_means) store_columns<3>(a.grad_means + 3 * first, n, to_means);
        if (a.grad_rest) store_rest<D>(a.grad_rest + rest_values * first, n, streams, spare, columns);
    }
    if (streams) end_stream();
}

} // namespace

void harmonics_forward(const HarmonicsArgs &a, int64_t begin, int64_t end) {
    (a.degree == 0   ? forward<0>
     : a.degree == 1 ? forward<1>
     : a.degree == 2 ? forward<2>
                     : forward<3>)(a, begin, end);
}

void harmonics_backward(const HarmonicsArgs &a, int64_t begin, int64_t end) {
    (a.degree == 0   ? backward<0>
     : a.degree == 1 ? backward<1>
     : a.degree == 2 ? backward<2>
                     : backward<3>)(a, begin, end);
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
