// Deferred reflection per pixel, around the look-up in the cubemap: rays mirrored at blended normals before it, the
// layers of the picture after it, and both gradients.
#include "image.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float shortest_normal = 1e-3f, brightest = 5.0f; // log of light
constexpr float least_alpha = 1e-6f;

struct Mirror {
    float normal[3], inverse; // unit, and 1 / length
    bool short_;              // length below the floor: divided by the floor
    float along;              // ray . normal
};

inline Mirror mirror_at(const ReflectArgs &a, int64_t i) {
    const float *n = a.features + a.channels * i + 3, *ray = a.rays + 3 * i;
    Mirror m;
    const float squared = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    m.short_ = squared < shortest_normal * shortest_normal;
    m.inverse = 1.0f / (m.short_ ? shortest_normal : sqrtf(squared));
    m.along = 0.0f;
    for (int k = 0; k < 3; ++k) m.normal[k] = n[k] * m.inverse, m.along += ray[k] * m.normal[k];
    return m;
}

// Unpolarized power reflectance at cos i = c in [0, 1], and its derivative.
inline float reflectance(float c, float refractive_index, float *slope) {
    const float n2 = refractive_index * refractive_index, t = sqrtf(n2 - 1.0f + c * c), p = n2 * c, dt = c / t;
    const float s_sum = 1.0f / (c + t), p_sum = 1.0f / (p + t), rs = (c - t) * s_sum, rp = (p - t) * p_sum;
    // ((a - t) / (a + t))' = 2 (a' t - a t') / (a + t)^2
    *slope = rs * 2.0f * (t - c * dt) * s_sum * s_sum + rp * 2.0f * (n2 * t - p * dt) * p_sum * p_sum;
    return 0.5f * (rs * rs + rp * rp);
}

struct Light {
    float value[3], slope[3]; // and derivative by the raw texel value
    bool lit[3];              // not cut at 0
};

inline Light light_at(const ReflectArgs &a, int64_t i) {
    const float *raw = a.seen + 3 * i, *local = a.local ? a.features + a.channels * i + 7 : nullptr;
    Light l;
    for (int k = 0; k < 3; ++k) {
        if (a.fresnel) {
            l.value[k] = expf(raw[k] < brightest ? raw[k] : brightest);
            l.slope[k] = raw[k] <= brightest ? l.value[k] : 0.0f;
        } else {
            l.value[k] = 1.0f / (1.0f + expf(-raw[k]));
            l.slope[k] = l.value[k] * (1.0f - l.value[k]);
        }
        l.lit[k] = true;
        if (local) {
            l.value[k] += local[k];
            l.lit[k] = l.value[k] >= 0.0f;
            if (!l.lit[k]) l.value[k] = 0.0f;
        }
    }
    return l;
}

inline float facing(float along) { return along < -1.0f ? 1.0f : along > 0.0f ? 0.0f : -along; }

} // namespace

void reflect_directions(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const Mirror m = mirror_at(a, i);
        const float *ray = a.rays + 3 * i;
        for (int k = 0; k < 3; ++k) a.directions[3 * i + k] = ray[k] - 2.0f * m.along * m.normal[k];
    }
}

void reflect_layers(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *base = a.features + a.channels * i, strength = base[6];
        const Light l = light_at(a, i);
        float slope, weight = strength, kept = 1.0f - strength;
        if (a.fresnel) weight = strength * reflectance(facing(mirror_at(a, i).along), a.refractive_index, &slope), kept = 1.0f;
        for (int k = 0; k < 3; ++k) {
            const float specular = weight * l.value[k], diffuse = kept * base[k];
            a.specular[3 * i + k] = specular, a.diffuse[3 * i + k] = diffuse;
            a.final_picture[3 * i + k] = specular + diffuse, a.reflection[3 * i + k] = l.value[k];
        }
    }
}

// Gradients by the look-up, and by the features except the part of the normal that comes through the look-up, which
// reflect_backward_directions adds. Channels beyond those that are read get zero.
void reflect_backward_layers(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *base = a.features + a.channels * i, strength = base[6], *ray = a.rays + 3 * i;
        float *to = a.grad_features + a.channels * i;
        for (int c = 0; c < a.channels; ++c) to[c] = 0.0f;
        const Light l = light_at(a, i);
        float slope = 0.0f, share = 1.0f, kept = 1.0f - strength;
        Mirror m;
        if (a.fresnel) m = mirror_at(a, i), share = reflectance(facing(m.along), a.refractive_index, &slope), kept = 1.0f;
        float by_weight = 0.0f, by_kept = 0.0f;
        for (int k = 0; k < 3; ++k) {
            const float final_picture = a.grad_final ? a.grad_final[3 * i + k] : 0.0f;
            const float specular = final_picture + (a.grad_specular ? a.grad_specular[3 * i + k] : 0.0f);
            const float diffuse = final_picture + (a.grad_diffuse ? a.grad_diffuse[3 * i + k] : 0.0f);
            float light = strength * share * specular + (a.grad_reflection ? a.grad_reflection[3 * i + k] : 0.0f);
            if (!l.lit[k]) light = 0.0f;
            by_weight += l.value[k] * specular, by_kept += base[k] * diffuse;
            to[k] = kept * diffuse;
            if (a.local) to[7 + k] = light;
            a.grad_seen[3 * i + k] = light * l.slope[k];
        }
        to[6] = a.fresnel ? share * by_weight : by_weight - by_kept;
        if (a.fresnel && m.along >= -1.0f && m.along <= 0.0f) {
            // along = ray . n / |n|; the cosine is its negative.
            const float by_along = -slope * strength * by_weight;
            for (int k = 0; k < 3; ++k)
                to[3 + k] = by_along * m.inverse * (ray[k] - (m.short_ ? 0.0f : m.along * m.normal[k]));
        }
    }
}

void reflect_backward_directions(const ReflectArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const Mirror m = mirror_at(a, i);
        const float *ray = a.rays + 3 * i, *g = a.grad_directions + 3 * i;
        float *to = a.grad_features + a.channels * i + 3;
        const float across = g[0] * m.normal[0] + g[1] * m.normal[1] + g[2] * m.normal[2];
        float by_unit[3], radial = 0.0f;
        for (int k = 0; k < 3; ++k) {
            by_unit[k] = -2.0f * (m.along * g[k] + across * ray[k]);
            radial += by_unit[k] * m.normal[k];
        }
        for (int k = 0; k < 3; ++k) to[k] += m.inverse * (by_unit[k] - (m.short_ ? 0.0f : radial * m.normal[k]));
    }
}

void gbuffer_split(const GBufferArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *from = a.features + a.channels * i;
        for (int k = 0; k < 3; ++k) a.normal[3 * i + k] = from[3 + k];
        if (a.depth) a.depth[i] = from[a.channels - 1] / (a.alpha[i] > least_alpha ? a.alpha[i] : least_alpha);
    }
}

// The gradient of everything that was read of the features, in one pass.
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
