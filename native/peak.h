// Maximum of the exponent of a Gaussian on the screen.
#pragma once
#include "simd.h"

namespace polarguide {
namespace POLARGUIDE_ISA {
namespace {

constexpr float log2_minimum = -7.99435344f; // log2(1 / 255)

// Maximum of log2(alpha) over rectangles with sides x0 to x1 and y0 to y1 relative to the center of a Gaussian. It is concave, so
// the maximum lies on one of the two sides that face the center. `row` is a row of `screen` in ProjectArgs, and `to_y` and `to_x`
// are its last two values.
POLARGUIDE_INLINE reg peak_inside(const float *row, float to_y, float to_x, reg x0, reg x1, reg y0, reg y1) {
    const reg cx = clamp(reg{}, x0, x1), cy = clamp(reg{}, y0, y1);
    const reg ey = clamp(cx * to_y, y0, y1), ex = clamp(cy * to_x, x0, x1);
    const reg a = reg_splat(row[2]), b = reg_splat(row[3]), c = reg_splat(row[4]);
    const reg q1 = (a * cx + b * ey) * cx + c * ey * ey, q2 = (c * cy + b * ex) * cy + a * ex * ex;
    return max(q1, q2) + row[5];
}

} // namespace
} // namespace POLARGUIDE_ISA
} // namespace polarguide
