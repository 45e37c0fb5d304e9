"""``polarguide prepare``: from camera files and datasets to a scene that trains."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_files import write_nersp

from polarguide.cli.app import run
from tests.shots.test_read import CUP, write_four, write_mosaic

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
    assert "already complete" in capsys.readouterr().out
    assert run(["train", scene, "--out", out, "--steps", "4", "--downscale", "4", "--threads", "1"]) == 0


def test_a_dataset_becomes_a_scene_that_trains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nersp(tmp_path / "in")
    source, scene, out = (str(tmp_path / name) for name in ("in", "scene", "run"))
    assert run(["prepare", source, "--out", scene, "--threads", "1"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "4 views of the dataset nersp" in printed
    assert "Four-angle sum check: n/a" in printed
    assert "warning: The sense of nersp's angles is uncertain" in printed
    assert "Angles count clockwise as displayed, by assumption" in printed
    assert "sampled at random in the hull of the masks" in printed
    assert run(["train", scene, "--out", out, "--steps", "2", "--threads", "1"]) == 0


def test_a_folder_of_mosaics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    for name in "ab":
        write_mosaic(tmp_path / "in" / f"{name}.png")
    arguments = ["--sensor", "IMX250MZR", "--out", str(tmp_path / "out"), "--formats", "png,page"]
    assert run(["priors", str(tmp_path / "in"), *arguments]) == 0
    assert "12 bits" in capsys.readouterr().out
    for name in "ab":
        assert (tmp_path / "out" / name / "AoLP.png").is_file()
        assert (tmp_path / "out" / name / "shot.html").is_file()


def test_four_files_and_a_calibration(tmp_path: Path) -> None:
    paths = [str(path) for path in write_four(tmp_path / "in", CUP)]
    arguments = ["--out", str(tmp_path / "out"), "--formats", "npy", "--transfer", "linear", "--sense", "cw"]
    assert run(["priors", *paths, *arguments]) == 0
    assert (tmp_path / "out" / "cup" / "DoLP.npy").is_file()


def test_one_of_a_folder_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    for name in "ab":
        write_mosaic(tmp_path / "in" / f"{name}.png")
    (tmp_path / "in" / "b.png").write_bytes(b"no picture")
    arguments = ["--sensor", "IMX250MZR", "--out", str(tmp_path / "out"), "--formats", "npy"]
    assert run(["priors", str(tmp_path / "in"), *arguments]) == 2
    found = capsys.readouterr()
    assert "expected 2 shots, found 1 failed shots (b)" in found.err
    assert "b.png: expected a complete PNG" in found.out
    assert (tmp_path / "out" / "a" / "DoLP.npy").is_file()


def test_a_folder_with_ambiguous_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_four(tmp_path / "in", CUP)
    write_four(tmp_path / "in", tuple(name.replace("cup", "jar") for name in CUP))
    (tmp_path / "in" / "cup_45.tif").write_bytes((tmp_path / "in" / "cup_45.png").read_bytes())
    assert run(["priors", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--formats", "npy"]) == 2
    printed = capsys.readouterr()
    assert "one picture of cup at 45 degrees, found cup_45.png and cup_45.tif" in " ".join(
        printed.out.split()
    )
    assert "expected 2 shots, found 1 failed shots (cup)" in printed.err
    assert (tmp_path / "out" / "jar" / "DoLP.npy").is_file()
    assert not (tmp_path / "out" / "cup").exists()
