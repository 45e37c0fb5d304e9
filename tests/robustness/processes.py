"""What a process is given by its machine: limits, room, an environment, rights, and places that go away meanwhile."""

from __future__ import annotations  # noqa: I001

import os
import resource
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import hostile_files as made
from base import (
    CHECKPOINT, EVAL, FLAGS, MEASURE, MOSAIC, MOSAICS, READ, RENDER, RESUME, SHARE, TRAIN, export,
)  # fmt: skip
from case import Case, Change, nothing, table
from changes import SAME, beside, environment, held, limit, memory, nobody, rename, several, write

CASES: list[Case] = []

WORKS = "it works all the same"
READ_ONLY = stat.S_IRUSR | stat.S_IXUSR
LONG = f"train scene --out new --steps 60 --checkpoint-every 5 {FLAGS}"
WRITE = {
    "train": TRAIN, "resume": RESUME, "eval": EVAL, "share": SHARE, "render": RENDER, "priors": READ, "prepare": MOSAICS,
    **{f"export {kind}": export(kind) for kind in ("ply", "spz", "sog", "environment", "cameras")},
}  # fmt: skip


def _large(then: Change) -> Change:
    return several(lambda: made.png(Path(MOSAIC), 9000, 9000), then)

files = resource.RLIMIT_NOFILE
CASES += table(
    "process with", MOSAICS,
    Case("32 files open at most, training", limit(files, 32), TRAIN, passes=WORKS),
    Case("8 files open at most", limit(files, 8), passes=WORKS, ci=True),
    Case("little more memory, training", memory(64), TRAIN, passes=WORKS),
    Case("no more memory, preparing", memory(1), passes=WORKS),
    Case("no more memory, sharing", memory(1), SHARE, ci=True),
    Case("no more memory and a large measured mosaic", _large(memory(256)), MEASURE, ci=True),
    Case("no more processes", limit(resource.RLIMIT_NPROC, 0), EVAL, passes=WORKS),
    Case("a stack of 256 KiB", limit(resource.RLIMIT_STACK, 1 << 18), passes=WORKS),
    Case("files of 400 bytes", limit(resource.RLIMIT_FSIZE, 400), MEASURE, ci=True),
)  # fmt: skip

# A disk that takes no more after so many bytes of a file.

def check(bytes_: int) -> Callable[[], None]:
    def whole() -> None:
        half = [path for path in Path().rglob("*") if path.is_file() and path.stat().st_size == bytes_]
        left = [*Path().rglob("*.tmp*")]
        assert not half + left, [*half, *left]

    return whole

CASES += [
    Case(f"files of at most {most} bytes, {name}", limit(resource.RLIMIT_FSIZE, most), command,
         passes="all files are smaller", check=check(most), ci=most == 6_000 and name in ("train", "eval", "export ply"))
    for name, command in WRITE.items() for most in (6_000, 60_000, 600_000)
]  # fmt: skip

two = {"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}
distributed = {"no port": {"MASTER_PORT": ""},
               "a port of 99999999": {"MASTER_PORT": "99999999"}, "a local rank in words": {"LOCAL_RANK": "x"},
               "a world of 10^9": {"WORLD_SIZE": "1000000000", "MASTER_PORT": "0"},
               "ranks in words": {"RANK": "first", "WORLD_SIZE": "many"}}  # fmt: skip
many, none = {"POLARGUIDE_THREADS": "1000000000"}, {"TMPDIR": "/nowhere"}
rows: tuple[tuple[str, dict[str, str | None], str, str, bool], ...] = (
    ("a billion threads", {**many}, READ, "", True),
    ("pixels in words for OpenCV", {"OPENCV_IO_MAX_IMAGE_PIXELS": "many"}, READ, "", True),
    ("a width below 0 for OpenCV", {"OPENCV_IO_MAX_IMAGE_WIDTH": "-1"}, READ, "", True),
    ("a size with its unit for OpenCV", {"OPENCV_IO_MAX_IMAGE_PIXELS": "64MB"}, READ, SAME, True),
    ("a rank of words alone", {"RANK": "first"}, TRAIN, "", True),
    ("a HOME that is no folder", {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null"}, EVAL, WORKS, False),
    ("no folder for what is temporary, exporting SPZ", {**none}, export("spz"), WORKS, False),
    ("a terminal of no columns", {"COLUMNS": "0", "LINES": "-1", "TERM": ""}, EVAL, WORKS, False),
)
CASES += [
    *(Case(f"environment with {name}", environment(**changed), command, passes=reason, ci=ci)
      for name, changed, command, reason, ci in rows),
    *(Case(f"environment with {name}", environment(**{**two, **changed}), TRAIN, ci=name[:2] in ("ra", "a ", "no"))
      for name, changed in distributed.items()),
]  # fmt: skip

presentation = "run/presentation.json"
calibrated = f"{MOSAICS} --calibration calibration.json"
here = nobody(".", mode=READ_ONLY)
run = nobody("run", mode=READ_ONLY)
CASES += table(
    "no rights to", MOSAICS,
    Case("a mosaic", nobody(MOSAIC), ci=True),
    Case("the source", nobody("mosaics")),
    Case("write here", here, ci=True),
    Case("write a page", here, SHARE),
    Case("write a run", run, EVAL),
    Case("write a run, resumed", run, RESUME),
    *(Case(path, nobody(path), TRAIN) for path in (
        "scene", "scene/polar", "scene/sparse/0", "scene/masks", "scene/split.json")),
    Case("a checkpoint", nobody(CHECKPOINT), EVAL),
    Case("a presentation", several(write(presentation, "{}"), nobody(presentation)), SHARE),
    Case("a calibration", nobody("calibration.json"), calibrated),
    Case("a lock", several(write("run/.lock", ""), nobody("run/.lock")), RESUME),
)  # fmt: skip


def _removed() -> None:
    os.mkdir("gone")
    os.chdir("gone")
    os.rmdir("../gone")

CASES += table(
    "process", MOSAICS,
    Case("while another writes the run", held("run/.lock"), RESUME, ci=True),
    Case("while another writes the table", held("new/.lock"), MEASURE),
    Case("while another prepares", held("new/.lock")),
    Case("in a folder that is no more", _removed, TRAIN),
    Case("given empty names", nothing, TRAIN.replace("--out new", "--out="), ci=True),
    Case("without an input", lambda: os.close(0), passes=WORKS),
    Case("without an output", lambda: os.dup2(os.open("/dev/full", os.O_WRONLY), 1), MEASURE),
)  # fmt: skip


def _swap() -> None:
    """Half a mosaic in the place of a whole one, and back."""
    whole = Path(MOSAIC).read_bytes()
    for _ in range(400):
        Path(MOSAIC).write_bytes(whole[: len(whole) // 2])
        Path(MOSAIC).write_bytes(whole)

before = "the training may have ended before"
CASES += table(
    "process", MOSAICS,
    Case("whose source is renamed meanwhile", beside(rename("mosaics", "elsewhere"), "new"), passes=WORKS),
    Case("whose mosaics grow meanwhile", beside(_swap, "new"), passes=WORKS),
    Case("whose table's folder is removed meanwhile", beside(lambda: shutil.rmtree("new", ignore_errors=True), "new"), MEASURE,
         passes=WORKS),
    Case("whose run is renamed meanwhile", beside(rename("new", "elsewhere"), "new/log.jsonl"), LONG, passes=before),
    Case("whose run is removed meanwhile", beside(lambda: shutil.rmtree("new"), "new/log.jsonl"), LONG, passes=before),
)  # fmt: skip
