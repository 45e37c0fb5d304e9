"""Changes to the base, which is the current folder when they are made: files, links, records, pictures, arrays, the process."""

from __future__ import annotations

import importlib
import json
import os
import resource
import shutil
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from base import CHECKPOINT, MOSAIC, PICTURE, TRUTH
from case import Change

OUTSIDE = "../../outside/victim.txt"
"""As a link in a folder of the base sees the file beside it."""
NOBODY = 65534
SAME = "it is the same content in another form"
UNUSED = "what is wrong with it is not read"
PLAUSIBLE = "the number that changed is as plausible as the one before"
A_NAME = "a name may be any that the disk takes"


def several(*changes: Change) -> Change:
    """One after the other."""
    return lambda: [change() for change in changes]


def write(path: str, data: bytes | str) -> Change:
    """Write a file."""
    return lambda: Path(path).write_bytes(data.encode() if isinstance(data, str) else data)


def write_json(path: str, content: Any) -> Change:
    """Write a JSON file."""
    return write(path, json.dumps(content))


def edit(path: str, change: Callable[[str], str], encoding: str = "utf-8") -> Change:
    """A text file written otherwise."""
    return lambda: Path(path).write_bytes(change(Path(path).read_text()).encode(encoding))


def edit_bytes(path: str, change: Callable[[bytes], bytes]) -> Change:
    """A file of other bytes."""
    return lambda: Path(path).write_bytes(change(Path(path).read_bytes()))


def field(path: str, *keys: Any, to: Any) -> Change:
    """One value of a JSON file."""

    def change(given: str) -> str:
        whole = inner = json.loads(given)
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = to
        return json.dumps(whole)

    return edit(path, change)


def lines(change: Callable[[int, str], str]) -> Callable[[str], str]:
    """Every line of a text, by its number."""
    return lambda given: "\n".join(change(number, line) for number, line in enumerate(given.split("\n")))


def remove(*paths: str) -> Change:
    """Remove files and folders."""

    def change() -> None:
        for path in map(Path, paths):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)

    return change


def copy(source: str, *targets: str) -> Change:
    """Copy a file."""
    return lambda: [
        Path(t).parent.mkdir(parents=True, exist_ok=True) or shutil.copyfile(source, t) for t in targets
    ]


def rename(source: str, target: str) -> Change:
    """Rename a file or a folder."""
    return lambda: Path(target).parent.mkdir(parents=True, exist_ok=True) or os.rename(source, target)


def renamed_view(view: str, to: str) -> Change:
    """Another name for a view's pictures."""
    return lambda: [
        path.rename(path.with_name(path.name.replace(view, to)))
        for path in list(Path("scene/polar").glob(f"{view}_*"))
    ]


def sparse(path: str, size: int, begin: bytes) -> Change:
    """A file of a size that takes no room."""

    def change() -> None:
        with open(path, "wb") as file:
            file.write(begin)
            file.truncate(size)

    return change


def link(path: str, target: str = "../../outside") -> Change:
    """A link in a file's or folder's place."""

    def change() -> None:
        remove(path)()
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).symlink_to(target)

    return change


PLACES: dict[str, Callable[[Path], object]] = {
    "file": lambda path: path.write_text("no folder"),
    "empty": lambda path: path.write_bytes(b""),
    "folder": lambda path: path.mkdir(),
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "loop": lambda path: path.symlink_to(path.name),
    "root": lambda path: path.symlink_to("/"),
    "itself": lambda path: path.symlink_to("."),
    "dangling": lambda path: path.symlink_to("nowhere"),
    "outside": lambda path: path.symlink_to(Path.cwd().parent / "outside/victim.txt"),
}
"""What may stand where a file should be."""
OF_FILES = ("folder", "pipe", "device", "loop", "dangling", "outside")


def put(path: str, how: str) -> Change:
    """Something else in a file's or folder's place, be there anything or not."""

    def change() -> None:
        remove(path)()
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        PLACES[how](Path(path))

    return change


def instead(suffix: str, make: Callable[..., object], *given: Any, at: str = PICTURE, **more: Any) -> Change:
    """A file of another suffix in the place of a picture."""

    def change() -> None:
        Path(at).unlink()
        make(Path(at).with_suffix(suffix), *given, **more)

    return change


def instead_bytes(suffix: str, data: bytes, at: str = MOSAIC) -> Change:
    """The same with its bytes."""
    return instead(suffix, lambda path: path.write_bytes(data), at=at)


def drawn(path: str, pixels: Any) -> Change:
    """A picture written anew."""

    def change() -> None:
        Path(path).parent.mkdir(exist_ok=True)
        done, data = cv2.imencode(Path(path).suffix, pixels)
        assert done
        Path(path).write_bytes(data.tobytes())

    return change


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def truth(**arrays: Any) -> Change:
    """Arrays of the ground truth, beside those that are there."""
    return lambda: np.savez(TRUTH, **{**np.load(TRUTH), **arrays})


def tensors(change: Callable[[dict[str, Any]], object]) -> Change:
    """Tensors of the run's checkpoint, by name."""

    def changed() -> None:
        files = importlib.import_module("safetensors.torch")
        whole = files.load_file(CHECKPOINT)
        change(whole)
        files.save_file({name: values.contiguous() for name, values in whole.items()}, CHECKPOINT)

    return changed


def filled(name: str, value: float) -> Change:
    """One number for all of a tensor."""
    return tensors(lambda whole: whole[name].fill_(value))


def small_machine(then: Change) -> Change:
    """As on a machine with 2 GiB of free memory."""

    def change() -> None:
        importlib.import_module("polarguide.capture.memory").free_memory = lambda: 2 << 30
        then()

    return change


def limit(kind: int, value: int) -> Change:
    """A limit of the process."""
    return lambda: resource.setrlimit(kind, (value, value))


def memory(more: int) -> Change:
    """Room for so many MiB more than the process has now."""

    def change() -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit(resource.RLIMIT_AS, pages * resource.getpagesize() + (more << 20))()

    return change


def environment(**changed: str | None) -> Change:
    """Variables of the environment; None removes one."""
    given = {name: value for name, value in changed.items() if value is not None}
    return lambda: [os.environ.pop(name, None) for name in changed] and os.environ.update(given)


def nobody(*closed: str, mode: int = 0) -> Change:
    """As a user without rights, for whom some places are closed."""

    def change() -> None:
        here = Path.cwd()
        for path in [here, *here.rglob("*")]:
            if not path.is_symlink():
                os.chown(path, NOBODY, NOBODY)
        for name in closed:
            os.chmod(name, mode)
        os.setgid(NOBODY)
        os.setuid(NOBODY)

    return change


def beside(act: Change, when: str) -> Change:
    """Do something from another process, once the command has written a file; it ends with the command."""

    def change() -> None:
        if not os.fork():
            try:
                while not Path(when).exists():
                    time.sleep(0.001)
                act()
            finally:
                os._exit(0)

    return change


def held(lock: str) -> Change:
    """A lock that another process has until the command has ended."""

    def change() -> None:
        fcntl = importlib.import_module("fcntl")
        Path(lock).parent.mkdir(exist_ok=True)
        read, wrote = os.pipe()
        if not os.fork():
            try:
                with open(lock, "w") as file:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.write(wrote, b"x")
                    time.sleep(60)  # it is killed before
            finally:
                os._exit(0)
        os.close(wrote)  # else the other's end would not be seen here
        assert os.read(read, 1), f"{lock} is not to be had"
        os.close(read)

    return change


def no_control() -> None:
    """What was printed is obeyed by no terminal."""
    said = Path("../said").read_bytes()
    assert b"\x1b" not in said, said[-300:]
    assert "\u202e".encode() not in said, said[-300:]


def no_script() -> None:
    """No page that was written runs what stands in a record."""
    for path in [*Path().glob("*.html"), *Path("new").glob("**/*.html"), *Path("new").glob("**/*.svg")]:
        page = path.read_text(errors="replace")
        assert "<script>alert(1)" not in page, path
        assert "<img src=x" not in page, path


def no_formula(table: str) -> Callable[[], None]:
    """No line of a table begins as a formula of a spreadsheet."""

    def check() -> None:
        for line in Path(table).read_text().splitlines():
            assert not line.startswith(("=", "@", "+", "-", "\t")), line

    return check


def same_bytes(path: str, as_of: str) -> Callable[[], None]:
    """A file is still as another."""

    def check() -> None:
        assert Path(path).read_bytes() == Path(as_of).read_bytes(), path

    return check
