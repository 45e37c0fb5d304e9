// Normals of flat Gaussians, their shortest axes turned outward, and directions mirrored at them.
#include "image.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float tiny = 1e-24f;

struct Axis {
    float chosen[3]; // the shortest of x, y, z: 1, the others 0
    float turn;      // 1 or -1
    float axis[3];
    float twice; // 2 / |q|^2
};

// The shortest axis under the rotation of a quaternion (w, x, y, z) of any length, turned outward. Without branches,
// which could not be predicted: with e the chosen axis and u = (x, y, z) it is e + 2 / |q|^2 (u u.e + w u x e - e u.u).
inline Axis outward_axis(const AxesArgs &a, int64_t i) {
    const float *q = a.quaternions + 4 * i, *s = a.log_scales + 3 * i, *m = a.means + 3 * i;
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    Axis r;
    const bool first = (s[0] <= s[1]) & (s[0] <= s[2]), second = !first & (s[1] <= s[2]);
    const float ex = first ? 1.0f : 0.0f, ey = second ? 1.0f : 0.0f, ez = 1.0f - ex - ey;
    r.chosen[0] = ex, r.chosen[1] = ey, r.chosen[2] = ez;
    const float length = x * x + y * y + z * z, squared = w * w + length;
    const float t = 2.0f / (squared < tiny ? tiny : squared);
    const float along = x * ex + y * ey + z * ez, kept = 1.0f - t * length;
    r.twice = t;
    r.axis[0] = kept * ex + t * (x * along + w * (y * ez - z * ey));
    r.axis[1] = kept * ey + t * (y * along + w * (z * ex - x * ez));
    r.axis[2] = kept * ez + t * (z * along + w * (x * ey - y * ex));
    float facing = 0.0f, distance = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float to_camera = a.center[k] - m[k];
        facing += to_camera * r.axis[k], distance += to_camera * to_camera;
    }
    if (a.outward) {
        const float *o = a.outward + 3 * i;
        const float side = o[0] * r.axis[0] + o[1] * r.axis[1] + o[2] * r.axis[2];
        const bool decides = (side != 0.0f) & (facing * facing < a.grazing * a.grazing * distance);
        facing = decides ? side : facing;
    }
    r.turn = facing >= 0.0f ? 1.0f : -1.0f;
    return r;
}

} // namespace

void axes_forward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const Axis r = outward_axis(a, i);
        for (int k = 0; k < 3; ++k) a.out[3 * i + k] = r.turn * r.axis[k];
    }
}

// The axis is e + t v, t = 2 / |q|^2, v = u u.e + w u x e - e u.u: the gradient is that of v times t, less the part that
// t's own change brings, which is along q.
void axes_backward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const Axis r = outward_axis(a, i);
        const float *q = a.quaternions + 4 * i, *e = r.chosen, *u = q + 1;
        float g[3], ug = 0.0f, ue = 0.0f, ge = 0.0f, change = 0.0f;
        for (int k = 0; k < 3; ++k) {
            g[k] = a.grad_out[3 * i + k] * r.turn;
            ug += u[k] * g[k], ue += u[k] * e[k], ge += g[k] * e[k];
            change += g[k] * (r.axis[k] - e[k]);
        }
        // e x g, so that g . (u x e) = u . (e x g)
        const float c[3] = {e[1] * g[2] - e[2] * g[1], e[2] * g[0] - e[0] * g[2], e[0] * g[1] - e[1] * g[0]};
        float *to = a.grad_quaternions + 4 * i;
        to[0] = r.twice * (u[0] * c[0] + u[1] * c[1] + u[2] * c[2] - change * q[0]);
        for (int k = 0; k < 3; ++k) {
            const float by_u = g[k] * ue + e[k] * ug + q[0] * c[k] - 2.0f * u[k] * ge;
            to[k + 1] = r.twice * (by_u - change * u[k]);
        }
    }
}

// Unit directions from the center to the means, mirrored at unit normals; zero for a mean at the center.
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
