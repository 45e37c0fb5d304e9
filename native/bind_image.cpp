#include "arrays.h"
#include "image.h"
#include "mips.h"
#include "parallel.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

namespace nb = nanobind;
using namespace polarguide;

namespace {


int64_t rows(const Array &array) { return array.ndim() ? int64_t(array.shape(0)) : 0; }

constexpr int64_t row_chunk = 8, item_chunk = 2048, merge_chunk = 16384;

// Work memory of the photometric loss: five planes and a scratch for each worker. It is not cleared, because each float is
// written before it is read.
class PhotometricMemory {
  public:
    PhotometricMemory(PhotometricArgs &a, int workers)
        : planes_(new float[size_t(a.stride) * size_t(a.height) * 5]), sums_(new double[size_t(a.height) * 3]),
          size_(photometric_scratch(a.stride)), scratch_(new float[size_t(size_) * size_t(workers)]) {
        float *next = planes_.get();
        for (float **plane : {&a.shown, &a.goal, &a.parts[0], &a.parts[1], &a.parts[2]})
            *plane = next, next += a.stride * a.height;
        a.row_l1 = sums_.get(), a.row_squares = a.row_l1 + a.height, a.row_ssim = a.row_squares + a.height;
    }
    float *scratch(int worker) { return scratch_.get() + worker * size_; }

  private:
    std::unique_ptr<float[]> planes_;
    std::unique_ptr<double[]> sums_;
    int64_t size_;
    std::unique_ptr<float[]> scratch_;
};

std::tuple<double, double, double> photometric(const Array &prediction, const Array &target, std::optional<Array> weight,
                                       double weight_sum, float ssim_weight, std::optional<Array> gradient) {
    const int64_t height = rows(prediction), width = prediction.ndim() > 1 ? int64_t(prediction.shape(1)) : 0;
    expect_shape(prediction, "prediction", {height, width, 3}), expect_shape(target, "target", {height, width, 3});
    if (weight) expect_shape(*weight, "weight", {height, width});
    if (gradient) expect_shape(*gradient, "gradient", {height, width, 3});
    if (height * width == 0) return {0.0, 0.0, 0.0};
    PhotometricArgs a{};
    a.height = int(height), a.width = int(width), a.stride = (3 * width + 15) / 16 * 16;
    a.prediction = prediction.data(), a.target = target.data(), a.weight = weight ? weight->data() : nullptr;
    a.gradient = gradient ? gradient->data() : nullptr;
    a.ssim_weight = ssim_weight, a.inverse_count = float(1.0 / (3.0 * weight_sum));
    nb::gil_scoped_release release;
    const Workers workers;
    PhotometricMemory memory(a, workers.count());
    auto run = [&](void (*kernel)(const PhotometricArgs &, int64_t, int64_t, float *)) {
        auto body = [&](int64_t b, int64_t e, int worker) { kernel(a, b, e, memory.scratch(worker)); };
        workers.chunks(height, row_chunk, body);
    };
    run(POLARGUIDE_DISPATCH(photometric_show));
    run(POLARGUIDE_DISPATCH(photometric_statistics));
    if (gradient) run(POLARGUIDE_DISPATCH(photometric_gradient));
    double l1 = 0.0, squares = 0.0, ssim = 0.0;
    for (int64_t y = 0; y < height; ++y) l1 += a.row_l1[y], squares += a.row_squares[y], ssim += a.row_ssim[y];
    const double values = 3.0 * weight_sum;
    return {l1 / values, ssim / values, squares / values};
}

CubemapArgs cubemap_args(const Array &texture, const Array &directions) {
    expect_shape(directions, "directions", {rows(directions), 3});
    CubemapArgs a{};
    a.resolution = int(cubemap_side(texture)), a.channels = int(texture.shape(3));
    a.texture = texture.data(), a.directions = directions.data();
    return a;
}

// Sums the gradient of the texels in slices of the directions and adds the slices in order. The number of slices depends only
// on the sizes, so the result does not depend on the number of threads. A slice costs a pass over the texels, so it has at
// least as many taps as texels. `add(begin, end, sums)` adds the contribution of some directions.
template <class Add> void sum_texture_gradient(int64_t texels, int64_t channels, int64_t count, float *gradient, Add add) {
    const int64_t size = texels * channels;
    const int64_t worth = std::min(count / 16384, 4 * count / texels), slices = std::clamp<int64_t>(worth, 1, 8);
    const int64_t share = (count + slices - 1) / slices;
    std::unique_ptr<float[]> others(new float[size_t(size) * size_t(slices - 1)]);
    auto sums = [&](int64_t slice) { return slice ? others.get() + (slice - 1) * size : gradient; };
    auto slice = [&](int64_t b, int64_t e, int) {
        for (int64_t i = b; i < e; ++i) {
            std::fill_n(sums(i), size, 0.0f);
            add(std::min(count, i * share), std::min(count, (i + 1) * share), sums(i));
        }
    };
    parallel_chunks(slices, 1, slice);
    auto merge = [&](int64_t b, int64_t e, int) {
        for (int64_t other = 1; other < slices; ++other) {
            const float *from = sums(other);
            for (int64_t k = b; k < e; ++k) gradient[k] += from[k];
        }
    };
    if (slices > 1) parallel_chunks(size, merge_chunk, merge);
}

MipArgs placed_mips(const std::vector<Array> &textures, const Array &directions, const Array &level) {
    MipArgs a = mip_args(textures);
    const int64_t count = rows(directions);
    expect_shape(directions, "directions", {count, 3}), expect_shape(level, "level", {count});
    a.directions = directions.data(), a.level = level.data();
    return a;
}

} // namespace

void bind_image(nb::module_ &module) {
    module.def("photometric", &photometric, nb::arg("prediction"), nb::arg("target"), nb::arg("weight").none(),
               nb::arg("weight_sum"), nb::arg("ssim_weight"), nb::arg("gradient").none(),
               "Return mean absolute difference, SSIM and squared difference of display values; compute the gradient of the loss.");
    module.def(
        "cubemap_forward",
        [](const Array &texture, const Array &directions, Array out) {
            CubemapArgs a = cubemap_args(texture, directions);
            const int64_t count = rows(directions);
            expect_shape(out, "out", {count, a.channels});
            a.out = out.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(cubemap_forward)(a, b, e); };
            parallel_chunks(count, item_chunk, body);
        },
        nb::arg("texture"), nb::arg("directions"), nb::arg("out"), "Look up a cubemap seamlessly and bilinearly.");
    module.def(
        "cubemap_backward",
        [](const Array &texture, const Array &directions, const Array &grad_out, std::optional<Array> grad_texture,
           std::optional<Array> grad_directions) {
            CubemapArgs a = cubemap_args(texture, directions);
            const int64_t count = rows(directions), side = a.resolution;
            expect_shape(grad_out, "grad_out", {count, a.channels});
            if (grad_texture) expect_shape(*grad_texture, "grad_texture", {6, side, side, a.channels});
            if (grad_directions) expect_shape(*grad_directions, "grad_directions", {count, 3});
            a.grad_out = grad_out.data();
            a.grad_directions = grad_directions ? grad_directions->data() : nullptr;
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(cubemap_backward_directions)(a, b, e); };
            if (grad_directions) parallel_chunks(count, item_chunk, body);
            auto add = [&](int64_t b, int64_t e, float *to) { POLARGUIDE_DISPATCH(cubemap_backward_texture)(a, b, e, to); };
            if (grad_texture) sum_texture_gradient(6 * side * side, a.channels, count, grad_texture->data(), add);
        },
        nb::arg("texture"), nb::arg("directions"), nb::arg("grad_out"), nb::arg("grad_texture").none(),
        nb::arg("grad_directions").none(), "Compute the gradients that are not None.");
    module.def(
        "mips_forward",
        [](const std::vector<Array> &textures, const Array &directions, const Array &level, Array out) {
            MipArgs a = placed_mips(textures, directions, level);
            const int64_t count = rows(directions);
            expect_shape(out, "out", {count, a.channels});
            a.out = out.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(mips_forward)(a, b, e); };
            parallel_chunks(count, item_chunk, body);
        },
        nb::arg("textures"), nb::arg("directions"), nb::arg("level"), nb::arg("out"), "Look up between mip levels.");
    module.def(
        "mips_backward",
        [](const std::vector<Array> &textures, const Array &directions, const Array &level, const Array &grad_out,
           std::optional<Array> grad_light, std::optional<Array> grad_textures, Array grad_directions, Array grad_level) {
            MipArgs a = placed_mips(textures, directions, level);
            const int64_t count = rows(directions), texels = texels_of(a);
            expect_shape(grad_out, "grad_out", {count, a.channels}), expect_shape(grad_level, "grad_level", {count});
            expect_shape(grad_directions, "grad_directions", {count, 3});
            if (grad_textures) expect_shape(*grad_textures, "grad_textures", {texels * a.channels});
            a.grad_out = grad_out.data(), a.grad_directions = grad_directions.data(), a.grad_level = grad_level.data();
            a.grad_light = a.grad_out;
            if (grad_light) expect_shape(*grad_light, "grad_light", {count, a.channels}), a.grad_light = grad_light->data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(mips_backward)(a, b, e); };
            parallel_chunks(count, item_chunk, body);
            auto add = [&](int64_t b, int64_t e, float *to) { POLARGUIDE_DISPATCH(mips_backward_textures)(a, b, e, to); };
            if (grad_textures) sum_texture_gradient(texels, a.channels, count, grad_textures->data(), add);
        },
        nb::arg("textures"), nb::arg("directions"), nb::arg("level"), nb::arg("grad_out"), nb::arg("grad_light").none(),
        nb::arg("grad_textures").none(), nb::arg("grad_directions"), nb::arg("grad_level"),
        "Compute gradients; those of the textures, one after the other, unless None. A grad_light replaces grad_out for textures and levels.");
}
