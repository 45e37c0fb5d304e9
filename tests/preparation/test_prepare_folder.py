"""The folder that ``prepare`` writes: gone on with, never written through, and never by two."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from camera_files import write_mosaics
from refused_preparations import MOSAIC, NAMES, refused

from polarguide import files
from polarguide.errors import PolarguideError
from polarguide.preparation import folder as folder_module
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide.system import hold_folder


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
    assert done.views == list(NAMES)
    assert first.stat().st_mtime_ns == before
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
    write, count = folder_module.SceneFolder.write_view, [0]

    def stop(self: object, *arguments: object) -> None:
        count[0] += 1
        if count[0] == 2:
            raise KeyboardInterrupt
        write(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(folder_module.SceneFolder, "write_view", stop)
    with pytest.raises(KeyboardInterrupt):
        prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC)
    assert not (tmp_path / "out" / "scene.json").exists()
    monkeypatch.undo()
    prepare_scene(tmp_path / "in", tmp_path / "out", MOSAIC)
    for path in sorted((tmp_path / "whole").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "out" / path.relative_to(tmp_path / "whole")).read_bytes(), (
            path
        )


def other_setting(source: Path, out: Path) -> PrepareSettings:
    return replace(MOSAIC, demosaic="quarter")


def changed_source(source: Path, out: Path) -> PrepareSettings:
    os.utime(source / "v001.png", ns=(1, 1))
    return MOSAIC


def more_views(source: Path, out: Path) -> PrepareSettings:
    shutil.copy(source / "v001.png", source / "v009.png")
    return MOSAIC


def foreign_scene(source: Path, out: Path) -> PrepareSettings:
    (out / "scene.json").write_text('{"refractive_index": 1.5}')
    return MOSAIC


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_setting, "a preparation with demosaic half, found demosaic quarter"),
        (changed_source, "v001.png as it was, found .*changed, added or removed"),
        (more_views, "v009.png"),
        (foreign_scene, "scene.json of another origin"),
    ],
)
def test_nothing_is_overwritten(tmp_path: Path, change: Callable, message: str) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    write_mosaics(source)
    prepare_scene(source, out, MOSAIC)
    settings = change(source, out)
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    with pytest.raises(PolarguideError, match=message):
        prepare_scene(source, out, settings)
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before


def test_out_with_other_files_or_a_file_is_left_alone(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "letters.txt").write_text("mine")
    assert "found other files" in refused(tmp_path / "in", tmp_path / "out", MOSAIC)
    assert "found a file" in refused(tmp_path / "in", tmp_path / "out" / "letters.txt", MOSAIC)


@pytest.mark.parametrize(
    "stranger", ["../victim.txt", "/victim.txt", "polar/../../victim.txt", "polar/other_000.png"]
)
@pytest.mark.parametrize("view", [None, "../v000"])
def test_nothing_is_removed_at_the_word_of_a_journal(tmp_path: Path, stranger: str, view: str | None) -> None:
    """An unfinished preparation from somebody else, which names files as those of a view without a pose."""
    source, out = tmp_path / "source", tmp_path / "out"
    write_mosaics(source)
    prepare_scene(source, out, MOSAIC)
    victim = out.parent / "victim.txt"
    victim.write_text("mine")
    named = str(victim) if stranger.startswith("/") else stranger
    journal = json.loads((out / "scene.json").read_text())
    views = journal["prepare"]["views"]
    views["v000"]["files"][named] = 4
    if view is not None:
        views[view] = views.pop("v000")
    (out / "scene.json").unlink()
    (out / "prepare.json").write_text(json.dumps(journal))
    with pytest.raises(PolarguideError, match=r"prepare\.json .*nothing was written"):
        prepare_scene(source, out, MOSAIC)
    assert victim.read_text() == "mine"


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    source, out, elsewhere = tmp_path / "source", tmp_path / "out", tmp_path / "elsewhere"
    write_mosaics(source)
    prepare_scene(source, out, MOSAIC)
    shutil.move(out / "polar", elsewhere)
    (out / "polar").symlink_to(elsewhere)
    for path in elsewhere.iterdir():
        path.write_bytes(b"mine")
    (out / "scene.json").rename(out / "prepare.json")
    with pytest.raises(PolarguideError, match="found a link to "):
        prepare_scene(source, out, MOSAIC)
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
    with pytest.raises(PolarguideError, match=f"{re.escape(place)}: expected a place in .*found a link to "):
        prepare_scene(source, out, MOSAIC)
    assert not any(elsewhere.iterdir())


def test_one_preparation_at_a_time_writes_a_folder(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "raw", 3)
    settings = PrepareSettings(sensor="IMX250MYR", bits=16, poses="none")
    (tmp_path / "out").mkdir()
    let_go = hold_folder(tmp_path / "out")
    with pytest.raises(PolarguideError, match="another polarguide prepare at work"):
        prepare_scene(tmp_path / "raw", tmp_path / "out", settings)
    assert list((tmp_path / "out").iterdir()) == []
    let_go()
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
    with pytest.raises(PolarguideError, match=rf"prepare\.json.*{key}"):
        prepare_scene(tmp_path / "source", tmp_path / "out", MOSAIC)


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
