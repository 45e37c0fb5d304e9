#include "arrays.h"
#include "gaussians.h"
#include "parallel.h"
#include "raster.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

namespace nb = nanobind;
using namespace polarguide;

namespace {

constexpr int64_t item_chunk = 4096, splat_chunk = 1024;

constexpr int64_t streamed_bytes = int64_t(8) << 20;

int64_t rows(const Array &array) { return array.ndim() ? int64_t(array.shape(0)) : 0; }

AxesArgs axes_args(const Array &means, const Array &quaternions, const Array &log_scales, const Array &center,
                   const std::optional<Array> &outward, float grazing) {
    const int64_t n = rows(means);
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

HarmonicsArgs harmonics_args(int degree, const Array &means, const Array &center, const Array &dc, const Array &rest) {
    if (degree < 0 || degree > 3)
        throw std::invalid_argument("degree: expected 0 to 3, found " + std::to_string(degree));
    const int64_t n = rows(means);
    expect_shape(means, "means", {n, 3}), expect_shape(center, "center", {3}), expect_shape(dc, "dc", {n, 3});
    expect_shape(rest, "rest", {n, 15, 3});
    HarmonicsArgs a{};
    a.streams = n * int64_t(45 * sizeof(float)) > streamed_bytes;
    a.degree = degree, a.means = means.data(), a.center = center.data(), a.dc = dc.data(), a.rest = rest.data();
    return a;
}

float *data_of(const std::optional<Array> &array) { return array ? array->data() : nullptr; }

// Parameters of Gaussians and of a shading model's channels. For each chunk, the kernels of axes and harmonics write to the
// memory of a worker, and the rows of features are then assembled from it.
class Splatting {
  public:
    Splatting(Array means, Array quaternions, Array log_scales, Array opacity_logits, Array dc, Array rest, int degree,
              Array center, std::optional<Array> forward, bool normals, float grazing, std::optional<Array> outward,
              std::optional<Array> strength, std::optional<Array> light_dc, std::optional<Array> light_rest,
              std::optional<Array> metalness, std::optional<Array> further)
        : quaternions_(quaternions), dc_(dc), rest_(rest), outward_(outward), light_dc_(light_dc), light_rest_(light_rest),
          degree_(degree), grazing_(grazing), normals_(normals), kept_{means, log_scales, opacity_logits, center} {
        const int64_t n = rows(means);
        expect_shape(opacity_logits, "opacity_logits", {n});
        if (forward) expect_shape(*forward, "forward", {3}), kept_.push_back(*forward);
        if (strength) expect_shape(*strength, "strength", {n}), kept_.push_back(*strength);
        if (metalness) expect_shape(*metalness, "metalness", {n}), kept_.push_back(*metalness);
        if (light_dc.has_value() != light_rest.has_value() || (light_dc && !normals))
            throw std::invalid_argument("light: expected both kinds of harmonics, and normals");
        a_.further_channels = further && further->ndim() == 2 ? int(further->shape(1)) : 0;
        if (further) expect_shape(*further, "further", {n, a_.further_channels}), kept_.push_back(*further);
        a_.channels = 3 + (normals ? 3 : 0) + (strength ? 1 : 0) + (light_dc ? 3 : 0) + a_.further_channels + (forward ? 1 : 0);
        if (a_.channels > max_channels)
            throw std::invalid_argument("further: expected at most " + std::to_string(max_channels) + " channels in all");
        axes_ = axes_args(means, quaternions, log_scales, center, outward, grazing);
        color_ = harmonics_args(degree, means, center, dc, rest);
        if (light_dc) light_ = harmonics_args(degree, means, center, *light_dc, *light_rest), light_.center = origin_;
        a_.means = means.data(), a_.center = center.data(), a_.forward = data_of(forward);
        a_.log_scales = log_scales.data(), a_.opacity_logits = opacity_logits.data();
        a_.strength_logits = data_of(strength), a_.metalness = data_of(metalness), a_.further = data_of(further);
        count_ = n;
    }

    int channels() const { return a_.channels; }

    void forward(Array scales, Array opacities, Array features, std::optional<Array> mirrored) {
        expect_shape(scales, "scales", {count_, 3}), expect_shape(opacities, "opacities", {count_});
        expect_shape(features, "features", {count_, a_.channels});
        if (mirrored) expect_shape(*mirrored, "mirrored", {count_, 3});
        float *rays = data_of(mirrored);
        SplatArgs a = a_;
        a.scales = scales.data(), a.opacities = opacities.data(), a.features = features.data();
        nb::gil_scoped_release release;
        in_chunks([&](int64_t begin, int64_t n, float *memory) {
            float *color = take(&memory, 3), *normals = take(&memory, 3), *light = take(&memory, 3);
            float *directions = rays ? rays + 3 * begin : take(&memory, 3);
            HarmonicsArgs h = part(color_, begin);
            h.out = color;
            POLARGUIDE_DISPATCH(harmonics_forward)(h, 0, n);
            if (normals_) {
                AxesArgs x = part(axes_, begin);
                x.out = normals;
                POLARGUIDE_DISPATCH(axes_forward)(x, 0, n);
                x.normals = normals, x.out = directions;
                if (light_.dc) POLARGUIDE_DISPATCH(mirrored_forward)(x, 0, n);
            }
            if (light_.dc) {
                h = part(light_, begin);
                h.means = directions, h.out = light;
                POLARGUIDE_DISPATCH(harmonics_forward)(h, 0, n);
            }
            SplatArgs s = part(a, begin);
            s.color = color, s.normals = normals_ ? normals : nullptr, s.light = light_.dc ? light : nullptr;
            POLARGUIDE_DISPATCH(splat_assemble)(s, 0, n);
        });
    }

    // `grad_`: gradients of the results, from the rasterizer. `to_`: gradients of the parameters.
    void backward(const Array &scales, const Array &opacities, const Array &features, std::optional<Array> mirrored,
                  const Array &grad_means, const Array &grad_quaternions, const Array &grad_scales, const Array &grad_opacities,
                  const Array &grad_features, Array to_means, Array to_quaternions, Array to_log_scales, Array to_opacity_logits,
                  Array to_dc, Array to_rest, std::optional<Array> to_strength, std::optional<Array> to_light_dc,
                  std::optional<Array> to_light_rest, std::optional<Array> to_further) {
        const int64_t n = count_;
        expect_all({&scales, &grad_scales, &grad_means, &to_means, &to_log_scales, &to_dc}, "of means, scales or color", {n, 3});
        expect_all({&opacities, &grad_opacities, &to_opacity_logits}, "of opacities", {n});
        expect_all({&grad_quaternions, &to_quaternions}, "of quaternions", {n, 4});
        expect_all({&features, &grad_features}, "of features", {n, a_.channels});
        expect_shape(to_rest, "to_rest", {n, 15, 3});
        expect(to_strength, a_.strength_logits, "to_strength", {n});
        expect(mirrored, light_.dc, "mirrored", {n, 3});
        expect(to_light_dc, light_.dc, "to_light_dc", {n, 3}), expect(to_light_rest, light_.dc, "to_light_rest", {n, 15, 3});
        expect(to_further, a_.further, "to_further", {n, a_.further_channels});
        SplatArgs a = a_;
        a.scales = scales.data(), a.opacities = opacities.data(), a.features = features.data();
        a.grad_means = grad_means.data(), a.grad_quaternions = grad_quaternions.data(), a.grad_scales = grad_scales.data();
        a.grad_opacities = grad_opacities.data(), a.grad_features = grad_features.data();
        a.to_means = to_means.data(), a.to_quaternions = to_quaternions.data(), a.to_log_scales = to_log_scales.data();
        a.to_opacity_logits = to_opacity_logits.data(), a.to_strength_logits = data_of(to_strength), a.to_further = data_of(to_further);
        HarmonicsArgs color = color_, light = light_;
        color.grad_dc = to_dc.data(), color.grad_rest = to_rest.data();
        light.means = data_of(mirrored), light.grad_dc = data_of(to_light_dc), light.grad_rest = data_of(to_light_rest);
        nb::gil_scoped_release release;
        in_chunks([&](int64_t begin, int64_t count, float *memory) {
            SplatArgs s = part(a, begin);
            s.to_color = take(&memory, 3), s.to_depth = s.forward ? take(&memory, 1) : nullptr;
            s.to_normals = normals_ ? take(&memory, 3) : nullptr, s.to_light = light_.dc ? take(&memory, 3) : nullptr;
            POLARGUIDE_DISPATCH(splat_split)(s, 0, count);
            HarmonicsArgs h = part(color, begin);
            h.grad_out = s.to_color, h.grad_means = take(&memory, 3);
            POLARGUIDE_DISPATCH(harmonics_backward)(h, 0, count);
            s.by_color = h.grad_means;
            if (light_.dc) {
                h = part(light, begin);
                h.grad_out = s.to_light, h.grad_means = nullptr;
                POLARGUIDE_DISPATCH(harmonics_backward)(h, 0, count);
            }
            if (normals_) {
                AxesArgs x = part(axes_, begin);
                x.grad_out = s.to_normals, x.grad_quaternions = take(&memory, 4);
                POLARGUIDE_DISPATCH(axes_backward)(x, 0, count);
                s.by_normals = x.grad_quaternions;
            }
            POLARGUIDE_DISPATCH(splat_join)(s, 0, count);
        });
    }

  private:
    static constexpr int64_t most_values = 3 + 3 + 3 + 3 + 1 + 4; // per Gaussian in the memory of a chunk
    static float *take(float **memory, int values) {
        float *found = *memory;
        *memory += values * splat_chunk;
        return found;
    }
    template <class Work> void in_chunks(Work work) {
        const Workers workers;
        const std::unique_ptr<float[]> memory(new float[size_t(workers.count()) * most_values * splat_chunk]);
        auto body = [&](int64_t b, int64_t e, int worker) { work(b, e - b, memory.get() + worker * most_values * splat_chunk); };
        workers.chunks(count_, splat_chunk, body);
    }
    template <class T> static void skip(T **values, int64_t count) {
        if (*values) *values += count;
    }
    static HarmonicsArgs part(HarmonicsArgs a, int64_t i) {
        a.means += 3 * i, a.dc += 3 * i, a.rest += 45 * i;
        skip(&a.grad_dc, 3 * i), skip(&a.grad_rest, 45 * i);
        return a;
    }
    static AxesArgs part(AxesArgs a, int64_t i) {
        a.means += 3 * i, a.quaternions += 4 * i, a.log_scales += 3 * i, skip(&a.outward, 3 * i);
        return a;
    }
    static SplatArgs part(SplatArgs a, int64_t i) {
        a.means += 3 * i, a.log_scales += 3 * i, a.opacity_logits += i, a.scales += 3 * i, a.opacities += i;
        a.features += a.channels * i, skip(&a.strength_logits, i), skip(&a.metalness, i), skip(&a.further, a.further_channels * i);
        skip(&a.grad_means, 3 * i), skip(&a.grad_quaternions, 4 * i), skip(&a.grad_scales, 3 * i), skip(&a.grad_opacities, i);
        skip(&a.grad_features, a.channels * i), skip(&a.to_means, 3 * i), skip(&a.to_quaternions, 4 * i);
        skip(&a.to_log_scales, 3 * i), skip(&a.to_opacity_logits, i), skip(&a.to_strength_logits, i);
        skip(&a.to_further, a.further_channels * i);
        return a;
    }
    static void expect_all(std::initializer_list<const Array *> arrays, const char *name, std::initializer_list<int64_t> shape) {
        for (const Array *array : arrays) expect_shape(*array, name, shape);
    }
    static void expect(const std::optional<Array> &array, const void *wanted, const char *name, std::initializer_list<int64_t> shape) {
        if (array.has_value() != (wanted != nullptr))
            throw std::invalid_argument(std::string(name) + (wanted ? ": expected an array" : ": expected None"));
        if (array) expect_shape(*array, name, shape);
    }

    Array quaternions_, dc_, rest_;
    std::optional<Array> outward_, light_dc_, light_rest_;
    int degree_;
    float grazing_;
    bool normals_;
    std::vector<Array> kept_;
    int64_t count_ = 0;
    SplatArgs a_{};
    AxesArgs axes_{};
    HarmonicsArgs color_{}, light_{};
    float origin_[3] = {};
};

ShortestArgs shortest_args(const Array &log_scales, const Array &radii) {
    const int64_t n = rows(radii);
    expect_shape(radii, "radii", {n}), expect_shape(log_scales, "log_scales", {n, 3});
    ShortestArgs a{};
    a.log_scales = log_scales.data(), a.radii = radii.data();
    return a;
}

} // namespace

void bind_gaussians(nb::module_ &module) {
    module.def(
        "axes_forward",
        [](const Array &means, const Array &quaternions, const Array &log_scales, const Array &center,
           std::optional<Array> outward, float grazing, Array out) {
            AxesArgs a = axes_args(means, quaternions, log_scales, center, outward, grazing);
            const int64_t n = rows(means);
            expect_shape(out, "out", {n, 3});
            a.out = out.data();
            run(POLARGUIDE_DISPATCH(axes_forward), a, n);
        },
        nb::arg("means"), nb::arg("quaternions"), nb::arg("log_scales"), nb::arg("center"), nb::arg("outward").none(),
        nb::arg("grazing"), nb::arg("out"), "Compute shortest axes, turned outward.");
    module.def(
        "axes_backward",
        [](const Array &means, const Array &quaternions, const Array &log_scales, const Array &center,
           std::optional<Array> outward, float grazing, const Array &grad_out, Array grad_quaternions) {
            AxesArgs a = axes_args(means, quaternions, log_scales, center, outward, grazing);
            const int64_t n = rows(means);
            expect_shape(grad_out, "grad_out", {n, 3}), expect_shape(grad_quaternions, "grad_quaternions", {n, 4});
            a.grad_out = grad_out.data(), a.grad_quaternions = grad_quaternions.data();
            run(POLARGUIDE_DISPATCH(axes_backward), a, n);
        },
        nb::arg("means"), nb::arg("quaternions"), nb::arg("log_scales"), nb::arg("center"), nb::arg("outward").none(),
        nb::arg("grazing"), nb::arg("grad_out"), nb::arg("grad_quaternions"), "Compute the gradient.");
    module.def(
        "mirrored_forward",
        [](const Array &means, const Array &center, const Array &normals, Array out) {
            const int64_t n = rows(means);
            expect_shape(means, "means", {n, 3}), expect_shape(center, "center", {3});
            expect_shape(normals, "normals", {n, 3}), expect_shape(out, "out", {n, 3});
            AxesArgs a{};
            a.means = means.data(), a.center = center.data(), a.normals = normals.data(), a.out = out.data();
            run(POLARGUIDE_DISPATCH(mirrored_forward), a, n);
        },
        nb::arg("means"), nb::arg("center"), nb::arg("normals"), nb::arg("out"),
        "Mirror rays from the center at unit normals.");
    module.def(
        "harmonics_forward",
        [](int degree, const Array &means, const Array &center, const Array &dc, const Array &rest, Array out) {
            HarmonicsArgs a = harmonics_args(degree, means, center, dc, rest);
            const int64_t n = rows(means);
            expect_shape(out, "out", {n, 3});
            a.out = out.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(harmonics_forward)(a, b, e); };
            parallel_chunks(n, item_chunk, body);
        },
        nb::arg("degree"), nb::arg("means"), nb::arg("center"), nb::arg("dc"), nb::arg("rest"), nb::arg("out"),
        "Evaluate the harmonics of each Gaussian in its direction.");
    module.def(
        "harmonics_backward",
        [](int degree, const Array &means, const Array &center, const Array &dc, const Array &rest,
           const Array &grad_out, std::optional<Array> grad_means, Array grad_dc, std::optional<Array> grad_rest) {
            HarmonicsArgs a = harmonics_args(degree, means, center, dc, rest);
            const int64_t n = rows(means);
            expect_shape(grad_out, "grad_out", {n, 3});
            if (grad_means) expect_shape(*grad_means, "grad_means", {n, 3});
            expect_shape(grad_dc, "grad_dc", {n, 3});
            if (grad_rest) expect_shape(*grad_rest, "grad_rest", {n, 15, 3});
            a.grad_out = grad_out.data(), a.grad_means = grad_means ? grad_means->data() : nullptr, a.grad_dc = grad_dc.data();
            a.grad_rest = grad_rest ? grad_rest->data() : nullptr;
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(harmonics_backward)(a, b, e); };
            parallel_chunks(n, item_chunk, body);
        },
        nb::arg("degree"), nb::arg("means"), nb::arg("center"), nb::arg("dc"), nb::arg("rest"), nb::arg("grad_out"),
        nb::arg("grad_means").none(), nb::arg("grad_dc"), nb::arg("grad_rest").none(), "Compute the gradients that are not None.");
    nb::class_<Splatting>(module, "Splatting", "Input of a rasterizer from the parameters of Gaussians, and its gradient.")
        .def(nb::init<Array, Array, Array, Array, Array, Array, int, Array, std::optional<Array>, bool, float, std::optional<Array>,
                      std::optional<Array>, std::optional<Array>, std::optional<Array>, std::optional<Array>, std::optional<Array>>(),
             nb::arg("means"), nb::arg("quaternions"), nb::arg("log_scales"), nb::arg("opacity_logits"), nb::arg("dc"),
             nb::arg("rest"), nb::arg("degree"), nb::arg("center"), nb::arg("forward").none(), nb::arg("normals"),
             nb::arg("grazing"), nb::arg("outward").none(), nb::arg("strength").none(), nb::arg("light_dc").none(),
             nb::arg("light_rest").none(), nb::arg("metalness").none(), nb::arg("further").none())
        .def_prop_ro("channels", &Splatting::channels, "Number of features of a Gaussian.")
        .def("forward", &Splatting::forward, nb::arg("scales"), nb::arg("opacities"), nb::arg("features"),
             nb::arg("mirrored").none(), "Compute the input. `mirrored` may be None unless `backward` follows and there is light.")
        .def("backward", &Splatting::backward, nb::arg("scales"), nb::arg("opacities"), nb::arg("features"),
             nb::arg("mirrored").none(), nb::arg("grad_means"), nb::arg("grad_quaternions"), nb::arg("grad_scales"),
             nb::arg("grad_opacities"), nb::arg("grad_features"), nb::arg("to_means"), nb::arg("to_quaternions"),
             nb::arg("to_log_scales"), nb::arg("to_opacity_logits"), nb::arg("to_dc"), nb::arg("to_rest"),
             nb::arg("to_strength").none(), nb::arg("to_light_dc").none(), nb::arg("to_light_rest").none(),
             nb::arg("to_further").none(), "Compute the gradients.");
    module.def(
        "shortest_sum",
        [](const Array &log_scales, const Array &radii) {
            const ShortestArgs a = shortest_args(log_scales, radii);
            const int64_t n = rows(radii), chunks = (n + item_chunk - 1) / item_chunk;
            std::vector<double> sums(size_t(chunks), 0.0), counts(size_t(chunks), 0.0);
            {
                nb::gil_scoped_release release;
                auto body = [&](int64_t b, int64_t e, int) {
                    const size_t chunk = size_t(b / item_chunk);
                    POLARGUIDE_DISPATCH(shortest_sum)(a, b, e, &sums[chunk], &counts[chunk]);
                };
                parallel_chunks(n, item_chunk, body);
            }
            double sum = 0.0, count = 0.0;
            for (size_t i = 0; i < sums.size(); ++i) sum += sums[i], count += counts[i];
            return std::tuple<double, double>(sum, count);
        },
        nb::arg("log_scales"), nb::arg("radii"), "Return the sum of the shortest scales of visible Gaussians, and their number.");
    module.def(
        "shortest_gradient",
        [](const Array &log_scales, const Array &radii, float factor, Array gradient) {
            ShortestArgs a = shortest_args(log_scales, radii);
            const int64_t n = rows(radii);
            expect_shape(gradient, "gradient", {n, 3});
            a.factor = factor, a.gradient = gradient.data();
            nb::gil_scoped_release release;
            auto body = [&](int64_t b, int64_t e, int) { POLARGUIDE_DISPATCH(shortest_gradient)(a, b, e); };
            parallel_chunks(n, item_chunk, body);
        },
        nb::arg("log_scales"), nb::arg("radii"), nb::arg("factor"), nb::arg("gradient"), "Compute the factor times the gradient of the sum.");
}
