"""Terms of the loss at inputs whose value is known."""

import math
from dataclasses import dataclass, fields, replace

import pytest
import torch
from faults import Fault
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

from polarguide import optics
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.result import RenderResult
from polarguide.training.losses import (
    Weights,
    azimuth_loss,
    chromatic_loss,
    consistency_loss,
    depth_normals,
    flatness_loss,
    normal_loss,
    step_loss,
    stokes_loss,
    term,
)
from polarguide.training.photometric import photometric_loss
from polarguide.training.priors import stokes_weight, surface_weight
from polarguide.training.targets import Step, StepTargets, ViewPriors

SIZE = (12, 14)
GLASS = DeferredShading("fresnel")
SCALES = torch.tensor([[-3.0, -2.0, -1.0], [-1.0, -4.0, -2.0], [0.0, 0.0, -5.0]])


def unit(seed: int) -> Tensor:
    return normalize(torch.randn(*SIZE, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


CAMERA = Camera(
    SIZE[1],
    SIZE[0],
    20.0,
    20.0,
    7.0,
    6.0,
    torch.eye(3, dtype=torch.float64),
    torch.zeros(3, dtype=torch.float64),
)


def picture(seed: int) -> Tensor:
    return torch.rand(*SIZE, 3, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def priors() -> ViewPriors:
    normal = unit(0)
    plane = normalize(torch.linalg.cross(normal, unit(1)), dim=-1)
    weight = torch.rand(SIZE, generator=torch.Generator().manual_seed(2))
    return ViewPriors(
        CAMERA,
        srgb_encode(picture(3)),
        srgb_encode(picture(4)),
        torch.ones(SIZE),
        normal,
        plane,
        weight,
        normal,
        weight.square(),
        measured(1.0),
        stokes_weight(measured(1.0), torch.ones(SIZE)),
        weight,
    )


LAYERS = (picture(20), picture(21))
FACING = normalize(unit(22) - 1.5 * CAMERA.world_rays(), dim=-1)


def measured(index_shift: float) -> Tensor:
    """What a camera measures of two known layers on a surface with known normals."""
    specular, diffuse = LAYERS
    normal = CAMERA.to_camera(FACING)
    return optics.predicted_stokes(2 * specular, 2 * diffuse, normal, CAMERA.rays(), 0.5 + index_shift)


def step(
    result: RenderResult,
    shown: Tensor,
    priors: ViewPriors | None,
    valid: Tensor | None = None,
    ssim_weight: float = 0.2,
) -> Step:
    return Step(
        result,
        StepTargets(CAMERA, shown, valid, priors=priors),
        GLASS,
        {"log_scales": SCALES},
        2.0,
        ssim_weight,
    )


def result(**layers: Tensor) -> RenderResult:
    values = {"final": picture(5), "base": picture(5), "alpha": torch.ones(SIZE), **layers}
    return RenderResult(values, training={"radii": torch.ones(3)})


@pytest.mark.parametrize("length", [0.5, 1.0, 3.0])
def test_losses_of_normals_whatever_their_length(priors: ViewPriors, length: float) -> None:
    """Zero at the target, two at the opposite, one across; the azimuth is blind to the sign."""
    normal, plane, chromatic = length * priors.normal, length * priors.plane, length * priors.chromatic
    for loss, rendered, expected in (
        (normal_loss, normal, 0.0),
        (normal_loss, -normal, 2.0),
        (normal_loss, plane, 1.0),
        (azimuth_loss, plane, 1.0),
        (azimuth_loss, -plane, 1.0),
        (chromatic_loss, chromatic, 0.0),
        (chromatic_loss, -chromatic, 2.0),
    ):
        assert float(loss(rendered, priors)) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_normal_loss_takes_the_nearest_candidate_pixel_by_pixel(priors: ViewPriors) -> None:
    candidates = torch.stack((-priors.normal, priors.plane, unit(40), unit(41)), dim=-2)
    live = replace(priors, candidates=candidates)
    rendered = 0.7 * unit(42)
    cosines = (normalize(rendered, dim=-1)[..., None, :] * candidates).sum(dim=-1)
    expected = ((1 - cosines.max(dim=-1).values) * priors.weight).sum() / priors.weight.sum()
    torch.testing.assert_close(normal_loss(rendered, live), expected)
    assert float(normal_loss(candidates[..., 2, :], live)) == pytest.approx(0.0, abs=1e-6)


def test_azimuth_loss_is_zero_in_the_plane_whatever_the_zenith(priors: ViewPriors) -> None:
    across = torch.linalg.cross(priors.plane, priors.normal)
    for angle in torch.linspace(0, 3, 7):
        in_plane = torch.cos(angle) * priors.normal + torch.sin(angle) * across
        assert float(azimuth_loss(in_plane, priors)) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("loss", [normal_loss, azimuth_loss, chromatic_loss])
def test_pixels_without_weight_do_not_count(priors: ViewPriors, loss: object) -> None:
    weight = priors.weight.clone()
    weight[:, :5] = 0
    priors = replace(priors, weight=weight, chromatic_weight=weight)
    normal = unit(9)
    other = normal.clone()
    other[:, :5] = unit(10)[:, :5]
    assert torch.equal(loss(normal, priors), loss(other, priors))  # type: ignore[operator]
    none = replace(priors, weight=torch.zeros(SIZE), chromatic_weight=torch.zeros(SIZE))
    assert float(loss(normal, none)) == 0  # type: ignore[operator]


def test_a_blended_normal_of_length_zero_has_a_finite_gradient(priors: ViewPriors) -> None:
    normal = torch.zeros(*SIZE, 3, requires_grad=True)
    (normal_loss(normal, priors) + azimuth_loss(normal, priors)).backward()
    assert bool(torch.isfinite(normal.grad).all())


def test_chromatic_loss_has_a_weight_of_its_own(priors: ViewPriors) -> None:
    none = replace(priors, chromatic_weight=torch.zeros(SIZE))
    assert float(chromatic_loss(-priors.chromatic, none)) == 0


def test_stokes_loss_is_zero_for_the_layers_and_normals_that_were_measured(priors: ViewPriors) -> None:
    rendered = result(specular=LAYERS[0], diffuse=LAYERS[1], normal=0.7 * FACING)
    assert float(stokes_loss(rendered, priors, GLASS)) == pytest.approx(0.0, abs=1e-6)
    assert float(stokes_loss(rendered, priors, replace(GLASS, refractive_index=1.4))) > 1e-3
    swapped = result(specular=LAYERS[1], diffuse=LAYERS[0], normal=FACING)
    assert float(stokes_loss(swapped, priors, GLASS)) > 1e-2
    nothing = replace(priors, stokes_weight=torch.zeros(SIZE))
    assert float(stokes_loss(swapped, nothing, GLASS)) == 0


def test_stokes_loss_turns_a_normal_to_the_one_that_was_measured(priors: ViewPriors) -> None:
    start = normalize(FACING + 0.2 * unit(23), dim=-1)
    normal = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([normal], lr=0.01)
    for _ in range(300):
        optimizer.zero_grad()
        stokes_loss(result(specular=LAYERS[0], diffuse=LAYERS[1], normal=normal), priors, GLASS).backward()
        optimizer.step()
    before = (start * FACING).sum(-1).clamp(-1, 1).acos().mean()
    after = (normalize(normal.detach(), dim=-1) * FACING).sum(-1).clamp(-1, 1).acos().mean()
    assert float(after) < 0.3 * float(before)


def test_stokes_loss_is_finite_where_there_is_no_light_and_no_normal(priors: ViewPriors) -> None:
    dark = replace(priors, stokes=torch.zeros(3, *SIZE, 3))
    layers = [torch.zeros(*SIZE, 3, requires_grad=True) for _ in range(3)]
    rendered = result(specular=layers[0], diffuse=layers[1], normal=layers[2])
    stokes_loss(rendered, dark, GLASS).backward()
    for layer in layers:
        assert bool(torch.isfinite(layer.grad).all())


def test_flatness_is_the_shortest_scale_of_what_is_visible() -> None:
    radii = torch.tensor([4.0, 0.0, 1.0])
    expected = 100 / 2 * (math.exp(-3) + math.exp(-5)) / 2
    assert float(flatness_loss(SCALES, radii, 2.0)) == pytest.approx(expected, rel=1e-5)
    assert float(flatness_loss(SCALES, torch.zeros(3), 2.0)) == 0


def test_the_step_loss_is_the_weighted_sum_of_its_terms(priors: ViewPriors) -> None:
    shown = srgb_encode(picture(6))
    rendered = result(specular=picture(7), diffuse=picture(8), normal=unit(9))
    valid = (picture(11)[..., 0] > 0.2).float()
    weights = Weights(
        photometric=0.7,
        specular=0.5,
        diffuse=0.2,
        normal=0.3,
        azimuth=0.4,
        chromatic=0.6,
        flatness=0.9,
        stokes=1.1,
    )
    total, photometric, error = step_loss(step(rendered, shown, priors, valid, 0.3), weights)
    expected_photometric = photometric_loss(rendered.final, shown, valid, 0.3)
    expected = (
        0.7 * expected_photometric
        + 0.5 * photometric_loss(rendered.specular, priors.specular, priors.separated, 0.3)
        + 0.2 * photometric_loss(rendered.diffuse, priors.diffuse, priors.separated, 0.3)
        + 0.3 * normal_loss(rendered.normal, priors)
        + 0.4 * azimuth_loss(rendered.normal, priors)
        + 0.6 * chromatic_loss(rendered.normal, priors)
        + 0.9 * flatness_loss(SCALES, rendered.training["radii"], 2.0)
        + 1.1 * stokes_loss(rendered, priors, GLASS)
    )
    assert float(total) == pytest.approx(float(expected), rel=1e-5)
    assert float(photometric) == pytest.approx(float(expected_photometric), rel=1e-6)
    squares = (srgb_encode(rendered.final.clamp(0, 1)) - shown).square().mean(dim=-1)
    assert float(error) == pytest.approx(float((valid * squares).sum() / valid.sum()), rel=1e-5)


def test_every_term_reads_targets_and_layers_that_there_are() -> None:
    known = {field.name for field in fields(ViewPriors)}
    for weight in fields(Weights):
        alone = Weights(**{"photometric": 0.0, weight.name: 1.0})
        assert alone.fields_read <= known, weight.name
        assert {*weight.metadata["rendered"]} <= {"normal", "depth", "layers"}, weight.name
        assert alone.rendered == {*weight.metadata["rendered"]}, weight.name
        # Priors are computed for the terms that need them; a term that can do without them is marked as optional.
        assert alone.priors == (bool(weight.metadata["priors"]) and not weight.metadata["optional"]), (
            weight.name
        )


def test_few_polarized_pixels_pull_no_harder_than_many(priors: ViewPriors) -> None:
    one = torch.zeros(SIZE)
    one[3, 4] = 1.0
    few = replace(priors, weight=one, chromatic_weight=one)
    spread = replace(few, azimuth_share=0.5, chromatic_share=0.25)
    pixels = SIZE[0] * SIZE[1]
    for loss, share in ((azimuth_loss, 0.5), (normal_loss, 0.5), (chromatic_loss, 0.25)):
        assert float(loss(unit(9), spread)) == pytest.approx(float(loss(unit(9), few)) / (share * pixels))
    # Where more than that share is polarized, the least share means nothing.
    whole = replace(spread, weight=torch.ones(SIZE))
    assert float(azimuth_loss(unit(9), whole)) == pytest.approx(
        float(azimuth_loss(unit(9), replace(whole, azimuth_share=0.0)))
    )


def test_what_is_bright_counts_for_the_agreement_with_depth_whatever_its_polarization(
    priors: ViewPriors,
) -> None:
    dark, bright = torch.zeros_like(priors.stokes), torch.ones_like(priors.stokes)
    nowhere = torch.zeros(SIZE)
    assert torch.equal(surface_weight(bright, nowhere, 0.25), torch.ones(SIZE))
    assert torch.equal(surface_weight(dark, nowhere, 0.25), nowhere)
    # S0/2 of 0.125 is half of what counts fully.
    torch.testing.assert_close(surface_weight(0.25 * bright, nowhere, 0.25), torch.full(SIZE, 0.5))
    assert torch.equal(surface_weight(dark, priors.weight, 0.25), priors.weight)
    assert torch.equal(surface_weight(bright, nowhere, 0.0), nowhere)


def test_layers_of_half_the_picture_weigh_half(priors: ViewPriors) -> None:
    rendered = result(final=picture(6), specular=picture(7), diffuse=picture(8))
    half = torch.zeros(SIZE)
    half[: SIZE[0] // 2] = 1.0
    some = replace(priors, separated=half)

    def layers(given: ViewPriors) -> float:
        total, photometric, _ = step_loss(
            step(rendered, srgb_encode(picture(6)), given), Weights(specular=0.5)
        )
        return float(total - photometric)

    expected = 0.5 * float(photometric_loss(picture(7), priors.specular, half, 0.2))
    assert layers(some) == pytest.approx(0.5 * expected, rel=1e-5)


def test_a_perfect_picture_costs_nothing(priors: ViewPriors) -> None:
    assert priors.separated.all()
    rendered = result(final=picture(6), specular=picture(3), diffuse=picture(4), normal=priors.normal)
    weights = Weights(specular=0.5, diffuse=0.2, normal=0.3, azimuth=0.4)
    total, *_ = step_loss(step(rendered, srgb_encode(picture(6)), priors), weights)
    assert float(total) == pytest.approx(0.0, abs=1e-5)


def test_layers_that_a_recipe_lacks_are_left_out(priors: ViewPriors) -> None:
    weights = Weights(specular=0.5, diffuse=0.2, normal=0.3, azimuth=0.4)
    shown = srgb_encode(picture(6))
    total, photometric, _ = step_loss(step(result(), shown, priors), weights)
    assert torch.equal(total, photometric)
    total, photometric, _ = step_loss(step(result(normal=unit(1)), shown, None), weights)
    assert torch.equal(total, photometric)


def test_a_loss_that_is_not_finite_is_an_error(priors: ViewPriors) -> None:
    rendered = result(normal=torch.full((*SIZE, 3), torch.nan))
    Fault("training", "finite", "nan").raised_by(
        step_loss, step(rendered, picture(6), priors), Weights(normal=0.1)
    )


TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)).Q
TURNED = Camera(
    24, 20, 30.0, 28.0, 11.0, 10.5, TURN * torch.linalg.det(TURN), torch.zeros(3, dtype=torch.float64)
)
PLANES = ([0.0, 0.0, -1.0], [0.3, -0.2, -1.0], [-0.6, 0.5, -0.8])


def depth_of_plane(normal: Tensor, distance: float = 5.0) -> Tensor:
    """Camera depth of the plane ``normal . x = -distance`` in camera axes."""
    rays = TURNED.rays(dtype=torch.float64)
    return -distance * rays[..., 2] / (rays @ normal)


def surface(normal: Tensor, depth: Tensor, alpha: Tensor) -> RenderResult:
    picture = torch.zeros(20, 24, 3)
    layers = {"final": picture, "base": picture, "alpha": alpha, "normal": normal, "depth": depth}
    return RenderResult(layers, training={"radii": torch.ones(1)})


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("distance", [0.01, 5.0, 1000.0])
def test_a_plane_has_its_own_normal_everywhere(plane: list[float], distance: float) -> None:
    normal = normalize(torch.tensor(plane, dtype=torch.float64), dim=0)
    found = depth_normals(depth_of_plane(normal, distance), TURNED)
    assert_close(TURNED.to_camera(found[1:-1, 1:-1]), normal.expand(18, 22, 3), rtol=0, atol=1e-6)
    for border in (found[0], found[-1], found[:, 0], found[:, -1]):
        assert not border.any()


def test_the_term_is_zero_where_all_agree_and_grows_with_the_angle() -> None:
    normal = normalize(torch.tensor(PLANES[1], dtype=torch.float64), dim=0)
    depth, alpha = depth_of_plane(normal), torch.full((20, 24), 0.7, dtype=torch.float64)
    world = TURNED.to_world(normal.expand(20, 24, 3))
    same = consistency_loss(surface(0.7 * world, depth, alpha), TURNED)
    assert float(same) == pytest.approx(0.0, abs=1e-6)
    opposite = consistency_loss(surface(-0.7 * world, depth, alpha), TURNED)
    assert float(opposite) == pytest.approx(1.4, abs=1e-6)
    scattered = consistency_loss(surface(0.3 * world, depth, alpha), TURNED)
    assert float(scattered) == pytest.approx(0.4, abs=1e-6)


def test_gradients_of_depth_normals_against_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    depth = (3 + torch.rand(20, 24, generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: depth_normals(d, TURNED), (depth,), fast_mode=True)


@pytest.mark.parametrize("value", [0.0, 1e-8, 2.0])
def test_any_constant_depth_is_finite_with_gradients(value: float) -> None:
    depth = torch.full((20, 24), value, requires_grad=True)
    normals = depth_normals(depth, TURNED)
    normals.sum().backward()
    assert bool(torch.isfinite(normals).all())
    assert bool(torch.isfinite(depth.grad).all())


def test_pixels_without_weight_do_not_count_for_consistency() -> None:
    normal = normalize(torch.tensor(PLANES[1], dtype=torch.float64), dim=0)
    depth, alpha = depth_of_plane(normal), torch.ones(20, 24, dtype=torch.float64)
    world = TURNED.to_world(normal.expand(20, 24, 3)).clone()
    world[:, :12] = -world[:, :12]
    weight = torch.zeros(20, 24, dtype=torch.float64)
    weight[:, 12:] = 1
    assert float(consistency_loss(surface(world, depth, alpha), TURNED, weight)) == pytest.approx(0, abs=1e-6)
    assert float(consistency_loss(surface(world, depth, alpha), TURNED, 1 - weight)) > 0.5


def test_a_picture_without_an_inner_pixel_has_no_loss() -> None:
    normal, ones = torch.zeros(2, 30, 3), torch.ones(2, 30)
    assert float(consistency_loss(surface(normal, ones, ones), TURNED)) == 0


@dataclass(frozen=True)
class MoreWeights(Weights):
    """As a package of its own has them."""

    brightness: float = term(rendered=("layers",))

    def own_terms(self):
        return (lambda step, weights: weights.brightness * step.result.final.mean(),)


def test_a_term_of_another_package_is_in_the_loss():
    shown = srgb_encode(picture(6))
    rendered = result()
    plain, *_ = step_loss(step(rendered, shown, None), Weights())
    more, *_ = step_loss(step(rendered, shown, None), MoreWeights(brightness=2.0))
    assert_close(more - plain, 2.0 * rendered.final.mean())
    assert "layers" in MoreWeights(brightness=2.0).rendered
    assert "layers" not in MoreWeights().rendered
