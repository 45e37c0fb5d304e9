"""Tables of angles, calibrations of angles, and relative exposures."""

from __future__ import annotations

import dataclasses
import itertools
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault

from polarguide.capture import load_scene
from polarguide.capture.calibration import Calibration, combined, oriented
from polarguide.capture.exposures import FOUR, Exposure, angles_of_names, read_table, table_text
from polarguide.capture.filter.shots import find_single_shots
from polarguide.capture.point_exposures import PointExposures, exposures_of_points
from polarguide.geometry.polarizer import ANGLES, malus, stokes_of_four
from polarguide.inspection.capture import read_capture
from polarguide.preparation.filter_source import reconciled
from tests.helpers.tiny_capture import NAMES, TinyCapture, write_picture, write_tiny_capture


@pytest.fixture
def tiny(tmp_path: Path) -> TinyCapture:
    return write_tiny_capture(tmp_path / "tiny")


def write(tiny: TinyCapture, *lines: str, header: str = "file,view,angle,gain") -> Path:
    path = tiny.root / "angles.csv"
    path.write_text("\n".join((header, *lines)) + "\n")
    return path


def replaced(tiny: TinyCapture, view: str, pictures: dict[str, np.ndarray]) -> None:
    """Other pictures of a view than its four."""
    for path in (tiny.root / "polar").glob(f"{view}_*"):
        path.unlink()
    for name, values in pictures.items():
        write_picture(tiny.root / "polar" / name, values)


def test_a_table_of_the_four_pictures_changes_nothing(tiny: TinyCapture) -> None:
    plain = load_scene(tiny.root)
    write(
        tiny,
        *(f"{name}_{angle:03d}.png,{name},{angle + 180}," for name in NAMES for angle in (135, 0, 90, 45)),
    )
    listed = load_scene(tiny.root)
    assert listed.digest != plain.digest
    for view, other in zip(plain.views, listed.views, strict=True):
        assert view.is_four
        assert other.is_four
        for field in ("codes", "invalid", "saturated"):
            assert torch.equal(getattr(view, field), getattr(other, field))
        assert torch.equal(view.photograph(), other.photograph())
        assert torch.equal(view.stokes(), other.stokes())


def test_any_pictures_of_any_view(tiny: TinyCapture) -> None:
    stokes = np.stack(stokes_of_four(tiny.linear["v001"]))
    at = {f"shot{angle}.png": malus(stokes, math.radians(angle)) for angle in (10, 70, 130)}
    replaced(tiny, "v001", at)
    replaced(tiny, "v002", {"first.png": tiny.linear["v002"].mean(axis=0)})
    replaced(tiny, "v003", {"v003_x.png": tiny.linear["v003"][1], "v003_y.png": tiny.linear["v003"][3] / 2})
    replaced(tiny, "v004", {"lost.png": tiny.linear["v004"][0]})
    write(
        tiny,
        *(f"{name},v001,{angle}" for name, angle in zip(at, (10, 250, -50), strict=True)),
        "first.png, v002, none",
        "v003_x.png,v003,45.0,1",
        "v003_y.png,v003,135,0.5",
        "lost.png,v004,unknown,",
    )
    views = {view.name: view for view in load_scene(tiny.root).views}
    three, plain, pair, lost = (views[f"v00{k}"] for k in (1, 2, 3, 4))
    assert [e.angle for e in three.exposures] == [10, 70, 130]
    assert three.is_determined
    assert np.allclose(three.stokes().numpy(), stokes, atol=5e-5)
    assert plain.exposures == (Exposure(filtered=False),)
    assert plain.measures_radiance
    assert not plain.is_determined
    assert pair.measures_radiance
    assert not pair.is_determined
    assert np.allclose(pair.photograph().numpy(), tiny.linear["v003"][[1, 3]].mean(axis=0), atol=5e-5)
    assert not lost.measures_radiance
    assert lost.exposures == (Exposure(),)
    assert views["v005"].is_four
    Fault("view v003", "pictures that determine a Stokes vector", "45, 135").raised_by(pair.stokes)


def test_the_frame_of_a_filter(tiny: TinyCapture) -> None:
    tiny.write_json("scene.json", {"polarizer": "filter"})
    view = load_scene(tiny.root).views[0]
    assert view.mount == "filter"
    assert not view.is_four
    assert view.is_determined
    four = dataclasses.replace(view, mount="sensor")
    assert not torch.allclose(view.stokes(), four.stokes(), atol=1e-3)
    row, column = view.codes.shape[1] // 2 - 1, view.codes.shape[2] // 2
    assert torch.allclose(view.stokes()[:, row, column], four.stokes()[:, row, column], atol=2e-3)
    tiny.write_json("scene.json", {"polarizer": "lens"})
    Fault("polarizer)", "filter or sensor", '"lens').raised_by(load_scene, tiny.root)


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        (["v000_000.png,v000"], Fault("line 2), v000_000.png", expected="an angle")),
        (["v000_000.png"], Fault("line 2)", expected="4 cells")),
        (["v000_000.png,v000,0,1,2"], Fault("line 2)", expected="4 cells")),
        (
            ["v000_000.png,v000,0", "v000_000.png,v000,45"],
            Fault("line 3)", expected="one line for each file"),
        ),
        (
            ["v000_000.png,v000,fifty"],
            Fault("line 2), v000_000.png", "an angle in degrees up to 3600, unknown or none", '"fifty'),
        ),
        (["v000_000.png,v000,inf"], Fault("line 2), v000_000.png", expected="an angle in degrees")),
        (["v000_000.png,v000,"], Fault("line 2), v000_000.png", expected="an angle in degrees")),
        (["v000_000.png,v000,0,-1"], Fault("line 2), v000_000.png", expected="a gain from 1e-06 to 1e+06")),
        (["v000_000.png,,0"], Fault(expected="the picture of view v000 at 0 degrees")),
        (["../v000_000.png,v000,0"], Fault("line 2)", "a picture in polar/", "../v000")),
        (["", "gone.png,v000,0"], Fault("line 3)", "a picture in polar/", "gone.png")),
    ],
)
def test_each_fault_is_one_line(tiny: TinyCapture, lines: list[str], fault: Fault) -> None:
    write(tiny, *lines)
    caught = fault.raised_by(load_scene, tiny.root)
    assert "angles.csv" in str(caught)


@pytest.mark.parametrize("header", ["file,view", "file,view,angle,angle", "picture,view,angle"])
def test_the_header_is_checked(tiny: TinyCapture, header: str) -> None:
    write(tiny, header=header)
    Fault("line 1)", expected="the header file,angle").raised_by(load_scene, tiny.root)


def test_pictures_that_nothing_names_are_warned_of(tiny: TinyCapture) -> None:
    write_picture(tiny.root / "polar" / "extra.png", tiny.linear["v000"][0])
    write(tiny, "v000_000.png,v000,0")
    assert any(
        "extra.png" in warning and "angles.csv" in warning for warning in load_scene(tiny.root).warnings
    )


def test_a_view_without_all_four_has_to_be_listed(tiny: TinyCapture) -> None:
    tiny.picture("v002", 45).unlink()
    Fault(expected="at 45 degrees", remedy="angles.csv").raised_by(load_scene, tiny.root)
    write(tiny, "v002_000.png,v002,0", header="file,view,angle")
    view = load_scene(tiny.root).view("v002")
    assert sorted(e.angle for e in view.exposures if e.angle is not None) == [0, 90, 135]
    assert view.is_determined


def test_inspection_knows_what_the_pictures_are(tiny: TinyCapture) -> None:
    assert read_capture(tiny.root).four
    replaced(tiny, "v002", {"first.png": tiny.linear["v002"][0]})
    write(tiny, "first.png,v002,0")
    capture = read_capture(tiny.root)
    assert not capture.four
    assert [len(view.codes) for view in capture.views] == [len(view.exposures) for view in capture.views]
    assert next(view for view in capture.views if view.name == "v002").exposures == (Exposure(0.0),)


def test_a_table_that_is_written_can_be_read(tmp_path: Path) -> None:
    exposures = [*FOUR, Exposure(12.34, gain=1.25), Exposure(), Exposure(filtered=False)]
    path = tmp_path / "angles.csv"
    path.write_text(table_text((f"{k}.png", "a", e, 0.5 if k else None, "") for k, e in enumerate(exposures)))
    assert [item.exposure for item in read_table(path)] == exposures


def test_a_column_that_is_not_known_is_refused(tmp_path: Path) -> None:
    """``certainty`` was a column of versions before 0.2."""
    (tmp_path / "angles.csv").write_text("file,view,angle,gain,certainty\na.png,a,10,1.0000,0.90\n")
    Fault("angles.csv", "the header file,angle", "certainty").raised_by(read_table, tmp_path / "angles.csv")


TABLES = {
    "all columns": "file,view,angle,gain,modulation,note\nv001.png,v001,30,2,0.9,doubtful\n",
    "other order": "angle,gain,file,view\n30,2,v001.png,v001\n",
    "spaces, quotes and another end of lines": '\ufefffile, view, angle, gain\r\n"v001.png", v001 , "390", 2\r\n\r\n',
    "upper case": "File,View,Angle,Gain\nv001.png,v001,-150,2\n",
    "no view": "file,angle,gain\nv001.png,30,2\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_one_table_says_the_same_of_a_scene_and_of_photographs(tmp_path: Path, name: str) -> None:
    tiny = write_tiny_capture(tmp_path / "scene")
    replaced(tiny, "v001", {"v001.png": tiny.linear["v001"][0]})
    shots = tmp_path / "shots"
    shots.mkdir()
    shutil.copy(tiny.root / "polar" / "v001.png", shots)
    for folder in (tiny.root, shots):
        (folder / "angles.csv").write_text(TABLES[name])
    assert load_scene(tiny.root).view("v001").exposures == (Exposure(30.0, gain=2.0),)
    (shot,) = find_single_shots(shots)[0]
    assert (shot.path.name, shot.view, shot.gain) == ("v001.png", "v001", 2.0)
    assert isinstance(shot.angle, float)
    assert shot.angle % 180 == 30


@pytest.mark.parametrize(
    "text",
    [
        "file,angle\na.png,3601\n",
        "file,angle,gain\na.png,0,1e7\n",
        'file,angle\n"a.png,0\n',
        "file,angle\n\0,0\n",
    ],
)
def test_a_table_is_refused_for_both_or_for_none(tmp_path: Path, text: str) -> None:
    tiny = write_tiny_capture(tmp_path / "scene")
    (tmp_path / "shots").mkdir()
    shutil.copy(tiny.picture("v000", 0), tmp_path / "shots" / "a.png")
    shutil.copy(tiny.picture("v000", 0), tiny.root / "polar" / "a.png")
    said = []
    for folder, read in ((tiny.root, load_scene), (tmp_path / "shots", find_single_shots)):
        (folder / "angles.csv").write_text(text)
        caught = Fault().raised_by(read, folder)
        said.append((caught.expected, caught.found, caught.remedy))
    assert said[0] == said[1]


def taken(calibration: Calibration) -> np.ndarray:
    """What an instrument of this calibration stores under 0, 45, 90 and 135 of one pixel's light, [4, 1]."""
    sign = -1 if calibration.sense == "cw" else 1
    stokes = (1.0, 0.3, 0.25)
    true = [np.radians(sign * angle + calibration.zero) for angle in calibration.order]
    return np.array([[malus(stokes, angle)] for angle in true], np.float32)


SOME = [
    Calibration(),
    Calibration(sense="cw"),
    Calibration(zero=90),
    Calibration(sense="cw", zero=45),
    Calibration(order=(90, 45, 0, 135)),
    Calibration(order=(45, 0, 90, 135)),
    Calibration(zero=12.0),
    Calibration(sense="cw", zero=-10.0),
]


@pytest.mark.parametrize(("first", "second"), list(itertools.product(SOME, SOME)))
def test_one_calibration_in_place_of_two(first: Calibration, second: Calibration) -> None:
    whole = combined(first, second)
    if whole is None:
        assert not first.permutes  # a pairing found after a turn was no fault of names
        assert sorted(second.order) == sorted(ANGLES) != list(second.order)
        return
    # The stored values are those of an instrument that counts as ``whole`` says: all three ways read the same light.
    stored = taken(whole)
    np.testing.assert_allclose(oriented(stored, whole), taken(Calibration()), atol=1e-6)
    np.testing.assert_allclose(oriented(oriented(stored, first), second), taken(Calibration()), atol=1e-6)


def made(pictures: int, points: int, seed: int, *, share: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Intensities [points, pictures], and the logarithms of the exposures, mean 0."""
    rng = np.random.default_rng(seed)
    logs = rng.normal(0, 0.3, pictures)
    values = rng.uniform(0.05, 0.8, points)[:, None] * np.exp(logs)
    values[rng.uniform(size=values.shape) > share] = np.nan
    return values, logs - logs.mean()


def compared(values: np.ndarray, seed: int = 0) -> PointExposures:
    """Exposures of gray pictures of points that are spread over a cube."""
    places = np.random.default_rng(seed).uniform(-1, 1, (len(values), 3))
    return exposures_of_points(values[..., None], places)


def test_exact_intensities_give_exact_exposures() -> None:
    values, logs = made(12, 300, 0)
    exposures = compared(values)
    found, numbers = exposures.logs[:, 0], exposures.points
    np.testing.assert_allclose(found, logs, atol=1e-6)
    assert (numbers > 100).all()


def test_polarized_and_mirroring_points_are_outvoted() -> None:
    values, logs = made(20, 400, 1)
    rng = np.random.default_rng(2)
    angles = rng.uniform(0, np.pi, 20)
    polarized = values[:160]  # all alike, as the surface of a table
    polarized *= 1 + 0.4 * np.cos(2 * angles)
    values[160:200] *= np.exp(rng.normal(0, 1.0, (40, 20)))
    values *= np.exp(rng.normal(0, 0.02, values.shape))
    found = compared(values).logs[:, 0]
    assert np.abs(found - logs).max() < 0.02
    plain = np.nanmean(np.log(values) - np.nanmean(np.log(values), axis=1, keepdims=True), axis=0)
    assert np.abs(plain - plain.mean() - logs).max() > 0.1


def test_pictures_without_points_in_common_are_not_compared() -> None:
    values, logs = made(9, 300, 3, share=0.9)
    values[:200, 6:] = np.nan  # two groups that nothing links, and one picture that sees next to nothing
    values[200:, :6] = np.nan
    values[10:, 0] = np.nan
    exposures = compared(values)
    found, numbers = exposures.logs[:, 0], exposures.points
    assert np.isnan(found[[0, 6, 7, 8]]).all()
    assert numbers[0] < 20
    np.testing.assert_allclose(found[1:6], logs[1:6] - logs[1:6].mean(), atol=1e-6)
    assert np.isnan(compared(values[:, :1]).logs).all()


def lit_by_reflections(logs: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Intensities [points, pictures, 3] at places, whose parts of space brighten by some percent from view to view."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1, 1, (1500, 3))
    parts = (places > 0) @ [1, 2, 4]
    brighter = rng.normal(0, 0.05, (8, len(logs)))[parts][..., None]
    noise = rng.normal(0, 0.02, (1500, len(logs), 3))
    values = rng.uniform(0.05, 0.8, (1500, 1, 3)) * np.exp(logs + brighter + noise)
    values[rng.uniform(size=values.shape[:2]) > 0.4] = np.nan
    return values, places


@pytest.mark.parametrize("seed", range(4))
def test_equal_exposures_get_no_gain(seed: int) -> None:
    values, places = lit_by_reflections(np.zeros((30, 3)), seed)
    found = exposures_of_points(values, places)
    assert np.abs(found.logs).max() > 0.02
    assert (found.significant == 0).all()
    assert found.gains() == [(1.0, 1.0, 1.0)] * 30


@pytest.mark.parametrize("color", [False, True])
def test_exposures_that_differ_are_found_in_every_channel(color: bool) -> None:
    rng = np.random.default_rng(5)
    logs = np.log(2) * rng.uniform(-0.5, 0.5, (30, 3 if color else 1)) * np.ones(3)
    logs -= logs.mean(axis=0)
    values, places = lit_by_reflections(logs, 6)
    found = exposures_of_points(values, places)
    assert np.abs(found.logs - logs).max() < 0.08
    strong = np.abs(logs).max(axis=1) > 0.25
    assert (found.significant[strong] != 0).all()
    left = np.abs(found.significant - logs)
    assert float(np.sqrt((left**2).mean())) < 0.06 < float(logs.std())


def test_files_are_corrected_a_little_and_only_a_little() -> None:
    rng = np.random.default_rng(4)
    logs = rng.normal(0, 0.2, 60)
    points = logs + rng.normal(0, 0.05, 60) + 3.0
    points[:2] += 0.4  # a reflection that all points are in
    found = reconciled(points, logs, np.zeros(60, bool))
    assert np.abs(found.logs - logs - np.median(found.logs - logs)).max() < 0.03
    assert (found.contradicted, found.scatter) == ((), pytest.approx(0.05, abs=0.025))


def test_a_file_that_is_contradicted_by_far_is_not_believed() -> None:
    rng = np.random.default_rng(5)
    logs = rng.normal(0, 0.2, 20)
    files = logs.copy()
    files[7] -= np.log(4)
    found = reconciled(logs + rng.normal(0, 0.03, 20), files, np.zeros(20, bool))
    assert (found.contradicted, found.logs[7]) == ((7,), pytest.approx(logs[7], abs=0.1))


def test_the_filter_takes_a_share_that_points_tell() -> None:
    """A real filter leaves 0.38, not half: photographs without it are 2.6 times as bright at one exposure."""
    rng = np.random.default_rng(6)
    bare = np.arange(24) % 4 == 0
    files = rng.normal(0, 0.2, 24)
    logs = files + np.where(bare, 0.0, np.log(0.38))
    found = reconciled(logs + rng.normal(0, 0.02, 24), files, bare)
    assert np.abs(found.logs - logs - np.median(found.logs - logs)).max() < 0.03
    ideal = reconciled(np.full(24, np.nan), files, bare)
    np.testing.assert_allclose(ideal.logs, files + np.where(bare, np.log(2), 0))


def test_what_one_source_lacks_the_other_gives() -> None:
    logs = np.linspace(-0.4, 0.4, 9)
    points, files = logs + 1.0, logs.copy()
    points[3], files[5], points[7], files[7] = (np.nan,) * 4
    found = reconciled(points, files, np.zeros(9, bool)).logs
    assert np.isnan(found[7])
    known = np.arange(9) != 7
    np.testing.assert_allclose((found - found[0])[known], (logs - logs[0])[known], atol=1e-9)


@pytest.mark.parametrize(
    ("names", "view"),
    [
        (("v0_I_000", "v0_I_045", "v0_I_090", "v0_I_135"), "v0"),
        (("v0_I_000", "v0_I_060", "v0_I_120"), "v0"),
        (("v0_I_000", "v0_I_045", "v0_I_unknown"), "v0"),
        (("v0_pol_010", "v0_pol_070", "v0_pol_130"), "v0"),
        (("I_000", "I_060", "I_120"), "I"),
    ],
)
def test_a_letter_before_the_angle_is_no_part_of_the_view(names: tuple[str, ...], view: str) -> None:
    read = angles_of_names(names)
    assert all(name is not None and name[0] == view for name in read)
