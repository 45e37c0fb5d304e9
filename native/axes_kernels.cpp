// Normals of flat Gaussians, their shortest axes turned outward, and directions mirrored at them.
#include "image.h"

#include <math.h>

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float tiny = 1e-24f;

struct Axis {
    int shortest;
    float turn; // 1 or -1
    float axis[3];
    float twice; // 2 / |q|^2
};

// Column `shortest` of the rotation of a quaternion (w, x, y, z) of any length, turned outward.
inline Axis outward_axis(const AxesArgs &a, int64_t i) {
    const float *q = a.quaternions + 4 * i, *s = a.log_scales + 3 * i, *m = a.means + 3 * i;
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    Axis r;
    r.shortest = s[0] <= s[1] && s[0] <= s[2] ? 0 : s[1] <= s[2] ? 1 : 2;
    const float squared = w * w + x * x + y * y + z * z;
    const float t = 2.0f / (squared < tiny ? tiny : squared);
    r.twice = t;
    if (r.shortest == 0)
        r.axis[0] = 1.0f - t * (y * y + z * z), r.axis[1] = t * (x * y + w * z), r.axis[2] = t * (x * z - w * y);
    else if (r.shortest == 1)
        r.axis[0] = t * (x * y - w * z), r.axis[1] = 1.0f - t * (x * x + z * z), r.axis[2] = t * (y * z + w * x);
    else
        r.axis[0] = t * (x * z + w * y), r.axis[1] = t * (y * z - w * x), r.axis[2] = 1.0f - t * (x * x + y * y);
    float facing = 0.0f, distance = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float to_camera = a.centre[k] - m[k];
        facing += to_camera * r.axis[k], distance += to_camera * to_camera;
    }
    if (a.outward) {
        const float *o = a.outward + 3 * i;
        const float side = o[0] * r.axis[0] + o[1] * r.axis[1] + o[2] * r.axis[2];
        if (side != 0.0f && facing * facing < a.grazing * a.grazing * distance) facing = side;
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

// With A(q) = R(q) |q|^2 / 2 without its diagonal's constant, n = e + t A e, t = 2 / |q|^2: the gradient is that of A
// times t, less the part that t's own change brings, which is along q.
void axes_backward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const Axis r = outward_axis(a, i);
        const float *q = a.quaternions + 4 * i;
        const float w = q[0], x = q[1], y = q[2], z = q[3];
        float g[3], d[4], along = 0.0f;
        for (int k = 0; k < 3; ++k) {
            g[k] = a.grad_out[3 * i + k] * r.turn;
            along += g[k] * (r.axis[k] - (k == r.shortest ? 1.0f : 0.0f));
        }
        if (r.shortest == 0) {
            d[0] = z * g[1] - y * g[2], d[1] = y * g[1] + z * g[2];
            d[2] = -2.0f * y * g[0] + x * g[1] - w * g[2], d[3] = -2.0f * z * g[0] + w * g[1] + x * g[2];
        } else if (r.shortest == 1) {
            d[0] = -z * g[0] + x * g[2], d[1] = y * g[0] - 2.0f * x * g[1] + w * g[2];
            d[2] = x * g[0] + z * g[2], d[3] = -w * g[0] - 2.0f * z * g[1] + y * g[2];
        } else {
            d[0] = y * g[0] - x * g[1], d[1] = z * g[0] - w * g[1] - 2.0f * x * g[2];
            d[2] = w * g[0] + z * g[1] - 2.0f * y * g[2], d[3] = x * g[0] + y * g[1];
        }
        for (int k = 0; k < 4; ++k) a.grad_quaternions[4 * i + k] = r.twice * (d[k] - along * q[k]);
    }
}

// Unit directions from the centre to the means, mirrored at unit normals; zero for a mean at the centre.
void mirrored_forward(const AxesArgs &a, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
        const float *m = a.means + 3 * i, *n = a.normals + 3 * i;
        const float x = m[0] - a.centre[0], y = m[1] - a.centre[1], z = m[2] - a.centre[2];
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
