"""Shots whose maps have no place, shots at other angles, and a table that is taken away."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from base import MOSAICS, READ, SHOTS
from fourth_places import SHOWN
from further_folders import MEASURE
from making import MOSAIC, Change, MadeCase, made_case, nothing


def _others_written(folder: Path) -> None:
    assert (folder / "new/v000/maps.json").exists()
    assert (folder / "new/v002/maps.json").exists()


def shot_cases() -> Iterator[MadeCase]:
    """Single shots."""

    def in_the_way(folder: Path) -> None:
        (folder / "new").mkdir()
        (folder / "new/v001").write_text("a file where a folder should be")

    yield made_case(
        "fourth shot whose folder is a file",
        in_the_way,
        ["priors", "mosaics", "--out", "new", *SHOWN],
        "",
        _others_written,
    )

    def at_another_angle(folder: Path) -> None:
        for angle in ("0", "45"):
            source = next((folder / "shots").rglob(f"*{angle}*/v000*"), None) or next(
                (folder / "shots").rglob(f"*v000*{angle}*")
            )
        (folder / "alone").mkdir()
        for angle in ("0", "45", "90", "135", "60"):
            shutil.copyfile(source, folder / f"alone/v_{angle}{source.suffix}")

    yield made_case(
        "fourth shot at 60 degrees beside four",
        at_another_angle,
        ["prepare", "alone", *SHOTS[2:]],
        says="warning: .*its pictures are the same",
    )

    def small(path: Path) -> None:
        import numpy as np

        for name in ("DoLP", "S0"):
            found = np.load(path / f"new/v001/{name}.npy").shape
            assert found[:2] == (10, 12), found

    yield made_case(
        "fourth view of a scene in half its size",
        nothing,
        [*READ, "--downscale", "2", "--formats", "npy"],
        "the maps have the size that was asked for",
        small,
    )

    def large(folder: Path) -> None:
        import numpy as np
        from PIL import Image

        for path in (folder / "mosaics").iterdir():
            path.unlink()
        Image.fromarray(np.full((6000, 6000), 900, np.uint16)).save(folder / MOSAIC)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + (50 << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    yield made_case(
        "fourth mosaic of 6000 pixels a side and 50 MiB",
        large,
        MOSAICS,
        says="memory",
    )


def watch_cases() -> Iterator[MadeCase]:
    """A table that goes away while it is written."""

    def later(act: Callable[[Path], object], after: float = 0.5) -> Change:
        def change(folder: Path) -> None:
            if not os.fork():
                for stream in (1, 2):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
                time.sleep(after)
                with contextlib.suppress(OSError):
                    act(folder)
                os._exit(0)

        return change

    watch = [
        "measure",
        "--watch",
        "mosaics",
        "--out",
        "new",
        *MEASURE[4:],
        "--settle",
        "0.05",
        "--idle",
        "1.5",
    ]
    for name, act in {
        "removed": lambda folder: shutil.rmtree(folder / "new"),
        "renamed": lambda folder: (folder / "new").rename(folder / "old"),
        "replaced": lambda folder: (
            (folder / "new/table.jsonl").unlink(),
            (folder / "new/table.jsonl").write_text(""),
        ),
    }.items():
        yield made_case(
            f"fourth watch whose table is {name}", later(act), watch, says="removed, renamed or replaced"
        )
