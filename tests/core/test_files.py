"""Files appear whole or not at all, and a failure is explained."""

import errno
import os
import shutil
from pathlib import Path

import pytest
from faults import Fault

from polarguide.core.errors import PolarguideError
from polarguide.core.files import (
    atomic,
    atomic_folder,
    holds_files,
    make_folder,
    read_file,
    require_inside,
    write_text,
    write_whole,
    writing,
)


def test_a_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "ä")
    assert path.read_bytes() == "ä".encode()
    assert write_whole(path, b"123") == 3
    assert read_file(path) == b"123"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no"), OSError(errno.ENOSPC, "full")])
def test_a_failure_leaves_the_old_file(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with atomic(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises((KeyboardInterrupt, ValueError, PolarguideError)):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_content_is_on_the_disk_before_it_takes_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("sync"), sync(handle))[1])
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("replace"), replace(a, b))[1])
    write_text(tmp_path / "a", "x")
    assert done == ["sync", "replace", "sync"]


def test_what_cannot_be_written_is_explained(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "none" / "a", tmp_path / "file" / "a"):
        Fault(str(path), "to write", "", "room").raised_by(write_text, path, "x")
    Fault("folder", "to write").raised_by(make_folder, tmp_path / "file" / "folder")
    for _ in range(2):
        make_folder(tmp_path / "one" / "two")
    assert (tmp_path / "one" / "two").is_dir()


def test_pipes_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    Fault("pipe", "", "a pipe or device").raised_by(read_file, tmp_path / "pipe")


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    pid = os.fork()
    if not pid:
        os._exit(0)
    os.waitpid(pid, 0)
    dead, alive = tmp_path / f".a.txt.{pid}.tmp", tmp_path / ".a.txt.1.tmp"
    other = tmp_path / f".b.txt.{pid}.tmp"
    for path in (dead, alive, other):
        path.write_text("half")
    folder = tmp_path / f".a.txt.{pid}.tmp.d"
    folder.mkdir()
    write_text(tmp_path / "a.txt", "whole")
    assert not dead.exists()
    assert not folder.exists()
    assert alive.exists()
    assert other.exists()


def test_a_folder_appears_with_whole_files(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "one").write_text("1")
        assert list((tmp_path / "out").iterdir()) == []
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["one"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def _half_a_folder(out: Path) -> None:
    with atomic_folder(out) as folder:
        (folder / "one").write_text("2")
        raise OSError(errno.ENOSPC, "full")


def test_a_folder_that_fails_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "one").write_text("1")
    Fault("out", "", "full").raised_by(_half_a_folder, tmp_path / "out")
    assert (tmp_path / "out" / "one").read_text() == "1"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_cannot_be_copied_is_one_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``shutil.copytree`` goes on after a file that does not fit, and raises one error with a list of all."""
    (tmp_path / "old" / "below").mkdir(parents=True)
    for name in ("a", "b", "below/c"):
        (tmp_path / "old" / name).write_text("x")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copystat", full)
    with pytest.raises(PolarguideError) as caught, writing(tmp_path / "new"):
        shutil.copytree(tmp_path / "old", tmp_path / "new")
    assert caught.value.found == "[Errno 28] No space left on device"


def test_nothing_is_written_through_what_bears_this_processs_number(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "folder" / "run.json"
    victim.write_text("mine")
    path.parent.mkdir()
    path.with_name(f".run.json.{os.getpid()}.tmp").symlink_to(victim)
    path.with_name(".run.json.\u00b2.tmp").touch()  # a digit, but no number
    write_text(path, "new")
    assert (victim.read_text(), path.read_text()) == ("mine", "new")
    folder = tmp_path / "folder" / "sparse"
    folder.with_name(f".sparse.{os.getpid()}.tmp").mkdir()  # a container gives every process the same number
    with atomic_folder(folder) as temporary:
        (temporary / "a").touch()
    assert (folder / "a").exists()


def test_places_that_links_lead_out_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    (tmp_path / "run").symlink_to("whole")  # the folder itself may be one
    (tmp_path / "whole" / "inner").symlink_to("../whole/other")
    (tmp_path / "whole" / "render").symlink_to(tmp_path)
    run = tmp_path / "run"
    require_inside(run, run / "export", run / "inner", run / "inner" / "deep")
    for place in (run / "render", run / "render" / "deep"):
        Fault(str(place), f"a place in {run}", "a link to").raised_by(require_inside, run, place)


def test_files_larger_than_they_may_be(tmp_path: Path) -> None:
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(1 << 32)
    Fault("sparse", "", "more than 2048 MiB").raised_by(read_file, tmp_path / "sparse")
    Fault("sparse", "", "more than 1 MiB").raised_by(read_file, tmp_path / "sparse", largest=1 << 20)


def test_what_a_killed_process_left_is_no_content(tmp_path: Path) -> None:
    assert not holds_files(tmp_path)
    (tmp_path / ".scene.json.4711.tmp").write_text("{")
    assert not holds_files(tmp_path)
    (tmp_path / ".mine.tmp").write_text("")
    assert holds_files(tmp_path)
