"""Terms on pixels: the native pass against the plain functions in float64, value and gradient."""

import math
from dataclasses import dataclass, fields, replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from polarguide import _native, optics
from polarguide.geometry.camera import Camera
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.losses import (
    PolarizationTerm,
    Terms,
    Weights,
    normal_terms,
    normal_terms_reference,
    pixel_terms,
)
from polarguide.training.priors import stokes_weight, surface_weight
from polarguide.training.targets import Step, StepTargets, ViewPriors

HEIGHT, WIDTH = 37, 70  # more than one block of pixels in a row, and more than one part
SIZE = (HEIGHT, WIDTH)
INPUTS = ("normal", "specular", "diffuse", "depth")
SHADING = DeferredShading("fresnel", refractive_index=1.4)
ALL = Weights(stokes=0.9, azimuth=0.15, chromatic=0.05, normal=0.2, consistency=0.1)


def random(seed: int, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def camera() -> Camera:
    rotation = torch.linalg.qr(random(1, 3, 3)).Q
    rotation = rotation * torch.linalg.det(rotation)
    return Camera(WIDTH, HEIGHT, 50.0, 48.0, 33.0, 20.0, rotation, torch.zeros(3, dtype=torch.float64))


def rendered() -> RenderResult:
    """Normals mostly toward the camera, of many lengths, with every kind of odd one; a wavy depth."""
    rays = camera().world_rays(dtype=torch.float64)
    normal = normalize(random(2, *SIZE, 3) - 2 * rays, dim=-1) * random(3, *SIZE, 1).abs()
    normal[3] = normalize(random(4, WIDTH, 3), dim=-1)  # some face away
    normal[5], normal[6] = 0.0, 1e-17 * normal[6]  # none, and too short for either dtype
    normal[7] *= 1e-3  # shorter than what is brought to one
    normal[8] = -rays[8]  # toward the camera
    across = normalize(torch.linalg.cross(rays[9:11], random(5, 2, WIDTH, 3)), dim=-1)
    normal[9:11] = (
        across + torch.tensor([-0.003, 0.003])[:, None, None] * rays[9:11]
    )  # grazing from either side
    depth = 3 + random(6, HEIGHT, 1).cumsum(0) * 0.02 + 0.05 * random(7, *SIZE)
    depth[20:24, 10:20] = 0.0
    depth[26:30, 30:40] = 1e-7
    layers = [random(k, *SIZE, 3).abs() for k in (8, 9)]
    layers[0][11], layers[1][12] = 0.0, 0.0
    alpha = torch.sigmoid(random(10, *SIZE))
    alpha[13] = 0.0
    lobes = {"final": layers[0], "base": layers[0], "specular": layers[0], "diffuse": layers[1]}
    return RenderResult({**lobes, "normal": normal, "depth": depth, "alpha": alpha})


def measured() -> ViewPriors:
    weight = random(12, *SIZE).clamp(0, 1)
    stokes = random(13, 3, *SIZE, 3)
    stokes[0] = stokes[0].abs() + stokes[1:].abs().sum(0)
    stokes[:, 14] = 0.0
    directions = [normalize(random(k, *SIZE, 3), dim=-1) for k in (14, 15, 16)]
    return ViewPriors(
        specular=stokes[0],
        diffuse=stokes[0],
        separated=weight,
        normal=directions[0],
        plane=directions[1],
        weight=weight,
        chromatic=directions[2],
        chromatic_weight=weight.square(),
        camera=camera(),
        stokes=stokes,
        stokes_weight=stokes_weight(stokes, (random(17, *SIZE) > -1).double()),
        surface=surface_weight(stokes, weight, 20.0),
        azimuth_share=0.7,
        chromatic_share=0.01,
    )


def cast(record, dtype: torch.dtype):
    if isinstance(record, RenderResult):
        return record.with_layers(**{name: layer.to(dtype) for name, layer in record.layers.items()})
    tensors = {f.name: getattr(record, f.name) for f in fields(record)}
    return replace(record, **{k: t.to(dtype) for k, t in tensors.items() if isinstance(t, Tensor)})


def with_gradients(terms, dtype: torch.dtype) -> tuple[Tensor, dict[str, Tensor]]:
    """Value and gradients of ``terms(result, priors)`` for inputs of a dtype."""
    leaves = {name: getattr(rendered(), name).to(dtype).requires_grad_() for name in INPUTS}
    value = 3 * terms(cast(rendered(), dtype).with_layers(**leaves), cast(measured(), dtype))
    value.backward()
    zeros = {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
    return value.detach(), {k: zeros[k] if leaf.grad is None else leaf.grad for k, leaf in leaves.items()}


def assert_same(
    found: tuple[Tensor, dict[str, Tensor]], exact: tuple[Tensor, dict[str, Tensor]], tolerance: float = 2e-5
) -> None:
    """Gradients agree relative to those of their pixel, the odd ones too."""
    assert float(found[0]) == pytest.approx(float(exact[0]), rel=1e-6)
    for name in INPUTS:
        mine, theirs = (by[name].double().reshape(HEIGHT, WIDTH, -1) for by in (found[1], exact[1]))
        size = theirs.abs().amax(-1)
        off = (mine - theirs).abs().amax(-1) / (size + size.median() + 1e-12)
        assert bool(torch.isfinite(mine).all()), name
        assert float(off.max()) < tolerance, (
            f"{name}: {float(off.max())} at {divmod(int(off.argmax()), WIDTH)}"
        )


SINGLE = [
    replace(Weights(), **{name: 0.7}) for name in ("stokes", "azimuth", "chromatic", "normal", "consistency")
]


def names(weights: Weights) -> str:
    return "+".join(f.name for f in fields(weights) if getattr(weights, f.name) != f.default)


def step(result: RenderResult, priors: ViewPriors, shading: ShadingModel = SHADING) -> Step:
    targets = StepTargets(camera(), result.final, priors=priors)
    return Step(result, targets, shading, {}, 1.0)


def native(weights: Weights, shading: ShadingModel = SHADING):
    return lambda result, priors: normal_terms(step(result, priors, shading), weights)


def reference(weights: Weights, shading: ShadingModel = SHADING):
    return lambda result, priors: normal_terms_reference(step(result, priors, shading), weights)


@pytest.mark.parametrize("weights", [*SINGLE, ALL], ids=names)
def test_native_agrees_with_the_reference(simd: str, weights: Weights) -> None:
    found = with_gradients(native(weights), torch.float32)
    exact = with_gradients(reference(weights), torch.float64)
    assert_same(found, exact)
    assert_same(found, with_gradients(reference(weights), torch.float32))


def test_a_live_choice_takes_the_nearest_candidate_natively_and_not() -> None:
    weights = Weights(normal=0.7)
    candidates = normalize(random(40, *SIZE, 4, 3), dim=-1)

    def live(terms):
        return lambda result, priors: terms(result, replace(priors, candidates=candidates.to(priors.normal)))

    def plainly(result: RenderResult, priors: ViewPriors) -> Tensor:
        facing = result.normal / result.normal.norm(dim=-1, keepdim=True).clamp(min=1e-2)
        distances = torch.stack([1 - (facing * candidates[..., k, :]).sum(-1) for k in range(4)], dim=-1)
        weight = priors.weight
        return 0.7 * (weight * distances.min(dim=-1).values).sum() / (0.7 * weight.numel())

    found = with_gradients(live(native(weights)), torch.float32)
    assert_same(found, with_gradients(live(reference(weights)), torch.float64))
    value, gradients = with_gradients(plainly, torch.float64)
    assert float(found[0]) == pytest.approx(float(value), rel=1e-4)
    normal = rendered().normal
    usual = normal.norm(dim=-1) > 0.05
    torch.testing.assert_close(
        found[1]["normal"].double()[usual], gradients["normal"][usual], atol=1e-7, rtol=1e-4
    )
    assert float(value) < 0.8 * float(with_gradients(reference(weights), torch.float64)[0])


@pytest.mark.parametrize("weights", SINGLE, ids=names)
def test_a_slightly_different_term_is_told_apart(weights: Weights) -> None:
    found = with_gradients(native(weights), torch.float32)
    other = replace(weights, **{names(weights): 0.7001})
    with pytest.raises(AssertionError):
        assert_same(found, with_gradients(reference(other), torch.float64))


def test_every_term_has_a_gradient_by_what_it_reads() -> None:
    for weights, read in zip(SINGLE, (3, 1, 1, 1, 2), strict=True):
        gradients = with_gradients(native(weights), torch.float32)[1]
        assert sum(bool(g.any()) for g in gradients.values()) == read


def test_float64_takes_the_reference_bit_for_bit() -> None:
    found, exact = (with_gradients(f(ALL), torch.float64) for f in (native, reference))
    assert torch.equal(found[0], exact[0])
    for name in INPUTS:
        assert torch.equal(found[1][name], exact[1][name])


def test_threads_do_not_change_the_result() -> None:
    results = []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        results.append(with_gradients(native(ALL), torch.float32))
    for other in results[1:]:
        assert torch.equal(results[0][0], other[0])
        for name in INPUTS:
            assert torch.equal(results[0][1][name], other[1][name])


@dataclass(frozen=True)
class Mirror(DeferredShading):
    """Says of polarization something else than a dielectric does."""

    def predicted_stokes(self, result: RenderResult, camera: Camera) -> Tensor:
        return 0.5 * super().predicted_stokes(result, camera)


def test_a_model_with_a_prediction_of_its_own_takes_the_reference_for_it() -> None:
    mirror = Mirror("fresnel", refractive_index=1.4)
    found = with_gradients(native(ALL, mirror), torch.float32)
    assert_same(found, with_gradients(reference(ALL, mirror), torch.float64))


def test_intensities_behind_a_polarizer_at_any_angle() -> None:
    angles = [0.1, 0.9, 2.3]
    analyzers = [(0.5, 0.5 * math.cos(2 * t), 0.5 * math.sin(2 * t)) for t in angles]
    seen = random(30, len(angles), *SIZE, 3).abs()

    def directly(result: RenderResult, priors: ViewPriors) -> Tensor:
        stokes = SHADING.predicted_stokes(result, camera())
        expected = torch.stack([optics.intensity(stokes, angle) for angle in angles])
        return 0.3 * (priors.stokes_weight[..., None] * (expected - seen).abs()).sum()

    def fused(result: RenderResult, priors: ViewPriors) -> Tensor:
        polarization = PolarizationTerm(
            seen.float(), analyzers, priors.stokes_weight, 0.3, SHADING.refractive_index
        )
        return pixel_terms(result, camera(), Terms(polarization, (), None))

    assert_same(with_gradients(fused, torch.float32), with_gradients(directly, torch.float64))


def test_no_weight_no_light_and_no_surface_cost_nothing() -> None:
    nothing = {name: torch.zeros(*SIZE, 3, requires_grad=True) for name in INPUTS[:3]}
    depth = torch.zeros(SIZE, requires_grad=True)
    flat = torch.zeros(SIZE)
    result = cast(rendered(), torch.float32).with_layers(**nothing, depth=depth, alpha=flat)
    priors = cast(measured(), torch.float32)
    dark = replace(priors, weight=flat, chromatic_weight=flat, stokes=torch.zeros(3, *SIZE, 3), surface=flat)
    value = normal_terms(step(result, dark), ALL)
    value.backward()
    assert float(value.detach()) == 0
    for leaf in (*nothing.values(), depth):
        assert not leaf.grad.any()


def test_not_a_number_is_not_hidden() -> None:
    for name in INPUTS[:3]:
        broken = getattr(rendered(), name).clone().float()
        broken[18, 33] = torch.nan
        result = cast(rendered(), torch.float32).with_layers(**{name: broken})
        value = normal_terms(step(result, cast(measured(), torch.float32)), ALL)
        assert not bool(torch.isfinite(value)), name


def test_shapes_are_checked() -> None:
    result = cast(rendered(), torch.float32).with_layers(specular=torch.zeros(3, 3, 3))
    with pytest.raises(ValueError, match="specular: "):
        normal_terms(step(result, cast(measured(), torch.float32)), ALL)
