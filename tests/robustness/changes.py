"""Changes to the base, which is the current folder when they are made: files, pictures, arrays, the process."""

from __future__ import annotations

import functools
import importlib
import json
import os
import resource
import shutil
import struct
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from base import CHECKPOINT, PICTURE, TRUTH
from case import Change

OUTSIDE = "../../outside/victim.txt"
"""As a link in a folder of the base sees the file beside it."""
NOBODY = 65534
SAME = "it is the same content in another form"
UNUSED = "what is wrong with it is not read"
PLAUSIBLE = "the number that changed is as plausible as the one before"
A_NAME = "a name may be any that the disk takes"
OPTIONAL = "the field may be missing, and is not relied on"
CHECKED = "the chunk or the bytes that changed are not read, such as those behind the end of the picture"
REPLACED = "a link is replaced, and what it led to stays"
OF_FILES = ("folder", "pipe", "device", "loop", "dangling", "outside")
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
"""What may stand where a file or a folder should be."""


def deferred(act: Callable[..., object]) -> Callable[..., Change]:
    """A function whose call is a change: what it does is done later, in the folder of a case."""

    @functools.wraps(act)
    def change(*given: Any, **named: Any) -> Change:
        return functools.partial(act, *given, **named)

    return change


several = deferred(lambda *changes: [change() for change in changes])
"""One change after the other."""
write = deferred(lambda path, data: Path(path).write_bytes(data.encode() if isinstance(data, str) else data))
"""Write a file: text or bytes."""
write_json = deferred(lambda path, content: Path(path).write_text(json.dumps(content)))
"""Write a JSON file."""
edit = deferred(lambda path, change: Path(path).write_text(change(Path(path).read_text())))
"""A text file written otherwise: ``change`` makes another text of it."""
edit_bytes = deferred(lambda path, change: Path(path).write_bytes(change(Path(path).read_bytes())))
"""A file of other bytes."""
limit = deferred(lambda kind, value: resource.setrlimit(kind, (value, value)))
"""A limit of the process."""
truth = deferred(lambda **arrays: np.savez(TRUTH, **{**np.load(TRUTH), **arrays}))
"""Arrays of the ground truth, beside those that are there."""


@deferred
def field(path: str, *keys: Any, to: Any) -> None:
    """One value of a JSON file."""
    whole = inner = json.loads(Path(path).read_text())
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = to
    Path(path).write_text(json.dumps(whole))


@deferred
def remove(*paths: str) -> None:
    """Remove files and folders."""
    for path in map(Path, paths):
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)


@deferred
def copy(source: str, *targets: str) -> None:
    """Copy a file."""
    for target in targets:
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)


@deferred
def rename(source: str, target: str) -> None:
    """Rename a file or a folder."""
    os.makedirs(os.path.dirname(target) or ".", exist_ok=True)
    os.rename(source, target)


@deferred
def sparse(path: str, size: int, begin: bytes) -> None:
    """A file of a size that takes no room."""
    Path(path).write_bytes(begin)
    os.truncate(path, size)


@deferred
def link(path: str, target: str = "../../outside") -> None:
    """A link in a file's or folder's place."""
    remove(path)()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).symlink_to(target)


@deferred
def put(path: str, how: str) -> None:
    """Something else in a file's or folder's place, be there anything or not."""
    remove(path)()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    PLACES[how](Path(path))


@deferred
def instead(suffix: str, make: Callable[..., object], *given: Any, at: str = PICTURE, **more: Any) -> None:
    """A file of another suffix in the place of a picture."""
    Path(at).unlink()
    make(Path(at).with_suffix(suffix), *given, **more)


@deferred
def drawn(path: str, pixels: Any) -> None:
    """A picture written anew."""
    Path(path).parent.mkdir(exist_ok=True)
    done, data = cv2.imencode(Path(path).suffix, pixels)
    assert done
    Path(path).write_bytes(data.tobytes())


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@deferred
def tensors(change: Callable[[dict[str, Any]], object]) -> None:
    """Tensors of the run's checkpoint, by name."""
    files = importlib.import_module("safetensors.torch")
    whole = files.load_file(CHECKPOINT)
    change(whole)
    files.save_file({name: values.contiguous() for name, values in whole.items()}, CHECKPOINT)


def filled(name: str, value: float) -> Change:
    """One number for all of a tensor."""
    return tensors(lambda whole: whole[name].fill_(value))


@deferred
def small_machine(then: Change) -> None:
    """As on a machine with 2 GiB of free memory."""
    importlib.import_module("polarguide.capture.layout").free_memory = lambda: 2 << 30
    then()


@deferred
def memory(more: int) -> None:
    """Room for so many MiB more than the process has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit(resource.RLIMIT_AS, pages * resource.getpagesize() + (more << 20))()


@deferred
def nobody(*closed: str, mode: int = 0) -> None:
    """As a user without rights, for whom some places are closed."""
    for path in [Path.cwd(), *Path.cwd().rglob("*")]:
        if not path.is_symlink():
            os.chown(path, NOBODY, NOBODY)
    for name in closed:
        os.chmod(name, mode)
    os.setgid(NOBODY)
    os.setuid(NOBODY)


@deferred
def beside(act: Change, when: str) -> None:
    """Do something from another process, once the command has written to a place; it ends with the command."""
    if not os.fork():
        try:
            while not (os.path.exists(when) and os.path.getsize(when)):
                time.sleep(0.001)
            act()
        finally:
            os._exit(0)


@deferred
def held(lock: str) -> None:
    """A lock that another process has until the command has ended."""
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


def text_forms(path: str, content: dict[str, Any], number: str) -> Sequence[tuple[str, Change, str]]:
    """A JSON file as Windows and careless programs save it: name, change, and why it may pass."""
    plain, large = json.dumps(content), json.dumps({**content, number: 87654321})
    return (
        ("with a mark of its bytes", write(path, "\ufeff" + plain), SAME),
        ("with lines as Windows has them", write(path, plain.replace(", ", ",\r\n ")), SAME),
        ("with a number of 1e400", write(path, large.replace("87654321", "1e400")), ""),
        ("with true for a number", write_json(path, {**content, number: True}), ""),
        ("with a comment", write(path, "// mine\n" + plain), ""),
    )


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
        begins = [line[:1] for line in Path(table).read_text().splitlines()]
        assert not set(begins) & set("=@+-\t"), begins

    return check
