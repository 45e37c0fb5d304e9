"""Names that a console takes for markup, that it cannot write, or that are no text."""

from __future__ import annotations  # noqa: I001

import os
from pathlib import Path

from base import (
    EVAL, MAPS, MEASURE, MOSAIC, MOSAICS, ONE, PICTURE, READ, RENDER, SYNTH, TRAIN, WATCH,
)  # fmt: skip
from case import Case, nothing, table
from changes import A_NAME, copy, edit, no_control, rename, several, write, write_json
from synthesis import ball

CASES: list[Case] = []
NO_TEXT = os.fsdecode(b"new\xff\xfe")
CONTROL = "\x1b[2J\x1b]0;mine\x07\u202e"


def _named(command: str, out: str = "", source: str = "") -> list[str]:
    """A command whose source, or what it writes, is called otherwise."""
    words = command.split()
    if source:
        words[1] = source
    if out:
        words[words.index("--out") + 1] = out
    return words


for kind, name in (
    ("markup", "new[/red]"),
    ("escapes", "new\x1b[2J\u202e"),
    ("bytes that are no text", NO_TEXT),
):
    moved, shot = rename("run", name), f"mosaics/{name}.png"
    CASES += table(
        f"name of {kind}:", "",
        *(Case(verb, change, words, ci=kind == "escapes" and verb in ("train", "measure")) for verb, change, words in (
            ("train", nothing, _named(TRAIN, name)),
            ("eval", moved, _named(EVAL, source=name)),
            ("render", moved, _named(RENDER, source=name)),
            ("export", moved, ["export", name, "--format", "ply"]),
            ("prepare", nothing, _named(MOSAICS, name)),
            ("priors", nothing, _named(MAPS, name)),
            ("measure", nothing, _named(MEASURE, name)),
            ("a watched shot", several(copy(MOSAIC, shot), write(shot, "none")), WATCH),
            ("synth", write_json("spec.json", ball()), _named(SYNTH, name)),
        )),
        passes=A_NAME, check=no_control,
    )  # fmt: skip

# What was trained in a folder whose name is no UTF-8 can be read again.
name = os.fsdecode(b"run\xff")
film = f"render run --path orbit --frames 2 --layers final {ONE} --video"
CASES += table(
    "run in a folder whose name is no UTF-8:", "",
    Case("eval", command=_named(EVAL, source=name), ci=True),
    *(Case(f"export {kind}", command=["export", name, "--format", kind, *ONE.split()], ci=kind == "environment")
      for kind in ("ply", "environment", "cameras", "normals")),
    Case("share", command=["share", name, *ONE.split()]),
    Case("maps", command=_named(MAPS.replace("npy", "exr"), name), ci=True),
    Case("a film", command=[*_named(film, source=name), f"{name}/a.mp4"]),
    change=rename("run", name), passes=A_NAME, prints=r"\A(?!.*error: )",
)  # fmt: skip


def _view_of_control() -> None:
    for path in list(Path("scene/polar").glob("v001_*")):
        path.rename(path.with_name(path.name.replace("v001", CONTROL)))
    edit("scene/sparse/0/images.txt", lambda given: given.replace("v001.png", f"{CONTROL}.png"))()


CASES += table(
    "control characters of", TRAIN,
    Case("a view without a pose", _view_of_control, READ, ci=True),
    Case("a picture of no view", copy(PICTURE, f"scene/polar/{CONTROL}.png"), READ),
    Case("a scene", rename("scene", CONTROL), ["priors", CONTROL, *READ.split()[2:]], passes="they are not shown"),
    Case("an option", more=["--recipe", CONTROL], ci=True),
    check=no_control,
)  # fmt: skip
