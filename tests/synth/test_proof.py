"""Rendered light against Fresnel's equations, by the optics that read real captures.

A smooth ball under an even sky: every zenith and azimuth, known exactly.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from polarguide import optics
from polarguide.geometry.camera import Camera, look_at
from polarguide.geometry.vectors import unit_array as unit
from polarguide.synth.build import BuiltScene, build_scene
from polarguide.synth.film import LobeRadiance, render_lobes
from polarguide.synth.ground_truth import ground_truth_maps
from polarguide.synth.schema import parse_scene
from polarguide.synth.settings import Variant
from polarguide.synth.transport import PathLimits

INDEX = 1.5
BALL = {
    "name": "ball",
    "camera": {"rings": [{"radius": 3, "height": 1}]},
    "environment": {"type": "uniform", "radiance": [1, 1, 1], "height": 4},
    "things": [
        {
            "name": "ball",
            "shape": {"type": "ball", "radius": 1},
            "material": {"color": [0.6, 0.3, 0.15], "roughness": 0.001, "index": INDEX},
        }
    ],
}


@pytest.fixture(scope="module")
def camera() -> Camera:
    """Off the axis of the ball, so that frames off the axis count, and turned against the world."""
    return Camera(
        20, 16, 20.0, 20.0, 10.0, 8.0, *look_at((2.2, -1.4, 1.1), (0.2, 0.15, 0.1), (0.0, 0.0, 1.0))
    )


@pytest.fixture(scope="module")
def ball(variant: Variant, tmp_path_factory: pytest.TempPathFactory) -> BuiltScene:
    folder = tmp_path_factory.mktemp("ball")
    return build_scene(parse_scene(BALL, "ball", folder=folder), folder, variant)


@pytest.fixture(scope="module")
def light(ball: BuiltScene, camera: Camera) -> LobeRadiance:
    return render_lobes(ball.scenes, camera, 64, seed=3, limits=PathLimits(depth=3), center=True)


@pytest.fixture(scope="module")
def normals(camera: Camera) -> tuple[Tensor, Tensor]:
    """Analytic normals of the unit ball in camera axes, [H, W, 3] float64, and where there is one."""
    eye = camera.center.numpy()
    rays = camera.world_rays(dtype=torch.float64).numpy()
    along = rays @ eye
    inside = along**2 - (eye @ eye - 1)
    reach = -along - np.sqrt(np.maximum(inside, 0))
    world = unit(eye + reach[..., None] * rays)
    return camera.to_camera(torch.from_numpy(world)), torch.from_numpy(inside > 0.03)


def angle_error(stokes: Tensor, expected: Tensor) -> Tensor:
    """Difference of AoLP modulo half a turn, degrees."""
    return torch.rad2deg(torch.remainder(optics.aolp(stokes) - expected + math.pi / 2, math.pi) - math.pi / 2)


@pytest.mark.parametrize("lobe", ["specular", "diffuse"])
def test_each_lobe_obeys_fresnel(
    lobe: str, light: LobeRadiance, normals: tuple[Tensor, Tensor], camera: Camera
) -> None:
    normal, where = normals
    rays = camera.rays(dtype=torch.float64)
    zenith, azimuth = optics.zenith(normal, rays), optics.azimuth(normal, rays)
    # Near the middle there is no direction, at the rim the highlight of a rough surface is cut off.
    where = where & (zenith > math.radians(15)) & (zenith < math.radians(78))
    assert where.sum() > 80
    stokes = optics.luminance(torch.from_numpy(getattr(light, lobe)))
    degree = optics.specular_dolp if lobe == "specular" else optics.diffuse_dolp
    error = (optics.dolp(stokes) - degree(zenith, INDEX))[where].abs()
    assert error.max() < 1e-3
    turn = math.pi / 2 if lobe == "specular" else 0.0
    off = angle_error(stokes, azimuth + turn)[where]
    assert off.abs().mean() < 0.01
    assert off.mean().abs() < 0.005


def test_specular_light_is_fresnels_reflectance(
    light: LobeRadiance, normals: tuple[Tensor, Tensor], camera: Camera, variant: Variant
) -> None:
    normal, where = normals
    zenith = optics.zenith(normal, camera.rays(dtype=torch.float64))
    rs, rp = optics.reflectances(zenith, INDEX)
    found = torch.from_numpy(light.specular[0]).mean(-1)
    where = where & (zenith < math.radians(75))
    ratio = found[where] / ((rs + rp) / 2)[where]
    assert ratio.mean() == pytest.approx(1, abs=5e-3)
    assert (ratio - 1).abs().max() < (0.02 if variant.channels == 3 else 0.1)  # sampled wavelengths are noisy


def test_full_polarization_at_brewsters_angle(
    ball: BuiltScene, camera: Camera, variant: Variant, normals: tuple[Tensor, Tensor], light: LobeRadiance
) -> None:
    normal, where = normals
    zenith = optics.zenith(normal, camera.rays(dtype=torch.float64))
    # Rp vanishes as the square of the distance from Brewster's angle: sqrt(1 - DoLP), signed, crosses zero there.
    near = where & ((zenith - optics.brewster(INDEX)).abs() < math.radians(12))
    degree = optics.dolp(optics.luminance(torch.from_numpy(light.specular)))[near]
    inner = zenith[near]
    root = torch.sqrt((1 - degree).clamp(min=0)) * torch.sign(inner - optics.brewster(INDEX))
    basis = torch.stack([torch.ones_like(inner), inner, inner**2, inner**3], -1)
    weights = torch.linalg.lstsq(basis, root[:, None]).solution[:, 0]
    angles = torch.linspace(math.radians(52), math.radians(61), 9001, dtype=torch.float64)
    curve = torch.stack([angles**k for k in range(4)], -1) @ weights
    crossing = float(angles[curve.abs().argmin()])
    assert math.degrees(crossing) == pytest.approx(math.degrees(float(optics.brewster(INDEX))), abs=0.1)


def test_lobes_add_up_and_predict_the_polarization(
    light: LobeRadiance, normals: tuple[Tensor, Tensor], camera: Camera
) -> None:
    normal, where = normals
    total = light.stokes
    np.testing.assert_allclose(total[0], light.specular[0] + light.diffuse[0] + light.emitted, atol=1e-12)
    rays = camera.rays(dtype=torch.float64)
    where = where & (optics.zenith(normal, rays) < math.radians(78))
    model = optics.predicted_stokes(
        torch.from_numpy(light.specular[0]), torch.from_numpy(light.diffuse[0]), normal, rays, INDEX
    )
    assert (model - torch.from_numpy(total)).abs()[:, where].max() < 1e-3


def test_what_is_seen_directly_is_the_sky(light: LobeRadiance, normals: tuple[Tensor, Tensor]) -> None:
    _, where = normals
    assert light.emitted[0, 0] == pytest.approx(1.0, abs=0.02)
    assert not light.specular[0, 0].any()
    assert not light.diffuse[:, 0, 0].any()
    assert not light.emitted[where.numpy()].any()


def test_pixel_truth_agrees_with_the_geometry(
    ball: BuiltScene, camera: Camera, normals: tuple[Tensor, Tensor]
) -> None:
    ground_truth = ground_truth_maps(ball, camera)
    normal, where = normals
    found = camera.to_camera(torch.from_numpy(ground_truth["normal"].astype(np.float64)))
    assert ((torch.nn.functional.normalize(found, dim=-1) * normal).sum(-1)[where] > 0.99999).all()
    assert (torch.from_numpy(ground_truth["mask"])[where]).all()
    eye = camera.center.numpy()
    places = (
        eye
        + ground_truth["depth"].astype(np.float64)[..., None]
        * (camera.world_rays(dtype=torch.float64) / camera.rays(dtype=torch.float64)[..., 2:]).numpy()
    )
    size = np.linalg.norm(places[where.numpy()], axis=-1)
    np.testing.assert_allclose(size, 1, atol=4e-3)  # half precision


def test_lobes_add_up_to_mitsubas_own_path_tracer(
    ball: BuiltScene, camera: Camera, light: LobeRadiance, variant: Variant
) -> None:
    """The same scene by ``stokes`` over ``path``; its frame differs off the axis, S0 and DoLP do not."""
    import mitsuba as mi

    axes = np.eye(4)
    rows = camera.rotation.numpy()
    axes[:3] = np.stack((-rows[0], -rows[1], rows[2], camera.center.numpy()), -1)
    sensor = mi.load_dict({
        "type": "perspective", "fov_axis": "x", "fov": math.degrees(2 * math.atan(camera.width / 2 / camera.fx)),
        "to_world": mi.ScalarTransform4f(axes), "near_clip": 1e-3,
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
    })  # fmt: skip
    inner = {"type": "path", "max_depth": 4}
    integrator = mi.load_dict({"type": "stokes", "inner": inner})
    theirs = np.array(mi.render(ball.scenes[0], sensor=sensor, integrator=integrator, spp=64), np.float64)
    names = integrator.aov_names()
    found = [
        theirs[..., theirs.shape[-1] - len(names) + names.index(f"S{k}.{c}")] for k in range(3) for c in "RGB"
    ]
    other = np.stack(found).reshape(3, 3, camera.height, camera.width).transpose(0, 2, 3, 1)
    mine = render_lobes(ball.scenes, camera, 64, seed=5, limits=PathLimits(depth=3)).stokes
    channel = slice(0, 1) if variant.channels == 3 else slice(0, 3)
    inside = np.s_[5:11, 6:14]
    for image in (other, mine):
        assert image[0][inside].min() > 0
    a, b = (
        optics.luminance(torch.from_numpy(image[(slice(None), *inside)][..., channel]))
        for image in (other, mine)
    )
    assert float(a[0].mean()) == pytest.approx(float(b[0].mean()), rel=0.02)
    # Sampled wavelengths make noise of their own.
    assert (optics.dolp(a) - optics.dolp(b)).abs().mean() < (5e-3 if variant.channels == 3 else 2e-2)
