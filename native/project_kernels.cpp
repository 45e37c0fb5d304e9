// EWA projection of Gaussians, the tiles that they touch, and the gradients of the projection.
#include "peak.h"
#include "raster.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float blur = 0.1f; // px^2, added to the projected covariance
constexpr float natural = 0.693147181f;
constexpr float minimum_opacity = 1.0f / 255.0f;

// Tiles of a Gaussian are examined in groups: four columns and as many rows as fill a register.
constexpr int group_columns = 4, group_rows = reg_lanes / group_columns;
alignas(64) const float lane_column[16] = {0, 16, 32, 48, 0, 16, 32, 48, 0, 16, 32, 48, 0, 16, 32, 48};
alignas(64) const float lane_row[16] = {0, 0, 0, 0, 16, 16, 16, 16, 32, 32, 32, 32, 48, 48, 48, 48};
static_assert(tile_size == 16, "lane_column and lane_row say where a group's tiles begin");

// Lowest and highest bit of a row of a group. For an empty row they are outside all columns, in reverse order.
constexpr int none = 1 << 20;
const int lowest[16] = {none, 0, 1, 0, 2, 0, 1, 0, 3, 0, 1, 0, 2, 0, 1, 0};
const int highest[16] = {-none, 0, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3, 3};

// Values common to the forward and the backward projection, one Gaussian per lane of a register. Lanes of culled Gaussians
// are undefined.
struct Projection {
    ireg valid;             // in front of the near plane and opaque enough
    reg t[3], opacity;          // camera-space mean
    reg tx, ty;                 // its x and y, clamped for the Jacobian to the surroundings of the picture
    ireg clamped_x, clamped_y;
    reg q[4], norm;             // unit quaternion (w, x, y, z), and its length before
    reg s[3];
    reg w[9];                   // camera rotation times the rotation of the Gaussian
    reg v[9];                   // camera-space covariance
    reg j[4];                   // Jacobian: j0 = fx/z, j1 = -fx tx/z^2, j2 = fy/z, j3 = -fy ty/z^2
    reg a, b, c;                // 2D covariance with the blur
    reg determinant;            // of it
};

POLARGUIDE_INLINE reg limited(reg x, float low, float high, ireg *clamped) {
    *clamped = (x < low) | (x > high);
    return clamp(x, reg_splat(low), reg_splat(high));
}

// Gaussians g to g + n, at most one per lane.
POLARGUIDE_INLINE void project_some(const ProjectArgs &p, int64_t g, int n, Projection *o) {
    const PinholeCamera &cam = p.camera;
    const float *R = cam.rotation;
    reg m[3], q[4];
    load_columns<3>(p.means + 3 * g, n, m);
    load_columns<4>(p.quaternions + 4 * g, n, q);
    load_columns<3>(p.scales + 3 * g, n, o->s);
    load_columns<1>(p.opacities + g, n, &o->opacity);
    for (int i = 0; i < 3; ++i)
        o->t[i] = R[3 * i] * m[0] + R[3 * i + 1] * m[1] + R[3 * i + 2] * m[2] + cam.translation[i];
    const reg z = o->t[2];
    o->valid = (z > cam.near_plane) & (o->opacity >= minimum_opacity);
    o->norm = max(square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), reg_splat(1e-12f));
    const reg unit = 1.0f / o->norm;
    for (int i = 0; i < 4; ++i) o->q[i] = q[i] * unit;
    const reg w = o->q[0], x = o->q[1], y = o->q[2], k = o->q[3];
    const reg r[9] = {1.0f - 2.0f * (y * y + k * k), 2.0f * (x * y - w * k), 2.0f * (x * k + w * y),
                      2.0f * (x * y + w * k), 1.0f - 2.0f * (x * x + k * k), 2.0f * (y * k - w * x),
                      2.0f * (x * k - w * y), 2.0f * (y * k + w * x), 1.0f - 2.0f * (x * x + y * y)};
    reg e[9]; // w times the scales: the covariance is e e^T
    for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 3; ++c) {
            o->w[3 * i + c] = R[3 * i] * r[c] + R[3 * i + 1] * r[3 + c] + R[3 * i + 2] * r[6 + c];
            e[3 * i + c] = o->w[3 * i + c] * o->s[c];
        }
    for (int i = 0; i < 3; ++i)
        for (int c = i; c < 3; ++c)
            o->v[3 * i + c] = o->v[3 * c + i] = e[3 * i] * e[3 * c] + e[3 * i + 1] * e[3 * c + 1] + e[3 * i + 2] * e[3 * c + 2];
    const reg rz = 1.0f / z;
    const float margin_x = 0.15f * cam.width / cam.fx, margin_y = 0.15f * cam.height / cam.fy;
    const reg u = limited(o->t[0] * rz, -cam.cx / cam.fx - margin_x, (cam.width - cam.cx) / cam.fx + margin_x, &o->clamped_x);
    const reg h = limited(o->t[1] * rz, -cam.cy / cam.fy - margin_y, (cam.height - cam.cy) / cam.fy + margin_y, &o->clamped_y);
    o->tx = u * z, o->ty = h * z;
    o->j[0] = cam.fx * rz, o->j[1] = -cam.fx * u * rz, o->j[2] = cam.fy * rz, o->j[3] = -cam.fy * h * rz;
    const reg *j = o->j;
    reg p0[3], p1[3]; // rows of J e; their products are the covariance
    for (int c = 0; c < 3; ++c) p0[c] = j[0] * e[c] + j[1] * e[6 + c], p1[c] = j[2] * e[3 + c] + j[3] * e[6 + c];
    const reg a = p0[0] * p0[0] + p0[1] * p0[1] + p0[2] * p0[2], c = p1[0] * p1[0] + p1[1] * p1[1] + p1[2] * p1[2];
    o->a = a + blur, o->c = c + blur;
    o->b = p0[0] * p1[0] + p0[1] * p1[1] + p0[2] * p1[2];
    // a c - b^2 cancels for needles; a sum of squared minors does not.
    const reg m0 = p0[1] * p1[2] - p0[2] * p1[1], m1 = p0[2] * p1[0] - p0[0] * p1[2], m2 = p0[0] * p1[1] - p0[1] * p1[0];
    o->determinant = m0 * m0 + m1 * m1 + m2 * m2 + blur * (a + c) + blur * blur;
}

// Writes the values that the picture needs.
struct Shown {
    alignas(64) float screen[screen_values][reg_lanes], half_x[reg_lanes], half_y[reg_lanes], radius[reg_lanes], depth[reg_lanes];
    alignas(64) int32_t kept[reg_lanes];
};

POLARGUIDE_INLINE void show(const PinholeCamera &cam, const Projection &o, Shown *out) {
    const reg inverse = 1.0f / o.determinant, rz = 1.0f / o.t[2];
    const reg x = cam.fx * o.t[0] * rz + cam.cx, y = cam.fy * o.t[1] * rz + cam.cy;
    const reg level = log2(max(o.opacity, reg_splat(minimum_opacity)));
    // alpha >= 1/255 inside the ellipse d^T conic d <= reach
    const reg reach = max(2.0f * natural * (level + 7.99435344f), reg{});
    const reg half_x = square_root(reach * o.a), half_y = square_root(reach * o.c);
    const ireg kept = o.valid & (o.determinant > 0.0f) & (o.determinant < 1e30f) & (x + half_x > 0.0f) &
                          (x - half_x < float(cam.width)) & (y + half_y > 0.0f) & (y - half_y < float(cam.height));
    const reg middle = 0.5f * (o.a + o.c), spread = middle * middle - o.determinant;
    const reg scale = inverse / natural;
    const reg values[screen_values] = {x, y, -0.5f * o.c * scale, o.b * scale, -0.5f * o.a * scale, level, o.b / o.a, o.b / o.c};
    for (int k = 0; k < screen_values; ++k) reg_store(out->screen[k], values[k]);
    reg_store(out->half_x, half_x), reg_store(out->half_y, half_y), reg_store(out->depth, o.t[2]);
    reg_store(out->radius, 3.0f * square_root(middle + square_root(max(spread, reg_splat(0.1f)))));
    __builtin_memcpy(out->kept, &kept, sizeof kept);
}

POLARGUIDE_INLINE int clamp_tile(float pixel, int tiles) {
    float t = floorf(pixel * (1.0f / tile_size));
    return t < 0.0f ? 0 : t > float(tiles) ? tiles : int(t);
}

} // namespace

void project(const ProjectArgs &p, int64_t begin, int64_t end) {
    const int tiles_x = (p.camera.width + tile_size - 1) / tile_size, tiles_y = (p.camera.height + tile_size - 1) / tile_size;
    for (int64_t first = begin; first < end; first += reg_lanes) {
        const int n = end - first < reg_lanes ? int(end - first) : reg_lanes;
        Projection o;
        Shown shown;
        project_some(p, first, n, &o);
        show(p.camera, o, &shown);
        for (int l = 0; l < n; ++l) {
            const int64_t g = first + l;
            int32_t *box = p.box + 4 * g;
            box[0] = box[1] = box[2] = box[3] = 0;
            p.radius[g] = p.depth[g] = 0.0f;
            if (!shown.kept[l]) continue;
            const float x = shown.screen[0][l], y = shown.screen[1][l], half_x = shown.half_x[l], half_y = shown.half_y[l];
            const int x0 = clamp_tile(x - half_x, tiles_x), x1 = clamp_tile(x + half_x + tile_size, tiles_x);
            const int y0 = clamp_tile(y - half_y, tiles_y), y1 = clamp_tile(y + half_y + tile_size, tiles_y);
            if (x0 >= x1 || y0 >= y1) continue;
            box[0] = x0, box[1] = x1, box[2] = y0, box[3] = y1;
            for (int k = 0; k < screen_values; ++k) p.screen[g * screen_values + k] = shown.screen[k][l];
            p.depth[g] = shown.depth[l], p.radius[g] = shown.radius[l];
        }
    }
}

void emit_tiles(const TileEmitArgs &args, int64_t begin, int64_t end) {
    constexpr float side = tile_size - 1; // between the outermost pixel centers
    for (int64_t g = begin; g < end; ++g) {
        const int32_t *box = args.box + 4 * g;
        TileRun *runs = args.runs + args.offset[g];
        int32_t count = 0, touched = 0;
        const float *s = args.screen + g * screen_values;
        for (int ty = box[2]; ty < box[3]; ty += group_rows) {
            const reg y0 = reg_load(lane_row) + (float(ty * tile_size) + 0.5f - s[1]);
            const int rows = box[3] - ty < group_rows ? box[3] - ty : group_rows;
            int first[group_rows], last[group_rows]; // columns
            for (int r = 0; r < group_rows; ++r) first[r] = none, last[r] = -none;
            for (int tx = box[0]; tx < box[1]; tx += group_columns) {
                const reg x0 = reg_load(lane_column) + (float(tx * tile_size) + 0.5f - s[0]);
                const reg peak = peak_inside(s, s[6], s[7], x0, x0 + side, y0, y0 + side);
                uint32_t inside = bits(at_least(peak, reg_splat(log2_minimum - 1e-4f)));
                if (box[1] - tx < group_columns) inside &= ((1u << (box[1] - tx)) - 1) * 0x1111u;
                for (int r = 0; r < group_rows; ++r, inside >>= group_columns) {
                    const uint32_t here = inside & ((1u << group_columns) - 1);
                    const int low = tx + lowest[here], high = tx + highest[here];
                    first[r] = low < first[r] ? low : first[r], last[r] = high > last[r] ? high : last[r];
                }
            }
            for (int r = 0; r < rows; ++r) {
                if (first[r] > last[r]) continue; // tiles between count even if rounding excludes them; none of their blocks is touched
                runs[count++] = {uint16_t(ty + r), uint16_t(first[r]), uint16_t(last[r] + 1)};
                touched += last[r] + 1 - first[r];
            }
        }
        args.count[g] = count, args.touched[g] = touched;
    }
}

namespace {

// Computes gradients of the 3D mean, quaternion and scales from gradients of the 2D mean and conic.
POLARGUIDE_INLINE void project_some_backward(const PinholeCamera &cam, const Projection &o, const reg *grad, reg *mean,
                                             reg *quaternion, reg *scale) {
    // conic = inverse of [[a, b], [b, c]]: gradient of the covariance is -conic G conic.
    const reg inverse = 1.0f / o.determinant;
    const reg ka = o.c * inverse, kb = -o.b * inverse, kc = o.a * inverse;
    const reg ga = grad[2], gb = 0.5f * grad[3], gc = grad[4];
    const reg m00 = ka * ga + kb * gb, m01 = ka * gb + kb * gc, m10 = kb * ga + kc * gb, m11 = kb * gb + kc * gc;
    const reg d00 = -(m00 * ka + m01 * kb), d01 = -(m00 * kb + m01 * kc), d11 = -(m10 * kb + m11 * kc);
    const reg *j = o.j, *v = o.v;
    // Gradient of V = J^T D J (symmetric), J rows: (j0, 0, j1), (0, j2, j3).
    const reg zero = {}, r0[3] = {j[0], zero, j[1]}, r1[3] = {zero, j[2], j[3]};
    reg dv[9];
    for (int i = 0; i < 3; ++i)
        for (int k = i; k < 3; ++k)
            dv[3 * i + k] = dv[3 * k + i] = r0[i] * (d00 * r0[k] + d01 * r1[k]) + r1[i] * (d01 * r0[k] + d11 * r1[k]);
    // Gradient of J = 2 D J V.
    reg jv0[3], jv1[3];
    for (int k = 0; k < 3; ++k) {
        jv0[k] = j[0] * v[k] + j[1] * v[6 + k];
        jv1[k] = j[2] * v[3 + k] + j[3] * v[6 + k];
    }
    const reg dj0 = 2.0f * (d00 * jv0[0] + d01 * jv1[0]), dj1 = 2.0f * (d00 * jv0[2] + d01 * jv1[2]);
    const reg dj2 = 2.0f * (d01 * jv0[1] + d11 * jv1[1]), dj3 = 2.0f * (d01 * jv0[2] + d11 * jv1[2]);
    const reg rz = 1.0f / o.t[2], rz2 = rz * rz;
    reg dt[3];
    dt[0] = cam.fx * rz * grad[0], dt[1] = cam.fy * rz * grad[1];
    dt[2] = -(cam.fx * o.t[0] * grad[0] + cam.fy * o.t[1] * grad[1]) * rz2;
    // j0 = fx/z; j1 = -fx tx/z^2 with tx = x, or z times a constant if clamped.
    dt[2] -= rz2 * (cam.fx * dj0 + cam.fy * dj2);
    const reg by_x = cam.fx * rz2 * dj1, by_y = cam.fy * rz2 * dj3;
    const reg along_x = o.tx * rz * by_x, along_y = o.ty * rz * by_y;
    dt[0] -= o.clamped_x ? zero : by_x, dt[1] -= o.clamped_y ? zero : by_y;
    dt[2] += (o.clamped_x ? along_x : 2.0f * along_x) + (o.clamped_y ? along_y : 2.0f * along_y);
    const float *R = cam.rotation;
    for (int i = 0; i < 3; ++i) mean[i] = R[i] * dt[0] + R[3 + i] * dt[1] + R[6 + i] * dt[2];
    // V = N N^T, N = W S, W = camera rotation * r: dN = 2 dV N.
    reg dw[9];
    for (int c = 0; c < 3; ++c) {
        reg sum = zero;
        for (int i = 0; i < 3; ++i) {
            const reg dn = 2.0f * o.s[c] * (dv[3 * i] * o.w[c] + dv[3 * i + 1] * o.w[3 + c] + dv[3 * i + 2] * o.w[6 + c]);
            sum += dn * o.w[3 * i + c];
            dw[3 * i + c] = dn * o.s[c];
        }
        scale[c] = sum;
    }
    reg dr[9];
    for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 3; ++c) dr[3 * i + c] = R[i] * dw[c] + R[3 + i] * dw[3 + c] + R[6 + i] * dw[6 + c];
    const reg w = o.q[0], x = o.q[1], y = o.q[2], z = o.q[3];
    reg dq[4];
    dq[0] = 2.0f * (x * (dr[7] - dr[5]) + y * (dr[2] - dr[6]) + z * (dr[3] - dr[1]));
    dq[1] = 2.0f * (w * (dr[7] - dr[5]) - 2.0f * x * (dr[4] + dr[8]) + y * (dr[1] + dr[3]) + z * (dr[2] + dr[6]));
    dq[2] = 2.0f * (w * (dr[2] - dr[6]) + x * (dr[1] + dr[3]) - 2.0f * y * (dr[0] + dr[8]) + z * (dr[5] + dr[7]));
    dq[3] = 2.0f * (w * (dr[3] - dr[1]) + x * (dr[2] + dr[6]) + y * (dr[5] + dr[7]) - 2.0f * z * (dr[0] + dr[4]));
    const reg along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z, unit = 1.0f / o.norm;
    for (int i = 0; i < 4; ++i) quaternion[i] = (dq[i] - along * o.q[i]) * unit;
}

// Sums the rows of one Gaussian's instances and writes gradients that do not depend on the projection; false without
// instances. After the features, `sum` holds the gradients of the 2D mean and conic.
POLARGUIDE_INLINE bool sum_instances(const ProjectBackwardArgs &args, int64_t g, float *sum) {
    const int d = args.channels, real = args.channels_real, stride = d + instance_extra;
    const int64_t first = args.instance_begin[g], last = args.instance_begin[g + 1];
    for (int i = 0; i < stride; i += lanes) { // rows have space for a whole vector after the last value
        vf total = {};
        for (int64_t n = first; n < last; ++n) total += load(args.grad_instances + n * stride + i);
        store(sum + i, total);
    }
    float *features = args.grad_features + g * real;
    for (int k = 0; k < real; ++k) features[args.permutation[k]] = sum[k];
    const float *extra = sum + d;
    args.grad_opacities[g] = first < last ? extra[5] / args.forward.opacities[g] : 0.0f;
    if (args.statistic) args.statistic[2 * g] = extra[6], args.statistic[2 * g + 1] = extra[7];
    return first < last;
}

} // namespace

void project_backward(const ProjectBackwardArgs &args, int64_t begin, int64_t end) {
    alignas(64) float sum[max_channels + instance_extra + lanes], grads[5][reg_lanes];
    alignas(64) int32_t seen[reg_lanes];
    for (int64_t first = begin; first < end; first += reg_lanes) {
        const int n = end - first < reg_lanes ? int(end - first) : reg_lanes;
        reg mean[3] = {}, quaternion[4] = {}, scale[3] = {};
        bool any_seen = false;
        for (int l = 0; l < reg_lanes; ++l) {
            seen[l] = l < n && sum_instances(args, first + l, sum) ? -1 : 0;
            for (int k = 0; k < 5; ++k) grads[k][l] = seen[l] ? sum[args.channels + k] : 0.0f;
            any_seen |= seen[l] != 0;
        }
        if (any_seen) {
            Projection o;
            reg grad[5];
            ireg used;
            __builtin_memcpy(grad, grads, sizeof grad), __builtin_memcpy(&used, seen, sizeof used);
            project_some(args.forward, first, n, &o);
            project_some_backward(args.forward.camera, o, grad, mean, quaternion, scale);
            for (reg &value : mean) value = used ? value : reg{};
            for (reg &value : quaternion) value = used ? value : reg{};
            for (reg &value : scale) value = used ? value : reg{};
        }
        store_columns<3>(args.grad_means + 3 * first, n, mean);
        store_columns<4>(args.grad_quaternions + 4 * first, n, quaternion);
        store_columns<3>(args.grad_scales + 3 * first, n, scale);
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
