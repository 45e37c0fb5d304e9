#include "arrays.h"
#include "image.h"
#include "mips.h"
#include "parallel.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;
using namespace polarguide;

namespace {

using MaybeArray = std::optional<Array>;
constexpr int64_t item_chunk = 2048;

ReflectArgs reflect_args(const Array &features, const Array &rays, bool fresnel, bool local, float refractive_index, int index) {
    const int64_t n = features.ndim() == 2 ? int64_t(features.shape(0)) : 0;
    const int64_t channels = features.ndim() == 2 ? int64_t(features.shape(1)) : 0;
    expect_shape(features, "features", {n, channels}), expect_shape(rays, "rays", {n, 3});
    if (channels < (local ? 10 : 7))
        throw std::invalid_argument("features: expected base color, normal, strength and what the shading reads");
    ReflectArgs a{};
    if (index < -1 || index >= channels) throw std::invalid_argument("index: expected a channel, or -1");
    a.channels = int(channels), a.fresnel = fresnel, a.local = local, a.refractive_index = refractive_index, a.index = index;
    a.features = features.data(), a.rays = rays.data();
    return a;
}

template <class Args> void run(void (*kernel)(const Args &, int64_t, int64_t), const Args &a, int64_t count) {
    nb::gil_scoped_release release;
    auto body = [&](int64_t b, int64_t e, int) { kernel(a, b, e); };
    parallel_chunks(count, item_chunk, body);
}

GBufferArgs gbuffer_args(const Array &alpha, int64_t channels) {
    const int64_t n = alpha.ndim() == 1 ? int64_t(alpha.shape(0)) : 0;
    expect_shape(alpha, "alpha", {n});
    if (channels < 7) throw std::invalid_argument("features: expected color, normal and a further channel");
    GBufferArgs a{};
    a.channels = int(channels), a.alpha = alpha.data();
    return a;
}

float *optional_rows(const MaybeArray &array, const char *name, int64_t n) {
    if (!array) return nullptr;
    expect_shape(*array, name, {n, 3});
    return array->data();
}

MetalArgs metal_args(const Array &features, const Array &rays, const Indices &pixels, int first, float least_share,
                     const Array &light) {
    const ReflectArgs all = reflect_args(features, rays, true, false, 1.5f, -1);
    if (first < 7 || first > all.channels - 4)
        throw std::invalid_argument("features: expected the channels of metals behind those of dielectrics");
    expect_ascending(pixels, "pixels", int64_t(features.shape(0)));
    expect_shape(light, "light", {int64_t(features.shape(0)), 3});
    MetalArgs a{};
    a.channels = all.channels, a.first = first, a.least_share = least_share;
    a.features = features.data(), a.rays = rays.data(), a.pixels = pixels.data(), a.light = light.data();
    return a;
}

void bind_metal(nb::module_ &module) {
    module.def(
        "metal_layers",
        [](const Array &features, const Array &rays, const Indices &pixels, int first, float least_share, const Array &light,
           Array share, Array reflected, Array slope, Array final_picture, Array specular) {
            MetalArgs a = metal_args(features, rays, pixels, first, least_share, light);
            const int64_t n = int64_t(pixels.shape(0)), p = int64_t(rays.shape(0));
            expect_shape(share, "share", {n});
            expect_shape(reflected, "reflected", {n, 3}), expect_shape(slope, "slope", {n, 3});
            expect_shape(final_picture, "final", {p, 3}), expect_shape(specular, "specular", {p, 3});
            a.share = share.data(), a.reflected = reflected.data(), a.slope = slope.data();
            a.final_picture = final_picture.data(), a.specular = specular.data();
            run(POLARGUIDE_DISPATCH(metal_layers), a, n);
        },
        nb::arg("features"), nb::arg("rays"), nb::arg("pixels"), nb::arg("first"), nb::arg("least_share"), nb::arg("light"),
        nb::arg("share"), nb::arg("reflected"), nb::arg("slope"), nb::arg("final"), nb::arg("specular"),
        "Compute the reflection of metals and add it to two layers.");
    module.def(
        "metal_backward",
        [](const Array &features, const Array &rays, const Indices &pixels, int first, float least_share, const Array &light,
           MaybeArray grad_final, MaybeArray grad_specular, MaybeArray grad_held, MaybeArray grad_reflected,
           MaybeArray grad_slope, Array grad_light, Array grad_normal, Array grad_metal) {
            MetalArgs a = metal_args(features, rays, pixels, first, least_share, light);
            const int64_t n = int64_t(pixels.shape(0)), p = int64_t(rays.shape(0));
            expect_shape(grad_light, "grad_light", {p, 3});
            expect_shape(grad_normal, "grad_normal", {n, 3}), expect_shape(grad_metal, "grad_metal", {n, 4});
            a.grad_layers[0] = optional_rows(grad_final, "grad_final", p);
            a.grad_layers[1] = optional_rows(grad_specular, "grad_specular", p);
            a.grad_layers[2] = optional_rows(grad_held, "grad_held", p);
            a.grad_reflected = optional_rows(grad_reflected, "grad_reflected", n);
            a.grad_slope = optional_rows(grad_slope, "grad_slope", n);
            a.grad_light = grad_light.data(), a.grad_normal = grad_normal.data(), a.grad_metal = grad_metal.data();
            run(POLARGUIDE_DISPATCH(metal_backward), a, n);
        },
        nb::arg("features"), nb::arg("rays"), nb::arg("pixels"), nb::arg("first"), nb::arg("least_share"), nb::arg("light"),
        nb::arg("grad_final").none(), nb::arg("grad_specular").none(), nb::arg("grad_held").none(),
        nb::arg("grad_reflected").none(), nb::arg("grad_slope").none(), nb::arg("grad_light"), nb::arg("grad_normal"),
        nb::arg("grad_metal"), "Add the gradient of the light; compute the gradients of normals, and of blended reflectance and share.");
}

// Looks up between levels; a single level avoids the work for two.
void look_up(const MipArgs &mips, int64_t count) {
    if (mips.levels > 1) return POLARGUIDE_DISPATCH(mips_forward)(mips, 0, count);
    CubemapArgs one{};
    one.resolution = mips.resolution[0], one.channels = mips.channels, one.texture = mips.textures[0];
    one.directions = mips.directions, one.out = mips.out;
    POLARGUIDE_DISPATCH(cubemap_forward)(one, 0, count);
}

// Sets the channel of roughness and the arguments of its levels.
void set_roughness(ReflectArgs &a, int64_t n, int roughness, float blur, const MaybeArray &alpha) {
    if (roughness < -1 || roughness >= a.channels) throw std::invalid_argument("roughness: expected a channel, or -1");
    if (roughness >= 0 && !alpha) throw std::invalid_argument("alpha: needed where there is roughness");
    if (alpha) expect_shape(*alpha, "alpha", {n});
    a.roughness = roughness, a.blur = blur, a.alpha = alpha ? alpha->data() : nullptr;
}

} // namespace

void bind_reflect(nb::module_ &module) {
    bind_metal(module);
    module.def(
        "turn",
        [](const Array &directions, const std::vector<float> &rotation, Array out) {
            const int64_t n = directions.ndim() == 2 ? int64_t(directions.shape(0)) : 0;
            expect_shape(directions, "directions", {n, 3}), expect_shape(out, "out", {n, 3});
            if (rotation.size() != 9) throw std::invalid_argument("rotation: expected 9 numbers");
            run(POLARGUIDE_DISPATCH(turn), TurnArgs{rotation.data(), directions.data(), out.data()}, n);
        },
        nb::arg("directions"), nb::arg("rotation"), nb::arg("out"), "Multiply rows by a rotation.");
    module.def(
        "reflect_forward",
        [](const Array &features, const Array &rays, const std::vector<Array> &textures, bool fresnel, bool local,
           float refractive_index, int index, int roughness, float blur, MaybeArray alpha, MaybeArray directions,
           MaybeArray level, MaybeArray seen, Array final_picture, Array specular, Array diffuse, Array reflection) {
            ReflectArgs a = reflect_args(features, rays, fresnel, local, refractive_index, index);
            const int64_t n = int64_t(rays.shape(0));
            set_roughness(a, n, roughness, blur, alpha);
            const MipArgs look = mip_args(textures);
            if (look.channels != 3) throw std::invalid_argument("textures: expected three channels, found " + std::to_string(look.channels));
            expect_shape(final_picture, "final", {n, 3}), expect_shape(specular, "specular", {n, 3});
            expect_shape(diffuse, "diffuse", {n, 3}), expect_shape(reflection, "reflection", {n, 3});
            float *all_directions = optional_rows(directions, "directions", n), *all_seen = optional_rows(seen, "seen", n);
            if (level) expect_shape(*level, "level", {n});
            nb::gil_scoped_release release;
            // Each piece passes through all three steps while it is in the cache.
            const Workers workers;
            std::vector<float> own(size_t(workers.count()) * 8 * item_chunk);
            auto body = [&](int64_t b, int64_t e, int worker) {
                float *spare = own.data() + int64_t(worker) * 8 * item_chunk;
                ReflectArgs part = a;
                part.features += b * a.channels, part.rays += 3 * b, part.alpha += a.alpha ? b : 0;
                part.along = spare + 6 * item_chunk;
                part.level = level ? level->data() + b : spare + 7 * item_chunk;
                part.directions = all_directions ? all_directions + 3 * b : spare;
                POLARGUIDE_DISPATCH(reflect_directions)(part, 0, e - b);
                MipArgs here = look;
                here.directions = part.directions, here.level = part.level;
                here.out = all_seen ? all_seen + 3 * b : spare + 3 * item_chunk;
                look_up(here, e - b);
                part.seen = here.out;
                part.final_picture = final_picture.data() + 3 * b, part.specular = specular.data() + 3 * b;
                part.diffuse = diffuse.data() + 3 * b, part.reflection = reflection.data() + 3 * b;
                POLARGUIDE_DISPATCH(reflect_layers)(part, 0, e - b);
            };
            workers.chunks(n, item_chunk, body);
        },
        nb::arg("features"), nb::arg("rays"), nb::arg("textures"), nb::arg("fresnel"), nb::arg("local"), nb::arg("refractive_index"),
        nb::arg("index"), nb::arg("roughness"), nb::arg("blur"), nb::arg("alpha").none(), nb::arg("directions").none(),
        nb::arg("level").none(), nb::arg("seen").none(), nb::arg("final"), nb::arg("specular"), nb::arg("diffuse"),
        nb::arg("reflection"),
        "Compute the layers of the picture; also mirrored rays, their levels and the light from the look-up, unless None.");
    module.def(
        "reflect_backward_layers",
        [](const Array &features, const Array &rays, const Array &seen, bool fresnel, bool local, float refractive_index,
           int index, MaybeArray grad_final, MaybeArray grad_specular, MaybeArray grad_diffuse, MaybeArray grad_reflection,
           MaybeArray grad_held_specular, MaybeArray grad_held_diffuse, Array grad_seen, MaybeArray grad_texels,
           Array grad_features) {
            ReflectArgs a = reflect_args(features, rays, fresnel, local, refractive_index, index);
            const int64_t n = int64_t(rays.shape(0));
            expect_shape(seen, "seen", {n, 3}), expect_shape(grad_seen, "grad_seen", {n, 3});
            expect_shape(grad_features, "grad_features", {n, a.channels});
            a.grad_final = optional_rows(grad_final, "grad_final", n);
            a.grad_specular = optional_rows(grad_specular, "grad_specular", n);
            a.grad_diffuse = optional_rows(grad_diffuse, "grad_diffuse", n);
            a.grad_reflection = optional_rows(grad_reflection, "grad_reflection", n);
            a.grad_held_specular = optional_rows(grad_held_specular, "grad_held_specular", n);
            a.grad_held_diffuse = optional_rows(grad_held_diffuse, "grad_held_diffuse", n);
            if ((a.grad_held_specular || a.grad_held_diffuse) && !grad_texels)
                throw std::invalid_argument("grad_texels: needed where a gradient by held layers is given");
            if (grad_texels) expect_shape(*grad_texels, "grad_texels", {n, 3}), a.grad_texels = grad_texels->data();
            a.seen = seen.data(), a.grad_seen = grad_seen.data(), a.grad_features = grad_features.data();
            run(POLARGUIDE_DISPATCH(reflect_backward_layers), a, n);
        },
        nb::arg("features"), nb::arg("rays"), nb::arg("seen"), nb::arg("fresnel"), nb::arg("local"), nb::arg("refractive_index"), nb::arg("index"),
        nb::arg("grad_final").none(), nb::arg("grad_specular").none(), nb::arg("grad_diffuse").none(),
        nb::arg("grad_reflection").none(), nb::arg("grad_held_specular").none(), nb::arg("grad_held_diffuse").none(),
        nb::arg("grad_seen"), nb::arg("grad_texels").none(), nb::arg("grad_features"),
        "Compute the gradients of the look-up, and of the features apart from the part through the look-up. Gradients of the "
        "held layers do not reach the normals: of both gradients of the look-up, only grad_texels includes them.");
    module.def(
        "reflect_backward_directions",
        [](const Array &features, const Array &rays, int roughness, float blur, MaybeArray alpha, const Array &grad_directions,
           MaybeArray grad_level, Array grad_features) {
            ReflectArgs a = reflect_args(features, rays, false, false, 1.5f, -1);
            const int64_t n = int64_t(rays.shape(0));
            set_roughness(a, n, roughness, blur, alpha);
            if (roughness >= 0 && !grad_level) throw std::invalid_argument("grad_level: needed where there is roughness");
            if (grad_level) expect_shape(*grad_level, "grad_level", {n}), a.grad_level = grad_level->data();
            expect_shape(grad_directions, "grad_directions", {n, 3});
            expect_shape(grad_features, "grad_features", {n, a.channels});
            a.grad_directions = grad_directions.data(), a.grad_features = grad_features.data();
            run(POLARGUIDE_DISPATCH(reflect_backward_directions), a, n);
        },
        nb::arg("features"), nb::arg("rays"), nb::arg("roughness"), nb::arg("blur"), nb::arg("alpha").none(),
        nb::arg("grad_directions"), nb::arg("grad_level").none(), nb::arg("grad_features"),
        "Add the gradients of normals and roughness through the look-up.");
    module.def(
        "gbuffer_split",
        [](const Array &features, const Array &alpha, Array normal, std::optional<Array> depth) {
            const int64_t channels = features.ndim() == 2 ? int64_t(features.shape(1)) : 0;
            GBufferArgs a = gbuffer_args(alpha, channels);
            const int64_t n = int64_t(alpha.shape(0));
            expect_shape(features, "features", {n, channels}), expect_shape(normal, "normal", {n, 3});
            if (depth) expect_shape(*depth, "depth", {n});
            a.features = features.data(), a.normal = normal.data(), a.depth = depth ? depth->data() : nullptr;
            run(POLARGUIDE_DISPATCH(gbuffer_split), a, n);
        },
        nb::arg("features"), nb::arg("alpha"), nb::arg("normal"), nb::arg("depth").none(),
        "Compute the blended normal, and the last channel over alpha.");
    module.def(
        "gbuffer_join",
        [](const Array &alpha, MaybeArray depth, MaybeArray grad_features, MaybeArray grad_normal, MaybeArray grad_depth,
           Array to_features, std::optional<Array> to_alpha) {
            const int64_t channels = to_features.ndim() == 2 ? int64_t(to_features.shape(1)) : 0;
            GBufferArgs a = gbuffer_args(alpha, channels);
            const int64_t n = int64_t(alpha.shape(0));
            expect_shape(to_features, "to_features", {n, channels});
            if (grad_features) expect_shape(*grad_features, "grad_features", {n, channels});
            if (grad_depth) {
                if (!depth || !to_alpha) throw std::invalid_argument("grad_depth: expected with depth and to_alpha");
                expect_shape(*grad_depth, "grad_depth", {n}), expect_shape(*depth, "depth", {n});
                expect_shape(*to_alpha, "to_alpha", {n});
                a.grad_depth = grad_depth->data(), a.depth = depth->data(), a.to_alpha = to_alpha->data();
            }
            a.grad_features = grad_features ? grad_features->data() : nullptr;
            a.grad_normal = optional_rows(grad_normal, "grad_normal", n), a.to_features = to_features.data();
            run(POLARGUIDE_DISPATCH(gbuffer_join), a, n);
        },
        nb::arg("alpha"), nb::arg("depth").none(), nb::arg("grad_features").none(), nb::arg("grad_normal").none(),
        nb::arg("grad_depth").none(), nb::arg("to_features"), nb::arg("to_alpha").none(),
        "Compute the gradients of features and, with a depth, of alpha.");
}
