"""Scoring a run: its record, its speed, and views behind one polarizer."""

import dataclasses
import json
import math
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from faults import Fault
from heard import Heard
from tiny import make_scene

from polarguide.api.runs import Run, open_run
from polarguide.capture import View
from polarguide.capture.exposures import FOUR, Exposure
from polarguide.results.evaluation import evaluate
from polarguide.results.evaluation.evaluate import (
    COMMIT,
    NOT_SCORING,
    NOT_TRAINING,
    code_digest,
    commit,
    cross_fitted,
    frames_per_second,
)


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
    assert "masks of 3, normals of 3 of 4 test views" in said
    assert "3 of 4 test views have a mask (not v022)" in said
    assert "scene.json (objects) does not list 3" in said.replace("\\", "/")
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
        "haze_true",
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
        ([500.0, 500.0], (None, "the process used more memory before scoring")),
        ([None, None], (None, "the operating system does not report it")),
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
    Fault("scene.json (objects[0])", "the field name").raised_by(opened, folder, scene, Heard())


def test_a_run_without_test_views_is_not_scored(changed: tuple[Path, Path]) -> None:
    folder, scene = changed
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**about, "test_views": []}))
    (folder / "metrics.json").unlink(missing_ok=True)
    Fault(expected="test view", found="none").raised_by(opened(folder, scene, Heard()).evaluate)
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
    others = dataclasses.replace(view, pictures=changed)
    ours, theirs = (cross_fitted(which, FINAL, STOKES) for which in (view, others))
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


ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("name", "text", "changes"),
    [
        ("optics/a.py", "second = 2", (True, True)),
        ("optics/a.py", '"""Other words."""\nfirst = 1  # and a comment', (False, False)),
        ("results/a.py", "second = 2", (True, False)),
        ("viewer/a.py", "second = 2", (False, False)),
        ("../polarguide_bench/polgs.py", "second = 2", (True, True)),
        ("../polarguide_bench/worker.py", "second = 2", (True, False)),
        ("../polarguide_bench/tables.py", "second = 2", (False, False)),
        ("_native.so", "second", (True, True)),
        ("new.py", "", (True, True)),
        ("_native.pyi", "second", (False, False)),
        ("data/picture.png", "second", (False, False)),
    ],
)
def test_code_counts_and_scoring_repeats_no_training(
    tmp_path: Path, name: str, text: str, changes: tuple[bool, bool]
) -> None:
    (tmp_path / "polarguide_bench").mkdir()
    files = ("optics/a.py", "results/a.py", "viewer/a.py", "_native.so", "_native.pyi", "data/picture.png")
    for file in files:
        (tmp_path / "polarguide" / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "polarguide" / file).write_text("first = 1")

    def digests() -> list[str]:
        code_digest.cache_clear()
        return [code_digest(tmp_path / "polarguide", training=training) for training in (False, True)]

    before = digests()
    (tmp_path / "polarguide" / name).write_text(text)
    assert tuple(now != then for now, then in zip(digests(), before, strict=True)) == changes
    assert {len(digest) for digest in before} == {16}


@pytest.mark.parametrize(
    ("module", "names"),
    [("polarguide.runs.train", NOT_TRAINING), ("polarguide.results.evaluation.evaluate", NOT_SCORING)],
)
def test_training_and_scoring_import_no_code_outside_of_their_digest(
    module: str, names: tuple[str, ...]
) -> None:
    left_out = {f"polarguide.{name.removesuffix('.py')}" for name in names}
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "polarguide.training.loop" in loaded.split()
    assert not {".".join(name.split(".")[:2]) for name in loaded.split()} & left_out


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=n", "-c", "user.email=e@example.org")
    return subprocess.run(
        ["git", *who, "-C", str(folder), *words], capture_output=True, text=True, check=True
    ).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> tuple[Path, str]:
    """A repository with one commit: its folder and the hash."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    top = tmp_path / "checkout"
    top.mkdir()
    git(top, "init", "-q")
    git(top, "commit", "-q", "--allow-empty", "-m", "first")
    return top, git(top, "rev-parse", "HEAD")


def test_a_checkout_reports_its_commit_and_nobody_elses(repository: tuple[Path, str]) -> None:
    top, head = repository
    own, installed = top / "src" / "polarguide", top / ".venv" / "site-packages" / "polarguide"
    own.mkdir(parents=True)
    installed.mkdir(parents=True)
    assert commit(own) == head
    assert commit(installed) is None
    (installed / COMMIT).write_text("0123abc\n")
    assert commit(installed) == "0123abc"
    (own / COMMIT).write_text("\n")
    assert commit(own) is None
    shutil.rmtree(top / ".git")
    (own / COMMIT).unlink()
    assert commit(own) is None


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is not on the path")
@pytest.mark.parametrize("place", ["", "their/vendored"])
def test_the_build_stamps_its_commit_and_nobody_elses(
    repository: tuple[Path, str], tmp_path: Path, place: str
) -> None:
    top, head = repository
    shutil.copytree(ROOT / "native", top / place / "native")
    shutil.copy(ROOT / "CMakeLists.txt", top / place)
    build = tmp_path / "build"
    command = ["cmake", "-S", str(top / place), "-B", str(build), "-DPOLARGUIDE_BINDINGS=OFF"]
    subprocess.run(command, capture_output=True, text=True, check=True)
    assert (build / COMMIT).read_text() == ("\n" if place else f"{head}\n")
