// EWA projection of the Gaussians, the tiles they touch, and the gradients of both.
#include "raster.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float blur = 0.3f; // px^2, added to the projected covariance
constexpr float natural = 0.693147181f;
constexpr float minimum_opacity = 1.0f / 255.0f;

// All that the forward and the backward projection of one Gaussian share.
struct Projection {
    float t[3];          // camera-space mean
    float tx, ty;        // its x and y, clamped for the Jacobian as far as the picture's surroundings reach
    bool clamped_x, clamped_y;
    float q[4], norm;    // unit quaternion (w, x, y, z), and the length it had
    float r[9];          // rotation of the Gaussian
    float s[3];
    float w[9];          // camera rotation times r
    float v[9];          // camera-space covariance
    float j[4];          // Jacobian: j0 = fx/z, j1 = -fx tx/z^2, j2 = fy/z, j3 = -fy ty/z^2
    float a, b, c;       // 2D covariance with the blur
    float determinant;   // of it
};

POLARGUIDE_INLINE void multiply(const float *x, const float *y, float *out) { // 3 x 3
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) out[3 * i + k] = x[3 * i] * y[k] + x[3 * i + 1] * y[3 + k] + x[3 * i + 2] * y[6 + k];
}

POLARGUIDE_INLINE float limited(float x, float low, float high, bool *clamped) {
    *clamped = x < low || x > high;
    return x < low ? low : x > high ? high : x;
}

POLARGUIDE_INLINE bool project_one(const ProjectArgs &p, int64_t g, Projection *o) {
    const PinholeCamera &cam = p.camera;
    const float *m = p.means + 3 * g, *R = cam.rotation;
    for (int i = 0; i < 3; ++i)
        o->t[i] = R[3 * i] * m[0] + R[3 * i + 1] * m[1] + R[3 * i + 2] * m[2] + cam.translation[i];
    const float z = o->t[2];
    if (!(z > cam.near_plane) || !(p.opacities[g] >= minimum_opacity)) return false;
    const float *q = p.quaternions + 4 * g;
    o->norm = sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const float unit = 1.0f / (o->norm > 1e-12f ? o->norm : 1e-12f);
    for (int i = 0; i < 4; ++i) o->q[i] = q[i] * unit;
    const float w = o->q[0], x = o->q[1], y = o->q[2], k = o->q[3];
    float *r = o->r;
    r[0] = 1 - 2 * (y * y + k * k), r[1] = 2 * (x * y - w * k), r[2] = 2 * (x * k + w * y);
    r[3] = 2 * (x * y + w * k), r[4] = 1 - 2 * (x * x + k * k), r[5] = 2 * (y * k - w * x);
    r[6] = 2 * (x * k - w * y), r[7] = 2 * (y * k + w * x), r[8] = 1 - 2 * (x * x + y * y);
    for (int i = 0; i < 3; ++i) o->s[i] = p.scales[3 * g + i];
    multiply(R, r, o->w);
    float n[9];
    for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 3; ++c) n[3 * i + c] = o->w[3 * i + c] * o->s[c];
    for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 3; ++c)
            o->v[3 * i + c] = n[3 * i] * n[3 * c] + n[3 * i + 1] * n[3 * c + 1] + n[3 * i + 2] * n[3 * c + 2];
    const float rz = 1.0f / z;
    const float margin_x = 0.15f * cam.width / cam.fx, margin_y = 0.15f * cam.height / cam.fy;
    const float u = limited(o->t[0] * rz, -cam.cx / cam.fx - margin_x, (cam.width - cam.cx) / cam.fx + margin_x, &o->clamped_x);
    const float h = limited(o->t[1] * rz, -cam.cy / cam.fy - margin_y, (cam.height - cam.cy) / cam.fy + margin_y, &o->clamped_y);
    o->tx = u * z, o->ty = h * z;
    o->j[0] = cam.fx * rz, o->j[1] = -cam.fx * u * rz, o->j[2] = cam.fy * rz, o->j[3] = -cam.fy * h * rz;
    const float *j = o->j;
    float p0[3], p1[3]; // rows of J N, whose products are the covariance
    for (int c = 0; c < 3; ++c) p0[c] = j[0] * n[c] + j[1] * n[6 + c], p1[c] = j[2] * n[3 + c] + j[3] * n[6 + c];
    const float a = p0[0] * p0[0] + p0[1] * p0[1] + p0[2] * p0[2], c = p1[0] * p1[0] + p1[1] * p1[1] + p1[2] * p1[2];
    o->a = a + blur, o->c = c + blur;
    o->b = p0[0] * p1[0] + p0[1] * p1[1] + p0[2] * p1[2];
    // a c - b^2 would cancel for needles: a sum of squared minors does not.
    const float m0 = p0[1] * p1[2] - p0[2] * p1[1], m1 = p0[2] * p1[0] - p0[0] * p1[2], m2 = p0[0] * p1[1] - p0[1] * p1[0];
    o->determinant = m0 * m0 + m1 * m1 + m2 * m2 + blur * (a + c) + blur * blur;
    return true;
}

POLARGUIDE_INLINE int clamp_tile(float pixel, int tiles) {
    float t = floorf(pixel * (1.0f / tile_size));
    return t < 0.0f ? 0 : t > float(tiles) ? tiles : int(t);
}

} // namespace

void project(const ProjectArgs &p, int64_t begin, int64_t end) {
    const int tiles_x = (p.camera.width + tile_size - 1) / tile_size, tiles_y = (p.camera.height + tile_size - 1) / tile_size;
    for (int64_t g = begin; g < end; ++g) {
        Projection o;
        int32_t *box = p.box + 4 * g;
        box[0] = box[1] = box[2] = box[3] = 0;
        p.radius[g] = p.depth[g] = 0.0f;
        if (!project_one(p, g, &o)) continue;
        const float determinant = o.determinant;
        if (!(determinant > 0.0f) || !(determinant < 1e30f)) continue;
        const float inverse = 1.0f / determinant, rz = 1.0f / o.t[2];
        float *screen = p.screen + g * screen_values;
        screen[0] = p.camera.fx * o.t[0] * rz + p.camera.cx;
        screen[1] = p.camera.fy * o.t[1] * rz + p.camera.cy;
        screen[2] = -0.5f * o.c * inverse / natural;
        screen[3] = o.b * inverse / natural;
        screen[4] = -0.5f * o.a * inverse / natural;
        screen[5] = log2f(p.opacities[g]);
        // alpha >= 1/255 inside the ellipse d^T conic d <= reach
        const float reach = 2.0f * natural * (screen[5] + 7.99435344f);
        const float half_x = sqrtf(reach * o.a), half_y = sqrtf(reach * o.c);
        if (!(screen[0] + half_x > 0.0f) || !(screen[0] - half_x < p.camera.width) || !(screen[1] + half_y > 0.0f) ||
            !(screen[1] - half_y < p.camera.height))
            continue;
        const int x0 = clamp_tile(screen[0] - half_x, tiles_x), x1 = clamp_tile(screen[0] + half_x + tile_size, tiles_x);
        const int y0 = clamp_tile(screen[1] - half_y, tiles_y), y1 = clamp_tile(screen[1] + half_y + tile_size, tiles_y);
        if (x0 >= x1 || y0 >= y1) continue;
        box[0] = x0, box[1] = x1, box[2] = y0, box[3] = y1;
        p.depth[g] = o.t[2];
        const float middle = 0.5f * (o.a + o.c), spread = middle * middle - determinant;
        p.radius[g] = 3.0f * sqrtf(middle + sqrtf(spread > 0.1f ? spread : 0.1f));
    }
}

void emit_tiles(const TileEmitArgs &args, int64_t begin, int64_t end) {
    for (int64_t g = begin; g < end; ++g) {
        const int32_t *box = args.box + 4 * g;
        int32_t *out = args.tiles + args.offset[g], n = 0;
        const float *s = args.screen + g * screen_values;
        for (int ty = box[2]; ty < box[3]; ++ty)
            for (int tx = box[0]; tx < box[1]; ++tx) {
                // The largest exponent over the tile's pixel centers: on one of the two sides facing the center.
                const float x0 = float(tx * tile_size) + 0.5f - s[0], x1 = x0 + (tile_size - 1);
                const float y0 = float(ty * tile_size) + 0.5f - s[1], y1 = y0 + (tile_size - 1);
                const float cx = x0 > 0 ? x0 : x1 < 0 ? x1 : 0, cy = y0 > 0 ? y0 : y1 < 0 ? y1 : 0;
                float ey = -0.5f * s[3] * cx / s[4], ex = -0.5f * s[3] * cy / s[2];
                ey = ey < y0 ? y0 : ey > y1 ? y1 : ey, ex = ex < x0 ? x0 : ex > x1 ? x1 : ex;
                const float q1 = s[2] * cx * cx + s[3] * cx * ey + s[4] * ey * ey;
                const float q2 = s[2] * ex * ex + s[3] * ex * cy + s[4] * cy * cy;
                if ((q1 > q2 ? q1 : q2) + s[5] >= -7.9945f) out[n++] = ty * args.tiles_x + tx;
            }
        args.touched[g] = n;
    }
}

namespace {

// From gradients of the 2D mean and conic to those of the 3D mean, quaternion and scales.
POLARGUIDE_INLINE void project_one_backward(const PinholeCamera &cam, const Projection &o, const float *grad, float *mean,
                                            float *quaternion, float *scale) {
    // conic = inverse of [[a, b], [b, c]]: gradient of the covariance is -conic G conic.
    const float inverse = 1.0f / o.determinant;
    const float ka = o.c * inverse, kb = -o.b * inverse, kc = o.a * inverse;
    const float ga = grad[2], gb = 0.5f * grad[3], gc = grad[4];
    const float m00 = ka * ga + kb * gb, m01 = ka * gb + kb * gc, m10 = kb * ga + kc * gb, m11 = kb * gb + kc * gc;
    const float d00 = -(m00 * ka + m01 * kb), d01 = -(m00 * kb + m01 * kc), d11 = -(m10 * kb + m11 * kc);
    const float *j = o.j, *v = o.v;
    // J rows: (j0, 0, j1), (0, j2, j3). Gradient of V = J^T D J (symmetric).
    const float r0[3] = {j[0], 0.0f, j[1]}, r1[3] = {0.0f, j[2], j[3]};
    float dv[9];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            dv[3 * i + k] = r0[i] * (d00 * r0[k] + d01 * r1[k]) + r1[i] * (d01 * r0[k] + d11 * r1[k]);
    // Gradient of J = 2 D J V.
    float jv0[3], jv1[3];
    for (int k = 0; k < 3; ++k) {
        jv0[k] = j[0] * v[k] + j[1] * v[6 + k];
        jv1[k] = j[2] * v[3 + k] + j[3] * v[6 + k];
    }
    const float dj0 = 2 * (d00 * jv0[0] + d01 * jv1[0]), dj1 = 2 * (d00 * jv0[2] + d01 * jv1[2]);
    const float dj2 = 2 * (d01 * jv0[1] + d11 * jv1[1]), dj3 = 2 * (d01 * jv0[2] + d11 * jv1[2]);
    const float rz = 1.0f / o.t[2], rz2 = rz * rz;
    float dt[3];
    dt[0] = cam.fx * rz * grad[0], dt[1] = cam.fy * rz * grad[1];
    dt[2] = -(cam.fx * o.t[0] * grad[0] + cam.fy * o.t[1] * grad[1]) * rz2;
    // j0 = fx/z; j1 = -fx tx/z^2 where tx = x, or z times a constant where clamped.
    dt[2] -= rz2 * (cam.fx * dj0 + cam.fy * dj2);
    if (o.clamped_x)
        dt[2] += cam.fx * o.tx * rz2 * rz * dj1;
    else
        dt[0] -= cam.fx * rz2 * dj1, dt[2] += 2 * cam.fx * o.tx * rz2 * rz * dj1;
    if (o.clamped_y)
        dt[2] += cam.fy * o.ty * rz2 * rz * dj3;
    else
        dt[1] -= cam.fy * rz2 * dj3, dt[2] += 2 * cam.fy * o.ty * rz2 * rz * dj3;
    const float *R = cam.rotation;
    for (int i = 0; i < 3; ++i) mean[i] = R[i] * dt[0] + R[3 + i] * dt[1] + R[6 + i] * dt[2];
    // V = N N^T, N = W S, W = camera rotation * r: dN = 2 dV N.
    float dw[9];
    for (int c = 0; c < 3; ++c) {
        float sum = 0.0f;
        for (int i = 0; i < 3; ++i) {
            const float dn = 2 * o.s[c] * (dv[3 * i] * o.w[c] + dv[3 * i + 1] * o.w[3 + c] + dv[3 * i + 2] * o.w[6 + c]);
            sum += dn * o.w[3 * i + c];
            dw[3 * i + c] = dn * o.s[c];
        }
        scale[c] = sum;
    }
    float dr[9];
    for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 3; ++c) dr[3 * i + c] = R[i] * dw[c] + R[3 + i] * dw[3 + c] + R[6 + i] * dw[6 + c];
    const float w = o.q[0], x = o.q[1], y = o.q[2], z = o.q[3];
    float dq[4];
    dq[0] = 2 * (x * (dr[7] - dr[5]) + y * (dr[2] - dr[6]) + z * (dr[3] - dr[1]));
    dq[1] = 2 * (w * (dr[7] - dr[5]) - 2 * x * (dr[4] + dr[8]) + y * (dr[1] + dr[3]) + z * (dr[2] + dr[6]));
    dq[2] = 2 * (w * (dr[2] - dr[6]) + x * (dr[1] + dr[3]) - 2 * y * (dr[0] + dr[8]) + z * (dr[5] + dr[7]));
    dq[3] = 2 * (w * (dr[3] - dr[1]) + x * (dr[2] + dr[6]) + y * (dr[5] + dr[7]) - 2 * z * (dr[0] + dr[4]));
    const float along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;
    const float unit = 1.0f / (o.norm > 1e-12f ? o.norm : 1e-12f);
    for (int i = 0; i < 4; ++i) quaternion[i] = (dq[i] - along * o.q[i]) * unit;
}

} // namespace

void project_backward(const ProjectBackwardArgs &args, int64_t begin, int64_t end) {
    const ProjectArgs &p = args.forward;
    const int d = args.channels, stride = d + instance_extra;
    float sum[max_channels + instance_extra + lanes];
    for (int64_t g = begin; g < end; ++g) {
        float *mean = args.grad_means + 3 * g, *scale = args.grad_scales + 3 * g;
        float *quaternion = args.grad_quaternions + 4 * g;
        float *features = args.grad_features + g * args.channels_real;
        const int64_t first = args.instance_begin[g], last = args.instance_begin[g + 1];
        for (int i = 0; i < stride; ++i) sum[i] = 0.0f;
        for (int64_t n = first; n < last; ++n) {
            const float *row = args.grad_instances + n * stride;
            for (int i = 0; i < stride; ++i) sum[i] += row[i];
        }
        for (int k = 0; k < args.channels_real; ++k) features[args.permutation[k]] = sum[k];
        const float *grad = sum + d;
        args.grad_opacities[g] = first < last ? grad[5] / p.opacities[g] : 0.0f;
        if (args.statistic) args.statistic[2 * g] = grad[6], args.statistic[2 * g + 1] = grad[7];
        Projection o;
        if (first < last && project_one(p, g, &o)) {
            project_one_backward(p.camera, o, grad, mean, quaternion, scale);
            continue;
        }
        for (int i = 0; i < 3; ++i) mean[i] = scale[i] = 0.0f;
        for (int i = 0; i < 4; ++i) quaternion[i] = 0.0f;
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
