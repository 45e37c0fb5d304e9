"""``make gpu-check`` without a GPU: scenes survive packing, the table, and the script itself with tiny sizes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from polarguide.capture import load_scene

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks" / "gpu"
sys.path.append(str(FOLDER))

import check  # noqa: E402
import packed  # noqa: E402


@pytest.fixture(scope="module")
def pack(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    packed.save_scene(load_scene(demo_scene, downscale=2), folder / f"demo{packed.SUFFIX}")
    return folder


def test_a_packed_scene_is_the_scene(demo_scene: Path, pack: Path) -> None:
    scene, again = load_scene(demo_scene, downscale=2), packed.read_scene(pack / f"demo{packed.SUFFIX}")
    assert again.test_names == scene.test_names
    assert torch.equal(again.points, scene.points)
    assert torch.equal(again.point_colors, scene.point_colors)
    for a, b in zip(again.views, scene.views, strict=True):
        assert a.name == b.name
        for name in ("codes", "invalid", "saturated"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
        assert (a.camera.fx, a.camera.cx) == (b.camera.fx, b.camera.cx)
        assert torch.equal(a.camera.rotation, b.camera.rotation)
        assert torch.equal(a.camera.translation, b.camera.translation)


def test_enlarged_views_look_at_the_same(pack: Path) -> None:
    scene = packed.read_scene(pack / f"demo{packed.SUFFIX}")
    (large,) = packed.enlarged(scene, 128, 96, 1).views
    view = scene.train_views[0]
    assert large.codes.shape == (4, 96, 128, 3)
    assert float(large.photograph().mean()) == pytest.approx(float(view.photograph().mean()), rel=0.02)
    middle = large.camera.rays()[48, 64]
    assert torch.allclose(middle, view.camera.rays()[24:25, 32:33].mean(dim=(0, 1)), atol=0.02)


def test_the_table_says_what_is_not_known() -> None:
    results: dict[str, dict[str, object]] = {part: {} for part in check.PARTS}
    assert "not known yet" in check.table(results)
    sides = {"ours": {"step_ms": 12.3, "outside": 0.1}, "plain": None}
    bench = {"size": [8, 6], "gaussians": 1000, **sides}
    text = check.table({**results, "build": {"device": "Some GPU"}, "bench-demo": bench})
    assert "Some GPU" in text
    assert "| training step, ms | 12.3 | n/a |" in text
    assert check.machine({"build": {"device": "NVIDIA H200"}}) == "nvidia-h200"


@pytest.mark.slow
def test_a_dry_run_goes_through_in_two_calls(pack: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / "check.py"), "--pack", str(pack), "--out", str(tmp_path / "out")]
    command += ["--results", str(tmp_path / "results.json"), "--device", "cpu", "--tiny"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    printed = ""
    for minutes in ("0.1", "30"):
        done = subprocess.run(
            [*command, "--minutes", minutes], env=environment, capture_output=True, text=True, check=False
        )
        printed = done.stdout
        assert done.returncode == 0, done.stderr
        if minutes == "0.1":
            assert "still missing" in printed
    assert printed.splitlines()[-1] == "complete"
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results) == set(check.PARTS)
    assert all(found["finished"] for found in results.values())
    assert "skipped" in results["tests"]["closing_line"].lower()
