"""The larger captures and mosaics beside the checkout, and the demo that ships with the package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from camera_files import read_invalid, read_polar

import polarguide
from polarguide.capture import load_scene
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
DEMO = Path(polarguide.__file__).parent / "data" / "demo"


def shared(name: str) -> Path:
    path = SHARED / name
    if not path.is_dir():
        pytest.skip("no captures in ../shared -> ln -s FOLDER ../shared")
    return path


@pytest.mark.parametrize("place", ["package", pytest.param("shared", marks=pytest.mark.shared)])
def test_demo(place: str) -> None:
    scene = load_scene(DEMO if place == "package" else shared("scenes/demo"))
    assert len(scene.views) == (50 if place == "package" else 27)
    assert (scene.test_names, scene.refractive_index) == (("v000", "v022", "v044", "v066"), 1.5)
    assert (scene.warnings, scene.points.shape) == ((), (4846, 3))
    for view in scene.test_views:
        ground_truth = view.ground_truth
        lengths = ground_truth.normal[ground_truth.mask].norm(dim=-1)
        torch.testing.assert_close(lengths, torch.ones_like(lengths))
        # On surfaces the two lobes add up to S0, which is twice the photograph.
        light = (ground_truth.specular + ground_truth.diffuse)[ground_truth.mask] / 2
        assert (view.photograph()[ground_truth.mask] - light).abs().median() < 5e-3


@pytest.mark.shared
@pytest.mark.parametrize(("name", "share"), [("spheres", 1e-3), ("water", 0.05)])
def test_saturation_of_the_rendered_scenes(name: str, share: float) -> None:
    scene = load_scene(shared(f"scenes/{name}"))
    assert scene.warnings == ()
    worst = max(float(view.saturated.float().mean()) for view in scene.views)
    assert 0.5 * share < worst < share


@pytest.mark.shared
def test_real_capture() -> None:
    scene = load_scene(shared("real/wwbottle"), downscale=4, split="every-8th")
    assert (len(scene.views), scene.warnings) == (60, ())
    assert scene.refractive_index is None
    assert scene.test_names[:3] == ("000", "008", "016")
    assert scene.views[0].codes.shape == (4, 128, 153, 3)
    assert scene.views[0].camera.fx == pytest.approx(1869.689706 / 4)
    residuals = []
    for view in scene.views[::10]:
        i0, i45, i90, i135 = view.intensities()
        residuals.append(((i0 + i90 - i45 - i135).abs() / (i0 + i45 + i90 + i135) * 2).median())
    assert 0.01 < float(torch.stack(residuals).median()) < 0.03


FOLDER = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "mosaic_mono"
SETTINGS = PrepareSettings(sensor="IMX250MZR", poses="none")

needs_mosaics = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="no captures in ../shared -> ln -s FOLDER ../shared"
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each mosaic prepared by itself, without and with gains."""
    root = tmp_path_factory.mktemp("mosaics")
    for path in FOLDER.glob("*.png"):
        name = path.stem.split("_")[0]
        (root / name).mkdir()
        (root / name / "v.png").symlink_to(path)
        prepare_scene(root / name, root / f"{name}-plain", replace(SETTINGS, gains="none"))
        prepare_scene(root / name, root / f"{name}-auto", SETTINGS)
    return root


def stokes(scene: Path) -> np.ndarray:
    """S0, S1, S2 of the one view, NaN where it is invalid."""
    i0, i45, i90, i135 = read_polar(scene, "v")[..., 0]
    found = np.stack([(i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135])
    return np.where(read_invalid(scene, "v"), np.nan, found)


@pytest.mark.shared
@needs_mosaics
@pytest.mark.parametrize("name", ["carps", "fruits"])
def test_pair_sums_agree(scenes: Path, name: str) -> None:
    deviations = []
    for kind in ("plain", "auto"):
        i0, i45, i90, i135 = read_polar(scenes / f"{name}-{kind}", "v")[..., 0]
        good = ~read_invalid(scenes / f"{name}-{kind}", "v") & (i0 + i90 > 0.04)
        deviations.append(float(np.median(np.abs(((i0 + i90)[good] / (i45 + i135)[good]) - 1))))
    assert 0.001 < deviations[0] < 0.04
    assert deviations[1] <= deviations[0]


@pytest.mark.shared
@needs_mosaics
def test_the_water_surface_of_carps(scenes: Path) -> None:
    s0, s1, s2 = stokes(scenes / "carps-auto")
    dolp = np.hypot(s1, s2) / s0
    assert 0.75 < np.nanpercentile(dolp, 99.5) < 1.0
    # Specular water: strongly polarized; its AoLP runs from about +10 degrees at the left to -23 at the right.
    angles = []
    width = s0.shape[1]
    for part in (slice(0, width // 6), slice(width - width // 6, width)):
        strong = dolp[:, part] > 0.4
        angles.append(np.degrees(np.arctan2(s2[:, part][strong].sum(), s1[:, part][strong].sum()) / 2))
    assert (angles[0], angles[1]) == (pytest.approx(10, abs=6), pytest.approx(-23, abs=6))
