"""Normals from the polarization of color differences, on light that Fresnel's equations predict."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import load_scene
from polarguide.geometry.vectors import dot

SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"
F64 = torch.float64
SIZE = (12, 16)


def rays() -> Tensor:
    y, x = torch.meshgrid(*(torch.linspace(-0.4, 0.4, n, dtype=F64) for n in SIZE), indexing="ij")
    return torch.nn.functional.normalize(torch.stack((x, y, torch.ones_like(x)), dim=-1), dim=-1)


def surface(zenith: float, azimuth: float) -> Tensor:
    """A normal with the same angles about every ray."""
    shape = torch.ones(SIZE, dtype=F64)
    return optics.normal_from_angles(zenith * shape, azimuth * shape, rays())


def half_turn_distance(a: Tensor, b: float) -> Tensor:
    return torch.remainder(a - b + math.pi / 2, math.pi) - math.pi / 2


def texture(seed: int = 0) -> Tensor:
    return torch.rand(*SIZE, 3, generator=torch.Generator().manual_seed(seed), dtype=F64) + 0.05


@pytest.mark.parametrize("index", [1.33, 1.5, 1.8])
@pytest.mark.parametrize("zenith", [0.4, 0.8, 1.2])
@pytest.mark.parametrize("share", [0.3, 1.0, 3.0])
def test_neutral_reflection_over_body_colors_gives_both_angles_exactly(
    index: float, zenith: float, share: float
) -> None:
    neutral = share * torch.ones(*SIZE, 1, dtype=F64).expand(-1, -1, 3)
    light = optics.predicted_stokes(neutral, texture(), surface(zenith, 0.7), rays(), index)
    found = optics.chromatic_normals(light, index)
    assert torch.allclose(found.zenith, torch.tensor(zenith, dtype=F64), atol=1e-6)
    assert half_turn_distance(found.azimuth, 0.7).abs().max() < 1e-6
    assert bool((found.certainty > 100).all())
    s0 = light[0]
    middle = s0.mean(dim=-1)
    among = ((s0 - middle[..., None]) ** 2).mean(dim=-1)
    # Away from the border, where the window is whole, and on average over it.
    window = (among[:5, :5].mean().sqrt() / middle[:5, :5].mean()).expand(())
    assert float(found.contrast[2, 2]) == pytest.approx(float(window))


def test_the_wrong_lobe_of_the_mixture_does_not_matter() -> None:
    """The mean points across the plane of incidence; the color differences still point along it."""
    neutral = 0.8 * torch.ones(*SIZE, 3, dtype=F64)
    light = optics.predicted_stokes(neutral, 0.3 * texture(), surface(0.9, -0.4), rays())
    across = half_turn_distance(optics.aolp(optics.luminance(light)), -0.4)
    assert across.abs().min() > 1.5
    found = optics.chromatic_normals(light)
    assert bool(found.decided.all())
    assert half_turn_distance(found.azimuth, -0.4).abs().max() < 1e-6


def test_a_pure_colored_reflection_is_not_taken_for_diffuse_light() -> None:
    nothing = torch.zeros(*SIZE, 3, dtype=F64)
    light = optics.predicted_stokes(texture(), nothing, surface(0.8, 0.7), rays())
    assert not optics.chromatic_normals(light).decided.any()


def test_a_picture_without_color_decides_nothing() -> None:
    gray = texture()[..., :1].expand(-1, -1, 3)
    light = optics.predicted_stokes(0.3 * torch.ones_like(gray), gray, surface(0.8, 0.7), rays())
    found = optics.chromatic_normals(light)
    assert not found.decided.any()
    assert torch.equal(found.certainty, torch.zeros(SIZE, dtype=F64))
    single = optics.chromatic_normals(light[..., :1])
    assert not single.decided.any()


def test_darkness_stays_finite_and_undecided() -> None:
    found = optics.chromatic_normals(torch.zeros(3, *SIZE, 3))
    assert not found.decided.any()
    for value in (found.zenith, found.azimuth, found.certainty):
        assert bool(torch.isfinite(value).all())


def test_noise_lowers_the_certainty() -> None:
    neutral = 0.5 * torch.ones(*SIZE, 3, dtype=F64)
    light = optics.predicted_stokes(neutral, texture(), surface(0.8, 0.7), rays())
    noise = torch.randn(light.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    certainty = [optics.chromatic_normals(light + s * noise).certainty.median() for s in (1e-3, 1e-2, 1e-1)]
    assert certainty[0] > certainty[1] > certainty[2]
    share = optics.chromatic_normals(light + 0.1 * noise).decided.double().mean()
    assert share < 0.1


@pytest.mark.parametrize(
    ("stokes", "window", "what"),
    [
        (torch.zeros(4, 8, 8, 3), 5, "stokes"),
        (torch.zeros(3, 8, 8), 5, "stokes"),
        (torch.zeros(3, 8, 8, 3), 4, "window"),
    ],
)
def test_wrong_arguments_are_named(stokes: Tensor, window: int, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        optics.chromatic_normals(stokes, window=window)


def angles_against_truth(scene: Path, downscale: int) -> tuple[float, float, float]:
    """Share of the foreground that is decided, and there mean errors of azimuth and zenith in degrees."""
    decided, total, azimuth, zenith = 0, 0, 0.0, 0.0
    for view in load_scene(scene, downscale=downscale).test_views:
        ground_truth = view.ground_truth
        assert ground_truth is not None
        assert ground_truth.normal is not None
        assert ground_truth.mask is not None
        view_rays = view.camera.rays()
        normal = view.camera.to_camera(ground_truth.normal.float())
        polar = optics.zenith(normal, view_rays)
        found = optics.chromatic_normals(optics.stokes(view.intensities()))
        steep = ground_truth.mask & (polar > math.radians(15)) & (dot(normal, view_rays) < 0)
        where = steep & found.decided & ~view.saturated
        turn = half_turn_distance(found.azimuth - optics.azimuth(normal, view_rays), 0.0)
        decided, total = decided + int(where.sum()), total + int(steep.sum())
        azimuth += float(turn[where].abs().rad2deg().sum())
        zenith += float((found.zenith - polar)[where].abs().rad2deg().sum())
    return decided / total, azimuth / decided, zenith / decided


def test_the_demo_scene_agrees_with_its_true_normals(demo_scene: Path) -> None:
    share, azimuth, zenith = angles_against_truth(demo_scene, 1)
    assert share > 0.15
    assert azimuth < 6
    assert zenith < 9


@pytest.mark.shared
@pytest.mark.skipif(not SCENES.is_dir(), reason="no captures in ../shared -> ln -s FOLDER ../shared")
@pytest.mark.parametrize("name", ["spheres", "cup"])
def test_shared_scenes_agree_with_their_true_normals(name: str) -> None:
    share, azimuth, zenith = angles_against_truth(SCENES / name, 1)
    assert share > 0.15
    assert azimuth < 4
    assert zenith < 8
