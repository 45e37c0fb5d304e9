"""``polarguide measure``: its exit status, its lines, and what it writes."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from bracketed import write_bracket
from camera_files import write_mosaics

from polarguide.cli.app import run
from polarguide.geometry.polarizer import ANGLES
from polarguide_shots.measurement.pictures import diverging
from tests.shots.test_read import write_four

SENSOR = ("--sensor", "IMX250MZR", "--bits", "12", "--threads", "1")


@pytest.fixture
def shots(tmp_path: Path) -> Path:
    folder = tmp_path / "shots"
    folder.mkdir()
    write_mosaics(folder, 3, color=False, bits=12)
    return folder


def measure(*arguments: object) -> int:
    return run(["measure", *(str(argument) for argument in (*arguments, *SENSOR))])


def rows_of(out: Path) -> list[dict[str, str]]:
    with open(out / "table.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_folder_with_a_bad_file(shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (shots / "v001.png").write_bytes(b"no picture")
    out = tmp_path / "out"
    assert measure(shots, "--out", out) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith(f"error: {shots / 'v001.png'}: expected a complete PNG, JPEG or TIFF file")
    assert "shots: 2 measured, 1 unread" in printed.out
    assert [(row["shot"], row["status"]) for row in rows_of(out)] == [
        ("v000", "measured"), ("v001", "unread"), ("v002", "measured"),
    ]  # fmt: skip
    assert measure(shots, "--out", out) == 2
    assert "(3 of them earlier)" in capsys.readouterr().out
    assert len(rows_of(out)) == 3


def test_limits_and_the_picture_of_what_is_beyond(
    shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits, out = tmp_path / "limits.json", tmp_path / "out"
    # S0 falls by a tenth from shot to shot: the last is beyond, in one of two regions.
    options = ("--out", out, "--roi", "left=0,0,20,48", "--roi", "40,8,16,16", "--limits", limits)
    limits.write_text(json.dumps({"limits": {"saturated": {"max": 0}}}))
    assert measure(shots, *options) == 0
    middle = [float(row["s0_mean"]) for row in rows_of(out) if row["region"] == "left"]
    assert middle[0] > middle[1] > middle[2]
    bound = (middle[1] + middle[2]) / 2
    limits.write_text(json.dumps({"regions": {"left": {"s0_mean": {"min": bound}}}}))
    taken = (out / "table.jsonl").read_text()
    assert measure(shots, *options) == 3
    said = capsys.readouterr().out
    assert "3 shots compared with new limits" in said
    assert "beyond: v002: left s0_mean" in said
    figures = [[row["s0_mean"] for row in json.loads(line)["regions"]] for line in taken.splitlines()]
    lines = (out / "table.jsonl").read_text().splitlines()
    assert [[row["s0_mean"] for row in json.loads(line)["regions"]] for line in lines] == figures
    assert [(row["shot"], row["region"], row["status"]) for row in rows_of(out)] == [
        ("v000", "left", "within"), ("v000", "roi2", "measured"),
        ("v001", "left", "within"), ("v001", "roi2", "measured"),
        ("v002", "left", "beyond"), ("v002", "roi2", "measured"),
    ]  # fmt: skip
    assert [path.name for path in (out / "beyond").iterdir()] == ["v002.png"]
    picture = cv2.imread(str(out / "beyond" / "v002.png"))[..., ::-1].astype(int)
    assert picture.shape[1] == 640
    red = (picture[..., 0] > 200) & (picture[..., 1] < 80)
    green = (picture[..., 1] > 180) & (picture[..., 0] < 80)
    assert red[100, :4].any()  # ten times as large: the left edge of "left"
    assert green[80:240, 400:402].any()  # and of the other

    # Wider limits take the picture away, other regions need a table of their own.
    limits.write_text(json.dumps({"limits": {"saturated": {"max": 0}}}))
    assert measure(shots, *options) == 0
    assert list((out / "beyond").iterdir()) == []
    assert {row["status"] for row in rows_of(out)} == {"within"}
    assert measure(shots, "--out", out, "--roi", "left=0,0,21,48", "--limits", limits) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_golden_part(shots: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert measure(shots, "--out", out, "--reference", shots / "v000.png") == 0
    rows = rows_of(out)
    assert float(rows[0]["s0_difference_rms"]) == float(rows[0]["aolp_difference_p99"]) == 0
    # The same light, a tenth darker: of the polarization, only rounding differs.
    assert float(rows[1]["s0_difference"]) == pytest.approx(-0.1 * float(rows[0]["s0_mean"]), rel=0.01)
    assert float(rows[1]["dolp_difference_p99"]) < 0.003
    assert abs(float(rows[1]["aolp_difference"])) < 0.1
    assert sorted(path.name for path in (out / "differences").iterdir()) == [
        "v000.png",
        "v001.png",
        "v002.png",
    ]


def test_colors_of_differences() -> None:
    picture = diverging(np.array([[-1.0, -0.5, 0.0, 0.5, 1.0, 9.0, np.nan]], np.float32), 1.0)[0].astype(int)
    assert picture[0, 2] > picture[0, 0]
    assert picture[4, 0] > picture[4, 2]
    assert len(set(picture[2])) == 1
    assert (picture[4] == picture[5]).all()
    assert len(set(picture[6])) == 1
    assert picture[6, 0] < picture[2, 0]


def test_ambiguous_and_incomplete_shots_are_lines_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts, out = tmp_path / "parts", tmp_path / "out"
    for name in ("cup", "jar", "lid"):
        write_four(parts, tuple(f"{name}_{angle}.png" for angle in ANGLES))
    (parts / "cup_45.tif").write_bytes((parts / "cup_45.png").read_bytes())
    (parts / "jar_135.png").rename(parts / "overview.png")
    assert run(["measure", str(parts), "--out", str(out), "--transfer", "linear"]) == 2
    printed = capsys.readouterr()
    said = printed.err.splitlines()
    assert len(said) == 3
    assert "one picture of cup at 45 degrees, found cup_45.png and cup_45.tif" in said[0]
    assert "shots of view jar at 0, 45, 90 and 135 degrees, found none at 135" in said[1]
    assert f"{parts / 'overview.png'}: expected raw mosaics with --sensor" in said[2]
    assert "shots: 1 measured, 3 unread" in printed.out
    rows = {row["shot"]: row for row in rows_of(out)}
    assert {name: row["status"] for name, row in rows.items()} == {
        "cup": "unread", "jar": "unread", "lid": "measured", "overview.png": "unread",
    }  # fmt: skip
    assert rows["cup"]["why"] == said[0].removeprefix("error: ")
    assert "cup_45.tif" in rows["cup"]["files"]
    (parts / "overview.png").rename(parts / "jar_135.png")
    (parts / "cup_45.tif").unlink()
    run(["measure", str(parts), "--out", str(out), "--transfer", "linear"])
    assert {row["shot"] for row in rows_of(out) if row["status"] == "measured"} == {"cup", "jar", "lid"}


def test_a_watch_says_at_its_end_what_never_came(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = tmp_path / "parts"
    write_four(parts, tuple(f"{angle}/cup.png" for angle in ANGLES))
    (parts / "90").rename(tmp_path / "90")
    command = ["measure", "--watch", str(parts), "--out", str(tmp_path / "out"), "--transfer", "linear"]
    command += ["--settle", "0.05", "--patience", "0.1", "--idle", "0.3"]
    assert run(command) == 2
    assert f"error: {parts}: expected four folders" in capsys.readouterr().err
    (parts / "90").mkdir()
    assert run(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {parts}: expected complete shots, found 1 ")
    assert "(cup)" in line
    (parts / "90").rmdir()
    (tmp_path / "90").rename(parts / "90")
    assert run(command) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("options", "found"), [(("--roi", "60,40,10,10"), "64x48"), (("--reference", "small.png"), "64x48")]
)
def test_pictures_that_options_do_not_fit(
    shots: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    refused,
    options: tuple[str, ...],
    found: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("small.png", np.full((32, 32), 900, np.uint16))
    assert found in refused("measure", shots / "v000.png", "--out", "out", *options, *SENSOR)


def test_measure_reads_brackets(tmp_path: Path) -> None:
    write_bracket(tmp_path / "line", "part")
    out = tmp_path / "out"
    roi = "lamp=85,46,10,10"
    assert measure(tmp_path / "line", "--out", out, "--black-level", "64", "--roi", roi) == 0
    (values,) = rows_of(out)
    assert values["shot"] == "part"
    assert float(values["dolp_mean"]) == pytest.approx(0.4, abs=0.02)
    assert float(values["s0_mean"]) > 10
