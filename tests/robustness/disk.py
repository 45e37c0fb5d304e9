"""The corpus of disks that are full."""

from __future__ import annotations

import random
import resource
from collections.abc import Iterator
from pathlib import Path

from base import EVAL, MOSAICS, READ, RESUME, TRAIN
from forked import Case


def disk_cases() -> Iterator[Case]:
    """A disk that takes no more after so many bytes of a file."""
    exports = ("ply", "spz", "sog", "environment", "cameras")
    commands = {
        "train": TRAIN,
        "resume": RESUME,
        "eval": EVAL,
        "share": ["share", "run", "--out", "new/page.html"],
        "render": ["render", "run", "--out", "new", "--device", "cpu"],
        "priors": READ,
        "prepare": MOSAICS,
        **{f"export {kind}": ["export", "run", "--format", kind, "--out", "new"] for kind in exports},
    }
    for name, command in commands.items():
        for limit in (6_000, 60_000, 600_000):

            def make(
                folder: Path, rng: random.Random, limit: int = limit, command: list[str] = command
            ) -> list[str]:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
                return command

            def check(folder: Path, limit: int = limit) -> None:
                half = [path for path in folder.rglob("*") if path.is_file() and path.stat().st_size == limit]
                left = [path for path in folder.rglob("*.tmp*")]
                assert not half + left, [*half, *left]

            yield Case(f"disk of {limit} bytes {name}", 0, make, "all files are smaller", check)
