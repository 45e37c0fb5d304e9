"""Real mosaics of a monochrome sensor beside the checkout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import read_invalid, read_polar

from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

FOLDER = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "mosaic_mono"
SETTINGS = PrepareSettings(sensor="IMX250MZR", poses="none")

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not FOLDER.is_dir(), reason="no captures in ../shared -> ln -s FOLDER ../shared"),
]


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


@pytest.mark.parametrize("name", ["carps", "fruits"])
def test_pair_sums_agree(scenes: Path, name: str) -> None:
    deviations = []
    for kind in ("plain", "auto"):
        i0, i45, i90, i135 = read_polar(scenes / f"{name}-{kind}", "v")[..., 0]
        good = ~read_invalid(scenes / f"{name}-{kind}", "v") & (i0 + i90 > 0.04)
        ratio = (i0 + i90)[good] / (i45 + i135)[good]
        deviations.append(float(np.median(np.abs(ratio - 1))))
    assert 0.001 < deviations[0] < 0.04
    assert deviations[1] <= deviations[0]


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
    assert angles[0] == pytest.approx(10, abs=6)
    assert angles[1] == pytest.approx(-23, abs=6)
