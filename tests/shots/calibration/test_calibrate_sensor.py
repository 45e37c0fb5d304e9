"""``calibrate_sensor`` on a sensor with made errors: extinction 20 to 300, angles +-2 degrees, gains +-3 %."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from faults import Fault
from made_sensor import (
    MadeSensor,
    dolp_aolp,
    fall_off,
    made_sensor,
    polarizer_light,
    write_codes,
    write_polarizer_shots,
)

from polarguide.capture.sensor.analyzers import AnalyzerCalibration, read_analyzers
from polarguide.core.progress import Reporter
from polarguide_shots.calibration.calibrate import Calibrated, calibrate_sensor
from polarguide_shots.calibration.settings import CalibrateSettings

DEGREES = [float(angle) for angle in range(0, 180, 15)]
DRIFT = list(1 + 0.15 * np.cos(2 * np.radians(np.array(DEGREES) - 25)))
"""Levels of a lamp that is polarized by 15 %."""


class Heard(Reporter):
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        self.said.append(f"warning: {text}")


def calibrated(folder: Path, name: str, reporter: Reporter | None = None, **changes: Any) -> Calibrated:
    settings: dict[str, Any] = {"sensor": name}
    if (folder / "dark.png").exists():
        settings["dark_frame"] = folder / "dark.png"
    settings.update(changes)
    out = folder / f"camera{len(list(folder.glob('*.safetensors')))}.safetensors"
    return calibrate_sensor(folder / "shots", out, CalibrateSettings(**settings), reporter or Reporter())


def errors(
    sensor: MadeSensor, calibration: AnalyzerCalibration | None, dolp: float = 0.1
) -> tuple[float, float]:
    """Mean error of DoLP, and of AoLP in degrees, over the sensor and over light of all angles."""
    wrong, turned = [], []
    for degrees in range(0, 180, 10):
        light = 0.5 * (polarizer_light(degrees) * [1, dolp, dolp])
        seen = sensor.sees(light).astype(np.float32)
        found, angle = dolp_aolp(sensor, seen if calibration is None else calibration.apply(seen))
        off = np.degrees(angle) - degrees
        wrong.append(np.abs(found - dolp).mean())
        turned.append(np.abs((off + 90) % 180 - 90).mean())
    return float(np.mean(wrong)), float(np.mean(turned))


@pytest.mark.parametrize("name", ["IMX250MZR", "IMX250MYR"])
@pytest.mark.parametrize(
    "case", ["unknown angles, flat", "known angles", "unknown angles alone", "five shots"]
)
def test_the_error_of_dolp_falls_at_least_fivefold(tmp_path: Path, name: str, case: str) -> None:
    """Positions with errors that change over the sensor; shots with noise (10,000 electrons) and a black level."""
    sensor = made_sensor(name, (96, 128))
    degrees = [10.0, 40.0, 75.0, 115.0, 150.0] if case == "five shots" else DEGREES
    drift = DRIFT if case in ("unknown angles, flat", "known angles") else None
    write_polarizer_shots(tmp_path, sensor, degrees, levels=drift, level=0.55, electrons=10_000, black=240)
    options: dict[str, Any] = {"flat": tmp_path / "flat.png"} if case == "unknown angles, flat" else {}
    if case in ("known angles", "five shots"):
        options["angles"] = "names"
    done = calibrated(tmp_path, name, **options)
    before, after = (errors(sensor, found) for found in (None, read_analyzers(done.path)))
    assert after[0] < before[0] / 5
    assert done.choice.block == 32
    assert done.shots.misfit < 0.002
    if "angles" in options:
        assert after[1] < 0.6


@pytest.mark.parametrize("name", ["IMX250MZR", "IMX250MYR"])
def test_pixels_that_differ_by_more_than_their_noise_get_vectors_of_their_own(
    tmp_path: Path, name: str
) -> None:
    sensor = made_sensor(name, (64, 96), single=True)
    write_polarizer_shots(tmp_path, sensor, DEGREES, frames=8, electrons=10_000)
    done = calibrated(tmp_path, name, angles="names")
    assert done.choice.block == done.calibration.pattern.period
    assert done.choice.noise < done.choice.scatter
    before, after = (errors(sensor, found) for found in (None, done.calibration))
    assert after[0] < before[0] / 5
    assert after[1] < before[1] / 5
    shared = calibrated(tmp_path, name, angles="names", block=32)
    assert errors(sensor, shared.calibration)[0] > before[0] / 2


def test_what_is_reported_is_what_was_made(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MZR", (96, 128))
    write_polarizer_shots(tmp_path, sensor, DEGREES, levels=DRIFT, level=0.55)
    heard = Heard()
    done = calibrated(tmp_path, "IMX250MZR", heard, angles="names", flat=tmp_path / "flat.png", block=32)
    for position in done.positions:
        made = sensor.vectors[np.isclose(np.degrees(sensor.nominal), position.angle)]
        strength = np.hypot(made[:, 1], made[:, 2])
        ratio = np.median((made[:, 0] + strength) / (made[:, 0] - strength))
        turn = (
            np.degrees(
                np.angle(np.exp(1j * (np.arctan2(made[:, 2], made[:, 1]) - np.radians(2 * position.angle))))
            )
            / 2
        )
        assert np.median(position.extinction) == pytest.approx(ratio, rel=0.03)
        assert np.median(position.angle_error) == pytest.approx(np.median(turn), abs=0.05)
    gains = {p.angle: float(np.median(p.throughput)) for p in done.positions}
    made_gains = {
        a: 2 * sensor.vectors[np.isclose(np.degrees(sensor.nominal), a)][:, 0].mean() for a in gains
    }
    ratio = np.mean(list(gains.values())) / np.mean(list(made_gains.values()))
    assert all(gains[a] == pytest.approx(made_gains[a] * ratio, abs=0.002) for a in gains)
    np.testing.assert_allclose(done.shots.levels, np.array(DRIFT) / np.mean(DRIFT), rtol=1e-3)
    assert done.shots.flat_dolp == pytest.approx(0.0, abs=5e-4)
    text = "\n".join(heard.said)
    for said in (
        "extinction ratio",
        f"varied by {max(DRIFT) / min(DRIFT) - 1:.1%}",
        "flat field",
        "ideal",
    ):
        assert said in text
    picture = cv2.imread(str(done.picture))
    assert picture.shape[0] > 800
    assert picture.std() > 20


def test_unknown_angles_are_found_but_for_their_zero(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MZR", (96, 128))
    write_polarizer_shots(tmp_path, sensor, DEGREES, levels=DRIFT, level=0.55)
    done = calibrated(tmp_path, "IMX250MZR", flat=tmp_path / "flat.png")
    off = np.degrees(done.shots.angles) - DEGREES
    off = (off - off[0] + 90) % 180 - 90
    np.testing.assert_allclose(off, 0, atol=0.05)
    # The gauge: the positions deviate from their names by nothing in the mean.
    vectors = done.calibration.vectors.mean(axis=(0, 1)).reshape(4, 3)
    turn = np.arctan2(vectors[:, 2], vectors[:, 1]) - 2 * np.radians([90, 45, 135, 0])
    assert np.degrees(np.angle(np.exp(1j * turn).mean())) / 2 == pytest.approx(0.0, abs=0.02)
    known = calibrated(tmp_path, "IMX250MZR", angles="names", reference="mean")
    np.testing.assert_allclose(known.calibration.vectors, done.calibration.vectors, atol=2e-3)


def test_the_extinction_of_the_polarizer_is_not_that_of_the_sensor(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MZR", (96, 128))
    write_polarizer_shots(tmp_path, sensor, DEGREES, extinction=30)
    taken_as_ideal = calibrated(tmp_path, "IMX250MZR", angles="names")
    told = calibrated(tmp_path, "IMX250MZR", angles="names", polarizer_extinction=30)
    assert errors(sensor, told.calibration)[0] < 0.001
    assert errors(sensor, taken_as_ideal.calibration)[0] > 0.005


def test_clockwise_angles_and_a_region(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MYR", (96, 128), offset=(3, 5))
    write_polarizer_shots(tmp_path, sensor, DEGREES)
    clockwise = ",".join(f"{-angle:g}" for angle in DEGREES)
    done = calibrated(tmp_path, "IMX250MYR", angles=clockwise, sense="cw", offset_x=3, offset_y=5)
    assert done.calibration.offset == (3, 5)
    inner = MadeSensor(sensor.name, sensor.vectors[1:95, 1:127], sensor.nominal[1:95, 1:127])
    light = np.array([0.5, 0.03, 0.04])
    found, _ = dolp_aolp(inner, done.calibration.apply(sensor.sees(light).astype(np.float32))[1:95, 1:127])
    before, _ = dolp_aolp(inner, inner.sees(light))
    assert np.abs(found - 0.1).mean() < np.abs(before - 0.1).mean() / 5


def test_a_light_that_falls_off_does_not_look_like_polarization(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MZR", (96, 128))
    for degrees in DEGREES:
        seen = fall_off((96, 128), 0.5) * sensor.sees(polarizer_light(degrees, 0.8))
        write_codes(tmp_path / "shots" / f"s_{degrees:g}.png", seen)
    done = calibrated(tmp_path, "IMX250MZR", angles="names")
    assert errors(sensor, done.calibration)[0] < errors(sensor, None)[0] / 5


def test_defects_get_the_vector_of_their_neighborhood(tmp_path: Path) -> None:
    sensor = made_sensor("IMX250MZR", (96, 128))
    broken = sensor.vectors.copy()
    broken[10, 20] = [0.5, 0.02, 0.0]  # no polarizer
    broken[50, 60] = [0.02, 0.02, 0.0]  # dead
    write_polarizer_shots(tmp_path, replace(sensor, vectors=broken), DEGREES)
    done = calibrated(tmp_path, "IMX250MZR", angles="names", block=1)
    assert done.defects == 2
    found = done.calibration.vectors
    for y, x in ((10, 20), (50, 60)):
        np.testing.assert_allclose(found[y // 2, x // 2, y % 2, x % 2], sensor.vectors[y, x], atol=0.03)


def test_the_same_shots_give_the_same_bytes(tmp_path: Path) -> None:
    write_polarizer_shots(tmp_path, made_sensor(size=(64, 64)), DEGREES, electrons=10_000)
    first, second = (calibrated(tmp_path, "IMX250MZR", lens="Ω 12 mm") for _ in range(2))
    assert first.path != second.path
    assert first.path.read_bytes() == second.path.read_bytes()
    assert read_analyzers(first.path).lens == "Ω 12 mm"


def scene(size: tuple[int, int]) -> np.ndarray:
    y, x = np.mgrid[: size[0], : size[1]]
    return 0.3 + 0.7 * ((x // 10 + y // 10) % 2)


def write_at(folder: Path, degrees: list[float], sensor: MadeSensor | None = None, **options: Any) -> None:
    write_polarizer_shots(folder, sensor or made_sensor(size=(64, 64)), degrees, **options)


def saturated(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, level=1.2)
    return {}


def one_angle(folder: Path) -> dict[str, Any]:
    write_at(folder, [30.0] * 6, electrons=10_000)
    return {}


def one_angle_given(folder: Path) -> dict[str, Any]:
    write_at(folder, [30.0] * 6)
    return {"angles": "names"}


def narrow(folder: Path) -> dict[str, Any]:
    write_at(folder, [30.0, 33.0, 36.0, 39.0, 42.0, 45.0])
    return {}


def too_few(folder: Path) -> dict[str, Any]:
    write_at(folder, [0.0, 45.0, 90.0, 135.0])
    return {}


def not_uniform(folder: Path) -> dict[str, Any]:
    sensor = made_sensor(size=(64, 64))
    for degrees in DEGREES:
        seen = scene((64, 64)) * sensor.sees(polarizer_light(degrees, 0.8))
        write_codes(folder / "shots" / f"s_{degrees:g}.png", seen)
    return {}


def bright_dark_frame(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, level=0.2)
    write_codes(folder / "dark.png", np.full((64, 64), 0.6))
    return {}


def other_size(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    write_codes(folder / "shots" / "shot_005_75.png", np.full((64, 80), 0.3))
    return {}


def dark_of_other_size(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    write_codes(folder / "dark.png", np.zeros((32, 64)))
    return {}


def truncated(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    path = folder / "shots" / "shot_005_75.png"
    path.write_bytes(path.read_bytes()[:-200])
    return {}


def no_polarizer(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, extinction=1.5)
    return {}


def swapped(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    return {"angles": ",".join(f"{angle:g}" for angle in sorted(DEGREES, key=lambda a: (a * 7) % 180))}


def other_sense(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    return {"angles": "names", "sense": "cw"}


def other_zero(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    return {"angles": ",".join(f"{angle + 90:g}" for angle in DEGREES)}


def polarized_flat(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    write_codes(folder / "flat.png", made_sensor(size=(64, 64)).sees(np.array([0.8, 0.3, 0.0])))
    return {"flat": folder / "flat.png"}


def polarized_lamp(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, level=0.55, levels=DRIFT)
    return {}


def flickering_lamp(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, level=0.55, levels=[1.0, 1.06] * 6)
    return {}


def count_of_angles(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    return {"angles": "0,15,30,45,60"}


def nameless(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    (folder / "shots" / "shot_005_75.png").rename(folder / "shots" / "shot_last.png")
    return {"angles": "names"}


def color_of_gray(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, made_sensor("IMX250MYR", (128, 128)))
    return {}


def odd_block(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES)
    return {"block": 31}


def faint(folder: Path) -> dict[str, Any]:
    write_at(folder, DEGREES, level=0.02)
    return {}


REFUSED = {
    saturated: ("shot_", Fault(expected="at most 0.1% saturated samples")),
    one_angle: ("shots", Fault(found="6 shots at one angle")),
    one_angle_given: ("--angles", Fault(found="6 shots at one angle")),
    narrow: ("shots", Fault(found="over 15 degrees")),
    too_few: ("shots", Fault(expected="at least 5 shots", found="4 (")),
    not_uniform: ("shots", Fault(expected="a uniform light")),
    bright_dark_frame: ("shot_000", Fault(expected="brighter than the dark frame")),
    other_size: ("shot_005_75", Fault(expected="64x64 pixels of uint16")),
    dark_of_other_size: ("dark.png|shot_000", Fault(found="64x")),
    truncated: ("shot_005_75", Fault()),
    no_polarizer: ("shot_000", Fault(expected="light through a polarizer")),
    swapped: ("--angles", Fault(remedy="in the order of the files' names")),
    other_sense: ("--angles", Fault(remedy="--sense")),
    other_zero: ("--angles", Fault(found="a zero")),
    polarized_flat: ("--flat", Fault(expected="unpolarized light")),
    polarized_lamp: ("shots", Fault(found="the lamp is polarized")),
    flickering_lamp: ("shots", Fault(expected="one steady, unpolarized light")),
    count_of_angles: ("--angles", Fault(expected="each of the 12 shots", found="5 angles")),
    nameless: ("shot_last", Fault(expected="a name that ends in the angle")),
    color_of_gray: ("--sensor", Fault()),
    odd_block: ("--block", Fault(expected="a multiple of 2")),
    faint: ("shot_", Fault(expected="a mean intensity of at least 2%")),
}


@pytest.mark.parametrize("make", REFUSED, ids=lambda make: make.__name__)
def test_wrong_shots_are_refused_with_one_line_and_nothing_is_written(tmp_path: Path, make: Any) -> None:
    where, fault = REFUSED[make]
    error = fault.raised_by(calibrated, tmp_path, "IMX250MZR", **make(tmp_path))
    assert any(part in error.where for part in where.split("|"))
    assert not list(tmp_path.glob("camera*"))


def test_what_exists_is_not_overwritten(tmp_path: Path) -> None:
    write_at(tmp_path, DEGREES)
    (tmp_path / "mine.png").write_bytes(b"a photograph")
    Fault("mine.png", expected="a new file").raised_by(
        calibrate_sensor, tmp_path / "shots", tmp_path / "mine.safetensors", CalibrateSettings("IMX250MZR")
    )
    Fault(expected="ends in .safetensors").raised_by(
        calibrate_sensor, tmp_path / "shots", tmp_path / "mine.json", CalibrateSettings("IMX250MZR")
    )
    assert (tmp_path / "mine.png").read_bytes() == b"a photograph"
    Fault(found="the folder of the shots").raised_by(
        calibrate_sensor,
        tmp_path / "shots",
        tmp_path / "shots" / "new.safetensors",
        CalibrateSettings("IMX250MZR"),
    )
