"""Normals and layers of one shot: those that the priors of a scene with poses give."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault

import polarguide
from polarguide import optics
from polarguide.geometry.vectors import unit
from polarguide_shots.exposures import find_shots
from polarguide_shots.maps import Developed, NoiseModel, ShotMaps
from polarguide_shots.options import ShotOptions
from polarguide_shots.prior_pictures import resolving_normals
from polarguide_shots.read import TOWARD, camera_of, maps_of, parse_intrinsics, read_shot, surface_maps
from polarguide_shots.sets import ExposureSet

VIEW = "v000"


@pytest.fixture(scope="module")
def demo() -> Path:
    scene = polarguide.demo_scene()
    return scene


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles of unit vectors, without the loss of an arc cosine near 1."""
    return np.rad2deg(2 * np.arcsin(np.clip(np.linalg.norm(a.astype(float) - b, axis=-1) / 2, 0, 1)))


def test_normals_are_those_of_the_scenes_priors(demo: Path) -> None:
    """With the camera's rays, and the same error against the ground truth."""
    view = polarguide.load_scene(demo, views=[VIEW]).view(VIEW)
    rays = view.camera.rays()
    luminance = optics.luminance(optics.stokes(view.intensities()))
    guide, _ = resolving_normals(view, None, rays, luminance, 1.5)
    candidates = optics.physical_candidates(luminance, rays, 1.5)
    theirs = optics.disambiguate(candidates, guide, rays, azimuth_weight=0.5).normal.numpy()
    (shot,) = (s for s in find_shots([demo]) if s.view == VIEW)
    maps = read_shot(shot)
    ours = surface_maps(maps, camera_of(shot, maps.size, None)).normal
    assert view.ground_truth is not None
    true = view.ground_truth.normal
    assert true is not None
    camera_normals = view.camera.to_camera(true).numpy()
    where = maps.usable & (np.linalg.norm(camera_normals, axis=-1) > 0.5)
    assert where.sum() > 1000
    assert degrees_between(ours, theirs)[where].max() < 0.01
    errors = [float(degrees_between(n, camera_normals)[where].mean()) for n in (ours, theirs)]
    assert abs(errors[0] - errors[1]) < 1e-3


def test_the_chosen_candidate_is_the_nearest_to_facing_the_camera() -> None:
    rng = np.random.default_rng(2)
    maps = made(rng.uniform(0, 0.99, (40, 50)), rng.uniform(0, np.pi, (40, 50)))
    camera = parse_intrinsics("60,60,25,20", maps.size)
    rays = camera.rays()
    candidates = optics.physical_candidates(torch.from_numpy(maps.stokes), rays, 1.5)
    guess = unit(torch.tensor(TOWARD)).expand(40, 50, 3)
    nearest = optics.disambiguate(candidates, guess, rays).normal.numpy()
    found = surface_maps(maps, camera)
    assert degrees_between(found.normal, nearest)[maps.usable].max() < 1e-3
    above = maps.dolp > optics.diffuse_dolp_limit(1.5)
    assert above.any()
    assert np.isnan(found.zeniths[0][above]).all()
    assert np.isfinite(found.zeniths[1:]).all()


def made(degree: np.ndarray, angle: np.ndarray) -> ShotMaps:
    """Read the maps of a shot of given DoLP and AoLP from four arrays."""
    s = np.stack(
        (np.full_like(degree, 0.8), 0.8 * degree * np.cos(2 * angle), 0.8 * degree * np.sin(2 * angle))
    )
    four = np.stack([optics.intensity(s, math.radians(a)) for a in optics.ANGLES])[..., None]
    nothing = np.zeros(degree.shape, bool)
    developed = Developed(
        four.astype(np.float32), nothing, nothing, nothing, NoiseModel(1e-8, 0.0, "given"),
        np.ones((4, 1, 1), np.float32), 1.0, 1.0, (),
    )  # fmt: skip
    return maps_of(ExposureSet("made", "mosaic", {0: Path("made.png")}), developed, ShotOptions())


def test_layers() -> None:
    maps = made(np.full((8, 8), 0.2), np.full((8, 8), 0.3))
    found = surface_maps(maps)
    assert not found.perspective
    s0 = maps.intensities.sum(axis=0) / 2
    np.testing.assert_allclose(found.specular_exact + found.diffuse_exact, s0, rtol=1e-5)
    paper = optics.paper_separation(optics.stokes(maps.intensities), found.zeniths[0])
    np.testing.assert_allclose(found.specular_paper, paper.specular, rtol=1e-5)
    # A normal of one pure lobe leaves all light to this lobe.
    share = found.specular_exact / s0
    assert ((share < 1e-3) | (share > 1 - 1e-3)).all()


def test_pixels_without_an_angle_have_no_normal() -> None:
    degree = np.full((8, 8), 0.2)
    degree[:4] = 0.0
    maps = made(degree, np.full((8, 8), 0.3))
    assert not maps.usable[:4].any()
    normal = surface_maps(maps).normal
    assert not normal[:4].any()
    np.testing.assert_allclose(np.linalg.norm(normal[4:], axis=-1), 1, rtol=1e-5)


@pytest.mark.parametrize("text", ["", "1,2,3", "a,b,c,d", "-5,5,1,1", "nan,1,1,1"])
def test_wrong_intrinsics(text: str) -> None:
    Fault("--intrinsics", expected="fx,fy,cx,cy").raised_by(parse_intrinsics, text, (10, 10))


def test_wrong_index() -> None:
    Fault("refractive_index").raised_by(
        surface_maps, made(np.full((4, 4), 0.2), np.zeros((4, 4))), refractive_index=0.9
    )
