// Terms of the loss on pixels, with their gradients. Pixels are processed in blocks. Each loop in a block has one value per
// pixel, so the compiler vectorizes it for each instruction set. Missing pixels of a block are zero, for which all results
// are finite.
#include "terms.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr int block = 64;
constexpr float shortest = 1e-2f;           // length below which a blended normal is not normalized
constexpr float no_length = 1.1920929e-7f;  // length below which a normal has no direction
constexpr float no_area = 1e-6f;            // the same for normals of the depth, in units of the depth
constexpr float nearest = 1e-6f;            // depth

typedef float Lane[block];
struct alignas(64) Vec {
    Lane k[3];
};

inline int block_of(int64_t i, int64_t end) { return end - i < block ? int(end - i) : block; }

inline void read(const float *from, int n, Vec &v) {
    if (n < block) v = Vec{};
    if (n == block)
        for (int l = 0; l < block; ++l) v.k[0][l] = from[3 * l], v.k[1][l] = from[3 * l + 1], v.k[2][l] = from[3 * l + 2];
    else
        for (int l = 0; l < n; ++l) v.k[0][l] = from[3 * l], v.k[1][l] = from[3 * l + 1], v.k[2][l] = from[3 * l + 2];
}
inline void write(const Vec &v, int n, float *to) {
    for (int l = 0; l < n; ++l) to[3 * l] = v.k[0][l], to[3 * l + 1] = v.k[1][l], to[3 * l + 2] = v.k[2][l];
}
inline void add(const Vec &v, int n, float *to) {
    for (int l = 0; l < n; ++l) to[3 * l] += v.k[0][l], to[3 * l + 1] += v.k[1][l], to[3 * l + 2] += v.k[2][l];
}
inline void read_weight(const TermArgs &t, int64_t i, int n, Lane &weight) {
    for (int l = n; l < block; ++l) weight[l] = 0.0f;
    for (int l = 0; l < n; ++l) weight[l] = t.weight ? t.weight[i + l] : 1.0f;
}
inline double sum_of(const double *values) {
    double sum = 0.0;
    for (int l = 0; l < block; ++l) sum += values[l];
    return sum;
}

// Rotates by the matrix [3,3] or by its transpose.
inline void turn(const float *m, const Vec &v, Vec &out) {
    for (int l = 0; l < block; ++l)
        for (int r = 0; r < 3; ++r)
            out.k[r][l] = m[3 * r] * v.k[0][l] + m[3 * r + 1] * v.k[1][l] + m[3 * r + 2] * v.k[2][l];
}
inline void turn_back(const float *m, const Vec &v, Vec &out) {
    for (int l = 0; l < block; ++l)
        for (int r = 0; r < 3; ++r) out.k[r][l] = m[r] * v.k[0][l] + m[3 + r] * v.k[1][l] + m[6 + r] * v.k[2][l];
}

// Components of the unit normal toward the camera and along the lens frame (optics.lens_frame), Fresnel's degrees of
// polarization over sin^2 (optics.dolp_slopes), and intermediate values for their gradients.
struct alignas(64) Surface {
    Vec unit, ray;           // camera axes
    Lane inverse;            // 1 / length; 0 without direction
    Lane x, y, facing;       // facing: 1 if the cosine lies in [0, 1]
    Lane specular, diffuse;  // degrees of polarization over sin^2
    Lane by_cosine[2];       // and their derivatives
    Lane double_cos, double_sin;
};

inline void frame_at(const Vec &ray, int l, float *right, float *up) {
    const float x = ray.k[0][l], y = ray.k[1][l], z = ray.k[2][l], sum = 1.0f + z;
    const float scale = 1.0f / (sum > no_length ? sum : no_length), mixed = x * y * scale;
    right[0] = 1.0f - x * x * scale, right[1] = -mixed, right[2] = -x;
    up[0] = mixed, up[1] = y * y * scale - 1.0f, up[2] = y;
}

void surface_at(const Vec &normal, const Lane &index, Surface &s) {
    for (int l = 0; l < block; ++l) {
        const float n2 = index[l] * index[l], inverse_n2 = 1.0f / n2;
        const float nx = normal.k[0][l], ny = normal.k[1][l], nz = normal.k[2][l], squared = nx * nx + ny * ny + nz * nz;
        const bool live = squared > no_length * no_length;
        const float inverse = (live ? 1.0f : 0.0f) / sqrtf(live ? squared : 1.0f);
        const float ux = nx * inverse, uy = ny * inverse, uz = nz * inverse;
        float right[3], up[3];
        frame_at(s.ray, l, right, up);
        s.unit.k[0][l] = ux, s.unit.k[1][l] = uy, s.unit.k[2][l] = uz, s.inverse[l] = inverse;
        const float x = ux * right[0] + uy * right[1] + uz * right[2], y = ux * up[0] + uy * up[1] + uz * up[2];
        s.x[l] = x, s.y[l] = y, s.double_cos[l] = x * x - y * y, s.double_sin[l] = 2.0f * x * y;
        const float cosine = -(ux * s.ray.k[0][l] + uy * s.ray.k[1][l] + uz * s.ray.k[2][l]);
        const float above = cosine > 0.0f ? cosine : 0.0f, c = above < 1.0f ? above : 1.0f;
        s.facing[l] = c == cosine ? 1.0f : 0.0f;
        const float sine2 = 1.0f - c * c, t = sqrtf(n2 - sine2), inverse_t = 1.0f / t;
        const float below = 1.0f / (c * c * t * t + sine2 * sine2), specular = 2.0f * c * t * below;
        const float slope = (t - c) * (t - c) * inverse_n2, slope_by = -2.0f * slope * inverse_t;
        const float left = 1.0f / (2.0f - sine2 * slope), diffuse = slope * left;
        s.specular[l] = specular, s.diffuse[l] = diffuse;
        s.by_cosine[0][l] = 2.0f * below * (t + c * c * inverse_t - specular * c * (t * t + c * c - 2.0f * sine2));
        s.by_cosine[1][l] = left * (slope_by - diffuse * (2.0f * c * slope - sine2 * slope_by));
    }
}

// Sums of the gradient of a block's Stokes vectors, per color.
struct alignas(64) StokesGradient {
    Vec s[3];
};

inline void compare(const PolarizationArgs &a, int k, int64_t i, int n, const Lane &pull, const Vec *stokes,
                    StokesGradient &to, double *sums, const Lane &weight) {
    const float *analyzer = a.analyzers + 3 * k, a0 = analyzer[0], a1 = analyzer[1], a2 = analyzer[2];
    Vec measured;
    read(a.measured + 3 * (k * a.count + i), n, measured);
    for (int c = 0; c < 3; ++c)
        for (int l = 0; l < block; ++l) {
            const float d = a0 * stokes[0].k[c][l] + a1 * stokes[1].k[c][l] + a2 * stokes[2].k[c][l] - measured.k[c][l];
            const float g = d > 0.0f ? pull[l] : d < 0.0f ? -pull[l] : 0.0f;
            to.s[0].k[c][l] += a0 * g, to.s[1].k[c][l] += a1 * g, to.s[2].k[c][l] += a2 * g;
            sums[l] += double(weight[l] * fabsf(d));
        }
}

} // namespace

// Contribution of metals in two blocks of colors; zero without metal.
namespace {
inline void read_metal(const PolarizationArgs &a, int64_t i, int n, Vec &metal, Vec &field) {
    metal = Vec{}, field = Vec{};
    for (int l = 0; l < n; ++l)
        for (int c = 0; c < 3; ++c)
            metal.k[c][l] = 2.0f * a.metal[6 * (i + l) + c], field.k[c][l] = 2.0f * a.metal[6 * (i + l) + 3 + c];
}
} // namespace

template <bool with_metal> void polarization_term_of(const PolarizationArgs &a, int64_t begin, int64_t end) {
    alignas(64) double sums[block] = {};
    for (int64_t i = begin; i < end; i += block) {
        const int n = block_of(i, end);
        Surface s;
        Vec normal, turned, specular, diffuse, stokes[3], metal, field;
        if (with_metal) read_metal(a, i, n, metal, field);
        alignas(64) Lane weight, pull, index;
        read(a.term.normal + 3 * i, n, normal), read(a.rays + 3 * i, n, s.ray);
        read(a.specular + 3 * i, n, specular), read(a.diffuse + 3 * i, n, diffuse);
        read_weight(a.term, i, n, weight);
        turn(a.rotation, normal, turned);
        for (int l = 0; l < block; ++l) index[l] = a.index && l < n ? a.index[i + l] : a.refractive_index;
        surface_at(turned, index, s);
        for (int l = 0; l < block; ++l) pull[l] = a.term.factor * weight[l];
        for (int c = 0; c < 3; ++c)
            for (int l = 0; l < block; ++l) {
                const float over = 2.0f * specular.k[c][l], under = 2.0f * diffuse.k[c][l];
                float polarized = s.diffuse[l] * under - s.specular[l] * over;
                if (with_metal) polarized += s.specular[l] * metal.k[c][l] - field.k[c][l];
                stokes[0].k[c][l] = over + under;
                stokes[1].k[c][l] = polarized * s.double_cos[l], stokes[2].k[c][l] = polarized * s.double_sin[l];
            }
        StokesGradient by{};
        for (int k = 0; k < a.measurements; ++k) compare(a, k, i, n, pull, stokes, by, sums, weight);
        Vec to_specular, to_diffuse, to_unit, to_normal;
        for (int l = 0; l < block; ++l) {
            float by_specular = 0.0f, by_diffuse = 0.0f, by_cos = 0.0f, by_sin = 0.0f;
            for (int c = 0; c < 3; ++c) {
                float over = 2.0f * specular.k[c][l];
                const float under = 2.0f * diffuse.k[c][l];
                if (with_metal) over -= metal.k[c][l];
                float polarized = s.diffuse[l] * under - s.specular[l] * over;
                if (with_metal) polarized -= field.k[c][l];
                const float g = by.s[1].k[c][l] * s.double_cos[l] + by.s[2].k[c][l] * s.double_sin[l];
                by_cos += polarized * by.s[1].k[c][l], by_sin += polarized * by.s[2].k[c][l];
                by_specular -= over * g, by_diffuse += under * g;
                to_specular.k[c][l] = 2.0f * (by.s[0].k[c][l] - s.specular[l] * g);
                to_diffuse.k[c][l] = 2.0f * (by.s[0].k[c][l] + s.diffuse[l] * g);
                if (with_metal) metal.k[c][l] = 2.0f * s.specular[l] * g, field.k[c][l] = -2.0f * g;
            }
            const float by_cosine = s.facing[l] * (by_specular * s.by_cosine[0][l] + by_diffuse * s.by_cosine[1][l]);
            const float by_x = 2.0f * (s.x[l] * by_cos + s.y[l] * by_sin), by_y = 2.0f * (s.x[l] * by_sin - s.y[l] * by_cos);
            float right[3], up[3], g[3], radial = 0.0f;
            frame_at(s.ray, l, right, up);
            for (int r = 0; r < 3; ++r) {
                g[r] = by_x * right[r] + by_y * up[r] - by_cosine * s.ray.k[r][l];
                radial += g[r] * s.unit.k[r][l];
            }
            for (int r = 0; r < 3; ++r) to_unit.k[r][l] = s.inverse[l] * (g[r] - radial * s.unit.k[r][l]);
        }
        turn_back(a.rotation, to_unit, to_normal);
        add(to_normal, n, a.term.grad_normal + 3 * i);
        write(to_specular, n, a.grad_specular + 3 * i), write(to_diffuse, n, a.grad_diffuse + 3 * i);
        for (int l = 0; with_metal && l < n; ++l)
            for (int c = 0; c < 3; ++c)
                a.grad_metal[6 * (i + l) + c] = metal.k[c][l], a.grad_metal[6 * (i + l) + 3 + c] = field.k[c][l];
    }
    a.term.parts[begin / pixels_per_part] = sum_of(sums);
}

void polarization_term(const PolarizationArgs &a, int64_t begin, int64_t end) {
    a.metal ? polarization_term_of<true>(a, begin, end) : polarization_term_of<false>(a, begin, end);
}

void direction_term(const DirectionArgs &a, int64_t begin, int64_t end) {
    alignas(64) double sums[block] = {};
    const float offset = a.plane ? 0.0f : 1.0f;
    for (int64_t i = begin; i < end; i += block) {
        const int n = block_of(i, end);
        Vec normal, direction, to_normal;
        alignas(64) Lane weight;
        read(a.term.normal + 3 * i, n, normal), read(a.direction + 3 * i, n, direction);
        read_weight(a.term, i, n, weight);
        for (int l = 0; l < block; ++l) {
            float squared = 0.0f, along = 0.0f;
            for (int r = 0; r < 3; ++r)
                squared += normal.k[r][l] * normal.k[r][l], along += normal.k[r][l] * direction.k[r][l];
            const bool whole = squared >= shortest * shortest;
            const float inverse = 1.0f / sqrtf(whole ? squared : shortest * shortest), cosine = along * inverse;
            // The distance decreases with the cosine, except on the positive side of a plane.
            const float sign = !a.plane || cosine < 0.0f ? -1.0f : cosine > 0.0f ? 1.0f : 0.0f;
            const float g = a.term.factor * weight[l] * sign * inverse, radial = whole ? cosine * inverse : 0.0f;
            sums[l] += double(weight[l] * (offset + (a.plane ? fabsf(cosine) : -cosine)));
            for (int r = 0; r < 3; ++r) to_normal.k[r][l] = g * (direction.k[r][l] - radial * normal.k[r][l]);
        }
        add(to_normal, n, a.term.grad_normal + 3 * i);
    }
    a.term.parts[begin / pixels_per_part] = sum_of(sums);
}

namespace {

// Row of the depth picture: rays (x, y, 1) and their depths z, with zeros before it and up to the end of the last block.
constexpr int margin = 16;
struct Line {
    float *x, *y, *z;
};
inline Line line_at(float *scratch, int64_t room, int place) {
    float *start = scratch + 3 * room * place + margin;
    return {start, start + room, start + 2 * room};
}
void lay_line(const ConsistencyArgs &a, int64_t row, int64_t room, const Line &line) {
    const float *ray = a.rays + 3 * row * a.width, *depth = a.depth + row * a.width;
    for (int64_t x = -margin; x < 0; ++x) line.x[x] = line.y[x] = line.z[x] = 0.0f;
    for (int64_t x = a.width; x < room - margin; ++x) line.x[x] = line.y[x] = line.z[x] = 0.0f;
    for (int64_t x = 0; x < a.width; ++x) {
        const float inverse = 1.0f / ray[3 * x + 2];
        line.x[x] = ray[3 * x] * inverse, line.y[x] = ray[3 * x + 1] * inverse, line.z[x] = depth[x];
    }
}

struct Neighbors {
    const float *x, *y, *z; // at the first pixel of a block
};
inline Neighbors from(const Line &line, int64_t at) { return {line.x + at, line.y + at, line.z + at}; }

// Gradients of a block: of the blended normal in camera axes, and of the depth of each neighbor.
struct alignas(64) DepthBlock {
    Vec normal, to_normal; // camera axes
    Lane weight, distance, to_left, to_right, to_up, to_down;
};

void consistency_block(const Neighbors &left, const Neighbors &right, const Neighbors &up, const Neighbors &down,
                       const float *middle, float factor, DepthBlock &b) {
    for (int l = 0; l < block; ++l) {
        const float scale = 1.0f / (middle[l] > nearest ? middle[l] : nearest);
        const float ax = (right.x[l] * right.z[l] - left.x[l] * left.z[l]) * scale;
        const float ay = (right.y[l] * right.z[l] - left.y[l] * left.z[l]) * scale;
        const float az = (right.z[l] - left.z[l]) * scale;
        const float dx = (down.x[l] * down.z[l] - up.x[l] * up.z[l]) * scale;
        const float dy = (down.y[l] * down.z[l] - up.y[l] * up.z[l]) * scale;
        const float dz = (down.z[l] - up.z[l]) * scale;
        const float cx = dy * az - dz * ay, cy = dz * ax - dx * az, cz = dx * ay - dy * ax; // down x across
        const float squared = cx * cx + cy * cy + cz * cz;
        const bool whole = squared >= no_area * no_area;
        const float inverse = 1.0f / sqrtf(whole ? squared : no_area * no_area);
        const float ux = cx * inverse, uy = cy * inverse, uz = cz * inverse;
        const float nx = b.normal.k[0][l], ny = b.normal.k[1][l], nz = b.normal.k[2][l];
        const float cosine = nx * ux + ny * uy + nz * uz, pull = -factor * b.weight[l];
        b.distance[l] -= cosine;
        b.to_normal.k[0][l] = pull * ux, b.to_normal.k[1][l] = pull * uy, b.to_normal.k[2][l] = pull * uz;
        const float radial = whole ? cosine : 0.0f, outer = pull * inverse * scale;
        const float gx = outer * (nx - radial * ux), gy = outer * (ny - radial * uy), gz = outer * (nz - radial * uz);
        const float px = gy * dz - gz * dy, py = gz * dx - gx * dz, pz = gx * dy - gy * dx; // g x down: gradient of across
        const float qx = ay * gz - az * gy, qy = az * gx - ax * gz, qz = ax * gy - ay * gx; // across x g: gradient of down
        b.to_right[l] = right.x[l] * px + right.y[l] * py + pz, b.to_left[l] = -(left.x[l] * px + left.y[l] * py + pz);
        b.to_down[l] = down.x[l] * qx + down.y[l] * qy + qz, b.to_up[l] = -(up.x[l] * qx + up.y[l] * qy + qz);
    }
}

// Lines before, at and after row y. They are reused between rows: each is prepared once per chunk.
struct Lines {
    Line line[3];
    float *leftward, *rightward; // contributions of a row, by source pixel
};

void consistency_row(const ConsistencyArgs &a, int64_t y, const Lines &lines) {
    alignas(64) double sums[block] = {};
    const Line &above = lines.line[(y + 2) % 3], &here = lines.line[y % 3], &below = lines.line[(y + 1) % 3];
    for (int64_t x = 0; x < a.width; x += block) {
        const int n = block_of(x, a.width);
        const int64_t i = y * a.width + x;
        DepthBlock b;
        Vec normal;
        read(a.term.normal + 3 * i, n, normal);
        turn(a.rotation, normal, b.normal);
        read_weight(a.term, i, n, b.weight);
        for (int l = 0; l < block; ++l) {
            if (x + l == 0 || x + l >= a.width - 1) b.weight[l] = 0.0f;
            b.distance[l] = l < n ? a.alpha[i + l] : 0.0f;
        }
        consistency_block(from(here, x - 1), from(here, x + 1), from(above, x), from(below, x), here.z + x, a.term.factor, b);
        for (int l = x ? 0 : 1; l < n && x + l < a.width - 1; ++l) sums[l] += double(b.weight[l] * b.distance[l]);
        for (int l = 0; l < block; ++l) lines.leftward[x + l] = b.to_left[l], lines.rightward[x + l] = b.to_right[l];
        for (int l = 0; l < n; ++l) a.upward[i + l] = b.to_up[l], a.downward[i + l] = b.to_down[l];
        turn_back(a.rotation, b.to_normal, normal);
        add(normal, n, a.term.grad_normal + 3 * i);
    }
    a.term.parts[y] = sum_of(sums);
    float *to = a.grad_depth + y * a.width;
    for (int64_t x = 0; x < a.width; ++x) to[x] = lines.rightward[x - 1] + lines.leftward[x + 1];
}

} // namespace

// Rows 1 to H - 2. Each row writes its contributions to the adjacent rows, and consistency_gather adds them.
void consistency_term(const ConsistencyArgs &a, int64_t begin, int64_t end, float *scratch) {
    const int64_t room = consistency_room(a.width);
    Lines lines;
    for (int k = 0; k < 3; ++k) lines.line[k] = line_at(scratch, room, k);
    lines.leftward = scratch + 9 * room + margin, lines.rightward = lines.leftward + room;
    for (int64_t x = -margin; x < room - margin; ++x) lines.leftward[x] = lines.rightward[x] = 0.0f;
    for (int64_t y = begin; y < end; ++y) {
        if (y == begin) lay_line(a, y - 1, room, lines.line[(y + 2) % 3]), lay_line(a, y, room, lines.line[y % 3]);
        lay_line(a, y + 1, room, lines.line[(y + 1) % 3]);
        consistency_row(a, y, lines);
    }
}

void consistency_gather(const ConsistencyArgs &a, int64_t begin, int64_t end) {
    for (int64_t y = begin; y < end; ++y) {
        const bool inner = y > 0 && y < a.height - 1, from_above = y >= 2, from_below = y < a.height - 2;
        const int64_t row = y * a.width;
        for (int64_t x = 0; x < a.width; ++x) {
            float sum = inner ? a.grad_depth[row + x] : 0.0f;
            if (from_above) sum += a.downward[row - a.width + x];
            if (from_below) sum += a.upward[row + a.width + x];
            a.grad_depth[row + x] = sum;
        }
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
