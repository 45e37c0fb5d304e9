#include "arrays.h"
#include "image.h"
#include "parallel.h"

#include <nanobind/stl/optional.h>

#include <optional>

namespace nb = nanobind;
using namespace polarguide;

namespace {

constexpr int64_t item_chunk = 4096;

AxesArgs axes_args(const Array &means, const Array &quaternions, const Array &log_scales, const Array &center,
                   const std::optional<Array> &outward, float grazing) {
    const int64_t n = means.ndim() ? int64_t(means.shape(0)) : 0;
    expect_shape(means, "means", {n, 3}), expect_shape(quaternions, "quaternions", {n, 4});
    expect_shape(log_scales, "log_scales", {n, 3}), expect_shape(center, "center", {3});
    if (outward) expect_shape(*outward, "outward", {n, 3});
    AxesArgs a{};
    a.means = means.data(), a.quaternions = quaternions.data(), a.log_scales = log_scales.data();
    a.center = center.data(), a.outward = outward ? outward->data() : nullptr, a.grazing = grazing;
    return a;
}

void run(void (*kernel)(const AxesArgs &, int64_t, int64_t), const AxesArgs &a, int64_t count) {
    nb::gil_scoped_release release;
    auto body = [&](int64_t b, int64_t e, int) { kernel(a, b, e); };
    parallel_chunks(count, item_chunk, body);
}

} // namespace

void bind_axes(nb::module_ &module) {
    module.def(
        "axes_forward",
        [](const Array &means, const Array &quaternions, const Array &log_scales, const Array &center,
           std::optional<Array> outward, float grazing, Array out) {
            AxesArgs a = axes_args(means, quaternions, log_scales, center, outward, grazing);
            const int64_t n = int64_t(means.shape(0));
            expect_shape(out, "out", {n, 3});
            a.out = out.data();
            run(POLARGUIDE_DISPATCH(axes_forward), a, n);
        },
        nb::arg("means"), nb::arg("quaternions"), nb::arg("log_scales"), nb::arg("center"), nb::arg("outward").none(),
        nb::arg("grazing"), nb::arg("out"), "Shortest axes turned outward.");
    module.def(
        "axes_backward",
        [](const Array &means, const Array &quaternions, const Array &log_scales, const Array &center,
           std::optional<Array> outward, float grazing, const Array &grad_out, Array grad_quaternions) {
            AxesArgs a = axes_args(means, quaternions, log_scales, center, outward, grazing);
            const int64_t n = int64_t(means.shape(0));
            expect_shape(grad_out, "grad_out", {n, 3}), expect_shape(grad_quaternions, "grad_quaternions", {n, 4});
            a.grad_out = grad_out.data(), a.grad_quaternions = grad_quaternions.data();
            run(POLARGUIDE_DISPATCH(axes_backward), a, n);
        },
        nb::arg("means"), nb::arg("quaternions"), nb::arg("log_scales"), nb::arg("center"), nb::arg("outward").none(),
        nb::arg("grazing"), nb::arg("grad_out"), nb::arg("grad_quaternions"), "Fills the gradient.");
    module.def(
        "mirrored_forward",
        [](const Array &means, const Array &center, const Array &normals, Array out) {
            const int64_t n = means.ndim() ? int64_t(means.shape(0)) : 0;
            expect_shape(means, "means", {n, 3}), expect_shape(center, "center", {3});
            expect_shape(normals, "normals", {n, 3}), expect_shape(out, "out", {n, 3});
            AxesArgs a{};
            a.means = means.data(), a.center = center.data(), a.normals = normals.data(), a.out = out.data();
            run(POLARGUIDE_DISPATCH(mirrored_forward), a, n);
        },
        nb::arg("means"), nb::arg("center"), nb::arg("normals"), nb::arg("out"),
        "Rays from the center, mirrored at unit normals.");
}
