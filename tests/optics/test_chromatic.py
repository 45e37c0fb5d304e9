"""Normals from color differences on computed light, and on the demo and real captures against their ground truth."""

import json
import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import load_scene
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot

SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"
needs_scenes = pytest.mark.skipif(
    not SCENES.is_dir(), reason="no captures in ../shared -> ln -s FOLDER ../shared"
)
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
    assert not optics.chromatic_normals(light[..., :1]).decided.any()


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
@needs_scenes
@pytest.mark.parametrize("name", ["spheres", "cup"])
def test_shared_scenes_agree_with_their_true_normals(name: str) -> None:
    share, azimuth, zenith = angles_against_truth(SCENES / name, 1)
    assert share > 0.15
    assert azimuth < 4
    assert zenith < 8


class Expected(NamedTuple):
    """Degrees: azimuth error modulo 90, best of six; specular PSNR: exact, by the paper, of no layer."""

    index: float
    azimuth_mean: float
    azimuth_median: float
    best_of_six: float
    exact: float
    paper: float
    nothing: float


EXPECTED = {
    "spheres": Expected(1.5, 2.2, 0.7, 16, 36.6, 22.5, 15.9),
    "cup": Expected(1.5, 4.9, 2.3, 15, 35.2, 26.5, 19.7),
    "car": Expected(1.5, 3.1, 0.3, 17, 27.4, 19.2, 13.1),
    "water": Expected(1.33, 1.8, 0.2, 9, 34.4, 27.8, 14.1),
}


class View(NamedTuple):
    stokes: Tensor
    rays: Tensor
    normals: Tensor
    mask: Tensor
    specular: Tensor
    diffuse: Tensor


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def camera(scene: Path, view: str) -> Camera:
    _, _, width, height, *intrinsics = rows(scene / "sparse/0/cameras.txt")[0]
    image = next(row for row in rows(scene / "sparse/0/images.txt")[::2] if row[9].startswith(view))
    w, *vector = (float(value) for value in image[1:5])
    v = torch.tensor(vector, dtype=torch.float64)
    cross = torch.linalg.cross(v.expand(3, 3), torch.eye(3, dtype=torch.float64), dim=-1).T
    rotation = torch.eye(3, dtype=torch.float64) + 2 * w * cross + 2 * cross @ cross
    translation = torch.tensor([float(value) for value in image[5:8]], dtype=torch.float64)
    return Camera(int(width), int(height), *map(float, intrinsics), rotation, translation)


def load(scene: Path, name: str) -> View:
    view = camera(scene, name)
    images = [cv2.imread(str(scene / f"polar/{name}_{angle:03d}.png"), -1) for angle in optics.ANGLES]
    intensities = torch.from_numpy(np.stack(images)[..., ::-1] / 65535.0)
    with np.load(scene / f"gt/{name}.npz") as ground_truth:
        normal, specular, diffuse = (
            torch.from_numpy(ground_truth[key].astype(np.float64))
            for key in ("normal", "specular", "diffuse")
        )
        mask = torch.from_numpy(ground_truth["mask"])
    normal = torch.nn.functional.normalize(view.to_camera(normal), dim=-1)
    return View(optics.stokes(intensities), view.rays(dtype=torch.float64), normal, mask, specular, diffuse)


@pytest.fixture(scope="module", params=EXPECTED)
def case(request: pytest.FixtureRequest) -> tuple[Expected, list[View]]:
    scene = SCENES / request.param
    views = json.loads((scene / "split.json").read_text())["test"]
    return EXPECTED[request.param], [load(scene, name) for name in views]


def shown(linear: Tensor) -> Tensor:
    linear = linear.clamp(0, 1)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def psnr(layer: Tensor, ground_truth: Tensor, mask: Tensor) -> float:
    return -10 * math.log10(float(((shown(layer / 2) - shown(ground_truth / 2))[mask] ** 2).mean()))


def polarized(view: View) -> tuple[Tensor, Tensor]:
    luminance = optics.luminance(view.stokes)
    return luminance, view.mask & optics.polarization_mask(luminance)


@pytest.mark.shared
@needs_scenes
def test_azimuth_agrees_modulo_a_quarter_turn(case: tuple[Expected, list[View]]) -> None:
    expected, views = case
    means, medians = [], []
    for view in views:
        luminance, pixels = polarized(view)
        difference = (optics.aolp(luminance) - optics.azimuth(view.normals, view.rays))[pixels]
        error = torch.rad2deg(torch.remainder(difference + math.pi / 4, math.pi / 2) - math.pi / 4).abs()
        means.append(float(error.mean()))
        medians.append(float(error.median()))
    assert np.mean(means) == pytest.approx(expected.azimuth_mean, abs=0.1)
    assert np.mean(medians) == pytest.approx(expected.azimuth_median, abs=0.1)


@pytest.mark.shared
@needs_scenes
def test_layers_and_normals_predict_the_measured_polarization(case: tuple[Expected, list[View]]) -> None:
    expected, views = case
    angle_errors, degree_errors = [], []
    for view in views:
        model = optics.predicted_stokes(view.specular, view.diffuse, view.normals, view.rays, expected.index)
        luminance, pixels = polarized(view)
        predicted = optics.luminance(model)
        angle = (optics.aolp(luminance) - optics.aolp(predicted))[pixels]
        error = torch.rad2deg(torch.remainder(angle + math.pi / 2, math.pi) - math.pi / 2).abs()
        angle_errors.append(float(error.median()))
        degree = (optics.dolp(luminance) - optics.dolp(predicted))[view.mask].abs()
        degree_errors.append(float(degree.median()))
    # Modulo half a turn now, and no worse: the layers say which of the two directions dominates.
    assert np.mean(angle_errors) == pytest.approx(expected.azimuth_median, abs=0.1)
    assert np.mean(degree_errors) < 0.015


@pytest.mark.shared
@needs_scenes
def test_best_of_six_normals(case: tuple[Expected, list[View]]) -> None:
    expected, views = case
    six, four = [], []
    for view in views:
        luminance, pixels = polarized(view)
        for errors, candidates in (
            (six, optics.physical_candidates(luminance, view.rays, expected.index)),
            (four, optics.paper_candidates(luminance, view.rays, expected.index)),
        ):
            cosine = optics.disambiguate(candidates, view.normals).cosine[pixels]
            errors.append(float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).mean()))
    assert np.mean(six) == pytest.approx(expected.best_of_six, abs=0.6)
    assert np.mean(four) > np.mean(six) + 15


@pytest.mark.shared
@needs_scenes
def test_separation_with_true_normals(case: tuple[Expected, list[View]]) -> None:
    expected, views = case
    exact, paper, nothing = [], [], []
    for view in views:
        found = optics.exact_separation(view.stokes, view.normals, view.rays, expected.index)
        exact.append(psnr(found.specular, view.specular, view.mask & found.conditioned))
        polar = optics.diffuse_zenith(optics.dolp(optics.luminance(view.stokes)), expected.index)
        cue = optics.paper_separation(view.stokes, polar, expected.index)
        paper.append(psnr(cue.specular, view.specular, view.mask))
        nothing.append(psnr(torch.zeros_like(view.specular), view.specular, view.mask))
    assert np.mean(exact) == pytest.approx(expected.exact, abs=0.1)
    assert np.mean(paper) == pytest.approx(expected.paper, abs=0.1)
    assert np.mean(nothing) == pytest.approx(expected.nothing, abs=0.15)
