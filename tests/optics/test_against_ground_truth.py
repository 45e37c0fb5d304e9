"""The optics on rendered scenes with known normals and layers.

The scenes come from an independent polarized light transport program, and what is expected of each was
computed by another implementation over the same test views: the tolerances only allow for its rounding and
for averaging in another order.
"""

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
from polarguide.geometry.camera import Camera

SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not SCENES.is_dir(), reason="no captures in ../shared -> ln -s FOLDER ../shared"),
]


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
