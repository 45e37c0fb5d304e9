"""Scoring a run: its record, its speed, and views behind one polarizer."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from heard import Heard

from polarguide.api import Run, open_run
from polarguide.capture import View
from polarguide.capture.exposures import FOUR, Exposure
from polarguide.core.errors import PolarguideError
from polarguide.results.evaluation import evaluate
from polarguide.results.evaluation.evaluate import cross_fitted, frames_per_second
from tests.helpers.tiny import make_scene


@pytest.fixture
def changed(trained: Path, demo_scene: Path, tmp_path: Path) -> tuple[Path, Path]:
    """Copies of a run folder and of its scene, which a test may change."""
    return Path(shutil.copytree(trained, tmp_path / "run")), Path(
        shutil.copytree(demo_scene, tmp_path / "demo")
    )


def opened(folder: Path, scene: Path, heard: Heard) -> Run:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the scene has changed
        run = open_run(folder, scene=scene, reporter=heard)
        assert run.scene.name == "demo"
    return run


def rewrite(path: Path, **arrays: np.ndarray | None) -> None:
    with np.load(path) as stored:
        found = {name: stored[name] for name in stored.files} | arrays
    np.savez_compressed(path, **{name: array for name, array in found.items() if array is not None})


def test_what_scores_do_not_mean_is_said(changed: tuple[Path, Path]) -> None:
    folder, scene = changed
    about = json.loads((scene / "scene.json").read_text())
    about["objects"] = [item for item in about["objects"] if item["name"] != "sphere_red"]
    (scene / "scene.json").write_text(json.dumps(about))
    rewrite(scene / "gt" / "v022.npz", normal=None, mask=None)
    heard = Heard()
    record = opened(folder, scene, heard).evaluate(reporter=heard)
    said = "\n".join(heard.said)
    assert "The ground truth gives masks of 3, normals of 3 of 4 test views" in said
    assert "Only 3 of 4 test views have a mask (not v022): stokes_error is over whole pictures." in said
    assert "scene.json (objects) does not list 3, which gt/v000.npz shows" in said.replace("\\", "/")
    assert "sphere_red" not in record["objects"]
    assert record["views"]["v022"]["normal_mae_deg"] is None
    assert record["views"]["v022"]["stokes_error"] is not None


def test_a_scene_without_ground_truth_has_its_stokes_error(changed: tuple[Path, Path]) -> None:
    folder, scene = changed
    shutil.rmtree(scene / "gt")
    heard = Heard()
    record = opened(folder, scene, heard).evaluate(reporter=heard)
    assert heard.said == []
    assert record["stokes_error"] > 0
    assert (record["objects"], record["materials"]) == ({}, {})
    for key in (
        "depth_error_median_percent",
        "haze",
        "depth_beyond",
        "mesh_fscore_1",
        "alpha_outside",
        "specular_psnr_dielectric",
    ):
        assert record[key] is None, key
    assert (folder / "errors.png").exists()


@pytest.mark.parametrize(
    ("peaks", "expected"),
    [
        ([500.0, 700.0], (700.0, None)),
        ([500.0, 500.0], (None, "the process had held more memory before it scored")),
        ([None, None], (None, "the system does not tell")),
    ],
)
def test_peak_memory_is_that_of_scoring(
    trained: Path,
    tmp_path: Path,
    peaks: list[float | None],
    expected: tuple[float | None, str | None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evaluate, "peak_memory_mib", iter(peaks).__next__)
    run = open_run(shutil.copytree(trained, tmp_path / "run"))
    record = run.evaluate()
    assert (record["peak_memory_mib"], record["peak_memory_mib_reason"]) == expected
    assert run.metrics()["peak_memory_mib_reason"] == expected[1]


def test_a_table_of_objects_that_is_wrong(changed: tuple[Path, Path]) -> None:
    folder, scene = changed
    (scene / "scene.json").write_text(json.dumps({"objects": [{"id": 1}]}))
    with pytest.raises(PolarguideError, match=r"scene\.json \(objects\[0\]\): expected the field name"):
        opened(folder, scene, Heard())


def test_a_run_without_test_views_is_not_scored(changed: tuple[Path, Path]) -> None:
    folder, scene = changed
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**about, "test_views": []}))
    (folder / "metrics.json").unlink(missing_ok=True)
    run = opened(folder, scene, Heard())
    with pytest.raises(
        PolarguideError, match=r"expected test views to score the run on, found none: .* split\.json"
    ):
        run.evaluate()
    assert not (folder / "metrics.json").exists()


VIEWS: Any = ["a", "b", "c", "d"]


class Clock:
    """Time that passes only while a view is drawn, half a second for each but the slower first one."""

    def __init__(self) -> None:
        self.now, self.drawn = 0.0, list[Any]()

    def draw(self, view: Any) -> None:
        self.drawn.append(view)
        self.now += 0.75 if view == "a" else 0.5

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(evaluate, "time", found)
    monkeypatch.setattr(evaluate.Stopwatch, "read", lambda self: (found.now, True))
    return found


@pytest.mark.parametrize(
    ("least", "most", "drawn", "speed"),
    [
        (0.0, 40.0, VIEWS * 4, 2.0),  # a warm-up, and three times each
        (10.0, 40.0, VIEWS * 6, 2.0),  # until it has taken long enough
        (0.0, 2.9, ["a", *VIEWS[:3]], 2.0),  # those that fit, once
        (0.0, 0.1, ["a", "a"], 1 / 0.75),
    ],
)
def test_slow_pictures_are_drawn_less_often(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, least: float, most: float, drawn: list[str], speed: float
) -> None:
    monkeypatch.setattr(evaluate, "MINIMUM_SECONDS", least)
    monkeypatch.setattr(evaluate, "MOST_SECONDS", most)
    assert frames_per_second(clock.draw, VIEWS) == pytest.approx(speed)
    assert clock.drawn == drawn


def test_beside_other_work_there_is_no_speed(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate.Stopwatch, "read", lambda self: (clock.now, False))
    assert frames_per_second(clock.draw, VIEWS) is None


WHOLE = make_scene().views[0]
STOKES = WHOLE.stokes()
FINAL = STOKES[0] / 2


def single(place: int, gain: float = 1.0) -> View:
    codes = (WHOLE.codes[place : place + 1].to(torch.float32) * gain).round().to(torch.int32).to(torch.uint16)
    return dataclasses.replace(WHOLE, pictures=codes, exposures=(Exposure(),))


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_a_model_that_is_right_predicts_any_picture(place: int, gain: float) -> None:
    view = single(place, gain)
    assert torch.allclose(cross_fitted(view, FINAL, STOKES), view.photograph(), atol=2e-3)


def test_no_pixel_takes_part_in_its_own_fit() -> None:
    """Whatever the left half shows, its prediction stays the same."""
    view = single(1)
    changed = view.codes.clone()
    middle = changed.shape[2] // 2
    changed[:, :, :middle] = (changed[:, :, :middle].to(torch.int32) // 2).to(torch.uint16)
    ours = cross_fitted(view, FINAL, STOKES)
    theirs = cross_fitted(dataclasses.replace(view, pictures=changed), FINAL, STOKES)
    assert torch.equal(ours[:, :middle], theirs[:, :middle])
    assert not torch.allclose(ours[:, middle:], theirs[:, middle:], atol=1e-2)


def test_without_a_prediction_the_gain_alone_is_fitted() -> None:
    found = cross_fitted(single(0), FINAL, None)
    ratio = found / FINAL
    middle = found.shape[1] // 2
    for half in (ratio[:, :middle], ratio[:, middle:]):
        assert math.isclose(float(half.min()), float(half.max()), rel_tol=1e-4)


def test_s0_needs_no_such_thing() -> None:
    assert WHOLE.exposures == FOUR
    assert WHOLE.measures_radiance
    assert not single(0).measures_radiance
