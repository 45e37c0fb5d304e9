"""Cases that are no random choice, with the words that each has to end with: what was found once, and stays mended."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import corpus
import spoil
from base import EVAL, MOSAICS, READ, RESUME, TRAIN
from forked import Case

Change = Callable[[Path, random.Random], None]
WHOLE = "error: scene/sparse/0/{0}: expected a complete COLMAP {0}, found "


def named_cases() -> Iterator[Case]:
    """All of them."""
    for make in (models, arrays, scenes, places, options):
        for case in make():
            yield replace(case, name=f"named {case.name}")


def says(name: str, change: Change, command: list[str], words: str) -> Case:
    """A case that has to print ``words``, a regular expression."""
    return replace(corpus.case(name, 0, change, command), says=words)


def models() -> Iterator[Case]:
    """Models that are cut short at many places: once a hang, or accepted."""
    for file in ("frames.bin", "rigs.bin"):
        for part in range(8):

            def cut(folder: Path, rng: random.Random, file: str = file, part: int = part) -> None:
                corpus.binary_model(folder)
                path = folder / "scene/sparse/0" / file
                path.write_bytes(path.read_bytes()[: part * path.stat().st_size // 8])

            yield says(f"{part}/8 of {file}", cut, READ, WHOLE.format(file))
    empty = corpus.on("scene/sparse/0/cameras.txt", spoil.bytes_of, "empty")
    yield says("cameras.txt empty", empty, READ, WHOLE.format("cameras.txt") + "an empty file")


def arrays() -> Iterator[Case]:
    """Archives of ground truth that claim more than there is, or cannot be opened."""
    for how in ("header", "encrypted", "objects", "not finite"):
        change = corpus.on("scene/gt/v000.npz", spoil.archive, how)
        yield says(f"gt {how}", change, READ, r"error: scene/gt/v000\.npz.*: expected ")


def scenes() -> Iterator[Case]:
    """What a scene may be as a whole."""

    def types(value: object) -> Change:
        return lambda folder, rng: spoil.json_field(folder / "scene/scene.json", ("objects",), value)

    wrong = {
        "a number": 3,
        "text": "cup",
        "numbers": [1],
        "a material": [{"material": 1}],
        "an ior": [{"material": {"ior": "1.5"}}],
    }
    for name, value in wrong.items():
        yield says(f"objects {name}", types(value), READ, r"error: scene/scene\.json \(objects.*expected ")
    pictures = {
        "gray": "warning: 1 of 9 views have gray pictures among others in color",
        "black": "warning: 1 of 9 views have pictures that are black throughout",
        "white": "warning: .*are at full scale",
    }
    for how, words in pictures.items():
        yield says(f"one {how}", corpus.on("scene/polar/v001_045.png", spoil.picture, how), READ, words)
    mosaics = {"black": "warning: v001: .*black throughout", "white": "warning: v001: 100% .*saturated"}
    for how, words in mosaics.items():
        yield says(f"mosaic {how}", corpus.on("mosaics/v001.png", spoil.picture, how), MOSAICS, words)


def places() -> Iterator[Case]:
    """Pipes and devices where a file should be: reading them may never end."""
    film = ["render", "run", "--path", "path.json", "--video", "new.mp4", "--frames", "2"]
    checkpoint = "run/checkpoint.safetensors"
    for file, command in ((checkpoint, EVAL), (checkpoint, RESUME), ("path.json", film)):
        for how in ("pipe", "device"):

            def change(folder: Path, rng: random.Random, file: str = file, how: str = how) -> None:
                (folder / file).touch()
                spoil.place(folder / file, how)

            yield says(
                f"{file} {how} {command[0]}", change, command, f"error: {file}: expected .*a pipe or device"
            )


def options() -> Iterator[Case]:
    """Just outside of what an option may be; the rest of what it may not is in ``options.py``."""
    priors = ["priors", "scene", "--out", "new"]
    outside = [
        (TRAIN[:-4], "threads", "1025", "up to 1024"),
        (TRAIN[:-4], "threads", "-1", "0 or more"),
        (TRAIN, "seed", str(2**63), f"up to {2**63 - 1}"),
        (TRAIN, "seed", "-1", "0 or more"),
        (TRAIN, "views-per-step", "4097", "up to 4096"),
        (TRAIN, "refractive-index", "nan", "between 1 and 4"),
        (priors, "threshold", "nan", ""),
        (MOSAICS, "black-level", "inf", ""),
        (MOSAICS, "zero", "nan", ""),
    ]
    for command, option, value, words in outside:
        arguments = [*command, f"--{option}", value]
        nothing: Change = lambda folder, rng: None  # noqa: E731
        yield says(
            f"--{option} {value}", nothing, arguments, f"error: .*{option}.*: expected .*{words}.*found"
        )
