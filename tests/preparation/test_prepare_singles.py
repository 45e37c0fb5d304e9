"""``prepare`` on photographs through a filter at any angles, one or several a view."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
import pytest
import tifffile
from camera_files import ANGLES, behind, read_invalid, smooth_light, write_shots
from faults import Fault
from filter_photographs import Photographed, photograph_plane
from heard import Heard
from raw_photographs import write_dng
from tiny_capture import encode_srgb, write_picture

from polarguide.capture.calibration import TURNS, Calibration, apply_orientation
from polarguide.capture.colmap.model import read_model
from polarguide.capture.filter.camera_files import Lens
from polarguide.geometry.polarizer import malus
from polarguide.preparation import prepare as prepare_module
from polarguide.preparation.filter_source import SinglesSource
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_synth.sensor import exif_tags

PLAIN = PrepareSettings(poses="none", transfer="linear", align=False)


def table(scene: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((scene / "angles.csv").read_text().splitlines()))


def summary(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())


def read_one(path: Path) -> np.ndarray:
    """Linear values of a picture in a scene."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    return (stored[..., ::-1] if stored.ndim == 3 else np.repeat(stored[..., None], 3, axis=2)) / 65535.0


def gain_errors(capture: Photographed, scene: Path) -> np.ndarray:
    """Relative errors of the gains, whose common factor is free."""
    rows = table(scene)
    found = np.log([float(row["gain"]) for row in rows])
    known = np.array([capture.shots[row["view"]].stops for row in rows]) * math.log(2)
    assert found.mean() == pytest.approx(0, abs=1e-5)
    return found - (known - known.mean())


@pytest.mark.parametrize("noted", [True, False])
def test_hand_held_photographs_become_a_scene(tmp_path: Path, noted: bool) -> None:
    """Noise, 8 bits, sRGB, automatic exposure, a sheet before the lens, and a camera held in four ways."""
    capture = photograph_plane(tmp_path, noted=noted)
    scene, heard = tmp_path / "scene", Heard()
    done = prepare_scene(capture.folder, scene, PrepareSettings(poses=str(capture.model)), heard)
    assert (done.views, summary(scene)["polarizer"]) == (sorted(capture.shots), "filter")
    rows = table(scene)
    assert list(rows[0]) == ["file", "view", "angle", "gain"]
    assert [row["view"] for row in rows] == sorted(capture.shots)
    for row in rows:
        shot = capture.shots[row["view"]]
        assert float(row["angle"]) == shot.angle
        assert row["file"] == f"{row['view']}_{int(shot.angle):03d}.png"
        exposed = capture.light(row["view"]) * 2**shot.stops
        picture = read_one(scene / "polar" / row["file"])
        valid = ~read_invalid(scene, row["view"])
        assert np.median(np.abs(picture - exposed)[valid] / exposed[valid]) < 0.03
        assert abs(np.mean((picture - exposed)[valid]) / exposed[valid].mean()) < 0.01
    assert np.abs(gain_errors(capture, scene)).max() < (0.01 if noted else 0.04)
    model = read_model(scene)
    for view, camera in capture.cameras.items():
        np.testing.assert_allclose(model.camera(view).rotation, camera.rotation, atol=1e-6)
        np.testing.assert_allclose(model.camera(view).center, camera.center, atol=1e-6)
    assert any(text.startswith("Gains: ") for text in heard.said)
    assert prepare_scene(capture.folder, scene, PrepareSettings(poses=str(capture.model))).new is False


@pytest.mark.parametrize("code", range(1, 9))
def test_exif_turns_pixels_and_the_angle(tmp_path: Path, code: int) -> None:
    """The angle is said relative to the camera's body; the picture behind it belongs to the turned angle."""
    stored = smooth_light(96, 128)
    upright = np.stack([apply_orientation(plane, code) for plane in stored])
    upright[1:] *= -1.0 if code in (5, 6, 7, 8) else 1.0
    upright[2] *= -1.0 if code in (2, 4, 5, 7) else 1.0
    path = tmp_path / "in" / "v_a30.jpg"
    write_picture(path, behind(stored, [30])[0], bits=8)
    data, block = path.read_bytes(), b"Exif\0\0" + exif_tags(code, None)
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + data[2:])
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN, heard)
    said = [text for text in heard.said if "EXIF orientation" in text]
    also = "1 of 1 views were rotated for display, including their polarizer angles"
    assert [(also in text, TURNS[code] in text) for text in said] == [(True, True)] * (code > 1)
    (row,) = table(tmp_path / "out")
    # Worked out by hand: a quarter adds 90, a mirror changes the sign.
    assert float(row["angle"]) == {1: 30, 2: 150, 3: 30, 4: 150, 5: 60, 6: 120, 7: 60, 8: 120}[code]
    expected = malus(upright, np.radians(float(row["angle"])))
    assert np.abs(read_one(tmp_path / "out" / "polar" / row["file"]) - expected).max() < 0.03


def test_views_with_any_number_of_shots(tmp_path: Path) -> None:
    light, source = smooth_light(), tmp_path / "in"
    said = {"four": ANGLES, "three": (0, 60, 120), "pair": (10, 100), "one": (165,)}
    for view, angles in said.items():
        for angle, values in zip(angles, behind(light, angles), strict=True):
            write_picture(source / f"{view}_a{angle}.png", values)
    write_picture(source / "half_unknown.png", behind(light, [20])[0])
    write_picture(source / "bare_none.png", light[0] / 2)
    done = prepare_scene(source, tmp_path / "out", replace(PLAIN, gains="none"))
    assert done.views == sorted([*said, "half", "bare"])
    rows = table(tmp_path / "out")
    for row in rows:
        expected = light[0] / 2
        if row["angle"] not in ("unknown", "none"):
            assert int(row["angle"]) in said[row["view"]]
            expected = malus(light, np.radians(float(row["angle"])))
        elif row["angle"] == "unknown":
            expected = behind(light, [20])[0]
        np.testing.assert_allclose(read_one(tmp_path / "out" / "polar" / row["file"]), expected, atol=2e-5)
    assert {row["gain"] for row in rows} == {"1"}
    assert sorted(path.stem for path in (tmp_path / "out" / "invalid").iterdir()) == done.views
    assert {row["view"]: row["angle"] for row in rows} | {"half": "unknown", "bare": "none"} == {
        row["view"]: row["angle"] for row in rows
    }


def write_three(folder: Path, names: tuple[str, ...]) -> None:
    for name in names:
        write_picture(folder / name, behind(smooth_light(), [0])[0])


@pytest.mark.parametrize(
    ("names", "angles", "expected"),
    [
        (("c_000.jpg", "d-30.jpg", "e 15deg.jpg"), None, {"c": "0", "d": "30", "e": "15"}),
        (("IMG_0012_045.jpg", "IMG_0013_a7.5.jpg"), None, {"IMG_0012": "45", "IMG_0013": "7.5"}),
        (("0/x.png", "30/y.png", "none/z.png"), None, {"x": "0", "y": "30", "z": "none"}),
        (("IMG_1.jpg", "IMG_2.jpg"), "unknown", {"IMG_1": "unknown", "IMG_2": "unknown"}),
        (("IMG_1.jpg", "IMG_2.jpg"), "0, 60", {"IMG_1": "0", "IMG_2": "60"}),
        (("DSC_015_unknown.jpg", "DSC_016_none.jpg"), None, {"DSC_015": "unknown", "DSC_016": "none"}),
    ],
)
def test_names_folders_and_options_say_angles(
    tmp_path: Path, names: tuple[str, ...], angles: str | None, expected: dict[str, str]
) -> None:
    write_three(tmp_path / "in", names)
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, angles=angles))
    assert {row["view"]: row["angle"] for row in table(tmp_path / "out")} == expected


def test_a_table_says_angles_views_and_gains(tmp_path: Path) -> None:
    source = tmp_path / "in"
    write_three(source, ("a.png", "b.png", "c.png"))
    (source / "angles.csv").write_text(
        "\ufefffile,angle,view,gain\r\na.png,-30,first,\r\nb.png, 60 ,first,\r\n\r\nc.png,Unknown,,0.5\r\n",
        "utf-8",
    )
    clockwise = replace(PLAIN, calibration=Calibration(sense="cw", zero=10.0))
    prepare_scene(source, tmp_path / "out", clockwise)
    found = {row["file"]: (row["view"], row["angle"], row["gain"]) for row in table(tmp_path / "out")}
    assert found == {
        "first_040.png": ("first", "40", "0.5"),
        "first_130.png": ("first", "130", "0.5"),
        "c_unknown.png": ("c", "unknown", "0.5"),
    }


def test_a_photograph_without_a_filter_gets_twice_the_light(tmp_path: Path) -> None:
    light = smooth_light(peak=0.45)
    for view in "abcd":
        write_picture(tmp_path / "in" / f"{view}_a20.png", behind(light, [20])[0])
    write_picture(tmp_path / "in" / "e_none.png", light[0])
    for path in (tmp_path / "in").iterdir():
        _state_exposure(path)
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    gains = {row["view"]: float(row["gain"]) for row in table(tmp_path / "out")}
    assert gains["e"] / gains["a"] == pytest.approx(2.0, rel=1e-4)


def _state_exposure(path: Path) -> None:
    """Put an exposure time into a PNG file."""
    data, tags = path.read_bytes(), b"eXIf" + exif_tags(1, Fraction(1, 60))
    chunk = (len(tags) - 4).to_bytes(4, "big") + tags + crc32(tags).to_bytes(4, "big")
    path.write_bytes(data[:33] + chunk + data[33:])


def test_a_file_that_lies_about_its_exposure_is_named(tmp_path: Path) -> None:
    capture, heard = photograph_plane(tmp_path), Heard()
    path = next(capture.folder.glob("v3_*"))
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    linear = np.where(stored <= 10, stored / 255 / 12.92, ((stored / 255 + 0.055) / 1.055) ** 2.4)
    _, data = cv2.imencode(".jpg", np.rint(255 * encode_srgb(linear / 2)), [cv2.IMWRITE_JPEG_QUALITY, 98])
    head = path.read_bytes()
    path.write_bytes(head[: 4 + int.from_bytes(head[4:6], "big")] + data[2:].tobytes())
    prepare_scene(capture.folder, tmp_path / "scene", PrepareSettings(poses=str(capture.model)), heard)
    assert any("contradicts the exposure" in t and "(v3)" in t for t in heard.said)
    errors = gain_errors(capture, tmp_path / "scene")
    assert errors[3] - np.median(errors) == pytest.approx(-math.log(2), abs=0.05)


def test_no_gains_on_request(tmp_path: Path) -> None:
    capture = photograph_plane(tmp_path, views=3)
    asked = PrepareSettings(poses=str(capture.model), gains="none")
    prepare_scene(capture.folder, tmp_path / "scene", asked)
    assert {row["gain"] for row in table(tmp_path / "scene")} == {"1"}


def test_camera_raw(tmp_path: Path) -> None:
    light = smooth_light(64, 96)
    for view, angle in (("a", 20), ("b", 70)):
        write_dng(tmp_path / "in" / f"{view}_a{angle}.dng", behind(light, [angle])[0], orientation=6)
    prepare_scene(tmp_path / "in", tmp_path / "out", PrepareSettings(poses="none"))
    rows = table(tmp_path / "out")
    assert [(row["view"], row["angle"]) for row in rows] == [("a", "110"), ("b", "160")]
    expected = np.rot90(behind(light, [20])[0], -1)
    off = np.abs(read_one(tmp_path / "out" / "polar" / rows[0]["file"]) - expected)[4:-4, 4:-4]
    assert off.max() < 0.01


def test_what_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = photograph_plane(tmp_path, views=4)
    asked, scene = PrepareSettings(poses=str(capture.model)), tmp_path / "scene"

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(prepare_module, "write_exposure_table", stop)
        with pytest.raises(KeyboardInterrupt):
            prepare_scene(capture.folder, scene, asked)
    assert not (scene / "scene.json").exists()
    before = {path: path.stat().st_mtime_ns for path in (scene / "polar").iterdir()}
    assert prepare_scene(capture.folder, scene, asked).new
    assert {path: path.stat().st_mtime_ns for path in (scene / "polar").iterdir()} == before
    assert len(table(scene)) == 4
    first = next(capture.folder.glob("v0_*"))
    first.rename(first.with_name("v0_unknown.jpg"))
    Fault(found="that was removed").raised_by(prepare_scene, capture.folder, scene, asked)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda view: view.pop("exposures"), Fault(expected="the exposures of")),
        (lambda view: view["exposures"][0].update(angle="left"), Fault("angle")),
        (lambda view: view["exposures"][0].update(light=-1), Fault("light")),
        (lambda view: view["exposures"][0].update(given_gain="x"), Fault("given_gain")),
        (lambda view: view["exposures"][0].update(angle=33), Fault(expected="the exposures of")),
        (lambda view: view["files"].update({"polar/other_045.png": 1}), Fault(expected="the exposures of")),
    ],
)
def test_a_journal_that_was_changed_is_refused(tmp_path: Path, change: Callable, fault: Fault) -> None:
    write_three(tmp_path / "in", ("a_a30.png",))
    scene = tmp_path / "scene"
    prepare_scene(tmp_path / "in", scene, PLAIN)
    whole = summary(scene)
    change(whole["prepare"]["views"]["a"])
    (scene / "scene.json").unlink()
    (scene / "prepare.json").write_text(json.dumps(whole))
    fault.raised_by(prepare_scene, tmp_path / "in", scene, PLAIN)


@pytest.mark.parametrize(
    ("names", "angles"),
    [
        ("cup_{}.png", range(10, 180, 30)),
        ("{}.png", range(0, 180, 20)),
        ("{}/cup.png", range(10, 180, 30)),
        ("cup_{}.png", range(0, 360, 40)),
        ("cup_a{}.png", (0, 60, 120, 180, 240)),
        ("cup_{}.png", (0, 45, 90, -45)),
        ("{}/cup.png", (0, 45, 90, -45)),
        ("{}.png", range(-80, 100, 20)),
    ],
)
def test_sweeps_are_named_as_for_priors(tmp_path: Path, names: str, angles: range | tuple[int, ...]) -> None:
    """Plain numbers that go evenly around, and pictures half a turn apart."""
    light, source = smooth_light(), tmp_path / "cup"
    for angle, values in zip(angles, behind(light, angles), strict=True):
        write_picture(source / names.format(angle), values)
    prepare_scene(source, tmp_path / "out", PLAIN)
    rows = table(tmp_path / "out")
    assert sorted(float(row["angle"]) for row in rows) == sorted(a % 180 for a in angles)
    assert {row["view"] for row in rows} == {"cup"}
    assert summary(tmp_path / "out")["format"] == "singles"
    for row in rows:
        expected = malus(light, np.radians(float(row["angle"])))
        assert np.abs(read_one(tmp_path / "out" / "polar" / row["file"]) - expected).max() < 2e-3


def test_four_shots_of_a_tripod_stay_what_they_were(tmp_path: Path) -> None:
    write_shots(tmp_path / "in", "v", behind(smooth_light()))
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    found = summary(tmp_path / "out")
    assert (found["format"], found["polarizer"]) == ("filter", "filter")
    assert not (tmp_path / "out" / "angles.csv").exists()
    (tmp_path / "in" / "90" / "v.png").unlink()
    Fault(found="none at 90", remedy="--format singles").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "less", PLAIN
    )
    prepare_scene(tmp_path / "in", tmp_path / "less", replace(PLAIN, format="singles"))
    assert [row["angle"] for row in table(tmp_path / "less")] == ["0", "45", "135"]


TABLES = {
    "missing line": (
        "file,angle\na.png,0\n",
        Fault("angles.csv", "a line for every photograph", "none for 1 (b.png)"),
    ),
    "doubled line": ("file,angle\na.png,0\nb.png,1\na.png,2\n", Fault(found="two for a.png, lines 2 and 4")),
    "no number": ("file,angle\na.png,0\nb.png,left\n", Fault("line 3), b.png", "an angle", '"left"')),
    "not finite": ("file,angle\na.png,nan\nb.png,0\n", Fault("line 2", expected="an angle")),
    "infinite": ("file,angle\na.png,inf\nb.png,0\n", Fault("line 2", expected="an angle")),
    "empty angle": ("file,angle\na.png,\nb.png,0\n", Fault("line 2", expected="an angle")),
    "no file": ("file,angle\na.png,0\nb.png,0\nc.png,0\n", Fault(expected="the file", found="nothing")),
    "no header": ("a.png,0\nb.png,0\n", Fault(expected="the header file,angle")),
    "doubled under two spellings": (
        "file,angle\na.png,0\n./a.png,1\n",
        Fault(found="two for a.png, lines 2 and 3"),
    ),
    "doubled by a detour": (
        "file,angle\na.png,0\n../in/a.png,1\n",
        Fault(found="two for a.png and ../in/a.png"),
    ),
    "decimal comma": ('file,angle\na.png,"22,5"\nb.png,0\n', Fault(found="22,5 with a decimal comma")),
    "decimal comma and semicolons": (
        "file;angle\na.png;22,5\nb.png;0\n",
        Fault(found="22,5 with a decimal comma"),
    ),
    "decimal comma without quotes": (
        "file,angle\na.png,22,5\nb.png,0\n",
        Fault(found="may be a decimal comma"),
    ),
    "null character": ("file,angle\na\0.png,0\nb.png,0\n", Fault("line 2)", found="a null character")),
    "unclosed quote": ('file,angle\na.png,"0\nb.png,0\n', Fault("line 2)", found="unexpected end of data")),
    "strange column": ("file,angle,size\na.png,0,1\nb.png,0,1\n", Fault(expected="the header")),
    "too few cells": ("file,angle\na.png\nb.png,0\n", Fault("line 2)", "2 cells", "1")),
    "too many cells": ("file,angle\na.png,0,1\nb.png,0\n", Fault("line 2)", "2 cells", "3")),
    "empty": ("", Fault(found="an empty file")),
    "no text": (b"\xff\xfe\x00", Fault(expected="CSV text in UTF-8")),
    "twice one angle": (
        "file,angle,view\na.png,0,v\nb.png,0,v\n",
        Fault(expected="one photograph of v at 0 degrees"),
    ),
    "twice no filter": (
        "file,angle,view\na.png,none,v\nb.png,none,v\n",
        Fault(expected="one photograph of v without a filter"),
    ),
    "elsewhere": ("file,angle\n../x.png,0\na.png,0\nb.png,0\n", Fault(expected="a picture in")),
    "no picture": ("file,angle\nangles.csv,0\na.png,0\nb.png,0\n", Fault(expected="a picture in")),
    "name of a view": (
        "file,angle,view\na.png,0,a/b\nb.png,0,c\n",
        Fault(expected="a view name that can be a file name"),
    ),
    "control characters": (
        'file,angle,view\na.png,0,"a\nb"\nb.png,0,c\n',
        Fault(expected="a view name that can be a file name"),
    ),
    "gain": ("file,angle,gain\na.png,0,0\nb.png,0,1\n", Fault(expected="a gain from")),
}


def test_one_file_in_two_forms_of_unicode_is_listed_twice(tmp_path: Path) -> None:
    write_three(tmp_path / "in", ("\N{LATIN SMALL LETTER U WITH DIAERESIS}.png", "b.png"))
    (tmp_path / "in" / "angles.csv").write_text(
        "file,angle\n\u00fc.png,0\nu\u0308.png,20\nb.png,1\n", encoding="utf-8"
    )
    refused(
        tmp_path, PLAIN, Fault(expected="one line for each file", found="two for \u00fc.png, lines 2 and 3")
    )


@pytest.mark.parametrize("again", ["./a.png", "../in/a.png", "link.png"])
def test_one_file_under_two_spellings_is_listed_twice(tmp_path: Path, again: str) -> None:
    write_three(tmp_path / "in", ("a.png", "b.png"))
    (tmp_path / "in" / "link.png").symlink_to("a.png")
    (tmp_path / "in" / "angles.csv").write_text(f"file,angle\na.png,0\n{again},20\nb.png,1\n")
    refused(tmp_path, PLAIN, Fault("line 3", expected="one line for each file", found="two for a.png"))


def test_a_table_with_semicolons_and_another_form_of_unicode(tmp_path: Path) -> None:
    write_three(tmp_path / "in", ("u\u0308.png", "b.png"))
    (tmp_path / "in" / "angles.csv").write_text("file;angle\n\u00fc.png;22.5\nb.png;0\n", encoding="utf-8")
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN)
    rows = [(row["view"], row["angle"]) for row in table(tmp_path / "out")]
    assert rows == [("b", "0"), ("\u00fc", "22.5")]


@pytest.mark.parametrize("case", TABLES)
def test_faults_of_the_table(tmp_path: Path, case: str) -> None:
    content, fault = TABLES[case]
    write_three(tmp_path / "in", ("a.png", "b.png"))
    write_picture(tmp_path / "x.png", np.zeros((8, 8, 3)))
    data = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "in" / "angles.csv").write_bytes(data)
    refused(tmp_path, PLAIN, fault)


def refused(root: Path, settings: PrepareSettings, fault: Fault) -> None:
    """One line, and nothing is written."""
    fault.raised_by(prepare_scene, root / "in", root / "out", settings)
    assert not (root / "out" / "scene.json").exists()


@pytest.mark.parametrize(
    ("names", "changes", "fault"),
    [
        (
            ("a_a30.jpg", "IMG_0012.jpg"),
            {},
            Fault(found="1 of 2 without an angle in their names (IMG_0012.jpg)"),
        ),
        (("img_001.jpg", "img_002.jpg"), {"format": "singles"}, Fault(found="2 of 2 without an angle")),
        (("a_a30.jpg", "a-30.png"), {}, Fault(expected="one photograph of a at 30 degrees")),
        (("a_a30.jpg", "b_a30.png"), {}, Fault(expected="one kind of file", found=") and PNG, TIFF or BMP")),
        (("IMG_1.jpg", "IMG_1.png"), {"angles": "unknown"}, Fault(expected="one file called IMG_1")),
        (
            ("IMG_1.jpg", "IMG_2.jpg"),
            {"angles": "0,60,120"},
            Fault(expected="divisible by 3", found="2"),
        ),
        (("IMG_1.jpg", "IMG_2.jpg"), {"angles": "0,left"}, Fault("--angles", expected="'unknown', 'none'")),
        (("IMG_1.jpg", "IMG_2.jpg"), {"angles": "there.csv"}, Fault("there.csv", expected="a readable file")),
        (("a_a30.jpg",), {"poses": "sfm"}, Fault(expected="at least 3 views")),
        (
            ("a_a30.jpg",),
            {"calibration": Calibration(order=(90, 45, 0, 135))},
            Fault(expected="only sense and zero"),
        ),
        (("a_a30.jpg",), {"demosaic": "full"}, Fault("--demosaic")),
    ],
)
def test_faults_of_names_and_options(
    tmp_path: Path, names: tuple[str, ...], changes: dict[str, object], fault: Fault
) -> None:
    write_three(tmp_path / "in", names)
    refused(tmp_path, replace(PLAIN, **changes), fault)


def test_a_table_and_an_option_contradict_each_other(tmp_path: Path) -> None:
    write_three(tmp_path / "in", ("a.png", "b.png"))
    (tmp_path / "in" / "angles.csv").write_text("file,angle\na.png,0\nb.png,0\n")
    refused(tmp_path, replace(PLAIN, angles="unknown"), Fault("--angles", expected="no --angles"))


def test_several_sizes_and_cameras(tmp_path: Path) -> None:
    write_picture(tmp_path / "in" / "a_a30.png", behind(smooth_light(48, 64), [0])[0])
    write_picture(tmp_path / "in" / "b_a30.png", behind(smooth_light(64, 48), [0])[0])
    prepare_scene(tmp_path / "in", tmp_path / "held", PLAIN)  # on its side: the same camera
    write_picture(tmp_path / "in" / "c_a30.png", behind(smooth_light(32, 64), [0])[0])
    refused(tmp_path, PLAIN, Fault(expected="photographs of one size", found="64x32"))
    (tmp_path / "in" / "c_a30.png").unlink()
    for name, model in (("a", "one"), ("b", "two")):
        (tmp_path / "in" / f"{name}_a30.png").unlink()
        pixels = np.full((48, 64, 3), 20_000, np.uint16)
        tags = [(272, "s", 0, model, True)]
        tifffile.imwrite(tmp_path / "in" / f"{name}_a30.tif", pixels, extratags=tags, photometric="rgb")
    source = SinglesSource(tmp_path / "in", PLAIN)
    assert source.lenses() == {"a": Lens("one"), "b": Lens("two")}
