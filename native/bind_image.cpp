#include "arrays.h"
#include "image.h"
#include "parallel.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

namespace nb = nanobind;
using namespace polarguide;

namespace {

using Indices = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;

void expect_size(const Array &array, const char *name, int64_t size) {
    if (int64_t(array.size()) != size)
        throw std::invalid_argument(std::string(name) + ": expected " + std::to_string(size) + " numbers, found " +
                                    std::to_string(array.size()));
}

int64_t rows(const Array &array) { return array.ndim() ? int64_t(array.shape(0)) : 0; }

constexpr int64_t row_chunk = 8, item_chunk = 2048;

// Work memory of the photometric loss: five planes and a scratch for each worker. Not cleared: every float is written
// before it is read.
class PhotometricMemory {
  public:
    PhotometricMemory(PhotometricArgs &a, int workers)
        : planes_(new float[size_t(a.stride) * size_t(a.height) * 5]), sums_(new double[size_t(a.height) * 2]),
          size_(photometric_scratch(a.stride)), scratch_(new float[size_t(size_) * size_t(workers)]) {
        float *next = planes_.get();
        for (float **plane : {&a.shown, &a.goal, &a.parts[0], &a.parts[1], &a.parts[2]})
            *plane = next, next += a.stride * a.height;
        a.row_l1 = sums_.get(), a.row_ssim = a.row_l1 + a.height;
    }
    float *scratch(int worker) { return scratch_.get() + worker * size_; }

  private:
    std::unique_ptr<float[]> planes_;
    std::unique_ptr<double[]> sums_;
    int64_t size_;
    std::unique_ptr<float[]> scratch_;
};

std::tuple<double, double> photometric(const Array &prediction, const Array &target, std::optional<Array> weight,
                                       double weight_sum, float ssim_weight, std::optional<Array> gradient) {
    const int64_t height = rows(prediction), width = prediction.ndim() > 1 ? int64_t(prediction.shape(1)) : 0;
    expect_shape(prediction, "prediction", {height, width, 3}), expect_shape(target, "target", {height, width, 3});
    if (weight) expect_shape(*weight, "weight", {height, width});
    if (gradient) expect_shape(*gradient, "gradient", {height, width, 3});
    if (height * width == 0) return {0.0, 0.0};
    PhotometricArgs a{};
    a.height = int(height), a.width = int(width), a.stride = (3 * width + 15) / 16 * 16;
    a.prediction = prediction.data(), a.target = target.data(), a.weight = weight ? weight->data() : nullptr;
    a.gradient = gradient ? gradient->data() : nullptr;
    a.ssim_weight = ssim_weight, a.inverse_count = float(1.0 / (3.0 * weight_sum));
    nb::gil_scoped_release release;
    PhotometricMemory memory(a, thread_count());
    auto run = [&](void (*kernel)(const PhotometricArgs &, int64_t, int64_t, float *)) {
        auto body = [&](int64_t b, int64_t e, int worker) { kernel(a, b, e, memory.scratch(worker)); };
        parallel_chunks(height, row_chunk, body);
    };
    run(POLARGUIDE_DISPATCH(photometric_show));
    run(POLARGUIDE_DISPATCH(photometric_statistics));
    if (gradient) run(POLARGUIDE_DISPATCH(photometric_gradient));
    double l1 = 0.0, ssim = 0.0;
    for (int64_t y = 0; y < height; ++y) l1 += a.row_l1[y], ssim += a.row_ssim[y];
    return {l1 / (3.0 * weight_sum), ssim / (3.0 * weight_sum)};
}

CubemapArgs cubemap_args(const Array &texture, const Indices &border, const Array &directions) {
    if (texture.ndim() != 4 || texture.shape(0) != 6 || texture.shape(1) != texture.shape(2))
        throw std::invalid_argument("texture: expected shape [6, R, R, C]");
    CubemapArgs a{};
    a.resolution = int(texture.shape(1)), a.channels = int(texture.shape(3));
    int64_t side = a.resolution + 2;
    if (int64_t(border.size()) != 6 * side * side) throw std::invalid_argument("border: expected [6, R + 2, R + 2]");
    if (directions.ndim() != 2 || directions.shape(1) != 3)
        throw std::invalid_argument("directions: expected shape [P, 3]");
    a.texture = texture.data(), a.border = border.data(), a.directions = directions.data();
    return a;
}

HarmonicsArgs harmonics_args(int degree, const Array &means, const Array &centre, const Array &dc, const Array &rest) {
    if (degree < 0 || degree > 3)
        throw std::invalid_argument("degree: expected 0 to 3, found " + std::to_string(degree));
    const int64_t n = rows(means);
    expect_shape(means, "means", {n, 3}), expect_shape(centre, "centre", {3}), expect_shape(dc, "dc", {n, 3});
    expect_shape(rest, "rest", {n, 15, 3});
    HarmonicsArgs a{};
    a.degree = degree, a.means = means.data(), a.centre = centre.data(), a.dc = dc.data(), a.rest = rest.data();
    return a;
}

} // namespace

void bind_image(nb::module_ &module) {
    module.def("photometric", &photometric, nb::arg("prediction"), nb::arg("target"), nb::arg("weight").none(),
               nb::arg("weight_sum"), nb::arg("ssim_weight"), nb::arg("gradient").none(),
               "Mean absolute difference and mean SSIM of shown pictures; fills the gradient of their mix.");
    module.def(
        "cubemap_forward",
        [](const Array &texture, const Indices &border, const Array &directions, Array out) {
            CubemapArgs a = cubemap_args(texture, border, directions);
            const int64_t count = int64_t(directions.shape(0));
            expect_size(out, "out", count * a.channels);
            a.out = out.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(cubemap_forward)(a, b, e); };
            parallel_chunks(count, item_chunk, body);
        },
        nb::arg("texture"), nb::arg("border"), nb::arg("directions"), nb::arg("out"));
    module.def(
        "cubemap_backward",
        [](const Array &texture, const Indices &border, const Array &directions, const Array &grad_out,
           std::optional<Array> grad_texture, std::optional<Array> grad_directions) {
            CubemapArgs a = cubemap_args(texture, border, directions);
            const int64_t count = int64_t(directions.shape(0));
            expect_size(grad_out, "grad_out", count * a.channels);
            a.grad_out = grad_out.data();
            if (grad_texture) expect_size(*grad_texture, "grad_texture", int64_t(texture.size()));
            if (grad_directions) expect_size(*grad_directions, "grad_directions", 3 * count);
            a.grad_texture = grad_texture ? grad_texture->data() : nullptr;
            a.grad_directions = grad_directions ? grad_directions->data() : nullptr;
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(cubemap_backward_directions)(a, b, e); };
            if (grad_directions) parallel_chunks(count, item_chunk, body);
            if (grad_texture) POLARGUIDE_DISPATCH(cubemap_backward_texture)(a, 0, count); // one thread: one order of sums
        },
        nb::arg("texture"), nb::arg("border"), nb::arg("directions"), nb::arg("grad_out"),
        nb::arg("grad_texture").none(), nb::arg("grad_directions").none());
    module.def(
        "harmonics_forward",
        [](int degree, const Array &means, const Array &centre, const Array &dc, const Array &rest, Array out) {
            HarmonicsArgs a = harmonics_args(degree, means, centre, dc, rest);
            const int64_t n = rows(means);
            expect_shape(out, "out", {n, 3});
            a.out = out.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(harmonics_forward)(a, b, e); };
            parallel_chunks(n, item_chunk, body);
        },
        nb::arg("degree"), nb::arg("means"), nb::arg("centre"), nb::arg("dc"), nb::arg("rest"), nb::arg("out"),
        "Sum of the harmonics towards each Gaussian.");
    module.def(
        "harmonics_backward",
        [](int degree, const Array &means, const Array &centre, const Array &dc, const Array &rest,
           const Array &grad_out, Array grad_means, Array grad_dc, Array grad_rest) {
            HarmonicsArgs a = harmonics_args(degree, means, centre, dc, rest);
            const int64_t n = rows(means);
            expect_shape(grad_out, "grad_out", {n, 3}), expect_shape(grad_means, "grad_means", {n, 3});
            expect_shape(grad_dc, "grad_dc", {n, 3}), expect_shape(grad_rest, "grad_rest", {n, 15, 3});
            a.grad_out = grad_out.data(), a.grad_means = grad_means.data(), a.grad_dc = grad_dc.data();
            a.grad_rest = grad_rest.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(harmonics_backward)(a, b, e); };
            parallel_chunks(n, item_chunk, body);
        },
        nb::arg("degree"), nb::arg("means"), nb::arg("centre"), nb::arg("dc"), nb::arg("rest"), nb::arg("grad_out"),
        nb::arg("grad_means"), nb::arg("grad_dc"), nb::arg("grad_rest"), "Fills the three gradients.");
}
