// Normals of flat Gaussians (their shortest axes, turned outward), and directions mirrored at normals.
#include "gaussians.h"
#include "simd.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float tiny = 1e-24f;

// Shortest axes of one Gaussian per lane of a register.
struct Axis {
    reg chosen[3];     // 1 for the shortest of x, y, z, else 0
    reg turn;          // 1 or -1
    reg quaternion[4]; // (w, x, y, z), of any length
    reg axis[3];
    reg twice; // 2 / |q|^2
};

// Computes the shortest axes of Gaussians i to i + n, turned outward. A quaternion (w, x, y, z) of any length rotates the chosen
// axis e to e + 2 / |q|^2 (u u.e + w u x e - e u.u) with u = (x, y, z).
POLARGUIDE_INLINE Axis outward_axis(const AxesArgs &a, int64_t i, int n) {
    const reg one = reg_splat(1.0f), zero = {};
    reg s[3], m[3];
    Axis r;
    load_columns<4>(a.quaternions + 4 * i, n, r.quaternion);
    load_columns<3>(a.log_scales + 3 * i, n, s);
    load_columns<3>(a.means + 3 * i, n, m);
    const reg w = r.quaternion[0], x = r.quaternion[1], y = r.quaternion[2], z = r.quaternion[3];
    const ireg first = (s[0] <= s[1]) & (s[0] <= s[2]), second = ~first & (s[1] <= s[2]);
    const reg ex = first ? one : zero, ey = second ? one : zero, ez = one - ex - ey;
    r.chosen[0] = ex, r.chosen[1] = ey, r.chosen[2] = ez;
    const reg length = x * x + y * y + z * z, squared = w * w + length;
    const reg t = 2.0f / max(squared, reg_splat(tiny));
    const reg along = x * ex + y * ey + z * ez, kept = 1.0f - t * length;
    r.twice = t;
    r.axis[0] = kept * ex + t * (x * along + w * (y * ez - z * ey));
    r.axis[1] = kept * ey + t * (y * along + w * (z * ex - x * ez));
    r.axis[2] = kept * ez + t * (z * along + w * (x * ey - y * ex));
    reg facing = zero, distance = zero;
    for (int k = 0; k < 3; ++k) {
        const reg to_camera = a.center[k] - m[k];
        facing += to_camera * r.axis[k], distance += to_camera * to_camera;
    }
    if (a.outward) {
        reg o[3];
        load_columns<3>(a.outward + 3 * i, n, o);
        const reg side = o[0] * r.axis[0] + o[1] * r.axis[1] + o[2] * r.axis[2];
        const ireg decides = (side != 0.0f) & (facing * facing < a.grazing * a.grazing * distance);
        facing = decides ? side : facing;
    }
    r.turn = facing >= 0.0f ? one : -one;
    return r;
}

} // namespace

void axes_forward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = end - i < reg_lanes ? int(end - i) : reg_lanes;
        const Axis r = outward_axis(a, i, n);
        const reg out[3] = {r.turn * r.axis[0], r.turn * r.axis[1], r.turn * r.axis[2]};
        store_columns<3>(a.out + 3 * i, n, out);
    }
}

// The axis is e + t v with t = 2 / |q|^2 and v = u u.e + w u x e - e u.u. The gradient is t times the gradient of v, minus a
// part along q from the change of t.
void axes_backward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += reg_lanes) {
        const int n = end - i < reg_lanes ? int(end - i) : reg_lanes;
        const Axis r = outward_axis(a, i, n);
        const reg *q = r.quaternion, *e = r.chosen, *u = q + 1;
        reg g[3], to[4], ug = {}, ue = {}, ge = {}, change = {};
        load_columns<3>(a.grad_out + 3 * i, n, g);
        for (int k = 0; k < 3; ++k) {
            g[k] *= r.turn;
            ug += u[k] * g[k], ue += u[k] * e[k], ge += g[k] * e[k];
            change += g[k] * (r.axis[k] - e[k]);
        }
        // e x g, so that g . (u x e) = u . (e x g)
        const reg c[3] = {e[1] * g[2] - e[2] * g[1], e[2] * g[0] - e[0] * g[2], e[0] * g[1] - e[1] * g[0]};
        to[0] = r.twice * (u[0] * c[0] + u[1] * c[1] + u[2] * c[2] - change * q[0]);
        for (int k = 0; k < 3; ++k) {
            const reg by_u = g[k] * ue + e[k] * ug + q[0] * c[k] - 2.0f * u[k] * ge;
            to[k + 1] = r.twice * (by_u - change * u[k]);
        }
        store_columns<4>(a.grad_quaternions + 4 * i, n, to);
    }
}

// Computes unit directions from the center to the means, mirrored at unit normals; zero for a mean at the center.
void mirrored_forward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *m = a.means + 3 * i, *n = a.normals + 3 * i;
        const float x = m[0] - a.center[0], y = m[1] - a.center[1], z = m[2] - a.center[2];
        const float squared = x * x + y * y + z * z;
        const float inverse = squared <= tiny ? 0.0f : 1.0f / sqrtf(squared);
        const float twice = 2.0f * (x * n[0] + y * n[1] + z * n[2]);
        a.out[3 * i] = (x - twice * n[0]) * inverse;
        a.out[3 * i + 1] = (y - twice * n[1]) * inverse;
        a.out[3 * i + 2] = (z - twice * n[2]) * inverse;
    }
}

} // namespace POLARGUIDE_ISA
} // namespace polarguide
