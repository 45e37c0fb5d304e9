"""``polarguide priors`` of shots without poses."""

from __future__ import annotations

from pathlib import Path

import pytest

from polarguide.cli.app import run
from tests.shots.test_read import CUP, write_four, write_mosaic


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


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--threshold", "0.1"], "--threshold: expected a scene with poses, found shots"),
        (["--views", "all"], "--views: expected a scene with poses, found shots"),
        (["--memory", "1GB"], "--memory: expected a scene with poses, found shots"),
        (["--run", "runs/x"], "--run: expected a scene with poses, found shots"),
        (["--downscale", "2"], "--downscale: expected 1 for shots, found 2"),
        (["--formats", "pdf"], "--formats: expected some of png, exr, npy, page, found pdf"),
        (["--full-well", "3"], "--full-well: expected 10 to 1000000000, found 3"),
        (["--refractive-index", "0.5"], "--refractive-index: expected 1.0001 to 4, found 0.5"),
        (["--intrinsics", "1,2"], "--intrinsics: expected fx,fy,cx,cy"),
    ],
)
def test_wrong_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], line: str
) -> None:
    write_mosaic(tmp_path / "a.png")
    given = ["priors", str(tmp_path / "a.png"), "--sensor", "IMX250MZR", "--out", str(tmp_path / "out")]
    assert run([*given, *arguments]) == 2
    said = capsys.readouterr().err
    assert line in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_one_of_a_folder_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    for name in "ab":
        write_mosaic(tmp_path / "in" / f"{name}.png")
    (tmp_path / "in" / "b.png").write_bytes(b"no picture")
    arguments = ["--sensor", "IMX250MZR", "--out", str(tmp_path / "out"), "--formats", "npy"]
    assert run(["priors", str(tmp_path / "in"), *arguments]) == 2
    found = capsys.readouterr()
    assert "expected 2 shots, found 1 that failed (b)" in found.err
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
    assert "expected 2 shots, found 1 that failed (cup)" in printed.err
    assert (tmp_path / "out" / "jar" / "DoLP.npy").is_file()
    assert not (tmp_path / "out" / "cup").exists()
