"""The folder of a scene while it is prepared, scenes without poses, and settings."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import cv2
import numpy as np
import pytest
from camera_files import write_model, write_mosaic, write_mosaics
from faults import Fault
from refused_preparations import MOSAIC, NAMES, refused

from polarguide.capture.calibration import Calibration
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES
from polarguide.capture.sensor.mosaics import PACKINGS
from polarguide.capture.sensor.pattern import SENSORS
from polarguide.core import files
from polarguide.core.system import only_writer
from polarguide.preparation import prepare as prepare_module
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings
from polarguide_bench.datasets.readers import READERS


def test_a_full_disk_and_going_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mosaics(tmp_path / "in", 3)
    replace_file, count = os.replace, [0]

    def full(source: Path, target: Path) -> None:
        count[0] += 1
        if count[0] > 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace_file(source, target)

    monkeypatch.setattr(files.os, "replace", full)
    text = refused(tmp_path / "in", tmp_path / "out", MOSAIC)
    assert "No space left on device" in text
    assert "goes on where it stopped" in text
    monkeypatch.undo()
    assert not list(tmp_path.rglob("*.tmp"))
    first = tmp_path / "out" / "polar" / "v000_000.png"
    before = first.stat().st_mtime_ns
    done = prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC)
    assert (done.views, first.stat().st_mtime_ns) == (list(NAMES), before)
    assert not prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC).new


def test_a_preparation_that_could_not_write_at_all_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders fit on a disk that takes no file: they are nobody's other files the next time."""
    write_mosaics(tmp_path / "in", 3)

    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "replace", full)
    assert "No space left on device" in refused(tmp_path / "in", tmp_path / "out", MOSAIC)
    monkeypatch.undo()
    (tmp_path / "out" / ".prepare.json.4711.tmp").write_text("{")  # of one that was killed at this moment
    assert prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC).views == list(NAMES)
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_stopped_preparation_gives_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mosaics(tmp_path / "in", 3)
    prepare_scene(tmp_path / "in", tmp_path / "whole", MOSAIC)
    write, count = prepare_module.write_view, [0]

    def stop(*arguments: object) -> object:
        count[0] += 1
        if count[0] == 2:
            raise KeyboardInterrupt
        return write(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(prepare_module, "write_view", stop)
    with pytest.raises(KeyboardInterrupt):
        prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC)
    assert not (tmp_path / "out" / "scene.json").exists()
    monkeypatch.undo()
    prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC)
    for path in sorted((tmp_path / "whole").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "out" / path.relative_to(tmp_path / "whole")).read_bytes(), (
            path
        )


def touched(source: Path, out: Path) -> tuple[Path, Path]:
    for path in source.iterdir():
        os.utime(path, ns=(1, 1))
    return source, out


def renamed(source: Path, out: Path) -> tuple[Path, Path]:
    return source.rename(source.with_name("moved")), out.rename(out.with_name("scene"))


def typed_otherwise(source: Path, out: Path) -> tuple[Path, Path]:
    return Path(os.path.relpath(source)), out


def copied(source: Path, out: Path) -> tuple[Path, Path]:
    return Path(shutil.copytree(source, source.with_name("copy"))), out


@pytest.mark.parametrize("change", [touched, renamed, typed_otherwise, copied])
@pytest.mark.parametrize("posed", [False, True])
def test_files_are_known_by_their_content(tmp_path: Path, change: Callable, posed: bool) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    write_mosaics(source)
    write_mosaic(tmp_path / "dark.png", np.zeros((48, 64)))
    model = write_model(tmp_path / "in" / "sparse" / "0", NAMES, "PINHOLE 64 48 80 82 33 25")
    settings = replace(MOSAIC, dark_frame=tmp_path / "dark.png", poses=str(model) if posed else "none")
    prepare_scene(source, out, settings)
    source, out = change(source, out)
    first = out / "polar" / "v000_000.png"
    before = first.stat().st_mtime_ns
    (tmp_path / "elsewhere").mkdir()
    dark = Path(shutil.move(tmp_path / "dark.png", tmp_path / "elsewhere"))
    later = replace(settings, dark_frame=dark, poses=str(source / "sparse" / "0") if posed else "none")
    assert not prepare_scene(source, out, later).new
    assert first.stat().st_mtime_ns == before


def other_setting(source: Path, out: Path) -> PrepareSettings:
    return replace(MOSAIC, demosaic="quarter")


def poses_later(source: Path, out: Path) -> PrepareSettings:
    model = write_model(source.parent / "model", NAMES, "PINHOLE 64 48 80 82 33 25")
    return replace(MOSAIC, poses=str(model))


def changed_source(source: Path, out: Path) -> PrepareSettings:
    data = (source / "v001.png").read_bytes()
    before = os.stat(source / "v001.png")
    (source / "v001.png").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))  # as large, and said to be as old
    os.utime(source / "v001.png", ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    return MOSAIC


def more_views(source: Path, out: Path) -> PrepareSettings:
    shutil.copy(source / "v001.png", source / "v009.png")
    return MOSAIC


def foreign_scene(source: Path, out: Path) -> PrepareSettings:
    (out / "scene.json").write_text('{"refractive_index": 1.5}')
    return MOSAIC


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (other_setting, Fault(expected="a preparation with demosaic half", found="demosaic quarter")),
        (poses_later, Fault(expected="a preparation with poses none", remedy="choose another --out")),
        (changed_source, Fault(expected="v001.png as it was", found="that was changed")),
        (more_views, Fault(expected="v009.png")),
        (foreign_scene, Fault(found="scene.json of another origin")),
    ],
)
def test_nothing_is_overwritten(tmp_path: Path, change: Callable, fault: Fault) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    write_mosaics(source)
    prepare_scene(source, out, MOSAIC)
    settings = change(source, out)
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    fault.raised_by(prepare_scene, source, out, settings)
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before


def test_out_with_other_files_or_a_file_is_left_alone(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "letters.txt").write_text("mine")
    assert "found other files" in refused(tmp_path / "in", tmp_path / "out", MOSAIC)
    assert "found a file" in refused(tmp_path / "in", tmp_path / "out" / "letters.txt", MOSAIC)


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    source, out, elsewhere = tmp_path / "source", tmp_path / "out", tmp_path / "elsewhere"
    write_mosaics(source)
    prepare_scene(source, out, MOSAIC)
    shutil.move(out / "polar", elsewhere)
    (out / "polar").symlink_to(elsewhere)
    for path in elsewhere.iterdir():
        path.write_bytes(b"mine")
    (out / "scene.json").rename(out / "prepare.json")
    Fault(found="a link to").raised_by(prepare_scene, source, out, MOSAIC)
    assert {path.read_bytes() for path in elsewhere.iterdir()} == {b"mine"}


@pytest.mark.parametrize("place", [".sfm/images", ".sfm/database.db", ".sparse.partial", "sparse"])
def test_no_link_in_an_unfinished_scene_is_written_through(tmp_path: Path, place: str) -> None:
    source, out, elsewhere = tmp_path / "source", tmp_path / "out", tmp_path / "elsewhere"
    write_mosaics(source)
    prepare_scene(source, out, MOSAIC)
    (out / "scene.json").rename(out / "prepare.json")
    elsewhere.mkdir()
    (out / place).parent.mkdir(exist_ok=True)
    (out / place).symlink_to(elsewhere)
    Fault(place, "a place in", "a link to").raised_by(prepare_scene, source, out, MOSAIC)
    assert not any(elsewhere.iterdir())


def test_one_preparation_at_a_time_writes_a_folder(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "raw", 3)
    settings = PrepareSettings(sensor="IMX250MYR", bits=16, poses="none")
    (tmp_path / "out").mkdir()
    with only_writer(tmp_path / "out", expected="", found=""):
        Fault(found="another polarguide prepare").raised_by(
            prepare_scene, tmp_path / "raw", tmp_path / "out", settings
        )
    assert list((tmp_path / "out").iterdir()) == []
    assert prepare_scene(tmp_path / "raw", tmp_path / "out", settings).new


@pytest.mark.parametrize(
    ("key", "value"),
    [("scale", None), ("gains", None), ("levels", None), ("scale", "x"), ("gains", [1, 1]), ("gains", [0, 1, 1, 1]),
     ("levels", {"bits": "x"}), ("levels", {"bits": 12})],
)  # fmt: skip
def test_what_was_measured_is_checked_before_it_is_gone_on_with(
    tmp_path: Path, key: str, value: object
) -> None:
    write_mosaics(tmp_path / "source")
    prepare_scene(tmp_path / "source", tmp_path / "out", MOSAIC)
    (tmp_path / "out" / "scene.json").rename(tmp_path / "out" / "prepare.json")
    path = tmp_path / "out" / "prepare.json"
    journal = json.loads(path.read_text())
    journal["prepare"]["measured"][key] = value
    if value is None:
        del journal["prepare"]["measured"][key]
    path.write_text(json.dumps(journal))
    error = Fault("prepare.json").raised_by(prepare_scene, tmp_path / "source", tmp_path / "out", MOSAIC)
    assert key in str(error)


def test_a_fault_of_ours_is_not_said_to_be_one_of_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mosaics(tmp_path / "source")
    prepare_scene(tmp_path / "source", tmp_path / "out", MOSAIC)
    (tmp_path / "out" / "scene.json").rename(tmp_path / "out" / "prepare.json")
    for picture in (tmp_path / "out" / "polar").glob("v000_*"):
        picture.unlink()

    def fails(*_: object, **__: object) -> None:
        raise ValueError("of ours")

    monkeypatch.setattr("polarguide.preparation.mosaic_source.demosaic", fails)
    with pytest.raises(ValueError, match="of ours"):
        prepare_scene(tmp_path / "source", tmp_path / "out", MOSAIC)


SETTINGS = PrepareSettings(sensor="IMX250MZR", bits=12)


def noise_mosaics(folder: Path, count: int) -> Path:
    """Mosaics of noise, in which there is nothing to match."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k}.png"), rng.integers(1000, 1400, (128, 128)).astype(np.uint16))
    return folder


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_views(tmp_path: Path, count: int) -> None:
    source = noise_mosaics(tmp_path / "in", count)
    priors = f"polarguide priors {source} --out in-priors --sensor IMX250MZR --bits 12"
    Fault(expected="at least 3 views", found=str(count), remedy=priors).raised_by(
        prepare_scene, source, tmp_path / "out", SETTINGS
    )
    assert not (tmp_path / "out").exists()
    alone = prepare_scene(
        source, tmp_path / "out", PrepareSettings(sensor="IMX250MZR", bits=12, poses="none")
    )
    assert len(alone.views) == count


@pytest.mark.parametrize("there", [False, True])
def test_views_that_do_not_register(tmp_path: Path, there: bool) -> None:
    source, out = noise_mosaics(tmp_path / "in", 3), tmp_path / "out"
    if there:
        out.mkdir()
    caught = Fault(found="0 of 3 views registered").raised_by(prepare_scene, source, out, SETTINGS)
    assert f"polarguide priors {source}" in str(caught)
    # What is recommended changes something: all pairs are compared by default.
    assert "--matching exhaustive" not in str(caught)
    assert "--sfm-pictures minimum" in str(caught)
    tried = replace(SETTINGS, matching="sequential", sfm_pictures="minimum")
    caught = Fault(remedy="--matching exhaustive").raised_by(prepare_scene, source, out, tried)
    assert "--sfm-pictures" not in str(caught)
    assert out.exists() == there
    assert not there or not list(out.iterdir())


def test_shots_of_a_filter_are_advised_without_a_sensor(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    picture = np.random.default_rng(1).integers(20_000, 30_000, (32, 32, 3)).astype(np.uint16)
    for angle in (0, 45, 90, 135):
        cv2.imwrite(str(tmp_path / "in" / f"cup_{angle}.png"), picture)
    caught = Fault(found="1 (cup)").raised_by(prepare_scene, tmp_path / "in", tmp_path / "out")
    assert f"polarguide priors {tmp_path / 'in'} --out in-priors." in str(caught)


def choices(hint: Any) -> set[str]:
    """The values of all ``Literal`` in a type."""
    parts = get_args(hint)
    return {part for part in parts if isinstance(part, str)} | {c for part in parts for c in choices(part)}


@pytest.mark.parametrize(
    ("field", "known"),
    [
        ("format", {"auto", "mosaic", "filter", "singles", *READERS}),
        ("sensor", set(SENSORS)),
        ("packing", set(PACKINGS)),
        ("demosaic", set(DEMOSAIC_MODES)),
    ],
)
def test_options_offer_what_there_is(field: str, known: set[str]) -> None:
    assert choices(get_type_hints(PrepareSettings)[field]) == known


def test_settings_are_recorded_with_absolute_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    settings = PrepareSettings(poses="model", masks=Path("masks")).checked()
    record = json.loads(json.dumps(settings.record()))
    assert record.keys() == {field.name for field in fields(PrepareSettings)}
    assert record["poses"] == str(tmp_path.resolve() / "model")
    assert record["masks"] == str(tmp_path.resolve() / "masks")
    assert record["calibration"] == {"gains": None, "order": [0, 45, 90, 135], "sense": None, "zero": 0.0}
    assert PrepareSettings(poses="none").checked().record()["poses"] == "none"


def test_options_go_over_the_calibration_file(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text('{"order": [90, 45, 0, 135], "sense": "cw", "zero": 3}')
    options = CalibrationOptions(tmp_path / "c.json", order="0,135,90,45", zero=0.0)
    assert options.read() == Calibration(None, (0, 135, 90, 45), "cw", 0.0)
    assert CalibrationOptions().read() == Calibration()


def test_a_damaged_journal_is_refused(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in")
    settings = PrepareSettings(poses="none", sensor="IMX250MYR")
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    path = tmp_path / "out" / "scene.json"
    content = json.loads(path.read_text())
    content["prepare"]["views"]["v000"]["files"]["polar/v000_000.png"] = "large"
    path.write_text(json.dumps(content))
    Fault("scene.json (prepare.views.v000.files", "a whole number", '"large"').raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", settings
    )


def test_options_are_read_without_heavy_libraries() -> None:
    program = (
        "import sys, polarguide.cli.captures\n"
        "print([m for m in ('torch', 'scipy', 'pycolmap', 'cv2', 'mitsuba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
