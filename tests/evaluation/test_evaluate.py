"""A whole run scored: what is said first, and what is written."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from heard import Heard

from polarguide.api import Run, open_run
from polarguide.errors import PolarguideError
from polarguide.evaluation import evaluate


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
