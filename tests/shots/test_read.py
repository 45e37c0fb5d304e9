"""Find and read exposure sets."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from faults import Fault
from PIL import Image

from polarguide import optics
from polarguide.capture.sensor.pattern import sensor_pattern, tiled
from polarguide.capture.write import write_view
from polarguide.geometry.polarizer import ANGLES, malus
from polarguide_shots.exposures import find_shots
from polarguide_shots.maps import Reason, ShotMaps
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot

SHAPE = (64, 96)
TINT = (0.8, 1.2, 1.0)  # of the filters; their mean is 1


def light(height: int = SHAPE[0], width: int = SHAPE[1]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth Stokes vectors of gray light."""
    y, x = np.mgrid[0:height, 0:width] / 64.0
    s0 = 0.7 + 0.2 * np.sin(2 * x) * np.cos(y)
    degree, angle = 0.3 + 0.2 * np.cos(1.5 * x), 0.4 + 0.8 * y
    return s0, s0 * degree * np.cos(2 * angle), s0 * degree * np.sin(2 * angle)


def write_mosaic(path: Path, sensor: str = "IMX250MZR") -> None:
    angles = tiled(sensor_pattern(sensor).angles, SHAPE)
    values = malus(light(), np.deg2rad(angles))
    colors = sensor_pattern(sensor).colors
    if colors is not None:
        values = values * np.array(TINT)[tiled(colors, SHAPE)]
    assert cv2.imwrite(str(path), np.rint(values * 4095).astype(np.uint16))


def write_four(folder: Path, names: tuple[str, ...]) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in names]
    for path, angle in zip(paths, ANGLES, strict=True):
        path.parent.mkdir(exist_ok=True)
        values = np.rint(malus(light(), math.radians(angle)) * 65535).astype(np.uint16)
        assert cv2.imwrite(str(path), np.repeat(values[..., None], 3, axis=2))
    return paths


PLAIN = ShotOptions(transfer="linear", align=False)
MONO = ShotOptions(sensor="IMX250MZR", bits=12)
CUP = tuple(f"cup_{angle}.png" for angle in ANGLES)


def agrees(maps: ShotMaps, atol: float) -> None:
    s0, s1, s2 = light()
    np.testing.assert_allclose(maps.s0, s0, atol=atol)
    np.testing.assert_allclose(maps.dolp, np.hypot(s1, s2) / s0, atol=atol)
    turn = maps.aolp - np.arctan2(s2, s1) / 2
    assert np.abs(np.sin(turn)).max() < 3 * atol
    assert ((maps.aolp >= 0) & (maps.aolp < np.pi)).all()


@pytest.mark.parametrize("mode", ["full", "half"])
@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
def test_a_mosaic(tmp_path: Path, sensor: str, mode: str) -> None:
    write_mosaic(tmp_path / "part.png", sensor)
    options = ShotOptions(sensor=sensor, bits=12, demosaic=mode)  # type: ignore[arg-type]
    maps = read_shot(tmp_path / "part.png", options)
    assert maps.name == "part"
    assert maps.intensities.shape[-1] == (1 if sensor == "IMX250MZR" else 3)
    if mode == "full":
        inner = np.s_[4:-4, 4:-4]
        s0, s1, s2 = light()
        np.testing.assert_allclose(maps.s0[inner], s0[inner], atol=2e-3)
        np.testing.assert_allclose(maps.dolp[inner], (np.hypot(s1, s2) / s0)[inner], atol=4e-3)
    else:
        assert maps.size == (SHAPE[1] // 2, SHAPE[0] // 2)
    assert maps.usable.mean() > 0.99


@pytest.mark.parametrize("mode", ["full", "half"])
def test_hot_pixels_of_a_mosaic_are_masked(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "part.png"
    write_mosaic(path)
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert read_shot(path, MONO).notes == ()
    values[[20, 31, 40], [30, 51, 70]] = 4000
    assert cv2.imwrite(str(path), values)
    maps = read_shot(path, replace(MONO, demosaic=mode))
    step = SHAPE[0] // maps.size[1]
    masked = maps.reason == Reason.MASKED
    assert masked[[20 // step, 31 // step, 40 // step], [30 // step, 51 // step, 70 // step]].all()
    assert masked.sum() <= 3 * 25
    s0, s1, s2 = (part[::step, ::step] for part in light())
    wrong = np.abs(maps.dolp - np.hypot(s1, s2) / s0) > 0.05
    assert not wrong[~masked].any()
    assert any("3 samples" in note for note in maps.notes)


@pytest.mark.parametrize(
    "names",
    [CUP, ("I0.png", "I45.png", "I90.png", "I135.png"), ("0/cup.png", "45/cup.png", "90/cup.png", "135/cup.png")],
)  # fmt: skip
def test_four_shots_as_files_and_as_a_folder(tmp_path: Path, names: tuple[str, ...]) -> None:
    paths = write_four(tmp_path / "cup", names)
    for given in (paths, [tmp_path / "cup"], [tmp_path]):
        (found,) = find_shots(given)
        assert found.kind == "filter"
        assert found.name == "cup" if given != [tmp_path] or "/" not in names[0] else "cup_cup"
        assert found.files == dict(zip(ANGLES, paths, strict=True))
        agrees(read_shot(found, PLAIN), 1e-4)


def test_a_folder_of_shots_by_suffix(tmp_path: Path) -> None:
    for name in ("cup", "part 7"):
        write_four(tmp_path, tuple(f"{name}_{angle}.png" for angle in ANGLES))
    assert [shot.name for shot in find_shots([tmp_path])] == ["cup", "part 7"]


def test_a_scene_without_poses(tmp_path: Path) -> None:
    codes = np.stack([np.rint(malus(light(), math.radians(a)) * 65535) for a in ANGLES]).astype(np.uint16)
    invalid = np.zeros(SHAPE, bool)
    invalid[10:20, 30:40] = True
    for folder in ("polar", "invalid"):
        (tmp_path / folder).mkdir()
    write_view(tmp_path, "v000", np.repeat(codes[..., None], 3, axis=3), invalid)
    (found,) = find_shots([tmp_path])
    assert (found.kind, found.view) == ("scene", "v000")
    maps = read_shot(found)
    agrees(maps, 1e-4)
    assert (maps.reason == Reason.MASKED).sum() == 100
    assert (maps.reason[10:20, 30:40] == Reason.MASKED).all()


def test_polanalyser_agrees(tmp_path: Path) -> None:
    """Demosaiced and computed by an independent program, which rounds its demosaicing to whole numbers."""
    reference = pytest.importorskip("polanalyser")
    write_mosaic(tmp_path / "a.png")
    raw = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    maps = read_shot(tmp_path / "a.png", MONO)
    theirs = np.stack(reference.demosaicing(raw, reference.COLOR_PolarMono)) / 4095
    assert np.abs(theirs - maps.intensities[..., 0])[:, 2:-2, 2:-2].max() <= 0.5001 / 4095
    stokes = reference.calcStokes(list(maps.intensities[..., 0]), np.deg2rad(ANGLES))
    np.testing.assert_allclose(maps.stokes, np.moveaxis(stokes, -1, 0), atol=1e-5)
    np.testing.assert_allclose(maps.dolp, reference.cvtStokesToDoLP(stokes), atol=1e-5)
    assert np.abs(np.sin(maps.aolp - reference.cvtStokesToAoLP(stokes))).max() < 1e-5


def test_a_region_of_the_sensor_and_a_black_level(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png")
    whole = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "b.png"), (whole[1:, 3:] + 100).astype(np.uint16))
    options = ShotOptions(sensor="IMX250MZR", bits=13, offset_x=3, offset_y=1, black_level=100)
    part = read_shot(tmp_path / "b.png", options)
    full = read_shot(tmp_path / "a.png", MONO)
    np.testing.assert_allclose(part.dolp[4:50, 4:80], full.dolp[5:51, 7:83], atol=1e-4)


def test_a_color_shot_keeps_its_colors_and_its_luminance_tells_the_angle(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png", "IMX250MYR")
    maps = read_shot(tmp_path / "a.png", ShotOptions(sensor="IMX250MYR", bits=12))
    gray = optics.luminance(optics.stokes(maps.intensities))
    np.testing.assert_allclose(maps.stokes, gray, atol=1e-6)
    np.testing.assert_allclose(maps.dolp, optics.dolp(gray), atol=1e-5)


def test_unequal_gains_are_told_and_corrected_on_demand(tmp_path: Path) -> None:
    paths = write_four(tmp_path, CUP)
    for path in (paths[0], paths[2]):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.rint(picture * 0.97).astype(np.uint16))
    plain = read_shot(paths, PLAIN)
    assert any("not corrected" in note for note in plain.notes)
    assert plain.pair_ratio == pytest.approx(0.97, abs=1e-3)
    corrected = read_shot(paths, ShotOptions(transfer="linear", align=False, gains="auto"))
    s0, s1, s2 = light()
    true = np.hypot(s1, s2) / s0
    assert np.abs(corrected.dolp - true).max() < 0.1 * np.abs(plain.dolp - true).max()


class TestWrong:
    def fails(self, fault: Fault, given: list[Path], options: ShotOptions | None = None) -> None:
        def read() -> None:
            for shot in find_shots(given, options):
                read_shot(shot, options)

        fault.raised_by(read)

    def test_three_of_four(self, tmp_path: Path) -> None:
        paths = write_four(tmp_path, CUP)
        missing = Fault(expected="shots of view cup at 0, 45, 90 and 135 degrees", found="none at 90")
        self.fails(missing, [*paths[:2], paths[3]])
        paths[1].unlink()
        self.fails(Fault(found="none at 45"), [tmp_path])

    def test_files_without_angles(self, tmp_path: Path) -> None:
        write_mosaic(tmp_path / "part.png")
        self.fails(
            Fault("part.png", expected="raw mosaics with --sensor, or shots with angles in their names"),
            [tmp_path / "part.png"],
        )
        self.fails(Fault(expected="raw mosaics with --sensor"), [tmp_path])

    def test_no_such_file(self, tmp_path: Path) -> None:
        self.fails(Fault("none.png", expected="a file or folder of shots"), [tmp_path / "none.png"])

    def test_an_empty_folder(self, tmp_path: Path) -> None:
        self.fails(Fault(expected="shots", found="an empty folder"), [tmp_path])

    def test_wrong_sensor(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(0)
        values = np.kron(rng.uniform(600, 2500, (32, 32)), np.ones((8, 8))).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "a.png"), values)
        self.fails(
            Fault(found="no sign of color filters"), [tmp_path / "a.png"], ShotOptions(sensor="IMX250MYR")
        )

    def test_a_file_cut_short(self, tmp_path: Path) -> None:
        write_mosaic(tmp_path / "a.png")
        data = (tmp_path / "a.png").read_bytes()
        (tmp_path / "a.png").write_bytes(data[: len(data) // 2])
        self.fails(Fault(found="a PNG file cut short"), [tmp_path / "a.png"], MONO)

    def test_wrong_depth(self, tmp_path: Path) -> None:
        write_mosaic(tmp_path / "a.png")
        self.fails(
            Fault("a.png (--bits)", expected="values below 256 for 8 bits"),
            [tmp_path / "a.png"],
            ShotOptions(sensor="IMX250MZR", bits=8),
        )

    def test_wrong_size(self, tmp_path: Path) -> None:
        write_mosaic(tmp_path / "a.png")
        options = ShotOptions(sensor="IMX250MZR", width=2448, height=2048)
        self.fails(Fault(expected="2448x2048 pixels"), [tmp_path / "a.png"], options)
        cv2.imwrite(str(tmp_path / "b.png"), np.zeros((2100, 2500), np.uint16))
        self.fails(Fault(expected="at most 2464x2056 pixels"), [tmp_path / "b.png"], MONO)

    def test_two_shots_where_one_is_asked_for(self, tmp_path: Path) -> None:
        for name in "ab":
            write_mosaic(tmp_path / f"{name}.png")
        Fault(expected="one shot", found="2").raised_by(read_shot, tmp_path, MONO)

    def test_two_of_one_name(self, tmp_path: Path) -> None:
        for folder in "ab":
            (tmp_path / folder).mkdir()
            write_mosaic(tmp_path / folder / "part.png")
        found = find_shots([tmp_path / "a" / "part.png", tmp_path / "b" / "part.png"], MONO)
        assert [shot.name for shot in found] == ["a_part", "b_part"]
        shutil.copytree(tmp_path / "a", tmp_path / "c" / "a")
        self.fails(Fault(expected="one shot of each name"), [tmp_path / "a", tmp_path / "c" / "a"], MONO)

    def test_options_out_of_range(self) -> None:
        Fault("--bits", "8 to 16", "20").raised_by(ShotOptions(bits=20).checked)


BITS = {
    "twelve": (4095, {"bits": 12}, 4095),
    "ten": (1023, {"bits": 10}, 1023),
    "saturation": (4095, {"bits": 12, "saturation": 3500}, 4095),
    "unstated": (4095, {}, 65535),
}


@pytest.mark.parametrize("case", sorted(BITS))
@pytest.mark.parametrize("angles", [ANGLES, (0, 30, 60, 90, 120, 150)], ids=["four", "six"])
def test_values_of_fewer_bits_in_16(tmp_path: Path, angles: tuple[int, ...], case: str) -> None:
    """Clipped pixels are saturated. A single shot does not determine the full scale, which is equal in a series."""
    top, given, white = BITS[case]
    stored = [np.minimum(np.rint(1.85 * malus(light(), math.radians(angle)) * top), top) for angle in angles]
    paths = [tmp_path / f"cup_a{angle}.png" for angle in angles]
    for path, values in zip(paths, stored, strict=True):
        assert cv2.imwrite(str(path), np.repeat(values[..., None].astype(np.uint16), 3, axis=2))
    maps = read_shot(paths, replace(PLAIN, **given, align=angles != ANGLES))
    lost = (np.stack(stored) >= given.get("saturation", top)).sum(axis=0)
    assert 0.02 < (lost > 0).mean() < 0.95
    np.testing.assert_allclose(
        maps.s0[lost == 0], 1.85 * light()[0][lost == 0] * top / white, atol=2.5 / white
    )
    if angles == ANGLES:
        np.testing.assert_array_equal(maps.reason == Reason.SATURATED, lost > 0)
    else:
        assert maps.left_out is not None
        assert (maps.left_out >= np.minimum(lost, 1)).mean() > 0.99


@pytest.mark.parametrize("angles", [ANGLES, (0, 30, 60, 90, 120, 150)], ids=["four", "six"])
def test_exposures_that_files_state_are_taken_back(tmp_path: Path, angles: tuple[int, ...]) -> None:
    """One picture has a third of a stop less, and its EXIF data say so."""
    for angle in angles:
        time = 80 if angle == 90 else 100  # one over
        values = np.rint(malus(light(), math.radians(angle)) * 0.8 * 100 / time * 255).astype(np.uint8)
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: 1 / time, 0x829D: 8.0, 0x8827: 100})
        picture = Image.fromarray(np.repeat(values[..., None], 3, axis=2))
        picture.save(tmp_path / f"cup_a{angle}.jpg", quality=100, subsampling=0, exif=exif)
    maps = read_shot(
        [tmp_path / f"cup_a{angle}.jpg" for angle in angles], replace(PLAIN, align=angles != ANGLES)
    )
    s0, s1, s2 = light()
    assert float(np.abs(maps.dolp - np.hypot(s1, s2) / s0).mean()) < 0.01
    assert any("exposures that differ by a factor of 1.25" in note for note in maps.notes)


def test_gains_none_leaves_exposures_that_files_state(tmp_path: Path) -> None:
    paths = []
    for angle in ANGLES:
        time = 80 if angle == 90 else 100
        values = np.full((16, 16, 3), 10000 // time, np.uint8)
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: 1 / time, 0x829D: 8.0, 0x8827: 100})
        paths.append(tmp_path / f"cup_{angle}.jpg")
        Image.fromarray(values).save(paths[-1], quality=100, exif=exif)
    stated, left = (read_shot(paths, replace(PLAIN, gains=gains)) for gains in ("exif", "none"))
    assert stated.dolp.max() < 2e-3
    assert left.dolp == pytest.approx(np.full((16, 16), 25 / 212.5), abs=2e-3)


def test_an_edge_without_a_partner_is_masked(tmp_path: Path) -> None:
    """The camera moved by three pixels before the second shot: dark pixels move along, others leave the picture."""
    rng = np.random.default_rng(4)
    scene = cv2.GaussianBlur(rng.random((128, 168)).astype(np.float32), (0, 0), 2)
    scene = (scene - scene.min()) / np.ptp(scene) * 0.8 + 0.1
    paths = [tmp_path / name for name in CUP]
    for path, shift in zip(paths, (0, 3, 0, 0), strict=True):
        values = np.rint(scene[:, 4 - shift : 164 - shift] * 65535).astype(np.uint16)
        cv2.imwrite(str(path), np.repeat(values[..., None], 3, axis=2))
    maps = read_shot(paths, replace(PLAIN, align=True))
    assert (maps.reason[:, -3:] == Reason.MASKED).all()
    assert not (maps.reason == Reason.SATURATED).any()


@pytest.mark.parametrize("flip", ["x", "y", "xy"])
def test_a_mirrored_mosaic_with_a_gamma(tmp_path: Path, flip: str) -> None:
    values = malus(light(), np.deg2rad(tiled(sensor_pattern("IMX250MZR").angles, SHAPE))) ** 0.8
    stored = np.rint(values * 4095).astype(np.uint16)
    stored = stored[:, ::-1] if "x" in flip else stored
    cv2.imwrite(str(tmp_path / "part.png"), stored[::-1] if "y" in flip else stored)
    maps = read_shot(tmp_path / "part.png", replace(MONO, flip=flip, gamma=0.8, demosaic="full"))
    inner, (s0, s1, s2) = np.s_[4:-4, 4:-4], light()
    np.testing.assert_allclose(maps.s0[inner], s0[inner], atol=3e-3)
    np.testing.assert_allclose(maps.dolp[inner], (np.hypot(s1, s2) / s0)[inner], atol=6e-3)
