"""Regions and limits: what they take, what they refuse, and when a figure is beyond."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from faults import Fault

from polarguide.visualization.figures import LINE_HEIGHT
from polarguide_shots.maps import NoiseModel, Reason, ShotMaps
from polarguide_shots.measurement.pictures import _layers, _pixels_beyond, regions_picture
from polarguide_shots.measurement.regions import Differences, Region, parse_regions, placed
from polarguide_shots.measurement.table import Bound, Limits, faults, read_limits


def test_regions_with_and_without_names() -> None:
    assert parse_regions(["1,2,3,4", "left lens=0,0,10,20"]) == (
        Region("roi1", 1, 2, 3, 4),
        Region("left lens", 0, 0, 10, 20),
    )


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "1,2,3,4,5", "a=1,2,3", "1,2,3,x", "=1,2,3,4", "a=1,2,0,4", "-1,2,3,4", "a\nb=1,2,3,4",
             "1.5,2,3,4", "1,2,3,9999999999", f"{'9' * 5000},0,1,1", "٩,0,1,1"],
)  # fmt: skip
def test_regions_that_are_none(text: str) -> None:
    Fault("--roi").raised_by(parse_regions, [text])


def test_two_regions_of_one_name() -> None:
    Fault(found="a twice").raised_by(parse_regions, ["a=1,2,3,4", "a=2,2,3,4"])


def test_a_region_beyond_the_picture() -> None:
    assert placed(parse_regions(["4,0,6,8"]), (10, 8), Path("a.png"))
    Fault("a.png", "the region roi1 within 10x8 pixels", "5,0,6,8").raised_by(
        placed, parse_regions(["5,0,6,8"]), (10, 8), Path("a.png")
    )
    assert placed((), (10, 8), Path("a.png")) == (Region("all", 0, 0, 10, 8),)


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_a_regions_limits_take_the_place_of_those_for_all(tmp_path: Path) -> None:
    content = {
        "limits": {"dolp_mean": {"max": 0.3}, "saturated": {"max": 0}},
        "regions": {"lens": {"dolp_mean": {"min": 0.1}}},
    }
    limits = read_limits(written(tmp_path / "l.json", content), ["lens", "rim"], reference=False)
    assert limits.of("rim") == {"dolp_mean": Bound(max=0.3), "saturated": Bound(max=0)}
    assert limits.of("lens") == {"dolp_mean": Bound(min=0.1), "saturated": Bound(max=0)}


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ({"limits": {"dolp_maen": {"max": 1}}}, Fault(found="dolp_maen", remedy="dolp_mean")),
        ({"limits": {"shot": {"max": 1}}}, Fault(expected="a field of the table")),
        ({"limits": {"dolp_mean": {"maximum": 1}}}, Fault(found="maximum")),
        ({"limits": {"dolp_mean": {"max": "1"}}}, Fault(expected="number")),
        ({"limits": {"dolp_mean": {}}}, Fault(expected="min, max or both")),
        ({"limits": {"dolp_mean": {"min": 2, "max": 1}}}, Fault(expected="a min up to the max")),
        ({"limits": {"aolp_mean": {"min": -400, "max": 900}}}, Fault(expected="angles from 0 to 180")),
        ({"limits": {"s0_difference": {"max": 1}}}, Fault(remedy="--reference")),
        ({"regions": {"nose": {"dolp_mean": {"max": 1}}}}, Fault(found="nose")),
        ({"bounds": {}}, Fault(found="bounds")),
        ({"format": 2, "limits": {"dolp_mean": {"max": 1}}}, Fault("format")),
        ({}, Fault(expected="at least one field")),
        ([], Fault(expected="object")),
    ],
)  # fmt: skip
def test_limits_that_are_wrong(content: object, fault: Fault, tmp_path: Path) -> None:
    path = written(tmp_path / "l.json", content)
    assert str(path) in fault.raised_by(read_limits, path, ["lens"], reference=False).where


def test_what_is_beyond() -> None:
    bounds = {"dolp_mean": Bound(0.1, 0.3)}
    assert faults({"dolp_mean": 0.1}, bounds) == faults({"dolp_mean": 0.3}, bounds) == []
    assert faults({"dolp_mean": 0.31}, bounds) == ["dolp_mean 0.31 over 0.3"]
    assert faults({"dolp_mean": 0.05}, bounds) == ["dolp_mean 0.05 under 0.1"]
    assert faults({"dolp_mean": None}, bounds) == ["dolp_mean has no value"]


def test_angles_may_go_through_180() -> None:
    bounds = {"aolp_mean": Bound(170, 10)}
    assert [bool(faults({"aolp_mean": a}, bounds)) for a in (0, 10, 11, 90, 169, 170, 179.9)] == [
        False, False, True, True, True, False, False,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("field", "bound", "layer"),
    [
        ("dolp_difference_p99", Bound(max=0.05), "dolp_difference"),
        ("dolp_difference", Bound(min=-0.05, max=0.05), "dolp_difference"),
        ("aolp_difference_rms", Bound(max=5.0), "aolp_difference"),
        ("dolp_mean", Bound(min=0.2), "dolp"),
        ("saturated", Bound(max=0), "photograph"),
    ],
)
def test_the_pixels_that_are_beyond_a_limit_are_outlined(field: str, bound: Bound, layer: str) -> None:
    """In the layer in which the part failed: a defect of 9 x 9 pixels in a region, and one outside of it."""
    defect = np.zeros((40, 60), bool)
    defect[10:19, 20:29] = True
    whole = defect.copy()
    whole[30:39, 50:59] = True
    dolp = np.where(whole, 0.1, 0.3).astype(np.float32)
    reason = np.where(whole, Reason.SATURATED if field == "saturated" else Reason.USABLE, Reason.USABLE)
    stokes = np.stack([np.ones_like(dolp), dolp, np.zeros_like(dolp)])
    maps = ShotMaps(
        "part", (), stokes[:, None].repeat(4, 1)[0][..., None], stokes, dolp, dolp, np.zeros_like(dolp),
        dolp, dolp, reason.astype(np.uint8), NoiseModel(1e-6, 0.0, "given"), None,
    )  # fmt: skip
    off = np.where(whole, -0.2, 0.0).astype(np.float32)
    differences = Differences(np.zeros_like(off), off, np.radians(100 * off))
    region = Region("pin", 0, 0, 40, 30)
    limits = Limits(limits={field: bound})
    values = _layers(maps, differences)[layer][2]
    assert (_pixels_beyond(maps, values, region, field, bound) == defect).all()
    picture = regions_picture(maps, [(region, [f"{field} 1 over 0"])], limits, differences)
    yellow = (picture[..., 0] > 240) & (picture[..., 1] > 200) & (picture[..., 2] < 40)
    rows, columns = np.nonzero(yellow)
    scale = picture.shape[1] // 60
    top = int(rows.min() - 10 * scale)
    assert 0 < top < 3 * LINE_HEIGHT, "the layer that failed comes first"
    assert abs(int(columns.min()) - 20 * scale) <= scale
    assert abs(int(columns.max()) - 29 * scale) <= scale
    without = regions_picture(maps, [(region, ["dolp_deviation 1 over 0"])], limits, differences)
    assert not ((without[..., 0] > 240) & (without[..., 1] > 200) & (without[..., 2] < 40)).any()
