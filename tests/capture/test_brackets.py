"""Exposure brackets: names, merging, and the four clients that develop camera files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch
from bracketed import (
    SENSOR,
    SIZE,
    STOPS,
    bright_light,
    write_bracket,
    write_bracketed_shots,
    write_table,
)
from faults import Fault
from PIL import Image

from polarguide.capture.brackets import Bracket, Radiance, measure_exposures
from polarguide.capture.brackets import merge as merge_measured
from polarguide.capture.develop import light_of_files
from polarguide.capture.formats.pictures import linear_codes
from polarguide.capture.layout import SHARE, exposure_name, find_layout, list_shot_files
from polarguide.capture.point_exposures import PointSamples
from polarguide.capture.view_reader import StoredViews, ViewData, read_view
from polarguide.core.progress import Reporter
from polarguide.geometry.polarizer import ANGLES, malus
from polarguide.inspection.capture import read_capture
from polarguide.inspection.inspect import measure_view
from polarguide.inspection.picture_checks import light_checks
from polarguide.preparation import filter_source
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide.preparation.source import ExposureRecord
from polarguide_shots.exposures import find_shots
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot
from polarguide_synth.sensor import noisy
from polarguide_synth.settings import SynthSettings

MOSAIC = PrepareSettings(sensor="IMX250MZR", black_level=64, bits=12, poses="none", gains="none")
SHOTS = PrepareSettings(transfer="linear", poses="none", gains="none")
OPTIONS = ShotOptions(sensor="IMX250MZR", black_level=64, bits=12, gains="none")


class Notes(Reporter):
    """Reporter that keeps what it is told."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def say(self, text: str) -> None:
        self.notes.append(text)


def prepared(root: Path, settings: PrepareSettings) -> tuple[ViewData, list[str]]:
    """Prepare a capture, and read its first view."""
    notes = Notes()
    scene = root.parent / "scene"
    names = prepare_scene(root, scene, settings, notes).views
    return read_view(find_layout(scene), names[0], factor=1, transfer="linear"), notes.notes


def s0_of(data: ViewData) -> np.ndarray:
    return data.codes.astype(np.float64).sum(axis=0) / 2 / 65535


def halved(picture: np.ndarray) -> np.ndarray:
    height, width = SIZE
    return picture.reshape(height // 2, 2, width // 2, 2, -1).mean(axis=(1, 3))


def linear(exposure: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return exposure


def stack(stops: tuple[float, ...], seed: int = 0) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the true radiance, and noisy exposures of it that clip at 1."""
    random = np.random.default_rng(seed)
    truth = bright_light()[0, ..., 0] / 2
    values = [noisy(truth * 2.0**stop, 1.0, random, SENSOR) for stop in stops]
    return truth, [(np.minimum(v, 1).astype(np.float32), np.asarray(v >= 1)) for v in values]


def merge(files: Bracket, exposures: list[tuple[np.ndarray, np.ndarray]]) -> Radiance:
    return merge_measured(exposures, linear, measure_exposures(files, exposures, linear))


def bracket(stops: tuple[float, ...] | None, count: int = 3) -> Bracket:
    return Bracket(tuple((Path(f"e{k}.png"),) for k in range(count)), stops)


@pytest.mark.parametrize(
    ("name", "shot", "stops"),
    [
        ("cup_45_ev-3.jpg", "cup_45", -3.0),
        ("cup-EV+1.5.png", "cup", 1.5),
        ("v01_ev0.png", "v01", 0.0),
        ("v01_bracket2.png", "v01", None),
        ("v01_bracket12.png", "v01", None),
        ("steel_bracket_000.png", "steel_bracket_000", None),
        ("steel_bracket_5.png", "steel_bracket_5", None),
        ("steel-bracket045.png", "steel-bracket045", None),
        ("v01.png", "v01", None),
        ("eve.png", "eve", None),
        ("ev3.png", "ev3", None),
    ],
)
def test_names_state_shots_and_exposures(name: str, shot: str, stops: float | None, tmp_path: Path) -> None:
    found = exposure_name(tmp_path / name)
    assert (found.shot, found.stops) == (shot, stops)


def test_merged_radiance_agrees_with_the_truth_within_its_noise() -> None:
    truth, exposures = stack(STOPS)
    merged = merge(bracket(STOPS), exposures)
    assert not merged.clipped.any()
    light = np.exp2(STOPS)[:, None, None]
    clear = np.stack([~clipped for _, clipped in exposures])
    # Inverse variances of the exposures that do not clip, in units of full scale.
    inverse = clear * light**2 / ((truth * light + 2.4**2 / 10500) / 10500)
    z = (merged.values - truth) * np.sqrt(inverse.sum(axis=0))
    assert abs(z.mean()) < 0.1
    assert 0.95 < z.std() < 1.1
    # No exposure alone measures the lamp and the dark surface as well.
    assert truth.max() > 15
    assert exposures[0][1].mean() > 0.02


def test_the_weights_are_better_than_any_single_exposure() -> None:
    truth, exposures = stack((0.0, -1.0))
    merged = merge(bracket((0.0, -1.0), 2), exposures)
    both = ~exposures[0][1] & ~exposures[1][1]
    error = np.std((merged.values - truth)[both])
    single = min(np.std((v / 2.0**s - truth)[both]) for (v, _), s in zip(exposures, (0, -1), strict=True))
    assert error < 0.9 * single


def test_samples_that_always_clip_are_marked_and_keep_a_lower_bound() -> None:
    _truth, exposures = stack((0.0, -2.0))
    merged = merge(bracket((0.0, -2.0), 2), exposures)
    assert np.array_equal(merged.clipped, exposures[0][1] & exposures[1][1])
    assert merged.clipped.any()
    np.testing.assert_allclose(merged.values[merged.clipped], 4.0, rtol=0.01)


@pytest.mark.parametrize("stated", [None, (0.0, -2.95, -6.0)])
def test_ratios_are_measured_where_exposures_overlap(stated: tuple[float, ...] | None) -> None:
    truth, exposures = stack((0.0, -3.04, -5.98))
    merged = merge(bracket(stated), exposures)
    np.testing.assert_allclose(merged.exposures.stops, (0.0, -3.04, -5.98), atol=0.02)
    assert merged.exposures.fitted == (stated is None)
    lamp = truth > 4
    assert merged.values[lamp].sum() == pytest.approx(truth[lamp].sum(), rel=0.02)


def test_unstated_exposures_may_be_in_any_order() -> None:
    truth, exposures = stack((-6.0, 0.0, -3.0))
    merged = merge(bracket(None), exposures)
    np.testing.assert_allclose(merged.exposures.stops, (-6.0, 0.0, -3.0), atol=0.02)
    np.testing.assert_allclose(merged.values.sum(), truth.sum(), rtol=0.02)


def test_the_normal_exposure_defines_full_scale() -> None:
    truth, exposures = stack((2.0, 0.0, -3.0, -6.0))
    merged = merge(bracket((2.0, 0.0, -3.0, -6.0), 4), exposures)
    np.testing.assert_allclose(merged.values.sum(), truth.sum(), rtol=0.02)


@pytest.mark.parametrize(
    ("actual", "named"),
    [((0.0, -2.0, -6.0), "e1.png"), ((0.0, -3.0, -5.0), "e2.png"), ((1.0, -3.0, -6.0), "e0.png")],
)
def test_a_mislabeled_exposure_is_named(actual: tuple[float, ...], named: str) -> None:
    _, exposures = stack(actual)
    Fault(named, "as stated", "in the pictures").raised_by(merge, bracket(STOPS), exposures)


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_moved_exposure_is_named(moved: int) -> None:
    _, exposures = stack(STOPS)
    random = np.random.default_rng(5)
    values = noisy(bright_light(shift=6)[0, ..., 0] / 2 * 2.0 ** STOPS[moved], 1.0, random, SENSOR)
    exposures[moved] = np.minimum(values, 1).astype(np.float32), np.asarray(values >= 1)
    Fault(f"e{moved}.png", "same scene", "beyond noise").raised_by(merge, bracket(STOPS), exposures)


def test_exposures_without_overlap_are_refused() -> None:
    _, exposures = stack((0.0, -11.0))
    Fault("e1.png", "overlaps with e0.png").raised_by(merge, bracket((0.0, -11.0), 2), exposures)


def test_mosaics_are_prepared_as_radiance(tmp_path: Path) -> None:
    for view in "ab":
        write_bracket(tmp_path / "raw", view, seed=ord(view))
    data, notes = prepared(tmp_path / "raw", MOSAIC)
    assert any("2 views have 3 exposures, which are merged: +0.00, -3.0" in note for note in notes)
    assert not any("not stated" in note for note in notes)
    assert data.is_radiance
    assert not data.invalid.any()
    truth = halved(bright_light()[0].mean(-1))[..., 0]
    ratio = s0_of(data)[..., 0] / truth
    assert np.median(ratio) == pytest.approx(1, abs=0.005)
    assert np.percentile(np.abs(ratio - 1), 95) < 0.07
    assert s0_of(data)[truth > 5].sum() / 3 == pytest.approx(truth[truth > 5].sum(), rel=0.01)
    (picture,) = tmp_path.glob("scene/polar/a_000.tif")
    assert tifffile.imread(picture).dtype == np.float32
    record = json.loads((tmp_path / "scene" / "scene.json").read_text())
    np.testing.assert_allclose(record["prepare"]["views"]["a"]["stops"], STOPS, atol=0.02)
    # The same call finds a complete scene, and a changed exposure a different capture.
    assert not prepare_scene(tmp_path / "raw", tmp_path / "scene", MOSAIC).new
    (tmp_path / "raw" / "b_ev-6.png").unlink()
    Fault("scene", "b_ev-6.png").raised_by(prepare_scene, tmp_path / "raw", tmp_path / "scene", MOSAIC)


def test_one_exposure_is_prepared_as_before(tmp_path: Path) -> None:
    for name in ("v_ev0", "v"):
        (path,) = write_bracket(tmp_path / name / "raw", "v", stops=(0.0,))
        path.rename(path.with_name(f"{name}.png"))
        prepare_scene(tmp_path / name / "raw", tmp_path / name / "scene", MOSAIC)
    named, plain = ((tmp_path / name / "scene" / "polar") for name in ("v_ev0", "v"))
    assert [p.name for p in sorted(named.iterdir())] == [f"v_{a:03d}.png" for a in ANGLES]
    assert all((named / p.name).read_bytes() == p.read_bytes() for p in plain.iterdir())


def test_calibrated_gains_apply_to_merged_mosaics(tmp_path: Path) -> None:
    write_bracket(tmp_path / "raw", "v")
    gains = replace(MOSAIC.calibration, gains=(1.0, 0.5, 1.0, 1.0))
    data, _ = prepared(tmp_path / "raw", replace(MOSAIC, calibration=gains))
    shares = data.codes.sum(axis=(1, 2, 3)) / 65535
    truth = [halved(malus(bright_light(), np.radians(a))).sum() for a in ANGLES]
    np.testing.assert_allclose(shares / truth, np.array([0.5, 1.0, 0.5, 0.5]), rtol=0.01)


@pytest.mark.parametrize("names", [None, ("bracket1", "bracket2", "bracket3")])
def test_shots_through_a_filter_are_prepared_as_radiance(
    tmp_path: Path, names: tuple[str, ...] | None
) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup", names=names)
    data, notes = prepared(tmp_path / "shots", SHOTS)
    assert any("not stated for 1 views, and fitted" in note for note in notes) == (names is not None)
    truth = bright_light()[0]
    np.testing.assert_allclose(s0_of(data)[truth > 5].sum(), truth[truth > 5].sum(), rtol=0.01)
    np.testing.assert_allclose(np.median(s0_of(data) / truth), 1, atol=0.005)


def test_jpeg_shots_with_exposure_times(tmp_path: Path) -> None:
    names = ("bracket1", "bracket2", "bracket3")
    write_bracketed_shots(tmp_path / "shots", "cup", names=names, suffix=".jpg", seconds=0.5)
    data, notes = prepared(tmp_path / "shots", replace(SHOTS, transfer="srgb"))
    assert not any("not stated" in note for note in notes)
    truth = bright_light()[0]
    np.testing.assert_allclose(s0_of(data)[truth > 5].sum(), truth[truth > 5].sum(), rtol=0.05)


def test_a_wrong_exposure_time_is_refused(tmp_path: Path) -> None:
    names = ("bracket1", "bracket2")
    write_bracketed_shots(
        tmp_path / "shots", "cup", (0, -3), names=names, suffix=".jpg", angles=(0,), seconds=1
    )
    other = write_bracketed_shots(tmp_path / "other", "cup", (-2,), names=("x",), suffix=".jpg", angles=(0,))
    target = tmp_path / "shots" / "cup_0_bracket2.jpg"
    with Image.open(target) as stated, Image.open(other[0]) as brighter:
        brighter.save(tmp_path / "new.jpg", quality=95, exif=stated.getexif())
    (tmp_path / "new.jpg").replace(target)
    settings = replace(SHOTS, transfer="srgb", format="singles")
    Fault("cup_0_bracket2.jpg", "-3.00 stops", "-2.").raised_by(prepared, tmp_path / "shots", settings)


def test_single_shots_are_prepared_as_radiance(tmp_path: Path) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup", angles=(30,))
    write_bracketed_shots(tmp_path / "shots", "jar", angles=(75,))
    data, _ = prepared(tmp_path / "shots", SHOTS)
    assert data.is_radiance
    assert len(data.codes) == 1
    truth = malus(bright_light(), np.radians(30))
    np.testing.assert_allclose(data.codes[0].sum() / 65535, truth.sum(), rtol=0.01)
    assert (tmp_path / "scene" / "angles.csv").read_text().count(".tif") == 2


def test_a_table_names_shots_and_exposures(tmp_path: Path) -> None:
    names = ("IMG_1", "IMG_2", "IMG_3")
    write_bracket(tmp_path / "raw", "x", names=names)
    write_table(tmp_path / "raw", ["x_IMG_1.png,part,0", "x_IMG_2.png,part,", "x_IMG_3.png,part,-6"])
    data, notes = prepared(tmp_path / "raw", MOSAIC)
    assert data.name == "part"
    assert data.is_radiance
    assert any("not stated for 1 views" in note for note in notes)


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ("file,shot\na.png,a\n", Fault("(line 1)", "file,shot,stops")),
        ("", Fault("(line 1)", "", "an empty file")),
        ("file,shot,stops\na.png,,0\n", Fault("(line 2)", "name of its shot")),
        ("file,shot,stops\na.png,a,x\n", Fault("(line 2)", "stops up to 20")),
        ("file,shot,stops\na.png,a,99\n", Fault("(line 2)", "stops up to 20")),
        ("file,shot,stops\na.png,a,0\na.png,b,0\n", Fault("(line 3)", "listed once")),
        ("file,shot,stops\na.png,a,0\nb.png,a,-3\n", Fault("(line 3)", "b.png", "nothing with this name")),
    ],
)
def test_tables_that_are_refused(tmp_path: Path, rows: str, fault: Fault) -> None:
    (tmp_path / "exposures.csv").write_text(rows)
    (tmp_path / "a.png").touch()
    fault.raised_by(list_shot_files, tmp_path, (".png",))


def test_a_missing_file_of_the_table_may_arrive_and_disappear(tmp_path: Path) -> None:
    write_table(tmp_path, ["a.png,shot,0", "b.png,shot,-3"])
    missing = Fault("(line 3)", "b.png", "nothing with this name")
    (tmp_path / "a.png").touch()
    missing.raised_by(list_shot_files, tmp_path, (".png",))
    (tmp_path / "b.png").touch()
    assert list_shot_files(tmp_path, (".png",)) == [tmp_path / "a.png"]
    (tmp_path / "b.png").unlink()
    missing.raised_by(list_shot_files, tmp_path, (".png",))


def test_objects_named_bracket_are_four_shots(tmp_path: Path) -> None:
    paths = [tmp_path / f"steel_bracket_{angle:03d}.png" for angle in ANGLES]
    for path in paths:
        path.touch()
    assert list_shot_files(tmp_path, (".png",)) == paths


def spoil_label(root: Path) -> None:
    (root / "v_ev-3.png").rename(root / "v_ev-4.png")


def spoil_motion(root: Path) -> None:
    write_bracket(root, "v", bright_light(shift=6), stops=(-3.0,))


def spoil_gap(root: Path) -> None:
    (root / "v_ev-3.png").unlink()
    write_bracket(root, "v", stops=(-11.0,))
    (root / "v_ev-6.png").unlink()


def spoil_twin(root: Path) -> None:
    (root / "v_ev-3.png").rename(root / "v_ev0.1.png")


def spoil_size(root: Path) -> None:
    assert cv2.imwrite(str(root / "v_ev-6.png"), np.full((64, 96), 900, np.uint16))


BAD: list[tuple[Callable[[Path], None], Fault]] = [
    (spoil_label, Fault("v_ev-4.png", "as stated", "in the pictures")),
    (spoil_motion, Fault("v_ev-3.png", "same scene", "beyond noise")),
    (spoil_gap, Fault("v_ev-11.png", "overlaps")),
    (spoil_twin, Fault("v_ev0", "different exposures", "v_ev0.1.png")),
    (spoil_size, Fault("v_ev-6.png", "128", "96")),
]


@pytest.mark.parametrize(("spoil", "fault"), BAD)
def test_bad_brackets_are_refused_by_prepare_and_priors(
    tmp_path: Path, spoil: Callable[[Path], None], fault: Fault
) -> None:
    root = tmp_path / "raw"
    write_bracket(root, "v")
    spoil(root)
    fault.raised_by(prepared, root, MOSAIC)
    assert not (tmp_path / "scene").exists()

    def priors() -> None:
        for shot in find_shots([root], OPTIONS):
            read_shot(shot, OPTIONS)

    fault.raised_by(priors)


def test_an_exposure_that_one_shot_lacks_is_refused(tmp_path: Path) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup")
    (tmp_path / "shots" / "cup_90_ev-6.png").unlink()
    Fault("cup_90_ev0.png", "3 exposures like").raised_by(prepared, tmp_path / "shots", SHOTS)


def test_shots_with_other_stops_are_refused(tmp_path: Path) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup")
    (tmp_path / "shots" / "cup_90_ev-3.png").rename(tmp_path / "shots" / "cup_90_ev-2.png")
    Fault("cup_90_ev0.png", "+0.00, -3.00, -6.00 stops", "+0.00, -2.00, -6.00 stops").raised_by(
        prepared, tmp_path / "shots", SHOTS
    )


@pytest.mark.parametrize("stops", [(-3.0,), (-3.0, -6.0), (1.0,), (1.0, -3.0)])
def test_a_shot_without_its_normal_exposure_is_refused(tmp_path: Path, stops: tuple[float, ...]) -> None:
    write_bracket(tmp_path / "raw", "v", stops=stops)
    fault = Fault("v_ev", "0 stops", f"{stops[0]:+.2f}")
    fault.raised_by(prepared, tmp_path / "raw", MOSAIC)
    (shot,) = find_shots([tmp_path / "raw"], OPTIONS)
    fault.raised_by(read_shot, shot, OPTIONS)


def test_a_table_without_a_normal_exposure_is_refused(tmp_path: Path) -> None:
    write_bracket(tmp_path / "raw", "x", stops=(-3.0,), names=("IMG_1",))
    write_table(tmp_path / "raw", ["x_IMG_1.png,part,-3"])
    Fault("x_IMG_1.png", "0 stops", "-3.00 stops").raised_by(prepared, tmp_path / "raw", MOSAIC)


@pytest.mark.parametrize(
    ("stops", "names"),
    [
        ((0.0, -3.0), None),
        # The scale is that of 0 stops, even if the nearest exposure deviates.
        ((0.125, -3.0), None),
        # The first file is not the longest exposure, which defines the scale.
        ((-3.0, 0.0), ("bracket1", "bracket2")),
    ],
)
def test_the_light_of_a_shot_belongs_to_the_scale_of_its_values(
    tmp_path: Path, stops: tuple[float, ...], names: tuple[str, ...] | None
) -> None:
    root = tmp_path / "shots"
    write_bracketed_shots(root, "cup", stops, names, ".jpg", angles=(30,), seconds=0.5)
    write_bracketed_shots(root, "jar", stops, names, ".jpg", angles=(75,), seconds=0.25)
    files = list_shot_files(root, (".jpg",))
    stated, missing = light_of_files({path.name[:3]: [path] for path in files})
    assert not missing
    np.testing.assert_allclose([stated[path] for path in files], [50, 25], rtol=1e-3)  # ISO 100
    prepared(root, replace(SHOTS, transfer="srgb", gains="exif"))
    gains = [line.split(",")[-1] for line in (tmp_path / "scene" / "angles.csv").read_text().split()[1:]]
    np.testing.assert_allclose(float(gains[0]) / float(gains[1]), 2, rtol=1e-3)


def test_a_bracket_that_states_the_light_of_one_exposure_corrects_nothing(tmp_path: Path) -> None:
    names = ("bracket1", "bracket2")
    paths = write_bracketed_shots(tmp_path, "cup", (-3, 0), names, ".jpg", angles=(30,), seconds=1)
    with Image.open(paths[1]) as picture:
        picture.save(tmp_path / "plain.jpg", quality=95)
    (tmp_path / "plain.jpg").replace(paths[1])
    stated, missing = light_of_files({"cup": paths[:1]})
    assert stated == {}
    assert "1 of 2 files have no ExposureTime" in missing


def test_most_of_a_radiance_may_exceed_full_scale(tmp_path: Path) -> None:
    stokes = 8 * bright_light()
    stokes[:, :, :32] /= 8
    write_bracket(tmp_path / "raw", "v", stokes)
    data, _ = prepared(tmp_path / "raw", MOSAIC)
    assert np.median(data.codes) > 65535
    np.testing.assert_allclose(np.median(s0_of(data) / halved(stokes[0].mean(-1))), 1, atol=0.01)
    assert read_capture(tmp_path / "scene").views[0].codes.dtype == torch.float32
    # Without the record of merged exposures, such numbers may have any unit.
    (tmp_path / "scene" / "scene.json").unlink()
    Fault("v_", "1 is full scale").raised_by(
        read_view, find_layout(tmp_path / "scene"), "v", factor=1, transfer="linear"
    )


class BrightPoints:
    """Points at the brightest pixel of each of two views."""

    places = np.random.default_rng(2).normal(size=(200, 3))
    observed = np.ones((200, 2), bool)

    def samples(self, _view: str, stored: list[np.ndarray], _bad: np.ndarray, transfer: str) -> PointSamples:
        values = [linear_codes(picture, transfer).max() / 65535 for picture in stored]
        return PointSamples(np.tile(np.array(values)[None, :, None], (200, 1, 3)), np.zeros(200, np.int64))


def test_gains_compare_highlights_of_a_radiance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("polar", "invalid"):
        (tmp_path / folder).mkdir()
    for view, value in (("a", 2.0), ("b", 4.0)):
        picture = np.full((8, 8, 3), 0.5, np.float32)
        picture[4, 4] = value
        tifffile.imwrite(tmp_path / "polar" / f"{view}.tif", picture, photometric="rgb")
        assert cv2.imwrite(str(tmp_path / "invalid" / f"{view}.png"), np.zeros((8, 8), np.uint8))
    monkeypatch.setattr(filter_source, "read_model", lambda root: None)
    monkeypatch.setattr(filter_source.ComparedPoints, "of", lambda model, views: BrightPoints())
    records = [ExposureRecord(view, 0.0, None, None) for view in "ab"]
    rows = [
        filter_source.PictureRow(view, f"{view}.tif", record)
        for view, record in zip("ab", records, strict=True)
    ]
    compared = filter_source._compare_points(tmp_path, rows, {"a": [0], "b": [1]}, np.zeros(2), Notes())
    assert compared is not None
    assert compared.logs[1, 0] - compared.logs[0, 0] == pytest.approx(np.log(2), abs=1e-3)


def corrects_the_table(root: Path, settings: PrepareSettings, suffix: str) -> None:
    """Prepare a capture with a table, correct the table, and check that a second call notices the change."""
    files = [path for path in sorted(root.iterdir()) if path.suffix == suffix]
    rows = [f"{path.name},{path.stem.rpartition('_')[0]}," for path in files]
    write_table(root, rows)
    prepared(root, settings)
    assert not prepare_scene(root, root.parent / "scene", settings).new
    write_table(root, [f"{row}{-3 if 'e2' in row else 0}" for row in rows])
    Fault("scene", "exposures.csv").raised_by(prepare_scene, root, root.parent / "scene", settings)


def test_a_corrected_table_is_noticed_by_prepare(tmp_path: Path) -> None:
    write_bracket(tmp_path / "mosaic" / "raw", "v", stops=(0.0, -3.0), names=("e1", "e2"))
    corrects_the_table(tmp_path / "mosaic" / "raw", MOSAIC, ".png")
    for name, angles in (("four", ANGLES), ("single", (30,))):
        write_bracketed_shots(tmp_path / name / "raw", "v", (0.0, -3.0), ("e1", "e2"), angles=angles)
        corrects_the_table(tmp_path / name / "raw", SHOTS, ".png")


def test_the_table_is_a_file_of_a_shot(tmp_path: Path) -> None:
    paths = write_bracket(tmp_path / "raw", "x", stops=(0.0, -3.0), names=("e1", "e2"))
    write_table(tmp_path / "raw", ["x_e1.png,part,0", "x_e2.png,part,-3"])
    (shot,) = find_shots([tmp_path / "raw"], OPTIONS)
    assert shot.paths == (*paths, tmp_path / "raw" / "exposures.csv")


def test_all_exposures_of_four_shots_count_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup")
    options = ShotOptions(transfer="linear", gains="none")
    (shot,) = find_shots([tmp_path / "shots"], options)
    height, width = SIZE
    # Enough for two exposures of four shots.
    free = 2 * 4 * 3 * (2 + 2) * height * width / SHARE
    monkeypatch.setattr("polarguide.capture.layout.free_memory", lambda: int(free))
    Fault("cup_0_ev0.png", "pictures that take up to", "four shots").raised_by(read_shot, shot, options)


def agrees(dolp: np.ndarray, usable: np.ndarray) -> None:
    assert usable.mean() > 0.95
    assert np.median(np.abs(dolp - 0.4)) < 0.02
    _height, width = dolp.shape
    lamp = np.s_[int(0.4 * width) - 2 : int(0.4 * width) + 3, int(0.7 * width) - 2 : int(0.7 * width) + 3]
    np.testing.assert_allclose(dolp[lamp], 0.4, atol=0.05)


def test_priors_of_a_mosaic(tmp_path: Path) -> None:
    paths = write_bracket(tmp_path / "raw", "part")
    (shot,) = find_shots([tmp_path / "raw"], OPTIONS)
    assert shot.name == "part"
    assert {*shot.paths} == {*paths}
    maps = read_shot(shot, OPTIONS)
    agrees(maps.dolp, maps.usable)
    assert any("3 exposures" in note for note in maps.notes)
    # The normal exposure alone loses the lamp.
    single = tmp_path / "single"
    single.mkdir()
    (tmp_path / "raw" / "part_ev0.png").rename(single / "part.png")
    (alone,) = find_shots([single], OPTIONS)
    assert read_shot(alone, OPTIONS).usable.mean() < maps.usable.mean() - 0.02


def test_priors_of_a_part_of_a_mosaic(tmp_path: Path) -> None:
    write_bracket(tmp_path / "raw", "part")
    (shot,) = find_shots([tmp_path / "raw"], OPTIONS)
    whole = read_shot(shot, replace(OPTIONS, read_noise=2.4, full_well=10500.0))
    part = read_shot(shot, replace(OPTIONS, read_noise=2.4, full_well=10500.0), part=(2, 2, 12, 12))
    assert part.s0.shape[0] < whole.s0.shape[0] or part.whole is None
    left, top = part.origin
    np.testing.assert_allclose(
        part.s0[4:12, 4:12], whole.s0[top + 4 : top + 12, left + 4 : left + 12], rtol=0.02
    )


def test_priors_of_four_shots(tmp_path: Path) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup")
    options = ShotOptions(transfer="linear", gains="none")
    (shot,) = find_shots([tmp_path / "shots"], options)
    assert shot.name == "cup"
    assert len(shot.paths) == 12
    maps = read_shot(shot, options)
    agrees(maps.dolp, maps.usable)


def test_sets_at_other_angles_refuse_brackets(tmp_path: Path) -> None:
    write_bracketed_shots(tmp_path / "shots", "cup", angles=(0, 60, 120))
    (shot,) = find_shots([tmp_path / "shots"])
    Fault("cup_0_ev0.png", "one exposure", "3 exposures").raised_by(read_shot, shot)


def test_inspect_shows_the_range(tmp_path: Path) -> None:
    for view in "ab":
        write_bracket(tmp_path / "raw", view)
    prepared(tmp_path / "raw", MOSAIC)
    capture = read_capture(tmp_path / "scene")
    assert {view.codes.dtype for view in capture.views} == {torch.float32}
    assert not any(bool(view.saturated.any()) for view in capture.views)
    saturation, *_ = light_checks(capture, [measure_view(view, 1.5) for view in capture.views])
    largest = max(float(view.codes.max()) for view in capture.views) / 65535
    assert f"The largest value is {largest:.1f} times full scale" in saturation.finding
    truth = halved(bright_light()[0].mean(-1))
    stops = np.log2(truth.max() / np.percentile(truth, 1))
    cover = float(saturation.finding.split("cover ")[1].split()[0])
    assert cover == pytest.approx(stops, abs=0.2)


def test_radiance_of_a_scene(tmp_path: Path) -> None:
    for view in "ab":
        write_bracket(tmp_path / "raw", view)
    prepared(tmp_path / "raw", MOSAIC)
    data = read_view(find_layout(tmp_path / "scene"), "a", factor=2, transfer="linear")
    full = read_view(find_layout(tmp_path / "scene"), "a", factor=1, transfer="linear")
    np.testing.assert_allclose(data.codes.mean(), full.codes.mean(), rtol=1e-5)
    assert not data.saturated(65535)[~data.black].any()
    assert StoredViews.of([full], [None]).picture_warnings("linear") == []
    Fault("a_000.tif", "linear", "srgb").raised_by(
        read_view, find_layout(tmp_path / "scene"), "a", factor=1, transfer="srgb"
    )


@pytest.mark.parametrize("text", ["", "0,0", "0,x", "0,-30"])
def test_synth_refuses_wrong_exposures(text: str) -> None:
    Fault("--exposures", "0,-3,-6", repr(text)).raised_by(
        SynthSettings(sensor="IMX250MZR", exposures=text).check
    )


def test_synth_needs_a_sensor_for_exposures() -> None:
    Fault("--exposures", "--sensor", "ideal").raised_by(SynthSettings(exposures="0,-3").check)
