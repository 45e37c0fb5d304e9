// Sixteen-lane vectors with GNU vector types: one source for all instruction sets. The compiler splits a vector into the
// registers of the target (one on AVX-512, two on AVX2, four on SSE2 and NEON).
#pragma once
#include <stdint.h>

#if defined(__SSE2__)
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized" // GCC 12 warns about its own "undefined" vectors
#pragma GCC diagnostic ignored "-Wuninitialized"
#endif
#include <immintrin.h>
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic pop
#endif
#endif

#define POLARGUIDE_INLINE static inline __attribute__((always_inline))

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr int lanes = 16;
typedef float vf __attribute__((vector_size(64), may_alias));
typedef float vf_unaligned __attribute__((vector_size(64), aligned(4), may_alias));
typedef float v4f __attribute__((vector_size(16), aligned(4), may_alias));

POLARGUIDE_INLINE vf splat(float x) { return vf{} + x; }
POLARGUIDE_INLINE vf load(const float *p) { return *reinterpret_cast<const vf_unaligned *>(p); }
POLARGUIDE_INLINE void store(float *p, vf x) { *reinterpret_cast<vf_unaligned *>(p) = x; }
// Writes to memory without using the caches, if the processor supports it, for data larger than the caches. `p` is a multiple
// of 64 bytes. Call `end_stream` before another thread reads the data.
POLARGUIDE_INLINE void stream(float *p, vf x) {
#if defined(__AVX512F__)
    _mm512_stream_ps(p, reinterpret_cast<__m512 &>(x));
#elif defined(__SSE2__)
    const __m128 *parts = reinterpret_cast<const __m128 *>(&x);
    for (int i = 0; i < 4; ++i) _mm_stream_ps(p + 4 * i, parts[i]);
#else
    store(p, x);
#endif
}
POLARGUIDE_INLINE void end_stream() {
#if defined(__SSE2__)
    _mm_sfence();
#endif
}
template <class V> POLARGUIDE_INLINE V min(V a, V b) { return a < b ? a : b; }
template <class V> POLARGUIDE_INLINE V max(V a, V b) { return a > b ? a : b; }
template <class V> POLARGUIDE_INLINE V clamp(V x, V low, V high) { return max(low, min(x, high)); }

// One register of the target. GCC compares and selects lane by lane in wider vectors, so code with many comparisons uses this
// type. So does code with more sums than a small register file can hold as wide vectors.
#if defined(__AVX512F__)
typedef vf reg;
typedef vf_unaligned reg_unaligned;
#elif defined(__AVX2__)
typedef float reg __attribute__((vector_size(32), may_alias));
typedef float reg_unaligned __attribute__((vector_size(32), aligned(4), may_alias));
#else
typedef float reg __attribute__((vector_size(16), may_alias));
typedef v4f reg_unaligned;
#endif
typedef decltype(reg{} < reg{}) ireg; // integers: results of comparisons
constexpr int reg_lanes = sizeof(reg) / sizeof(float);
POLARGUIDE_INLINE reg reg_splat(float x) { return reg{} + x; }
POLARGUIDE_INLINE reg reg_load(const float *p) { return *reinterpret_cast<const reg_unaligned *>(p); }
POLARGUIDE_INLINE void reg_store(float *p, reg x) { *reinterpret_cast<reg_unaligned *>(p) = x; }

// Bit l is set if lane l of a comparison result is true.
POLARGUIDE_INLINE uint32_t bits(ireg mask) {
#if defined(__AVX512F__)
    return _mm512_movepi32_mask(reinterpret_cast<__m512i &>(mask));
#elif defined(__AVX2__)
    return uint32_t(_mm256_movemask_ps(reinterpret_cast<__m256 &>(mask)));
#elif defined(__SSE2__)
    return uint32_t(_mm_movemask_ps(reinterpret_cast<__m128 &>(mask)));
#else
    uint32_t result = 0;
    for (int l = 0; l < reg_lanes; ++l) result |= uint32_t(mask[l] != 0) << l;
    return result;
#endif
}
// Comparisons for loops that test all lanes at once. AVX-512 has registers of bits for them, but GCC would move the result of a
// comparison there through a vector.
#if defined(__AVX512F__)
typedef __mmask16 lane_mask;
POLARGUIDE_INLINE lane_mask at_least(reg a, reg b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
POLARGUIDE_INLINE uint32_t bits(lane_mask mask) { return mask; }
POLARGUIDE_INLINE bool any(lane_mask mask) { return mask != 0; }
POLARGUIDE_INLINE reg where(lane_mask mask, reg a, reg b) { return _mm512_mask_blend_ps(mask, b, a); }
POLARGUIDE_INLINE reg where(lane_mask mask, reg a) { return _mm512_maskz_mov_ps(mask, a); } // 0 elsewhere
#else
typedef ireg lane_mask;
POLARGUIDE_INLINE lane_mask at_least(reg a, reg b) { return a >= b; }
POLARGUIDE_INLINE reg where(lane_mask mask, reg a, reg b) { return mask ? a : b; }
POLARGUIDE_INLINE reg where(lane_mask mask, reg a) { return mask ? a : reg{}; }
#endif
// Equal to the templates above, also for NaN; GCC would compare and select.
#if defined(__AVX512F__)
POLARGUIDE_INLINE reg min(reg a, reg b) { return _mm512_min_ps(a, b); }
POLARGUIDE_INLINE reg max(reg a, reg b) { return _mm512_max_ps(a, b); }
#elif defined(__AVX2__)
POLARGUIDE_INLINE reg min(reg a, reg b) { return _mm256_min_ps(a, b); }
POLARGUIDE_INLINE reg max(reg a, reg b) { return _mm256_max_ps(a, b); }
#elif defined(__SSE2__)
POLARGUIDE_INLINE reg min(reg a, reg b) { return _mm_min_ps(a, b); }
POLARGUIDE_INLINE reg max(reg a, reg b) { return _mm_max_ps(a, b); }
#endif
POLARGUIDE_INLINE bool any(ireg mask) {
#if defined(__SSE2__)
    return bits(mask) != 0;
#else
    typedef int64_t v2l __attribute__((vector_size(16), may_alias));
    const v2l halves = reinterpret_cast<const v2l &>(mask);
    return (halves[0] | halves[1]) != 0;
#endif
}

// Finds the words among `count` with a certain bit, in order, and returns their number. Both arrays have space for a whole vector
// at the end.
POLARGUIDE_INLINE int positions_of_bit(const uint16_t *words, int count, int bit, int32_t *positions) {
    int found = 0;
#if defined(__AVX512F__)
    const __m512i wanted = _mm512_set1_epi32(1 << bit);
    __m512i position = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    for (int i = 0; i < count; i += 16, position = _mm512_add_epi32(position, _mm512_set1_epi32(16))) {
        const __m256i some = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(words + i));
        const __mmask16 counted = count - i < 16 ? __mmask16((1u << (count - i)) - 1) : __mmask16(0xffff);
        const __mmask16 set = _mm512_mask_test_epi32_mask(counted, _mm512_cvtepu16_epi32(some), wanted);
        _mm512_storeu_si512(positions + found, _mm512_maskz_compress_epi32(set, position));
        found += __builtin_popcount(set);
    }
#else
    for (int i = 0; i < count; ++i) positions[found] = i, found += words[i] >> bit & 1; // without a branch to mispredict
#endif
    return found;
}

template <class V> POLARGUIDE_INLINE V square_root(V x) {
    alignas(64) float t[sizeof(V) / sizeof(float)];
    __builtin_memcpy(t, &x, sizeof x);
    for (float &value : t) value = __builtin_sqrtf(value); // one instruction for the whole vector
    __builtin_memcpy(&x, t, sizeof x);
    return x;
}

// 1/x to about 1e-7 relative; x in a normal range.
template <class V> POLARGUIDE_INLINE V reciprocal(V x) {
#if defined(__AVX512F__)
    __m512 v = reinterpret_cast<__m512 &>(x);
    __m512 r = _mm512_rcp14_ps(v);
    r = _mm512_mul_ps(r, _mm512_fnmadd_ps(v, r, _mm512_set1_ps(2.0f)));
    return reinterpret_cast<V &>(r);
#else
    return 1.0f / x;
#endif
}

// 2^x for x in [-120, 120], relative error about 1e-7 (a fifth-degree minimax polynomial on [-1/2, 1/2]).
template <class V> POLARGUIDE_INLINE V exp2(V x) {
    using I = decltype(x < x); // integers of the same width
    const float magic = 12582912.0f; // 1.5 * 2^23: adding it rounds to the nearest integer
    V shifted = x + magic;
    V f = x - (shifted - magic);
    V p = ((((f * 0.00132764719f + 0.00967553685f) * f + 0.0555071325f) * f + 0.240221197f) * f + 0.693146967f) * f +
          1.00000007f;
    return (V)((I)p + ((I)shifted << 23));
}

// 2^x with a relative error of about 5e-7; if one instruction looks up sixteen values, it needs three multiplications fewer.
POLARGUIDE_INLINE reg exp2_looked_up(reg x) {
#if defined(__AVX512F__)
    // 2^(k/16) as integers, minus the contribution of k to the exponent below.
    const __m512i powers =
        _mm512_setr_epi32(0x3f800000, 0x3f7daac3, 0x3f7b95c2, 0x3f79c3d3, 0x3f7837f0, 0x3f76f532, 0x3f75fed7, 0x3f75583f,
                          0x3f7504f3, 0x3f7508a4, 0x3f75672a, 0x3f76248c, 0x3f7744fd, 0x3f78ccdf, 0x3f7ac0c7, 0x3f7d257d);
    const float magic = 786432.0f; // 1.5 * 2^19: adding it rounds to the nearest sixteenth
    const reg shifted = x + magic;
    const reg f = x - (shifted - magic);
    const __m512i sixteenths = _mm512_castps_si512(shifted);
    const reg power = _mm512_castsi512_ps(
        _mm512_add_epi32(_mm512_permutexvar_epi32(sixteenths, powers), _mm512_slli_epi32(sixteenths, 19)));
    return power * ((f * 0.240226507f + 0.693187833f) * f + 1.0f);
#else
    return exp2(x);
#endif
}

// log2 of positive normal numbers, relative error about 1e-7.
template <class V> POLARGUIDE_INLINE V log2(V x) {
    using I = decltype(x < x);
    I raw = (I)x;
    I exponent = (raw - 0x3f3504f3) >> 23; // leaves a mantissa in [sqrt(1/2), sqrt(2))
    V m = (V)(raw - (exponent << 23));
    V s = (m - 1.0f) * reciprocal(m + 1.0f), q = s * s; // log m = 2 artanh s
    V series = (((q * 0.111111111f + 0.142857143f) * q + 0.2f) * q + 0.333333333f) * q + 1.0f;
    return __builtin_convertvector(exponent, V) + s * series * 2.88539008f;
}

// Transposes rows of W floats, one row per lane of V, to one vector per column, and back; rows from n on are zero or unchanged.
template <int W, class V> POLARGUIDE_INLINE void load_columns(const float *rows, int n, V *columns) {
    constexpr int count = sizeof(V) / sizeof(float);
    alignas(64) float t[W][count] = {};
    if (n == count) { // a constant count: the loop is unrolled
        for (int l = 0; l < count; ++l)
            for (int i = 0; i < W; ++i) t[i][l] = rows[W * l + i];
    } else {
        for (int l = 0; l < n; ++l)
            for (int i = 0; i < W; ++i) t[i][l] = rows[W * l + i];
    }
    __builtin_memcpy(columns, t, sizeof t);
}
template <int W, class V> POLARGUIDE_INLINE void store_columns(float *rows, int n, const V *columns) {
    constexpr int count = sizeof(V) / sizeof(float);
    alignas(64) float t[W][count];
    __builtin_memcpy(t, columns, sizeof t);
    if (n == count) {
        for (int l = 0; l < count; ++l)
            for (int i = 0; i < W; ++i) rows[W * l + i] = t[i][l];
    } else {
        for (int l = 0; l < n; ++l)
            for (int i = 0; i < W; ++i) rows[W * l + i] = t[i][l];
    }
}

// out[c][r] = in[r][c] for 16 x 16 floats; rows are `in_stride` and `out_stride` apart.
POLARGUIDE_INLINE void transpose16(const float *in, int64_t in_stride, float *out, int64_t out_stride) {
#if defined(__AVX512F__)
    __m512 r[16], t[16];
    for (int i = 0; i < 16; ++i) r[i] = _mm512_loadu_ps(in + in_stride * i);
    for (int i = 0; i < 16; i += 2) {
        t[i] = _mm512_unpacklo_ps(r[i], r[i + 1]);
        t[i + 1] = _mm512_unpackhi_ps(r[i], r[i + 1]);
    }
    for (int i = 0; i < 16; i += 4)
        for (int j = 0; j < 2; ++j) {
            __m512d a = _mm512_castps_pd(t[i + j]), b = _mm512_castps_pd(t[i + j + 2]);
            r[i + 2 * j] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, b));
            r[i + 2 * j + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, b));
        }
    // r[4 * g + c] holds, in its 128-bit piece q, rows 4g..4g+3 of column 4q + c.
    for (int c = 0; c < 4; ++c) {
        __m512 x = _mm512_shuffle_f32x4(r[c], r[4 + c], 0x88), y = _mm512_shuffle_f32x4(r[8 + c], r[12 + c], 0x88);
        __m512 z = _mm512_shuffle_f32x4(r[c], r[4 + c], 0xdd), w = _mm512_shuffle_f32x4(r[8 + c], r[12 + c], 0xdd);
        _mm512_storeu_ps(out + out_stride * c, _mm512_shuffle_f32x4(x, y, 0x88));
        _mm512_storeu_ps(out + out_stride * (c + 4), _mm512_shuffle_f32x4(z, w, 0x88));
        _mm512_storeu_ps(out + out_stride * (c + 8), _mm512_shuffle_f32x4(x, y, 0xdd));
        _mm512_storeu_ps(out + out_stride * (c + 12), _mm512_shuffle_f32x4(z, w, 0xdd));
    }
#else
    typedef float v4 __attribute__((vector_size(16), aligned(4), may_alias));
    for (int i = 0; i < 16; i += 4)
        for (int j = 0; j < 16; j += 4) {
            v4 a = *(const v4 *)(in + in_stride * i + j), b = *(const v4 *)(in + in_stride * (i + 1) + j);
            v4 c = *(const v4 *)(in + in_stride * (i + 2) + j), d = *(const v4 *)(in + in_stride * (i + 3) + j);
            v4 ab0 = __builtin_shufflevector(a, b, 0, 4, 1, 5), ab1 = __builtin_shufflevector(a, b, 2, 6, 3, 7);
            v4 cd0 = __builtin_shufflevector(c, d, 0, 4, 1, 5), cd1 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
            *(v4 *)(out + out_stride * j + i) = __builtin_shufflevector(ab0, cd0, 0, 1, 4, 5);
            *(v4 *)(out + out_stride * (j + 1) + i) = __builtin_shufflevector(ab0, cd0, 2, 3, 6, 7);
            *(v4 *)(out + out_stride * (j + 2) + i) = __builtin_shufflevector(ab1, cd1, 0, 1, 4, 5);
            *(v4 *)(out + out_stride * (j + 3) + i) = __builtin_shufflevector(ab1, cd1, 2, 3, 6, 7);
        }
#endif
}
POLARGUIDE_INLINE void transpose16(const float *in, float *out) { transpose16(in, 16, out, 16); }

} // namespace
} // namespace POLARGUIDE_ISA
} // namespace polarguide
