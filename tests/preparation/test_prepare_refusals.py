"""What ``prepare`` refuses of its input: one message, no traceback, and nothing that looks like a whole scene."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import ANGLES, behind, smooth_light, write_model, write_mosaics, write_shots
from faults import Fault
from refused_preparations import FILTER, MOSAIC, refused

from polarguide.capture import load_scene
from polarguide.capture.calibration import Calibration, read_calibration
from polarguide.core.errors import PolarguideWarning
from polarguide.core.progress import Reporter
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

RAW = replace(MOSAIC, packing="12p", width=64, height=48)


def cut(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


def save(path: Path, array: np.ndarray) -> None:
    np.save(path, array)


def picture(path: Path, array: np.ndarray) -> None:
    assert cv2.imwrite(str(path), array)


MOSAICS: dict[str, tuple[Callable[[Path], object], PrepareSettings, Fault]] = {
    "truncated png": (lambda d: cut(d / "v001.png", 200), MOSAIC, Fault("v001.png", found="cut short")),
    "zero bytes": (lambda d: cut(d / "v001.png", 0), MOSAIC, Fault("v001.png", found="an empty file")),
    "empty npy": (lambda d: (d / "w.npy").touch(), MOSAIC, Fault("w.npy", found="an empty file")),
    "truncated npy": (
        lambda d: (save(d / "w.npy", np.zeros((48, 64), np.uint16)), cut(d / "w.npy", 500)),
        MOSAIC, Fault("w.npy", expected="a complete .npy file"),
    ),
    "float npy": (lambda d: save(d / "w.npy", np.zeros((48, 64))), MOSAIC, Fault("w.npy", found="64 of float64")),
    "nan npy": (lambda d: save(d / "w.npy", np.full((48, 64), np.nan)), MOSAIC, Fault(found="float64")),
    "object npy": (
        lambda d: np.save(d / "w.npy", np.array([{}]), allow_pickle=True), MOSAIC,
        Fault(expected="a complete .npy file")
    ),
    "color png": (
        lambda d: picture(d / "w.png", np.zeros((48, 64, 3), np.uint8)), MOSAIC, Fault("w.png", found="48x64x3")
    ),
    "mixed sizes": (
        lambda d: picture(d / "w.png", np.ones((32, 64), np.uint16)), MOSAIC, Fault("w.png", "64x48", "64x32")
    ),
    "mixed depth": (
        lambda d: picture(d / "w.png", np.ones((48, 64), np.uint8)), MOSAIC, Fault("w.png", "uint16", "uint8")
    ),
    "duplicate names": (
        lambda d: picture(d / "v000.tif", np.ones((48, 64), np.uint16)), MOSAIC, Fault(found="v000.png and v000.tif")
    ),
    "not a picture": (lambda d: (d / "v000.png").write_text("hello"), MOSAIC, Fault("v000.png", found="another kind")),
    "tiny": (
        lambda d: [picture(d / f"v00{i}.png", np.ones((8, 8), np.uint16)) for i in range(3)],
        MOSAIC, Fault(expected="at least 16x16"),
    ),
    "raw without packing": (
        lambda d: (d / "w.raw").write_bytes(b"1"), MOSAIC,
        Fault(found="no --width, --height, --packing")
    ),
    "raw of wrong size": (
        lambda d: (d / "a.raw").write_bytes(b"1" * 100), RAW, Fault("a.raw", "4608 bytes for 64x48", "100")
    ),
    "width of other files": (lambda d: None, replace(MOSAIC, width=32), Fault(expected="32x48", found="64x48")),
    "no sensor": (
        lambda d: None, replace(MOSAIC, sensor=None),
        Fault(expected="photographs in color", found="which is gray", remedy="Raw mosaics: --sensor, one of IMX250MYR")
    ),
    "unknown sensor": (lambda d: None, replace(MOSAIC, sensor="IMX1"), Fault("--sensor", "IMX250MYR,", "IMX1")),
    "black level": (lambda d: None, replace(MOSAIC, black_level=70000.0), Fault("--black-level")),
    "nan black level": (lambda d: None, replace(MOSAIC, black_level=float("nan")), Fault("--black-level", found="nan")),
    "saturation": (lambda d: None, replace(MOSAIC, saturation=70000), Fault("--saturation")),
    "bits": (lambda d: None, replace(MOSAIC, bits=12), Fault("--bits", expected="values below 4096")),
    "bits out of range": (lambda d: None, replace(MOSAIC, bits=99), Fault("--bits", expected="8 to 16")),
    "negative offset": (lambda d: None, replace(MOSAIC, offset_x=-1), Fault("--offset-x", expected="0 to 1048576")),
    "missing dark frame": (
        lambda d: None, replace(MOSAIC, dark_frame="none.png"),
        Fault("none.png", expected="readable file")
    ),
    "dark frame of another size": (
        lambda d: picture(d.parent / "dark.png", np.ones((16, 16), np.uint16)),
        replace(MOSAIC, dark_frame="DARK"), Fault(expected="dark frame of 64x48"),
    ),
    "flag of the other format": (
        lambda d: None, replace(MOSAIC, transfer="srgb"),
        Fault("--transfer", expected="mosaic")
    ),
    "nan zero": (
        lambda d: None, replace(MOSAIC, calibration=Calibration(zero=float("nan"))), Fault("calibration (zero)")
    ),
    "order": (
        lambda d: None, replace(MOSAIC, calibration=Calibration(order=(0, 0, 90, 135))), Fault("calibration (order)")
    ),
    "empty folder": (lambda d: [p.unlink() for p in d.iterdir()], MOSAIC, Fault(found="an empty folder")),
    "no folder": (lambda d: shutil.rmtree(d), MOSAIC, Fault(expected="a folder of camera files", found="nothing")),
    "no model": (lambda d: None, replace(MOSAIC, poses="nowhere"), Fault("nowhere", expected="a COLMAP model")),
}  # fmt: skip


@pytest.mark.parametrize("case", MOSAICS)
def test_mosaics(tmp_path: Path, case: str) -> None:
    damage, settings, fault = MOSAICS[case]
    source = tmp_path / "räume und zeit"  # with blanks and umlauts, for every message
    write_mosaics(source)
    damage(source)
    if settings.dark_frame == "DARK":
        settings = replace(settings, dark_frame=str(tmp_path / "dark.png"))
    refused(source, tmp_path / "out", settings, fault)
    assert not (tmp_path / "out").exists()


SHOTS: dict[str, tuple[Callable[[Path], object], PrepareSettings, Fault]] = {
    "missing shot": (
        lambda d: (d / "90" / "b.png").unlink(), FILTER,
        Fault(expected="shots of view b", found="none at 90")
    ),
    "missing folder": (lambda d: shutil.rmtree(d / "135"), FILTER, Fault(found="none for 135")),
    "two folders for an angle": (lambda d: (d / "I-45").mkdir(), FILTER, Fault(expected="one folder for 45 degrees")),
    "duplicate shot": (
        lambda d: shutil.copy(d / "0" / "a.png", d / "0" / "a.tif"), FILTER,
        Fault(expected="picture of a at 0 degrees", found="a.tif")
    ),
    "truncated": (lambda d: cut(d / "45" / "b.png", 300), FILTER, Fault("b.png", found="cut short")),
    "mixed sizes": (
        lambda d: picture(d / "45" / "b.png", np.ones((8, 8, 3), np.uint16)), FILTER,
        Fault("b.png", expected="64x48 with 16 bits")
    ),
    "mixed depth": (
        lambda d: picture(d / "45" / "b.png", np.ones((48, 64, 3), np.uint8)), FILTER, Fault(found="64x48 with 8 bits")
    ),
    "flag of the other format": (
        lambda d: None, replace(FILTER, demosaic="quarter"),
        Fault("--demosaic", expected="filter")
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SHOTS)
def test_filter_shots(tmp_path: Path, case: str) -> None:
    damage, settings, fault = SHOTS[case]
    source = tmp_path / "in"
    for view in "ab":
        write_shots(source, view, behind(smooth_light()))
    damage(source)
    refused(source, tmp_path / "out", settings, fault)


@pytest.mark.parametrize(
    ("camera", "line", "fault"),
    [
        ("PINHOLE 64 48 80 82 32 24", None, Fault(expected="images named like the views")),
        (
            "PINHOLE 64 40 80 82 32 24",
            "1 1 0 0 0 0 0 2 1 v000.png",
            Fault(expected="the size of the pictures, 32x24"),
        ),
        (
            "PINHOLE 64 48 80 82 32 24",
            "1 nan 0 0 0 0 0 2 1 v000.png",
            Fault("model"),
        ),
        (
            "PINHOLE 64 48 80 82 32 24",
            "1 1 0 0 0 nan 0 2 1 v000.png",
            Fault("model"),
        ),
        (
            "PINHOLE 64 48 nan 82 32 24",
            "1 1 0 0 0 0 0 2 1 v000.png",
            Fault("model"),
        ),
        ("PINHOLE 64 48 -80 -82 32 24", "1 1 0 0 0 0 0 2 1 v000.png", Fault(expected="positive focal")),
    ],
)
def test_models(tmp_path: Path, camera: str, line: str | None, fault: Fault) -> None:
    write_mosaics(tmp_path / "in")
    model = write_model(tmp_path / "model", ("strangers", "elsewhere"), camera)
    if line is not None:
        (model / "images.txt").write_text(line + "\n\n")
    refused(tmp_path / "in", tmp_path / "out", replace(MOSAIC, poses=str(model)), fault)


def test_views_with_blanks_and_umlauts(tmp_path: Path) -> None:
    for view in ("große tasse", "b", "c"):
        write_shots(tmp_path / "täglich neu", view, behind(smooth_light()))
    model = write_model(tmp_path / "model", ("große_tasse", "b", "c"), "PINHOLE 64 48 80 82 32 24")
    for angle in ANGLES:
        folder = tmp_path / "täglich neu" / str(angle)
        (folder / "große tasse.png").rename(folder / "große_tasse.png")
    settings = replace(FILTER, poses=str(model))
    done = prepare_scene(tmp_path / "täglich neu", tmp_path / "die szene", settings)
    assert done.views == ["b", "c", "große_tasse"]
    assert len(load_scene(tmp_path / "die szene").views) == 3


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{", Fault(expected="a JSON file")),
        ("[]", Fault(expected="a JSON object", found="[]")),
        ('{"gain": 1}', Fault(expected="only gains, order, sense, zero", found="gain")),
        ('{"gains": {"0": 1}}', Fault("(gains)", expected="the field 45")),
        ('{"gains": {"0": 1, "45": 1, "90": "x", "135": 1}}', Fault("(gains.90)", "a number", '"x"')),
        ('{"gains": {"0": 1, "45": 1, "90": 0, "135": 1}}', Fault("(gains.90)", "0.5 to 2", "0")),
        ('{"order": [0, 45]}', Fault(expected="a list of length 4")),
        ('{"sense": "left"}', Fault(expected="ccw or cw")),
        ('{"zero": null}', Fault(expected="a number", found="null")),
        ('{"zero": 1e308}', Fault("(zero)", "-3600 to 3600", "1e+308")),
    ],
)
def test_calibration_files(tmp_path: Path, text: str, fault: Fault) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(text)
    fault.raised_by(read_calibration, path)


def test_a_calibration_file(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(
        '{"gains": {"0": 1.01, "45": 0.99, "90": 1, "135": 1}, "order": [90, 45, 0, 135], "zero": 3}'
    )
    expected = Calibration(gains=(1.01, 0.99, 1.0, 1.0), order=(90, 45, 0, 135), zero=3.0)
    assert read_calibration(path) == expected


def test_four_copies_of_one_shot_are_warned_of(tmp_path: Path) -> None:
    said: list[str] = []

    class Heard(Reporter):
        def warn(self, text: str) -> None:
            said.append(text)

    light = behind(smooth_light())
    for view, values in (("v000", light), ("v001", light[[0, 0, 0, 0]]), ("v002", light[[0, 1, 0, 3]])):
        write_shots(tmp_path / "raw", view, values)
    settings = PrepareSettings(poses="none", align=False, transfer="linear")
    prepare_scene(tmp_path / "raw", tmp_path / "out", settings, Heard())
    assert [text.split(" are ")[0] for text in said] == [
        "v001: its four pictures",
        "v002: its pictures at 0 and 90 degrees",
    ]
    assert all("identical" in text for text in said)


def test_pictures_at_other_angles_are_warned_of(tmp_path: Path) -> None:
    write_shots(tmp_path / "raw", "v000", behind(smooth_light()))
    files = sorted(path for path in (tmp_path / "raw").rglob("*") if path.is_file())
    (tmp_path / "one").mkdir()
    for angle, path in zip((0, 135, 45, 90), files, strict=True):
        shutil.copyfile(path, tmp_path / "one" / f"v_{angle}{path.suffix}")
    shutil.copyfile(files[0], tmp_path / "one" / f"v_60{files[0].suffix}")
    settings = PrepareSettings(format="filter", poses="none", align=False, transfer="linear")
    with pytest.warns(PolarguideWarning, match=r"not used \(v_60"):
        prepare_scene(tmp_path / "one", tmp_path / "out", settings, Reporter())
