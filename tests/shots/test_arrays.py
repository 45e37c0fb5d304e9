"""Shots in memory are those of the same values in files; what is no shot is refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from test_read import CUP, MONO, PLAIN, SHAPE, TINT, light, write_four, write_mosaic

import polarguide
from polarguide.capture.sensor.pattern import sensor_pattern, tiled
from polarguide.geometry.polarizer import malus
from polarguide_shots.maps import ShotMaps
from polarguide_shots.options import MeasureOptions, ShotOptions
from polarguide_shots.read import read_shot

ROI = MeasureOptions(roi=("pin=8,8,16,12", "rim=40,20,20,20"))


def read(path: Path) -> np.ndarray:
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return values if values.ndim == 2 else values[..., ::-1].copy()


def same(made: ShotMaps, filed: ShotMaps) -> None:
    """All of it, to the bit; a shot in memory has a name of its own, no files, and its pictures no names."""
    for field in fields(ShotMaps):
        one, other = getattr(made, field.name), getattr(filed, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other, err_msg=field.name)
        elif field.name not in ("name", "files", "pictures", "notes"):
            assert one == other, field.name


@pytest.mark.parametrize("change", [lambda a: a, torch.from_numpy], ids=["numpy", "torch"])
@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
def test_a_mosaic(tmp_path: Path, sensor: str, change: Callable[[np.ndarray], Any]) -> None:
    write_mosaic(tmp_path / "part.png", sensor)
    values = read(tmp_path / "part.png")
    kept = values.copy()
    options = replace(MONO, sensor=sensor)  # type: ignore[arg-type]
    filed, made = read_shot(tmp_path / "part.png", options), read_shot(change(values), options)
    same(made, filed)
    usable = f"{float(made.usable.mean()):.1%} usable"
    assert repr(made).startswith(f"<ShotMaps array: {made.size[0]}x{made.size[1]} pixels\n {usable}, ")
    assert (made.name, made.files, made.notes) == ("array", (), filed.notes)
    np.testing.assert_array_equal(values, kept)


def test_four_pictures_as_stored_gray_and_in_a_list(tmp_path: Path) -> None:
    stack = np.stack([read(path) for path in write_four(tmp_path, CUP)])
    for options in (PLAIN, replace(PLAIN, align=True, transfer="auto", gains="auto", bits=16)):
        filed = read_shot(tmp_path, options)
        for pictures in (stack, stack[..., 0], list(stack), torch.from_numpy(stack)):
            same(read_shot(pictures, options), filed)
        same(read_shot(stack[[1, 3, 0, 2]], options, angles=(45, -45, 0, 90)), filed)


def test_floats_are_linear(tmp_path: Path) -> None:
    stack = np.stack([read(path) for path in write_four(tmp_path, CUP)])
    same(
        read_shot(stack.astype(np.float32) / 65535, replace(PLAIN, transfer="linear")),
        read_shot(tmp_path, PLAIN),
    )


def test_other_angles(tmp_path: Path) -> None:
    angles = (0, 36, 72, 108, 144)
    for angle in angles:
        values = np.rint(malus(light(), np.deg2rad(angle)) * 65535).astype(np.uint16)
        assert cv2.imwrite(str(tmp_path / f"cup_a{angle}.png"), np.repeat(values[..., None], 3, axis=2))
    stack = np.stack([read(tmp_path / f"cup_a{angle}.png") for angle in angles])
    options = ShotOptions(transfer="linear")
    made = read_shot(stack, options, angles=angles)
    same(made, read_shot(tmp_path, options))
    assert [picture.angle for picture in made.pictures] == list(angles)
    left = read_shot(np.concatenate((stack, stack[:1])), options, angles=(*angles, "unknown"))
    same(left, made)
    assert left.notes[-1].startswith("1 pictures without a known angle")


MOSAIC = np.full(SHAPE, 900, np.uint16)


@pytest.mark.parametrize(
    ("array", "options", "angles", "found"),
    [
        (MOSAIC, PLAIN, None, "uint16 of shape [64, 96]"),
        (MOSAIC.astype(np.float32), MONO, None, "float32 of shape [64, 96]"),
        (np.stack([MOSAIC] * 4), MONO, None, "uint16 of shape [4, 64, 96]"),
        (MOSAIC[:8], MONO, None, "96x8"),
        (MOSAIC, replace(MONO, width=100), None, "96x64"),
        (np.stack([MOSAIC] * 3), PLAIN, None, "4"),
        (np.stack([MOSAIC] * 4).astype(np.int32), PLAIN, None, "int32 of shape [4, 64, 96, 1]"),
        (np.full((4, *SHAPE, 3), 2.0), PLAIN, None, "2 to 2"),
        (np.full((4, *SHAPE), 0.5), replace(PLAIN, transfer="srgb"), None, "float64 of shape [4, 64, 96]"),
        (np.stack([MOSAIC] * 3), PLAIN, (0, 5, 10), "0.0036 (0, 5, 10)"),
        ([MOSAIC, MOSAIC[:8]], PLAIN, None, "uint16 of shape [64, 96] and uint16 of shape [8, 96]"),
    ],
)
def test_what_is_no_shot_is_refused(array: Any, options: ShotOptions, angles: Any, found: str) -> None:
    Fault("array", found=found).raised_by(
        read_shot, array, options, **{} if angles is None else {"angles": angles}
    )


def test_measuring_without_files_is_measuring_files(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "part.png")
    filed = polarguide.measure([tmp_path / "part.png"], tmp_path / "out", ROI, MONO)
    table = (tmp_path / "out" / "table.csv").read_text().splitlines()
    values = read(tmp_path / "part.png")
    heard: list[str] = []
    for shots in ([values, values], (values for _ in range(2)), {"a": values, "b": values}):
        outcome = polarguide.measure(shots, options=ROI, reading=MONO, heard=lambda e: heard.append(e.shot))
        assert (outcome.folder, outcome.counts, outcome.exit_status) == (None, {"measured": 2}, 0)
        assert [row["region"] for row in outcome.rows] == ["pin", "rim"] * 2
        names = table[0].split(",")
        for row, line in zip(outcome.rows, table[1:], strict=False):
            stated = dict(zip(names, line.split(","), strict=True))
            assert float(stated["dolp_mean"]) == pytest.approx(row["dolp_mean"], rel=1e-6)
            assert (row["files"], row["taken"]) == ("", "")
    assert heard == ["array-1", "array-2"] * 2 + ["a", "b"]
    assert filed.entries == ()
    again = polarguide.measure([values], tmp_path / "out", ROI, MONO)
    assert again.counts == {"measured": 1}
    assert len((tmp_path / "out" / "table.csv").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    ("shots", "found"),
    [
        (MOSAIC, "one array"),
        ([MOSAIC, "part.png"], "both, or neither"),
        ((x for x in "ab"), "str"),
        ([], "none"),
    ],
)
def test_what_is_not_measured(shots: Any, found: str) -> None:
    Fault(found=found).raised_by(polarguide.measure, shots, reading=MONO)


def test_a_region_beyond_an_array_is_in_its_line() -> None:
    outcome = polarguide.measure([MOSAIC], options=MeasureOptions(roi=("1,1,500,5",)), reading=MONO)
    assert (outcome.exit_status, outcome.rows[0]["status"]) == (2, "unread")
    assert str(outcome.rows[0]["why"]).startswith("array-1: expected the region roi1 within 96x64 pixels")


@pytest.mark.parametrize("mode", ["full", "half", "quarter"])
@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
def test_regions_alone_are_what_the_whole_picture_says(sensor: str, mode: str) -> None:
    """With the noise of the sensor given; the rest of a large mosaic is not developed."""
    height, width = 400, 480
    angles = tiled(sensor_pattern(sensor).angles, (height, width))
    values = malus(light(height, width), np.deg2rad(angles)) * 3000
    if (colors := sensor_pattern(sensor).colors) is not None:
        values = values * np.array(TINT)[tiled(colors, (height, width))]
    frame = np.rint(np.random.default_rng(0).normal(values, np.sqrt(values))).astype(np.uint16)
    options = replace(MONO, sensor=sensor, demosaic=mode, full_well=4000.0)  # type: ignore[arg-type]
    step = {"full": 1, "half": 2, "quarter": 4}[mode]
    box = (203 // step, 98 // step, 70 // step, 90 // step)
    part, whole = read_shot(frame, options, part=box), read_shot(frame, options)
    assert part.whole == whole.size == (width // step, height // step)
    assert part.reason.size < 0.5 * whole.reason.size
    x, y = box[0] - part.origin[0], box[1] - part.origin[1]
    assert min(x, y) >= 0
    for name in ("s0", "dolp", "aolp", "sigma_dolp", "reason"):
        expected = getattr(whole, name)[box[1] : box[1] + box[3], box[0] : box[0] + box[2]]
        found = getattr(part, name)[y : y + box[3], x : x + box[2]]
        np.testing.assert_array_equal(found, expected, err_msg=name)
    roi = ",".join(map(str, box))
    alone, beside = (
        polarguide.measure([frame], options=MeasureOptions(roi=regions), reading=options).rows[0]
        for regions in ((roi,), (roi, f"all=0,0,{width // step},{height // step}"))
    )
    assert alone == beside


def below_the_caption(drawn: np.ndarray) -> int:
    """First row of the picture below its caption, which is white at the right end."""
    return int(np.flatnonzero((drawn[:, -1] != 255).any(axis=-1))[0])


def test_a_shot_beyond_a_limit_is_drawn_whole(tmp_path: Path) -> None:
    frame = np.full((400, 480), 900, np.uint16)
    (tmp_path / "limits.json").write_text('{"limits": {"s0_mean": {"max": 0.1}}}')
    options = MeasureOptions(roi=("pin=200,100,40,40",), limits=tmp_path / "limits.json")
    outcome = polarguide.measure([frame], tmp_path / "out", options, MONO)
    assert outcome.exit_status == 3
    picture = cv2.imread(str(tmp_path / "out" / "beyond" / "array-1.png"))
    assert picture.shape[1] == 960
    # The region in red where it is in the whole picture, twice as large.
    red = (picture[..., 2] > 200) & (picture[..., 1] < 60)
    rows, columns = np.nonzero(red[below_the_caption(picture) :][: 2 * 400])
    assert abs(columns.min() - 400) <= 6
    assert abs(columns.max() - 480) <= 6
    assert abs(rows.max() - 280) <= 6


def test_a_polygon_counts_pixels_whose_centers_it_holds(tmp_path: Path) -> None:
    """A triangle of half a square, beside the square; an hourglass, whose waist is crossed."""
    values = np.full((64, 96), 500, np.uint16)
    values[16:48, 16:48][np.tri(32, dtype=bool)] = 1500
    options = MeasureOptions(
        roi=("square=16,16,32,32", "low=16,16;48,48;16,48", "glass=16,16;48,16;16,48;48,48")
    )
    rows = polarguide.measure([values], options=options, reading=replace(MONO, demosaic="full")).rows
    square, low, glass = rows
    assert [row["pixels"] for row in rows] == [1024, 496, 512]
    assert (low["x"], low["y"], low["width"], low["height"]) == (16, 16, 32, 32)
    assert glass["usable"] + glass["noise"] + glass["dark"] + glass["saturated"] + glass["masked"] == 512
    assert float(low["s0_mean"]) == pytest.approx(2 * 1500 / 4095, rel=0.03)  # type: ignore[arg-type]
    assert float(square["s0_mean"]) < 0.8 * float(low["s0_mean"])  # type: ignore[arg-type]
    (tmp_path / "limits.json").write_text('{"limits": {"s0_mean": {"max": 0.1}}}')
    limited = replace(options, limits=tmp_path / "limits.json")
    assert polarguide.measure([values], tmp_path / "out", limited, MONO).exit_status == 3
    drawn = cv2.imread(str(tmp_path / "out" / "beyond" / "array-1.png"))
    scale = drawn.shape[1] // 96
    place = 32 * scale
    assert (
        drawn[below_the_caption(drawn) + place, place] == (32, 32, 255)
    ).all()  # on the triangle's long side


@pytest.mark.parametrize("roi", ["1,1;5,5", "a=1,1;9,1;5,1", "1,1;5,5;-1,3", "1,1;5,5;1.5,3", "=1,1;5,5;1,5"])
def test_what_is_no_polygon_is_refused(roi: str) -> None:
    Fault("--roi").raised_by(polarguide.measure, [MOSAIC], options=MeasureOptions(roi=(roi,)), reading=MONO)


@pytest.mark.parametrize("mode", ["full", "half", "quarter"])
@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
def test_means_scatter_by_their_standard_errors(sensor: str, mode: str) -> None:
    """Forty frames of one thing: the spread of the means, over the mean of what the table states."""
    shape, step = (64, 96), {"full": 1, "half": 2, "quarter": 4}[mode]
    values = malus(light(*shape), np.deg2rad(tiled(sensor_pattern(sensor).angles, shape))) * 3000
    if (colors := sensor_pattern(sensor).colors) is not None:
        values = values * np.array(TINT)[tiled(colors, shape)]
    random = np.random.default_rng(1)
    frames = (np.rint(random.normal(values, np.sqrt(values))).astype(np.uint16) for _ in range(40))
    options = replace(MONO, sensor=sensor, demosaic=mode, full_well=4095.0)  # type: ignore[arg-type]
    roi = ",".join(str(n // step) for n in (16, 16, 64, 32))
    rows = polarguide.measure(frames, options=MeasureOptions(roi=(roi,)), reading=options).rows
    for key in ("s0", "dolp", "aolp"):
        means, errors = (
            np.array([row[f"{key}_{what}"] for row in rows], float) for what in ("mean", "error")
        )
        assert 0.7 < means.std() / errors.mean() < 1.4, key  # of 40, within three standard deviations
