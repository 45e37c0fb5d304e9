"""Commands on a disk that is full: a small tmpfs of this process alone, with less room than they need.

A command writes to the disk once without a limit; then again with a share of the room that it took. It has to end with
one line, and to leave every file as it was, as the undisturbed command wrote it, or whole at least. The same command,
once there is room, has to end with the bytes of the undisturbed one and without temporary files. Takes Linux, and the
right to mount: root, or namespaces of users.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import hashlib
import importlib
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from base import EVAL, INSPECT, MOSAICS, ONE, READ, export
from forked import ERROR, Ended, run

CLONE_NEWNS, CLONE_NEWUSER = 0x00020000, 0x10000000
MS_REMOUNT, MS_REC, MS_PRIVATE = 32, 1 << 14, 1 << 18
LARGE = 1 << 30
SECONDS = 300
"""Of a command; a comparison starts programs of its own."""
SHARES = (0.0, 0.1, 0.35, 0.6, 0.85, 0.97)
STEPS = "--steps 12"
VARYING = {"log.jsonl", "results.json", "results.md", "results.csv", "results.tex", "report.html", "stderr.txt",
           "metrics.json", "inputs.json", "inspection.html", "inspection.json", "alone.txt"}  # fmt: skip
"""Files with times in them."""
UNCOUNTED = {".lock", "stderr.txt"}
libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Writer:
    """A row of the table: a command; the shares that ``make test`` tries; whether it is too long to be repeated."""

    name: str
    command: str | Callable[[], str]
    ci: tuple[float, ...] = ()
    once: bool = False


def _train() -> str:
    """A training, gone on with where it has begun."""
    more = " --resume" if Path("new/run.json").exists() else ""
    return f"train scene --out new {STEPS} --checkpoint-every 3 --threads 1 --device cpu{more}"


PICTURES = f"render run --out new {ONE}"
WRITERS = (
    Writer("train", _train, (0.0, 0.6)),
    Writer("eval", EVAL, (0.6,)),
    Writer("prepare", MOSAICS, (0.6,)),
    Writer("render", PICTURES),
    Writer("render npy", f"{PICTURES} --format npy"),
    Writer("render exr", f"{PICTURES} --format exr", (0.6,)),
    Writer("render video", "render run --path orbit --video new.mp4 --frames 3", (0.6,)),
    Writer("priors", READ, (0.6,)),
    Writer("inspect", INSPECT, (0.6,)),
    Writer("share", "share run --out new/page.html", (0.6,)),
    *(Writer(f"export {kind}", export(kind), (0.6,))
      for kind in ("ply", "spz", "environment", "cameras", "normals")),
    Writer("compare", f"compare scene --recipes 3dgs polarguide {STEPS} --out new"),
    Writer("synth", "synth proof --out new --size 16x16 --samples 1"),
    Writer("bench", "bench --out new", once=True),
)  # fmt: skip


def own_mounts() -> bool:
    """Give this process mounts of its own, before it has a thread; whether that is allowed."""
    user, group = os.getuid(), os.getgid()
    if not hasattr(libc, "unshare") or libc.unshare(CLONE_NEWNS | (CLONE_NEWUSER if user else 0)):
        return False
    with contextlib.suppress(OSError):
        if user:
            Path("/proc/self/setgroups").write_text("deny")
            Path("/proc/self/uid_map").write_text(f"0 {user} 1")
            Path("/proc/self/gid_map").write_text(f"0 {group} 1")
        return not libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None)
    return False


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file but locks."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in UNCOUNTED
    }


WHOLE: dict[str, Callable[[Path], object]] = {
    ".json": lambda path: json.loads(path.read_text()) is not None,
    ".safetensors": lambda path: importlib.import_module("safetensors.numpy").load_file(path),
    ".npz": lambda path: zipfile.ZipFile(path).testzip() is None,
    ".html": lambda path: path.read_text().rstrip().endswith("</html>"),
    ".jsonl": lambda path: True,  # a line that is cut short is passed over
}
"""Whether a file that is neither as before nor as in the end can be read to its end."""


def _is_whole(path: Path) -> bool:
    with contextlib.suppress(Exception):
        return bool(WHOLE[path.suffix](path))
    return path.suffix not in WHOLE and path.name in VARYING and path.stat().st_size > 0


class Disk:
    """A tmpfs, and the base that commands find on it."""

    def __init__(self, base: Path, place: Path) -> None:
        self.base, self.place, self.said = base, place, place.parent / "said"
        place.mkdir()
        self.mounted = self.mount(LARGE, again=False)

    def mount(self, size: int, *, again: bool = True) -> bool:
        """Mount so many bytes, or give the disk that is there another size."""
        options = f"size={size}".encode()
        return not libc.mount(b"tmpfs", bytes(self.place), b"tmpfs", MS_REMOUNT if again else 0, options)

    def used(self) -> int:
        """Bytes in use."""
        about = os.statvfs(self.place)
        return (about.f_blocks - about.f_bfree) * about.f_frsize

    def begin(self) -> dict[str, str]:
        """An empty disk with a copy of the base, and the digests of its files."""
        assert self.mount(LARGE)
        for old in self.place.iterdir():
            shutil.rmtree(old)
        shutil.copytree(self.base, self.place / "case")
        (self.place / "temporary").mkdir()
        return _digests(self.place / "case")

    def run(self, writer: Writer) -> Ended:
        """Run a command in a fork, on the disk."""

        def act() -> int:
            os.chdir(self.place / "case")
            os.environ["TMPDIR"] = str(self.place / "temporary")
            app: Any = importlib.import_module("polarguide.cli.app")
            try:
                command = writer.command if isinstance(writer.command, str) else writer.command()
            except importlib.import_module("polarguide.core.errors").PolarguideError as error:
                print(f"error: {error}", flush=True)
                return 2
            return int(app.run(command.split())) if command else 0

        return run(act, self.said, SECONDS)


def full_disks(base: Path, place: Path, asked: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Every command with every share of its room: the name of each, and what was wrong."""
    disk = Disk(base, place)
    if not disk.mounted:
        return
    try:
        for writer in WRITERS:
            shares = writer.ci if asked.ci else (0.0,) if writer.once else SHARES
            if not shares or asked.only not in f"disk {writer.name}":
                continue
            before = disk.begin()
            room = disk.used()
            done = Ended(0, "") if writer.once else disk.run(writer)
            assert done.status == 0, (writer.name, done)
            expected = {} if writer.once else _digests(place / "case")
            room = disk.used() - room
            for share in shares:
                found = _faults(writer, share * room, disk, before, expected)
                yield f"disk {writer.name}, {share:.0%} of {room} bytes", found
    finally:
        libc.umount(bytes(place))


def _faults(
    writer: Writer, room: float, disk: Disk, before: dict[str, str], expected: dict[str, str]
) -> list[str]:
    """What is wrong after a command with less room than it needs, and after it was repeated with enough."""
    disk.begin()
    case = disk.place / "case"
    assert disk.mount(disk.used() + int(room) // 4096 * 4096 + 4096 * (room > 0))
    done = disk.run(writer)
    assert disk.mount(LARGE)
    found = []
    if (
        done.status not in (0, 2)
        or (done.status == 2 and not ERROR.search(done.text))
        or "Traceback" in done.text
    ):
        found.append(f"status {done.status}{', too late' * done.late}: {done.text[-1500:]}")
    after = _digests(case)
    missing = sorted(expected.keys() - after.keys())
    if done.status == 0 and missing:
        found.append(f"it did not notice that it lacks {missing[:4]}")
    for path, digest in after.items():
        if ".tmp" in path:
            found.append(f"left {path}")
        elif digest not in (before.get(path), expected.get(path)) and not _is_whole(case / path):
            found.append(f"half of {path}")
    found += [f"lost {path}" for path in before.keys() - after.keys() if path in expected]
    if writer.once:
        return found
    done = disk.run(writer)
    after = _digests(case)
    if done.status:
        found.append(f"repeated: status {done.status}: {done.text[-1500:]}")
    differing = {path for path in expected.keys() | after.keys() if expected.get(path) != after.get(path)}
    wrong = sorted(path for path in differing if Path(path).name not in VARYING)
    if wrong:
        found.append(f"repeated: other bytes in {wrong[:6]}")
    return found
