// Deferred reflection per pixel: rays mirrored at blended normals before the look-up in the cubemap, layers of the picture
// after it, and both gradients.
#include "image.h"
#include "mirror.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float least_alpha = 1e-6f, log2_e = 1.44269504f;

// Loads columns `first` to `first` + W, one row per lane of a register; rows from n on are zero.
template <int W> POLARGUIDE_INLINE void columns_of(const float *rows, int stride, int first, int n, reg *columns) {
    alignas(64) float t[W][reg_lanes] = {};
    for (int l = 0; l < n; ++l)
        for (int k = 0; k < W; ++k) t[k][l] = rows[int64_t(stride) * l + first + k];
    __builtin_memcpy(columns, t, sizeof t);
}

POLARGUIDE_INLINE Mirror mirror_at(const ReflectArgs &a, int64_t i, int n) {
    reg blended[3], ray[3];
    columns_of<3>(a.features + a.channels * i, a.channels, 3, n, blended);
    load_columns<3>(a.rays + 3 * i, n, ray);
    return mirror_of(ray, blended);
}

// Unpolarized power reflectance for a ray and a normal, and its derivative with respect to their product.
POLARGUIDE_INLINE reg reflectance(reg along, reg refractive_index, reg *by_along) {
    const reg c = clamp(-along, reg{}, reg_splat(1.0f)); // the cosine
    const reg n2 = refractive_index * refractive_index;
    const reg t = square_root(c * c + (n2 - 1.0f)), p = n2 * c, dt = c / t;
    const reg s_sum = 1.0f / (c + t), p_sum = 1.0f / (p + t), rs = (c - t) * s_sum, rp = (p - t) * p_sum;
    // ((a - t) / (a + t))' = 2 (a' t - a t') / (a + t)^2
    const reg slope = rs * 2.0f * (t - c * dt) * s_sum * s_sum + rp * 2.0f * (n2 * t - p * dt) * p_sum * p_sum;
    *by_along = (along >= -1.0f) & (along <= 0.0f) ? -slope : reg{};
    return 0.5f * (rs * rs + rp * rp);
}

struct Light {
    reg value[3], slope[3]; // and derivative with respect to the look-up
    ireg lit[3];            // not clamped at 0
};

POLARGUIDE_INLINE Light light_at(const ReflectArgs &a, int64_t i, int n) {
    reg raw[3], local[3] = {};
    load_columns<3>(a.seen + 3 * i, n, raw);
    if (a.local) columns_of<3>(a.features + a.channels * i, a.channels, 7, n, local);
    Light l;
    for (int k = 0; k < 3; ++k) {
        if (a.fresnel) {
            l.value[k] = raw[k], l.slope[k] = reg_splat(1.0f);
        } else {
            // Above 80 the exponential overflows; NaN stays.
            const reg bounded = raw[k] < -80.0f ? reg_splat(-80.0f) : raw[k] > 80.0f ? reg_splat(80.0f) : raw[k];
            l.value[k] = 1.0f / (1.0f + exp2(-log2_e * bounded));
            l.slope[k] = l.value[k] * (1.0f - l.value[k]);
        }
        const reg sum = l.value[k] + local[k];
        l.lit[k] = sum >= 0.0f;
        l.value[k] = l.lit[k] ? sum : reg{};
    }
    return l;
}

// Optional gradient [P,3].
POLARGUIDE_INLINE void gradient_at(const float *gradient, int64_t i, int n, reg *columns) {
    if (gradient) return load_columns<3>(gradient + 3 * i, n, columns);
    for (int k = 0; k < 3; ++k) columns[k] = reg{};
}

// Factor from the blended roughness of a pixel to its mip level, which belongs to the mean roughness (blended over alpha).
POLARGUIDE_INLINE reg levels_of(const ReflectArgs &a, int64_t i, int n) {
    reg alpha;
    load_columns<1>(a.alpha + i, n, &alpha);
    return a.blur / (alpha > least_alpha ? alpha : reg_splat(least_alpha));
}

// Weights of light and base color: strength times Fresnel's reflectance and 1, or the weights of the lerp.
struct Blend {
    reg share, kept; // specular = strength share light, diffuse = kept base
    reg by_along;    // derivative of the share with respect to ray . normal
};

POLARGUIDE_INLINE Blend blend_of(const ReflectArgs &a, int64_t i, int n, reg strength, reg along) {
    Blend b = {reg_splat(1.0f), 1.0f - strength, reg{}};
    if (!a.fresnel) return b;
    reg index = {};
    if (a.index >= 0) columns_of<1>(a.features + a.channels * i, a.channels, a.index, n, &index);
    b.share = reflectance(along, a.refractive_index + index, &b.by_along), b.kept = reg_splat(1.0f);
    return b;
}

} // namespace

void turn(const TurnArgs &a, int64_t begin, int64_t end) {
    const float *r = a.rotation;
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        reg from[3], to[3];
        load_columns<3>(a.directions + 3 * i, n, from);
        for (int k = 0; k < 3; ++k) to[k] = from[0] * r[k] + from[1] * r[3 + k] + from[2] * r[6 + k];
        store_columns<3>(a.out + 3 * i, n, to);
    }
}

void reflect_directions(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        reg out[3];
        const Mirror m = mirror_at(a, i, n);
        mirrored_ray(m, out);
        store_columns<3>(a.directions + 3 * i, n, out);
        store_columns<1>(a.along + i, n, &m.along);
        if (!a.level) continue;
        reg level = {};
        if (a.roughness >= 0) {
            columns_of<1>(a.features + a.channels * i, a.channels, a.roughness, n, &level);
            level *= levels_of(a, i, n);
        }
        store_columns<1>(a.level + i, n, &level);
    }
}

void reflect_layers(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        reg base[3], strength, specular[3], diffuse[3], final_picture[3];
        columns_of<3>(a.features + a.channels * i, a.channels, 0, n, base);
        columns_of<1>(a.features + a.channels * i, a.channels, 6, n, &strength);
        const Light light = light_at(a, i, n);
        reg along;
        load_columns<1>(a.along + i, n, &along);
        const Blend blend = blend_of(a, i, n, strength, along);
        for (int k = 0; k < 3; ++k) {
            specular[k] = strength * blend.share * light.value[k], diffuse[k] = blend.kept * base[k];
            final_picture[k] = specular[k] + diffuse[k];
        }
        store_columns<3>(a.specular + 3 * i, n, specular), store_columns<3>(a.diffuse + 3 * i, n, diffuse);
        store_columns<3>(a.final_picture + 3 * i, n, final_picture), store_columns<3>(a.reflection + 3 * i, n, light.value);
    }
}

// Computes gradients of the look-up and of the features. reflect_backward_directions adds the part of the normal that passes
// through the look-up. Unused channels get zero. Gradients of the held layers do not reach the normal: of both gradients of the
// look-up, only `grad_texels` includes them.
void reflect_backward_layers(const ReflectArgs &a, int64_t begin, int64_t end) {
    const bool held = a.grad_held_specular || a.grad_held_diffuse;
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        reg base[3], strength, to[10], seen[3], texels[3], picture[3], by[5][3];
        columns_of<3>(a.features + a.channels * i, a.channels, 0, n, base);
        columns_of<1>(a.features + a.channels * i, a.channels, 6, n, &strength);
        const Light light = light_at(a, i, n);
        Mirror m;
        m.along = reg{};
        if (a.fresnel) m = mirror_at(a, i, n);
        const Blend blend = blend_of(a, i, n, strength, m.along);
        gradient_at(a.grad_final, i, n, picture), gradient_at(a.grad_specular, i, n, by[0]);
        gradient_at(a.grad_diffuse, i, n, by[1]), gradient_at(a.grad_reflection, i, n, by[2]);
        gradient_at(a.grad_held_specular, i, n, by[3]), gradient_at(a.grad_held_diffuse, i, n, by[4]);
        reg by_share = {}, by_held = {}, by_kept = {};
        for (int k = 0; k < 3; ++k) {
            const reg specular = picture[k] + by[0][k], diffuse = picture[k] + by[1][k] + by[4][k];
            const reg live = light.lit[k] ? strength * blend.share * specular + by[2][k] : reg{};
            const reg both = live + (light.lit[k] ? strength * blend.share * by[3][k] : reg{});
            by_share += light.value[k] * specular, by_held += light.value[k] * by[3][k], by_kept += base[k] * diffuse;
            to[k] = blend.kept * diffuse, to[7 + k] = both;
            seen[k] = live * light.slope[k], texels[k] = both * light.slope[k];
        }
        to[6] = a.fresnel ? blend.share * (by_share + by_held) : by_share + by_held - by_kept;
        if (a.fresnel) normal_by_along(m, blend.by_along * strength * by_share, to + 3);
        else to[3] = to[4] = to[5] = reg{};
        store_columns<3>(a.grad_seen + 3 * i, n, seen);
        if (held) store_columns<3>(a.grad_texels + 3 * i, n, texels);
        const int used = a.local ? 10 : 7;
        for (int l = 0; l < n; ++l) {
            float *row = a.grad_features + a.channels * (i + l);
            for (int c = 0; c < used; ++c) row[c] = to[c][l];
            for (int c = used; c < a.channels; ++c) row[c] = 0.0f;
        }
    }
}

void reflect_backward_directions(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = count_at(i, end);
        reg g[3], to[3];
        load_columns<3>(a.grad_directions + 3 * i, n, g);
        normal_by_mirrored(mirror_at(a, i, n), g, to);
        for (int k = 0; k < 3; ++k)
            for (int l = 0; l < n; ++l) a.grad_features[a.channels * (i + l) + 3 + k] += to[k][l];
        if (a.roughness < 0) continue;
        reg by_level;
        load_columns<1>(a.grad_level + i, n, &by_level);
        by_level *= levels_of(a, i, n);
        for (int l = 0; l < n; ++l) a.grad_features[a.channels * (i + l) + a.roughness] += by_level[l];
    }
}

void gbuffer_split(const GBufferArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *from = a.features + a.channels * i;
        for (int k = 0; k < 3; ++k) a.normal[3 * i + k] = from[3 + k];
        if (a.depth) a.depth[i] = from[a.channels - 1] / (a.alpha[i] > least_alpha ? a.alpha[i] : least_alpha);
    }
}

// Computes the gradient of all results of gbuffer_split in one pass.
void gbuffer_join(const GBufferArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *from = a.grad_features + a.channels * i;
        float *to = a.to_features + a.channels * i;
        for (int c = 0; c < a.channels; ++c) to[c] = a.grad_features ? from[c] : 0.0f;
        for (int k = 0; a.grad_normal && k < 3; ++k) to[3 + k] += a.grad_normal[3 * i + k];
        if (!a.grad_depth) continue;
        const bool covered = a.alpha[i] >= least_alpha;
        const float by_last = a.grad_depth[i] / (covered ? a.alpha[i] : least_alpha);
        to[a.channels - 1] += by_last;
        a.to_alpha[i] = covered ? -by_last * a.depth[i] : 0.0f;
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
