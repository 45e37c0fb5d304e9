// Seamless cubemap: bilinear look-up and its gradients.
//
// Sixteen directions are located at a time; taps are then read for each direction. Cells are squares between four texel
// centers. Their numbers include one ring of texels around each face, so a cell whose column or row is 0 or the resolution
// has taps on a neighboring face. These few cells use a slower path.
#include "image.h"
#include "simd.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

// Components and signs of s and t for OpenGL's faces +x -x +y -y +z -z.
constexpr int s_axis[6] = {2, 2, 0, 0, 0, 0}, t_axis[6] = {1, 1, 2, 2, 1, 1};
constexpr int s_sign[6] = {-1, 1, 1, 1, 1, -1}, t_sign[6] = {-1, -1, 1, -1, -1, -1};

// Sixteen located directions. `scale` is the slope of the cell coordinates along the face: R / 2 / major component.
struct Cells {
    alignas(64) float fu[lanes], fv[lanes], s[lanes], t[lanes], scale[lanes];
    alignas(64) int32_t u[lanes], v[lanes], face[lanes];
};

struct Resolutions {
    alignas(64) float of[lanes];
};
POLARGUIDE_INLINE Resolutions everywhere(int resolution) {
    Resolutions r;
    for (int l = 0; l < lanes; ++l) r.of[l] = float(resolution);
    return r;
}

// Computes column (or row) and fraction of a coordinate in [0.5, R + 0.5]. A NaN has cell 0 and remains in the fraction.
POLARGUIDE_INLINE void split(reg u, reg resolution, int32_t *cell, float *fraction) {
    const reg low = u > 0.0f ? u : reg{}, inside = low < resolution ? low : resolution;
    const ireg whole = __builtin_convertvector(inside, ireg);
    reg_store(fraction, u - __builtin_convertvector(whole, reg));
    for (int l = 0; l < reg_lanes; ++l) cell[l] = whole[l];
}

POLARGUIDE_INLINE void locate(const float *directions, int n, const Resolutions &resolutions, Cells *cells) {
    alignas(64) float d[3][lanes] = {};
    for (int l = 0; l < n; ++l)
        for (int i = 0; i < 3; ++i) d[i][l] = directions[3 * l + i];
    for (int b = 0; b < lanes; b += reg_lanes) {
        const reg resolution = reg_load(resolutions.of + b), half = 0.5f * resolution;
        const reg x = reg_load(d[0] + b), y = reg_load(d[1] + b), z = reg_load(d[2] + b);
        const reg ax = x < 0.0f ? -x : x, ay = y < 0.0f ? -y : y, az = z < 0.0f ? -z : z;
        const ireg on_x = (ax >= ay) & (ax >= az), on_y = ~on_x & (ay >= az), on_z = ~(on_x | on_y);
        const reg major = on_x ? x : on_y ? y : z, size = on_x ? ax : on_y ? ay : az;
        const ireg negative = major < 0.0f;
        const reg flipped_x = negative ? -x : x, flipped_z = negative ? -z : z;
        const reg inverse = size <= 1e-20f ? reg{} : 1.0f / size; // zero direction: the center of +x, without a gradient
        const reg s = (on_x ? -flipped_z : on_y ? x : flipped_x) * inverse, t = (on_y ? flipped_z : -y) * inverse;
        const ireg face = (on_y & 2) | (on_z & 4) | (negative & 1);
        for (int l = 0; l < reg_lanes; ++l) cells->face[b + l] = face[l];
        reg_store(cells->s + b, s), reg_store(cells->t + b, t), reg_store(cells->scale + b, inverse * half);
        split(s * half + (half + 0.5f), resolution, cells->u + b, cells->fu + b);
        split(t * half + (half + 0.5f), resolution, cells->v + b, cells->fv + b);
    }
}

// Texels of a tap: one, or at a corner of the cube the mean of the three that meet there.
struct Tap {
    int count;
    int64_t texel[3];
};

// Returns the texel of the neighboring face next to (column, row), one of which is one step outside `face`. Positions are in
// half texels from the center of the cube: a face lies at +-R, its texel centers at -(R - 1) .. R - 1.
POLARGUIDE_INLINE int64_t across(int face, int column, int row, int resolution) {
    const int last = resolution - 1, axis = face / 2;
    int p[3];
    p[axis] = face % 2 ? -last : last;
    p[s_axis[face]] = s_sign[face] * (2 * column - last), p[t_axis[face]] = t_sign[face] * (2 * row - last);
    const int other = column < 0 || column > last ? s_axis[face] : t_axis[face], next = 2 * other + (p[other] < 0);
    const int next_column = (s_sign[next] * p[s_axis[next]] + last) / 2;
    const int next_row = (t_sign[next] * p[t_axis[next]] + last) / 2;
    return (int64_t(next) * resolution + next_row) * resolution + next_column;
}

Tap tap_at(int face, int column, int row, int resolution) {
    const int last = resolution - 1;
    const int inner_column = column < 0 ? 0 : column > last ? last : column, inner_row = row < 0 ? 0 : row > last ? last : row;
    const int64_t own = (int64_t(face) * resolution + inner_row) * resolution + inner_column;
    if (column == inner_column && row == inner_row) return {1, {own, 0, 0}};
    if (column == inner_column || row == inner_row) return {1, {across(face, column, row, resolution), 0, 0}};
    return {3, {own, across(face, column, inner_row, resolution), across(face, inner_column, row, resolution)}};
}

// Cubemap: a texture [6,R,R,C].
struct Texture {
    int resolution, channels;
    const float *texels;
};

// Returns the four taps of cell l.
POLARGUIDE_INLINE void taps_of(int resolution, const Cells &cells, int l, Tap *taps) {
    for (int k = 0; k < 4; ++k)
        taps[k] = tap_at(cells.face[l], cells.u[l] - 1 + k % 2, cells.v[l] - 1 + k / 2, resolution);
}

POLARGUIDE_INLINE float value_of(const Texture &a, const Tap &tap, int c) {
    const float first = a.texels[tap.texel[0] * a.channels + c];
    if (tap.count == 1) return first;
    return (first + a.texels[tap.texel[1] * a.channels + c] + a.texels[tap.texel[2] * a.channels + c]) * (1.0f / 3.0f);
}

POLARGUIDE_INLINE bool within_face(int resolution, const Cells &cells, int l) {
    const unsigned inner = unsigned(resolution - 1);
    return unsigned(cells.u[l] - 1) < inner && unsigned(cells.v[l] - 1) < inner;
}
POLARGUIDE_INLINE int64_t first_texel(int resolution, const Cells &cells, int l) {
    return (int64_t(cells.face[l]) * resolution + cells.v[l] - 1) * resolution + cells.u[l] - 1;
}

// Interpolates in cell l. C channels; 0: any number.
template <int C> POLARGUIDE_INLINE void look_up(const Texture &a, const Cells &cells, int l, float *out) {
    const int channels = C ? C : a.channels;
    const float fu = cells.fu[l], fv = cells.fv[l];
    if (within_face(a.resolution, cells, l)) {
        const float *p = a.texels + first_texel(a.resolution, cells, l) * channels, *q = p + int64_t(a.resolution) * channels;
        for (int c = 0; c < channels; ++c) {
            const float top = p[c] + fu * (p[c + channels] - p[c]), bottom = q[c] + fu * (q[c + channels] - q[c]);
            out[c] = top + fv * (bottom - top);
        }
        return;
    }
    Tap taps[4];
    taps_of(a.resolution, cells, l, taps);
    for (int c = 0; c < channels; ++c) {
        float v[4];
        for (int k = 0; k < 4; ++k) v[k] = value_of(a, taps[k], c);
        const float top = v[0] + fu * (v[1] - v[0]), bottom = v[2] + fu * (v[3] - v[2]);
        out[c] = top + fv * (bottom - top);
    }
}

// Computes the gradient [3] of the direction in cell l from the gradient of its channels.
template <int C>
POLARGUIDE_INLINE void by_direction(const Texture &a, const Cells &cells, int l, const float *g, float *out) {
    const int channels = C ? C : a.channels;
    const int64_t down = int64_t(a.resolution) * channels;
    const float fu = cells.fu[l], fv = cells.fv[l];
    float by_u = 0.0f, by_v = 0.0f;
    Tap taps[4];
    const bool within = within_face(a.resolution, cells, l);
    const float *p = a.texels + (within ? first_texel(a.resolution, cells, l) * channels : 0), *q = p + down;
    if (!within) taps_of(a.resolution, cells, l, taps);
    for (int c = 0; c < channels; ++c) {
        float v[4];
        if (within)
            v[0] = p[c], v[1] = p[c + channels], v[2] = q[c], v[3] = q[c + channels];
        else
            for (int k = 0; k < 4; ++k) v[k] = value_of(a, taps[k], c);
        const float top = v[1] - v[0], bottom = v[3] - v[2], left = v[2] - v[0], right = v[3] - v[1];
        by_u += g[c] * (top + fv * (bottom - top)), by_v += g[c] * (left + fu * (right - left));
    }
    const int face = cells.face[l], axis = face / 2;
    const float by_s = by_u * cells.scale[l], by_t = by_v * cells.scale[l];
    const float by_major = -(by_s * cells.s[l] + by_t * cells.t[l]);
    out[s_axis[face]] = s_sign[face] > 0 ? by_s : -by_s, out[t_axis[face]] = t_sign[face] > 0 ? by_t : -by_t;
    out[axis] = face % 2 ? -by_major : by_major;
}

// Adds the contribution of cell l to the gradient of the texels.
template <int C>
POLARGUIDE_INLINE void by_texels(int resolution, int all, const Cells &cells, int l, const float *g, float *sums) {
    const int channels = C ? C : all;
    const float fu = cells.fu[l], fv = cells.fv[l];
    const float w[4] = {(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv};
    if (within_face(resolution, cells, l)) {
        float *p = sums + first_texel(resolution, cells, l) * channels, *q = p + int64_t(resolution) * channels;
        for (int c = 0; c < channels; ++c) {
            p[c] += w[0] * g[c], p[c + channels] += w[1] * g[c];
            q[c] += w[2] * g[c], q[c + channels] += w[3] * g[c];
        }
        return;
    }
    Tap taps[4];
    taps_of(resolution, cells, l, taps);
    for (int k = 0; k < 4; ++k)
        for (int i = 0; i < taps[k].count; ++i)
            for (int c = 0; c < channels; ++c)
                sums[taps[k].texel[i] * channels + c] += w[k] * g[c] * (taps[k].count == 1 ? 1.0f : 1.0f / 3.0f);
}

POLARGUIDE_INLINE int count_at(int64_t first, int64_t end) { return end - first < lanes ? int(end - first) : lanes; }

template <int C> void forward(const CubemapArgs &a, int64_t begin, int64_t end) {
    const Texture texture{a.resolution, a.channels, a.texture};
    const Resolutions resolutions = everywhere(a.resolution);
    Cells cells;
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = count_at(first, end);
        locate(a.directions + 3 * first, n, resolutions, &cells);
        for (int l = 0; l < n; ++l) look_up<C>(texture, cells, l, a.out + (first + l) * texture.channels);
    }
}

template <int C> void backward_directions(const CubemapArgs &a, int64_t begin, int64_t end) {
    const Texture texture{a.resolution, a.channels, a.texture};
    const Resolutions resolutions = everywhere(a.resolution);
    Cells cells;
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = count_at(first, end);
        locate(a.directions + 3 * first, n, resolutions, &cells);
        for (int l = 0; l < n; ++l)
            by_direction<C>(texture, cells, l, a.grad_out + (first + l) * a.channels, a.grad_directions + 3 * (first + l));
    }
}

template <int C> void backward_texture(const CubemapArgs &a, int64_t begin, int64_t end, float *sums) {
    const Resolutions resolutions = everywhere(a.resolution);
    Cells cells;
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = count_at(first, end);
        locate(a.directions + 3 * first, n, resolutions, &cells);
        for (int l = 0; l < n; ++l)
            by_texels<C>(a.resolution, a.channels, cells, l, a.grad_out + (first + l) * a.channels, sums);
    }
}

// Positions of sixteen directions between mip levels and within the two nearest levels.
struct Between {
    int lower[lanes], upper[lanes];
    float fraction[lanes];
    bool inside[lanes]; // within the range of levels
    Cells below, above;
};

POLARGUIDE_INLINE void place(const MipArgs &a, int64_t first, int n, Between *b) {
    const float last = float(a.levels - 1);
    Resolutions below = everywhere(1), above = everywhere(1);
    for (int l = 0; l < n; ++l) {
        const float given = a.level[first + l], level = given < 0.0f ? 0.0f : given > last ? last : given; // NaN stays
        const int whole = level > 0.0f ? int(level) : 0, most = a.levels > 1 ? a.levels - 2 : 0;
        b->lower[l] = whole < most ? whole : most;
        b->upper[l] = b->lower[l] + 1 < a.levels ? b->lower[l] + 1 : b->lower[l];
        b->fraction[l] = level - float(b->lower[l]), b->inside[l] = given >= 0.0f && given <= last;
        below.of[l] = float(a.resolution[b->lower[l]]), above.of[l] = float(a.resolution[b->upper[l]]);
    }
    locate(a.directions + 3 * first, n, below, &b->below), locate(a.directions + 3 * first, n, above, &b->above);
}

POLARGUIDE_INLINE Texture texture_of(const MipArgs &a, int level) {
    return {a.resolution[level], a.channels, a.textures[level]};
}

template <int C> void between(const MipArgs &a, int64_t begin, int64_t end) {
    float seen[largest_mip_channels];
    Between b;
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = count_at(first, end), channels = C ? C : a.channels;
        place(a, first, n, &b);
        for (int l = 0; l < n; ++l) {
            float *out = a.out + (first + l) * channels;
            look_up<C>(texture_of(a, b.lower[l]), b.below, l, out);
            look_up<C>(texture_of(a, b.upper[l]), b.above, l, seen);
            for (int c = 0; c < channels; ++c) out[c] += b.fraction[l] * (seen[c] - out[c]);
        }
    }
}

template <int C> void between_backward(const MipArgs &a, int64_t begin, int64_t end) {
    float below[largest_mip_channels], above[largest_mip_channels];
    Between b;
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = count_at(first, end), channels = C ? C : a.channels;
        place(a, first, n, &b);
        for (int l = 0; l < n; ++l) {
            const Texture lower = texture_of(a, b.lower[l]), upper = texture_of(a, b.upper[l]);
            const float *g = a.grad_out + (first + l) * channels, f = b.fraction[l];
            const float *by_light = a.grad_light + (first + l) * channels;
            look_up<C>(lower, b.below, l, below), look_up<C>(upper, b.above, l, above);
            float by_level = 0.0f, by_lower[3], by_upper[3];
            for (int c = 0; c < channels; ++c) by_level += by_light[c] * (above[c] - below[c]);
            a.grad_level[first + l] = b.inside[l] ? by_level : 0.0f;
            by_direction<C>(lower, b.below, l, g, by_lower), by_direction<C>(upper, b.above, l, g, by_upper);
            for (int k = 0; k < 3; ++k)
                a.grad_directions[3 * (first + l) + k] = by_lower[k] + f * (by_upper[k] - by_lower[k]);
        }
    }
}

template <int C> void between_texels(const MipArgs &a, int64_t begin, int64_t end, float *sums) {
    float part[largest_mip_channels];
    Between b;
    for (int64_t first = begin; first < end; first += lanes) {
        const int n = count_at(first, end), channels = C ? C : a.channels;
        place(a, first, n, &b);
        for (int l = 0; l < n; ++l) {
            const float *g = a.grad_light + (first + l) * channels, f = b.fraction[l];
            for (int c = 0; c < channels; ++c) part[c] = (1.0f - f) * g[c];
            by_texels<C>(a.resolution[b.lower[l]], channels, b.below, l, part, sums + a.begin[b.lower[l]]);
            for (int c = 0; c < channels; ++c) part[c] = f * g[c];
            by_texels<C>(a.resolution[b.upper[l]], channels, b.above, l, part, sums + a.begin[b.upper[l]]);
        }
    }
}

} // namespace

void cubemap_forward(const CubemapArgs &a, int64_t begin, int64_t end) {
    (a.channels == 3 ? forward<3> : a.channels == 1 ? forward<1> : forward<0>)(a, begin, end);
}

void cubemap_backward_directions(const CubemapArgs &a, int64_t begin, int64_t end) {
    (a.channels == 3 ? backward_directions<3> : a.channels == 1 ? backward_directions<1> : backward_directions<0>)(
        a, begin, end);
}

void cubemap_backward_texture(const CubemapArgs &a, int64_t begin, int64_t end, float *sums) {
    (a.channels == 3 ? backward_texture<3> : a.channels == 1 ? backward_texture<1> : backward_texture<0>)(
        a, begin, end, sums);
}

void mips_forward(const MipArgs &a, int64_t begin, int64_t end) {
    (a.channels == 3 ? between<3> : between<0>)(a, begin, end);
}

void mips_backward(const MipArgs &a, int64_t begin, int64_t end) {
    (a.channels == 3 ? between_backward<3> : between_backward<0>)(a, begin, end);
}

void mips_backward_textures(const MipArgs &a, int64_t begin, int64_t end, float *sums) {
    (a.channels == 3 ? between_texels<3> : between_texels<0>)(a, begin, end, sums);
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
