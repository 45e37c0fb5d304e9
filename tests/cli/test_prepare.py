"""``polarguide prepare``: from camera files and datasets to a scene that trains."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_files import write_nersp

from polarguide.cli.app import run

CELL = ((90, 45), (135, 0))


def demo_mosaics(demo: Path, folder: Path, views: list[str]) -> None:
    """What a color sensor of twice the size would have seen: each picture pixel becomes one 2x2 cell."""
    folder.mkdir()
    for view in views:
        raw = np.empty((192, 256), np.uint16)
        for row, column in np.ndindex(2, 2):
            path = demo / "polar" / f"{view}_{CELL[row][column]:03d}.png"
            rgb = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
            cell = rgb[..., 1].copy()
            cell[::2, ::2], cell[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
            raw[row::2, column::2] = cell
        assert cv2.imwrite(str(folder / f"{view}.png"), raw)


def test_mosaics_to_a_trained_scene(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = sorted(path.stem[:-4] for path in (demo_scene / "polar").glob("*_000.png"))[:6]
    demo_mosaics(demo_scene, tmp_path / "raw", views)
    source, scene, out = (str(tmp_path / name) for name in ("raw", "scene", "run"))
    model = str(demo_scene / "sparse" / "0")
    command = ["prepare", source, "--out", scene, "--sensor", "IMX250MYR", "--poses", model, "--threads", "1"]
    command.append("--no-register")  # the samples of these cells lie in one place
    assert run(command) == 0
    printed = capsys.readouterr().out
    assert f"scene: {scene} (6 views)" in printed
    assert f"next: polarguide inspect {scene}" in printed
    assert f"then: polarguide train {scene}" in printed
    before = cv2.imread(str(demo_scene / "polar" / f"{views[0]}_000.png"), cv2.IMREAD_UNCHANGED)
    after = cv2.imread(str(tmp_path / "scene" / "polar" / f"{views[0]}_000.png"), cv2.IMREAD_UNCHANGED)
    # What was sampled stays (up to the one gain of the angles that was estimated), the rest is interpolated.
    record = json.loads((tmp_path / "scene" / "scene.json").read_text())
    assert record["levels"]["white"] == 65472  # the demo's values are steps of 64
    factor = record["scale"] / record["gains"][0] * 65535 / 65472
    np.testing.assert_allclose(after[::2, ::2, 2], before[::2, ::2, 2] * factor, atol=1.5)
    assert np.abs(after.astype(float) - before * factor).mean() < 0.05 * 65535
    assert run(command) == 0
    assert "complete already" in capsys.readouterr().out
    assert run(["train", scene, "--out", out, "--steps", "4", "--downscale", "4", "--threads", "1"]) == 0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "raw mosaics with --sensor, or a published dataset"),
        (["--sensor", "IMX250MYR", "--order", "0,90"], "--order: expected four angles such as 90,45,0,135"),
        (["--sensor", "IMX250MYR", "--calibration", "none.json"], "none.json: expected a readable file"),
        (["--sensor", "IMX250MYR", "--zero", "nan"], "calibration (zero): expected a finite number"),
        (["--sensor", "IMX250MYR", "--poses", "none", "--threads", "-1"], "threads"),
    ],
)
def test_one_line_for_a_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    (tmp_path / "in").mkdir()
    assert cv2.imwrite(str(tmp_path / "in" / "a.png"), np.full((32, 32), 90, np.uint8))
    assert run(["prepare", str(tmp_path / "in"), "--out", str(tmp_path / "out"), *flags]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "out").exists()


def test_a_dataset_becomes_a_scene_that_trains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nersp(tmp_path / "in")
    source, scene, out = (str(tmp_path / name) for name in ("in", "scene", "run"))
    assert run(["prepare", source, "--out", scene, "--threads", "1"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "4 views, format nersp" in printed
    assert "Four-angle sum check: n/a" in printed
    assert "warning: The sense of nersp's angles is not certain" in printed
    assert "Angles count clockwise as displayed, as assumed (--sense and --zero say otherwise)" in printed
    assert "sampled at random in the hull of the masks" in printed
    assert run(["train", scene, "--out", out, "--steps", "2", "--threads", "1"]) == 0


def test_one_line_for_a_link_that_goes_nowhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nersp(tmp_path / "in")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for flags in (
        ["--poses", str(loop)],
        ["--format", "mosaic", "--sensor", "IMX250MZR", "--dark-frame", str(loop)],
    ):
        assert run(["prepare", str(tmp_path / "in"), "--out", str(tmp_path / "out"), *flags]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1, lines
        assert not (tmp_path / "out").exists()
