#include "arrays.h"
#include "parallel.h"
#include "terms.h"

#include <nanobind/stl/optional.h>

#include <memory>
#include <optional>
#include <vector>

namespace nb = nanobind;
using namespace polarguide;

namespace {

using MaybeArray = std::optional<Array>;
constexpr int64_t row_chunk = 8;

int64_t rows(const Array &array) { return array.ndim() ? int64_t(array.shape(0)) : 0; }

TermArgs term_args(const Array &normal, const MaybeArray &weight, float factor, Array &grad_normal) {
    const int64_t n = rows(normal);
    expect_shape(normal, "normal", {n, 3}), expect_shape(grad_normal, "grad_normal", {n, 3});
    if (weight) expect_shape(*weight, "weight", {n});
    TermArgs t{};
    t.normal = normal.data(), t.grad_normal = grad_normal.data(), t.weight = weight ? weight->data() : nullptr;
    t.factor = factor;
    return t;
}

double total(const std::vector<double> &parts) {
    double sum = 0.0;
    for (double part : parts) sum += part;
    return sum;
}

// Runs a kernel over pixels and returns the sum of its parts times the factor of the term.
template <class Args> double run(void (*kernel)(const Args &, int64_t, int64_t), Args &a, int64_t count) {
    nb::gil_scoped_release release;
    std::vector<double> parts(size_t((count + pixels_per_part - 1) / pixels_per_part));
    a.term.parts = parts.data();
    auto body = [&](int64_t b, int64_t e, int) { kernel(a, b, e); };
    parallel_chunks(count, pixels_per_part, body);
    return total(parts) * double(a.term.factor);
}

double polarization(const Array &normal, const Array &rays, const Array &rotation, const Array &specular,
                    const Array &diffuse, MaybeArray metal, const Array &measured, const Array &analyzers,
                    MaybeArray weight, float factor, float refractive_index, MaybeArray index, Array grad_normal,
                    Array grad_specular, Array grad_diffuse, MaybeArray grad_metal) {
    PolarizationArgs a{};
    a.term = term_args(normal, weight, factor, grad_normal);
    const int64_t n = rows(normal), measurements = rows(measured);
    expect_shape(rays, "rays", {n, 3}), expect_shape(rotation, "rotation", {3, 3});
    expect_shape(specular, "specular", {n, 3}), expect_shape(diffuse, "diffuse", {n, 3});
    expect_shape(measured, "measured", {measurements, n, 3}), expect_shape(analyzers, "analyzers", {measurements, 3});
    expect_shape(grad_specular, "grad_specular", {n, 3}), expect_shape(grad_diffuse, "grad_diffuse", {n, 3});
    if (metal) {
        if (!grad_metal) throw std::invalid_argument("metal: expected with grad_metal");
        expect_shape(*metal, "metal", {n, 6}), expect_shape(*grad_metal, "grad_metal", {n, 6});
        a.metal = metal->data(), a.grad_metal = grad_metal->data();
    }
    if (!(refractive_index > 1.0f)) throw std::invalid_argument("refractive_index: expected more than 1");
    a.rays = rays.data(), a.rotation = rotation.data(), a.specular = specular.data(), a.diffuse = diffuse.data();
    a.measured = measured.data(), a.analyzers = analyzers.data(), a.count = n, a.measurements = int(measurements);
    if (index) expect_shape(*index, "index", {n}), a.index = index->data();
    a.refractive_index = refractive_index, a.grad_specular = grad_specular.data(), a.grad_diffuse = grad_diffuse.data();
    return run(POLARGUIDE_DISPATCH(polarization_term), a, n);
}

double direction(const Array &normal, const Array &directions, MaybeArray weight, float factor, bool plane,
                 Array grad_normal) {
    DirectionArgs a{};
    a.term = term_args(normal, weight, factor, grad_normal);
    expect_shape(directions, "directions", {rows(normal), 3});
    a.direction = directions.data(), a.plane = plane;
    return run(POLARGUIDE_DISPATCH(direction_term), a, rows(normal));
}

double consistency(const Array &normal, const Array &rays, const Array &rotation, const Array &depth,
                   const Array &alpha, MaybeArray weight, float factor, Array grad_normal, Array grad_depth) {
    ConsistencyArgs a{};
    a.term = term_args(normal, weight, factor, grad_normal);
    const int64_t height = rows(depth), width = depth.ndim() > 1 ? int64_t(depth.shape(1)) : 0, n = height * width;
    expect_shape(depth, "depth", {height, width}), expect_shape(alpha, "alpha", {height, width});
    expect_shape(normal, "normal", {n, 3}), expect_shape(rays, "rays", {n, 3});
    expect_shape(rotation, "rotation", {3, 3}), expect_shape(grad_depth, "grad_depth", {height, width});
    if (height < 3 || width < 3) throw std::invalid_argument("depth: expected at least 3 x 3 pixels");
    a.height = int(height), a.width = int(width), a.rays = rays.data(), a.rotation = rotation.data();
    a.depth = depth.data(), a.alpha = alpha.data(), a.grad_depth = grad_depth.data();
    nb::gil_scoped_release release;
    const Workers workers;
    const int64_t each = consistency_scratch(width);
    const std::unique_ptr<float[]> beside(new float[size_t(2 * n)]), scratch(new float[size_t(each) * size_t(workers.count())]);
    std::vector<double> parts(size_t(height), 0.0);
    a.upward = beside.get(), a.downward = a.upward + n, a.term.parts = parts.data();
    auto body = [&](int64_t b, int64_t e, int worker) {
        POLARGUIDE_DISPATCH(consistency_term)(a, b + 1, e + 1, scratch.get() + worker * each);
    };
    workers.chunks(height - 2, row_chunk, body);
    auto gather = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(consistency_gather)(a, b, e); };
    workers.chunks(height, row_chunk, gather);
    return total(parts) * double(factor);
}

} // namespace

void bind_terms(nb::module_ &module) {
    module.def("polarization", &polarization, nb::arg("normal"), nb::arg("rays"), nb::arg("rotation"),
               nb::arg("specular"), nb::arg("diffuse"), nb::arg("metal").none(), nb::arg("measured"), nb::arg("analyzers"),
               nb::arg("weight").none(), nb::arg("factor"), nb::arg("refractive_index"), nb::arg("index").none(), nb::arg("grad_normal"),
               nb::arg("grad_specular"), nb::arg("grad_diffuse"), nb::arg("grad_metal").none(),
               "Return the distance of the polarization of two layers from K measurements; add to grad_normal, compute the other gradients.");
    module.def("direction", &direction, nb::arg("normal"), nb::arg("directions"), nb::arg("weight").none(),
               nb::arg("factor"), nb::arg("plane"), nb::arg("grad_normal"),
               "Return the distance of normals from directions or planes; add to grad_normal.");
    module.def("consistency", &consistency, nb::arg("normal"), nb::arg("rays"), nb::arg("rotation"), nb::arg("depth"),
               nb::arg("alpha"), nb::arg("weight").none(), nb::arg("factor"), nb::arg("grad_normal"),
               nb::arg("grad_depth"), "Return the distance of normals from normals of the depth; add to grad_normal.");
}
