"""What a process is given by its machine: limits, room, an environment, rights, and places that go away meanwhile."""

from __future__ import annotations

import os
import resource
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import hostile_files as made
from base import CHECKPOINT, EVAL, FLAGS, MEASURE, MOSAIC, MOSAICS, READ, RENDER, RESUME, SHARE, TRAIN, export
from case import Case, nothing, table
from changes import SAME, beside, deferred, held, limit, memory, nobody, rename, several, write

CASES: list[Case] = []
WORKS = "it works all the same"
BEFORE = "the training may have ended before"
READ_ONLY = stat.S_IRUSR | stat.S_IXUSR
LONG = f"train scene --out new --steps 60 --checkpoint-every 5 {FLAGS}"
LARGE = several(lambda: made.png(Path(MOSAIC), 9000, 9000), memory(256))
CASES += table(
    "process with", MOSAICS,
    Case("32 files open at most, training", limit(resource.RLIMIT_NOFILE, 32), TRAIN, passes=WORKS),
    Case("8 files open at most", limit(resource.RLIMIT_NOFILE, 8), passes=WORKS, ci=True),
    Case("no more memory, sharing", memory(1), SHARE, ci=True),
    Case("no more memory and a large measured mosaic", LARGE, MEASURE, ci=True),
    Case("no more processes", limit(resource.RLIMIT_NPROC, 0), EVAL, passes=WORKS),
    Case("files of 400 bytes", limit(resource.RLIMIT_FSIZE, 400), MEASURE, ci=True),
)  # fmt: skip


def _whole(most: int) -> Callable[[], None]:
    """No file ends where the limit is, and none is temporary."""

    def check() -> None:
        half = [path for path in Path().rglob("*") if path.is_file() and path.stat().st_size == most]
        assert not half + [*Path().rglob("*.tmp*")], half

    return check


WRITERS = {
    "train": TRAIN, "resume": RESUME, "eval": EVAL, "share": SHARE, "render": RENDER, "prepare": MOSAICS,
    **{f"export {kind}": export(kind) for kind in ("ply", "spz", "environment", "cameras", "normals")},
}  # fmt: skip
CASES += [
    Case(f"files of at most {most} bytes, {name}", limit(resource.RLIMIT_FSIZE, most), command, check=_whole(most),
         passes="all files are smaller", ci=most == 6_000 and name in ("train", "eval", "export ply"))
    for name, command in WRITERS.items() for most in (6_000, 60_000)
]  # fmt: skip


@deferred
def _environment(**changed: str) -> None:
    os.environ.update(changed)


CASES += table(
    "environment with", TRAIN,
    Case("a billion threads", _environment(POLARGUIDE_THREADS="1000000000"), READ, ci=True),
    Case("pixels in words for OpenCV", _environment(OPENCV_IO_MAX_IMAGE_PIXELS="many"), READ, ci=True),
    Case("a width below 0 for OpenCV", _environment(OPENCV_IO_MAX_IMAGE_WIDTH="-1"), READ, ci=True),
    Case("a unit for OpenCV", _environment(OPENCV_IO_MAX_IMAGE_PIXELS="64MB"), READ, passes=SAME, ci=True),
    Case("no folder for what is temporary", _environment(TMPDIR="/nowhere"), export("spz"), passes=WORKS),
)  # fmt: skip

PRESENTED = "run/presentation.json"
CASES += table(
    "no rights to", MOSAICS,
    Case("a mosaic", nobody(MOSAIC), ci=True),
    Case("the source", nobody("mosaics")),
    Case("write here", nobody(".", mode=READ_ONLY), ci=True),
    Case("write a page", nobody(".", mode=READ_ONLY), SHARE),
    Case("write a run", nobody("run", mode=READ_ONLY), EVAL),
    Case("write a run, resumed", nobody("run", mode=READ_ONLY), RESUME),
    *(Case(path, nobody(path), TRAIN) for path in ("scene", "scene/polar", "scene/sparse/0", "scene/split.json")),
    Case("a checkpoint", nobody(CHECKPOINT), EVAL),
    Case("a presentation", several(write(PRESENTED, "{}"), nobody(PRESENTED)), SHARE),
    Case("a calibration", nobody("calibration.json"), more="--calibration calibration.json"),
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
    Case("in a folder that is no more", _removed, TRAIN),
    Case("given empty names", nothing, TRAIN.replace("--out new", "--out="), ci=True),
    Case("without an input", lambda: os.close(0), passes=WORKS),
    Case("without an output", lambda: os.dup2(os.open("/dev/full", os.O_WRONLY), 1), MEASURE),
    Case("whose table is removed meanwhile", beside(lambda: shutil.rmtree("new"), "new"), MEASURE, passes=WORKS),
    Case("whose run is renamed meanwhile", beside(rename("new", "elsewhere"), "new/log.jsonl"), LONG, passes=BEFORE),
)  # fmt: skip
