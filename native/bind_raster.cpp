#include "arrays.h"
#include "parallel.h"
#include "rasterizer.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <chrono>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

namespace nb = nanobind;
using namespace polarguide;

namespace {

constexpr int largest_side = 1 << 16;

GaussianInputs inputs(const Array &means, const Array &quaternions, const Array &scales, const Array &opacities,
                      const Array &features) {
    int64_t n = int64_t(means.ndim() ? means.shape(0) : 0);
    expect_shape(means, "means", {n, 3}), expect_shape(quaternions, "quaternions", {n, 4});
    expect_shape(scales, "scales", {n, 3});
    expect_shape(opacities, "opacities", {n});
    if (features.ndim() != 2) throw std::invalid_argument("features: expected two axes [N, D]");
    int d = int(features.shape(1));
    expect_shape(features, "features", {n, d});
    if (d < 1 || d > max_channels)
        throw std::invalid_argument("features: expected 1 to " + std::to_string(max_channels) + " channels, found " +
                                    std::to_string(d));
    return {n, d, means.data(), quaternions.data(), scales.data(), opacities.data(), features.data()};
}

// Checks that each channel occurs once; the rasterizer does not check it again.
void expect_permutation(const std::vector<int32_t> &permutation, int statistic_channels) {
    const size_t count = permutation.size();
    if (count < 1 || count > size_t(max_channels))
        throw std::invalid_argument("permutation: expected 1 to " + std::to_string(max_channels) + " channels, found " +
                                    std::to_string(count));
    std::vector<bool> seen(count, false);
    for (int32_t channel : permutation) {
        if (channel < 0 || size_t(channel) >= count || seen[size_t(channel)])
            throw std::invalid_argument("permutation: expected every channel once, found " + std::to_string(channel));
        seen[size_t(channel)] = true;
    }
    if (statistic_channels < 0 || size_t(statistic_channels) > count)
        throw std::invalid_argument("statistic_channels: expected 0 to " + std::to_string(count) + ", found " +
                                    std::to_string(statistic_channels));
}

// Returns the place of each channel among the still channels; each occurs at most once.
std::vector<int32_t> inverse(const std::vector<int32_t> &still, int channels) {
    std::vector<int32_t> of_channel(size_t(channels), -1);
    for (size_t i = 0; i < still.size(); ++i) {
        if (still[i] < 0 || still[i] >= channels || of_channel[size_t(still[i])] >= 0)
            throw std::invalid_argument("still: expected different channels below " + std::to_string(channels) +
                                        ", found " + std::to_string(still[i]));
        of_channel[size_t(still[i])] = int32_t(i);
    }
    return of_channel;
}

constexpr int64_t nothing_drawn = -1;

struct Wrapped {
    Rasterizer rasterizer;
    int width, height, channels;
    int64_t drawn; // Gaussians of the last forward pass
};

} // namespace

void bind_raster(nb::module_ &module) {
    nb::class_<Wrapped>(module, "Rasterizer", "Rasterizer of one picture: forward pass, data for the backward pass, and backward pass.")
        .def(
            "__init__",
            [](Wrapped *self, const std::vector<float> &rotation, const std::vector<float> &translation,
               const std::vector<float> &intrinsics, int width, int height, float near_plane,
               const std::vector<int32_t> &permutation, int statistic_channels) {
                if (rotation.size() != 9 || translation.size() != 3 || intrinsics.size() != 4)
                    throw std::invalid_argument("camera: expected 9 + 3 + 4 numbers");
                if (width < 1 || height < 1) throw std::invalid_argument("camera: expected a picture of at least one pixel");
                if (width > largest_side || height > largest_side)
                    throw std::invalid_argument("camera: expected at most " + std::to_string(largest_side) + " pixels each way");
                expect_permutation(permutation, statistic_channels);
                PinholeCamera c{};
                for (size_t i = 0; i < 9; ++i) c.rotation[i] = rotation[i];
                for (size_t i = 0; i < 3; ++i) c.translation[i] = translation[i];
                c.fx = intrinsics[0], c.fy = intrinsics[1], c.cx = intrinsics[2], c.cy = intrinsics[3];
                c.width = width, c.height = height, c.near_plane = near_plane;
                new (self) Wrapped{Rasterizer(c, permutation, statistic_channels), width, height, int(permutation.size()), nothing_drawn};
            },
            nb::arg("rotation"), nb::arg("translation"), nb::arg("intrinsics"), nb::arg("width"), nb::arg("height"),
            nb::arg("near_plane"), nb::arg("permutation"), nb::arg("statistic_channels"))
        .def(
            "forward",
            [](Wrapped &self, const Array &means, const Array &quaternions, const Array &scales, const Array &opacities,
               const Array &features, Array out, Array alpha, Array radius, bool count_pairs, bool for_backward) {
                GaussianInputs in = inputs(means, quaternions, scales, opacities, features);
                expect_shape(features, "features", {in.count, self.channels});
                expect_shape(out, "out", {self.height, self.width, self.channels});
                expect_shape(alpha, "alpha", {self.height, self.width});
                expect_shape(radius, "radius", {in.count});
                self.drawn = nothing_drawn; // until the pass is complete
                nb::gil_scoped_release release;
                self.rasterizer.forward(in, out.data(), alpha.data(), radius.data(), count_pairs, for_backward);
                self.drawn = in.count;
            },
            nb::arg("means"), nb::arg("quaternions"), nb::arg("scales"), nb::arg("opacities"), nb::arg("features"),
            nb::arg("out"), nb::arg("alpha"), nb::arg("radius"), nb::arg("count_pairs") = false,
            nb::arg("for_backward") = true)
        .def(
            "surface",
            [](Wrapped &self, const Array &means, const Array &quaternions, const Array &scales, const Array &opacities,
               const Array &features, float width, Array out) {
                GaussianInputs in = inputs(means, quaternions, scales, opacities, features);
                if (self.channels != 4) throw std::invalid_argument("surface: expected a rasterizer of four channels");
                if (!(width > 0.0f)) throw std::invalid_argument("width: expected more than 0");
                expect_shape(features, "features", {in.count, 4});
                expect_shape(out, "out", {self.height, self.width, 4});
                self.drawn = nothing_drawn;
                nb::gil_scoped_release release;
                self.rasterizer.surface(in, width, out.data());
            },
            nb::arg("means"), nb::arg("quaternions"), nb::arg("scales"), nb::arg("opacities"), nb::arg("features"),
            nb::arg("width"), nb::arg("out"))
        .def(
            "backward",
            [](Wrapped &self, const Array &means, const Array &quaternions, const Array &scales, const Array &opacities,
               const Array &features, const Array &out, const Array &grad_out, const Array &grad_alpha, Array d_means,
               Array d_quaternions, Array d_scales, Array d_opacities, Array d_features, std::optional<Array> statistic,
               const std::vector<int32_t> &still, std::optional<Array> grad_still) {
                if (!self.rasterizer.kept()) throw std::invalid_argument("backward: no forward pass was kept for it");
                GaussianInputs in = inputs(means, quaternions, scales, opacities, features);
                if (self.drawn == nothing_drawn) throw std::invalid_argument("backward: expected a forward pass before it");
                if (in.count != self.drawn)
                    throw std::invalid_argument("backward: expected " + std::to_string(self.drawn) +
                                                " Gaussians as in the forward pass, found " + std::to_string(in.count));
                expect_shape(features, "features", {in.count, self.channels});
                for (const Array *a : {&out, &grad_out})
                    expect_shape(*a, "out or its gradient", {self.height, self.width, self.channels});
                expect_shape(grad_alpha, "grad_alpha", {self.height, self.width});
                inputs(d_means, d_quaternions, d_scales, d_opacities, d_features);
                expect_shape(d_means, "d_means", {in.count, 3});
                expect_shape(d_features, "d_features", {in.count, self.channels});
                if (statistic) expect_shape(*statistic, "statistic", {in.count, 2});
                Rasterizer::StillGradient held{nullptr, inverse(still, self.channels), int(still.size())};
                if (grad_still) {
                    expect_shape(*grad_still, "grad_still", {self.height, self.width, held.count});
                    if (held.count) held.values = grad_still->data();
                }
                nb::gil_scoped_release release;
                self.rasterizer.backward(in, out.data(), grad_out.data(), grad_alpha.data(), held,
                                         {d_means.data(), d_quaternions.data(), d_scales.data(), d_opacities.data(),
                                          d_features.data(), statistic ? statistic->data() : nullptr});
            },
            nb::arg("means"), nb::arg("quaternions"), nb::arg("scales"), nb::arg("opacities"), nb::arg("features"),
            nb::arg("out"), nb::arg("grad_out"), nb::arg("grad_alpha"), nb::arg("d_means"), nb::arg("d_quaternions"),
            nb::arg("d_scales"), nb::arg("d_opacities"), nb::arg("d_features"), nb::arg("statistic").none(),
            nb::arg("still") = std::vector<int32_t>{}, nb::arg("grad_still") = nb::none())
        .def_prop_ro("pairs", [](const Wrapped &self) { return self.rasterizer.pairs(); },
                     "Number of contributing pixel-Gaussian pairs in the last forward pass that counted them.")
        .def_prop_ro("instances", [](const Wrapped &self) { return self.rasterizer.instances(); },
                     "Number of Gaussian-tile pairs in the last forward pass.");
    module.def(
        "first_not_finite",
        [](const Array &array) { return POLARGUIDE_DISPATCH(first_not_finite)(array.data(), int64_t(array.size())); },
        nb::arg("array"), "Return the flat index of the first NaN or infinity, or -1.");
    module.attr("MAX_CHANNELS") = max_channels;
    module.def(
        "fma_peak",
        [](double seconds) {
            nb::gil_scoped_release release;
            const Workers workers;
            const int threads = workers.count();
            std::vector<float> sink(size_t(threads), 0.0f);
            double best = 0.0, spent = 0.0;
            while (spent < seconds) {
                constexpr int64_t rounds = 20000;
                auto burst = [&](int64_t b, int64_t e, int w) {
                    for (int64_t i = b; i < e; ++i) sink[size_t(w)] += POLARGUIDE_DISPATCH(fma_burst)(rounds);
                };
                auto start = std::chrono::steady_clock::now();
                workers.chunks(threads, 1, burst);
                double t = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
                best = std::max(best, double(rounds) * double(fma_burst_flops) * threads / t);
                spent += t;
            }
            return best;
        },
        nb::arg("seconds") = 0.5, "Measure the maximum single-precision flop/s of independent fused multiply-adds on all threads.");
}
