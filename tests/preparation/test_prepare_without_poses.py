"""One view, or views that structure from motion does not connect: what can be done, and nothing left half-made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from polarguide.errors import PolarguideError
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

SETTINGS = PrepareSettings(sensor="IMX250MZR", bits=12)


def noise_mosaics(folder: Path, count: int) -> Path:
    """Mosaics of noise, in which there is nothing to match."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(count):
        values = rng.integers(1000, 1400, (128, 128)).astype(np.uint16)
        cv2.imwrite(str(folder / f"{k}.png"), values)
    return folder


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_views(tmp_path: Path, count: int) -> None:
    source = noise_mosaics(tmp_path / "in", count)
    with pytest.raises(PolarguideError, match=f"at least 3 views .* found {count}") as caught:
        prepare_scene(source, tmp_path / "out", SETTINGS)
    assert f"polarguide priors {source} --out in-priors --sensor IMX250MZR --bits 12" in str(caught.value)
    assert not (tmp_path / "out").exists()
    alone = prepare_scene(
        source, tmp_path / "out", PrepareSettings(sensor="IMX250MZR", bits=12, poses="none")
    )
    assert len(alone.views) == count


@pytest.mark.parametrize("there", [False, True])
def test_views_that_do_not_register(tmp_path: Path, there: bool) -> None:
    source, out = noise_mosaics(tmp_path / "in", 3), tmp_path / "out"
    if there:
        out.mkdir()
    with pytest.raises(PolarguideError, match="0 of 3 views registered") as caught:
        prepare_scene(source, out, SETTINGS)
    assert f"polarguide priors {source}" in str(caught.value)
    # What is recommended changes something: all pairs are compared by default.
    assert "--matching exhaustive" not in str(caught.value)
    assert "--sfm-pictures minimum" in str(caught.value)
    tried = replace(SETTINGS, matching="sequential", sfm_pictures="minimum")
    with pytest.raises(PolarguideError, match="--matching exhaustive") as caught:
        prepare_scene(source, out, tried)
    assert "--sfm-pictures" not in str(caught.value)
    assert out.exists() == there
    assert not there or not list(out.iterdir())


def test_a_scene_without_poses_is_as_it_was(tmp_path: Path) -> None:
    source, out = noise_mosaics(tmp_path / "in", 3), tmp_path / "out"
    prepare_scene(source, out, PrepareSettings(sensor="IMX250MZR", bits=12, poses="none"))
    before = {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(PolarguideError, match="0 of 3 views registered"):
        prepare_scene(source, out, SETTINGS)
    after = {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert after == before


def test_shots_of_a_filter_are_advised_without_a_sensor(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    picture = np.random.default_rng(1).integers(20_000, 30_000, (32, 32, 3)).astype(np.uint16)
    for angle in (0, 45, 90, 135):
        cv2.imwrite(str(tmp_path / "in" / f"cup_{angle}.png"), picture)
    with pytest.raises(PolarguideError, match=r"found 1 \(cup\)") as caught:
        prepare_scene(tmp_path / "in", tmp_path / "out")
    assert f"polarguide priors {tmp_path / 'in'} --out in-priors." in str(caught.value)
