"""The memory of a training: shared out before a picture is decoded, refused with the least that suffices."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from faults import Fault
from torch import Tensor

from polarguide.capture import Scene
from polarguide.core.options import Exposures, SceneOptions, gibibytes
from polarguide.methods import RECIPES
from polarguide.runs import memory_plan
from polarguide.runs import train as training
from polarguide.runs.folder import MOST_GAUSSIANS, resolve
from polarguide.runs.memory_plan import GIBIBYTE, MemoryPlan, plan_memory
from polarguide.training.settings import STEPS, ResolvedSettings, TrainSettings

STOKES = RECIPES["polarguide-stokes"]
LARGE = [1224 * 1024] * 60
SMALL = [256 * 192] * 60


def least(pixels: list[int], gaussians: int) -> float:
    """GiB, from the error."""
    error = Fault(found="0.0 GB").raised_by(plan_memory, pixels, STOKES, gaussians, limit=0.01)
    size = gibibytes(re.search(r"--memory ([\d.]+GB)", error.remedy)[1])
    return size


def test_the_least_that_is_named_suffices_and_less_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_plan, "resident_memory", lambda: 400_000_000)
    for pixels, gaussians in ((SMALL, 100_000), (LARGE, 50_000), (LARGE, MOST_GAUSSIANS)):
        size = least(pixels, gaussians)
        plan = plan_memory(pixels, STOKES, gaussians, limit=size)
        assert plan.peak <= size * GIBIBYTE
        Fault("memory").raised_by(plan_memory, pixels, STOKES, gaussians, limit=size - 0.2)


def test_pictures_leave_memory_before_targets_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_plan, "resident_memory", lambda: 400_000_000)
    plans = [plan_memory(LARGE, STOKES, MOST_GAUSSIANS, limit=limit) for limit in (3.7, 5.0, 8.0, 30.0)]
    assert not plans[0].hold
    assert plans[-1] == MemoryPlan(True, None, plans[-1].peak)
    kept = [plan.view_bytes for plan in plans[:-1]]
    assert None not in kept
    assert kept == sorted(kept, key=lambda count: count or 0)
    assert plan_memory(SMALL, STOKES, 154_000, limit=4.0).view_bytes is None


def test_without_a_limit_what_is_free_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_plan, "resident_memory", lambda: 400_000_000)
    monkeypatch.setattr(memory_plan, "free_memory", lambda: 10**9)
    assert not plan_memory(LARGE, STOKES, MOST_GAUSSIANS, limit=None).hold
    monkeypatch.setattr(memory_plan, "free_memory", lambda: 10**12)
    assert plan_memory(LARGE, STOKES, MOST_GAUSSIANS, limit=None).view_bytes is None


@pytest.mark.parametrize(
    ("text", "bytes_"),
    [
        ("4GB", 4e9),
        ("600 mb", 6e8),
        ("3.5GiB", 3.5 * 2**30),
        ("2g", 2e9),
        ("1T", 1e12),
        ("4", 4 * 2**30),
    ],
)
def test_sizes(text: str, bytes_: float) -> None:
    assert gibibytes(text) == pytest.approx(bytes_ / 2**30)


def test_a_unit_alone_is_no_size() -> None:
    with pytest.raises(ValueError, match="GB"):
        gibibytes("GB")


def test_what_is_not_specified_follows_from_the_size_or_is_that_of_the_run_to_resume(
    tiny_scene: Scene,
) -> None:
    asked = TrainSettings()
    found = resolve(asked, tiny_scene, STOKES)
    pixels = sum(view.camera.width * view.camera.height for view in tiny_scene.train_views)
    assert (found.steps, found.gaussians) == (STEPS, int(pixels / STOKES.densification.pixels_each))
    assert found.background == "scene"
    given = TrainSettings(7, 1, 1.7, "black", gaussians=9)
    assert vars(resolve(given, tiny_scene, STOKES, found)) == {**vars(given), "views_per_step": 1}
    older = ResolvedSettings(steps=700, refractive_index=1.4, gaussians=50, background="masked")
    assert resolve(asked, tiny_scene, STOKES, older) == older


def test_the_refractive_index_is_the_one_asked_for_or_the_scenes(tiny_scene: Scene) -> None:
    water, unknown = (replace(tiny_scene, refractive_index=index) for index in (1.33, None))
    assert resolve(TrainSettings(), water, STOKES).refractive_index == 1.33
    assert resolve(TrainSettings(), unknown, STOKES).refractive_index == 1.5
    assert resolve(TrainSettings(refractive_index=1.6), water, STOKES).refractive_index == 1.6


@pytest.mark.parametrize("name", ["steps", "refractive_index", "gaussians"])
def test_zero_is_no_setting(name: str) -> None:
    Fault(name, "", "0").raised_by(TrainSettings, **{name: 0})


def test_options_take_a_limit() -> None:
    assert SceneOptions(memory=2.5).memory == 2.5
    assert SceneOptions().memory is None
    Fault("memory", "", "0").raised_by(SceneOptions, memory=0.0)


@pytest.mark.parametrize("exposures", ["three", "one"])
def test_other_exposures_leave_the_pictures_in_their_files(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exposures: Exposures
) -> None:
    means = []
    settings = TrainSettings(12, exposures=exposures)
    for hold in (True, False):
        plan = MemoryPlan(hold, None, 4 << 30)
        monkeypatch.setattr(training, "_planned", lambda *_, plan=plan: plan)
        run = training.train_gaussians(
            demo_scene, tmp_path / f"run {hold}", settings=settings, reading=SceneOptions(downscale=8)
        )
        held = [isinstance(view.pictures, Tensor) for view in run.scene.train_views]
        assert held == [hold] * len(held)
        means.append(run.gaussians["means"])
    assert torch.equal(*means)
