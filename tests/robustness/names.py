"""Names that a console takes for markup, that it cannot write, or that are no text, and pages that are called so."""

from __future__ import annotations  # noqa: I001

import os
import sys

import numpy as np
from base import (
    EVAL, INSPECT, MAPS, MEASURE, MOSAIC, MOSAICS, ONE, PICTURE, READ, RENDER, SHARE, SYNTH, TRAIN, WATCH,
)  # fmt: skip
from case import Case, Change, nothing, table
from changes import A_NAME, copy, no_control, no_script, rename, renamed_view, several, truth, write, write_json
from synthesis import ball

CASES: list[Case] = []

NAMES = {
    "markup": "new[/red]",
    "escapes": "new\x1b[2J\u202e",
    "bytes that are no text": os.fsdecode(b"new\xff\xfe"),
}
CONTROL = "\x1b[2J\x1b]0;mine\x07\u202e"
ESCAPED = "it is escaped"
HOSTILE = "x<img src=x onerror=alert(1)>"
NO_ERROR = r"\A(?!.*error: )"


def _named(command: str, out: str = "", source: str = "") -> list[str]:
    """A command whose source, or what it writes, is called otherwise."""
    words = command.split()
    if source:
        words[1] = source
    if out:
        words[words.index("--out") + 1] = out
    return words

# Names of what is written and of what is read, with every verb that prints them.
rows = []
for kind, name in NAMES.items():
    moved = rename("run", name)
    rows += table(
        f"name of {kind}:", "",
        *(Case(verb, change, command, passes=A_NAME, check=no_control, ci=kind == "escapes" and verb in ("train", "measure"))
          for verb, change, command in (
            ("train", nothing, _named(TRAIN, name)),
            ("eval", moved, _named(EVAL, source=name)),
            ("render", moved, _named(RENDER, source=name)),
            ("export", moved, ["export", name, "--format", "ply"]),
            ("share", moved, _named(SHARE, source=name)),
            ("prepare", nothing, _named(MOSAICS, name)),
            ("priors", nothing, _named(MAPS, name)),
            ("measure", nothing, _named(MEASURE, name)),
            ("a watched shot", several(copy(MOSAIC, f"mosaics/{name}.png"), write(f"mosaics/{name}.png", "none")), WATCH),
            ("tables", nothing, _named("tables a --out new", source=name)),
            ("synth", write_json("spec.json", ball()), _named(SYNTH, name)),
          )),
    )  # fmt: skip
CASES += rows

# Runs in a folder whose name is no UTF-8: what was trained there can be read again.
name = os.fsdecode(b"run\xff")
film = ["render", name, "--path", "orbit", "--frames", "2", "--layers", "final", "--video", f"{name}/a.mp4", *ONE.split()]
CASES += table(
    "run in a folder whose name is no UTF-8:", "",
    Case("eval", command=_named(EVAL, source=name), ci=True),
    Case("render", command=_named(RENDER, f"{name}/new", name)),
    *(Case(f"export {kind}", command=["export", name, "--format", kind, *ONE.split()], ci=kind == "environment")
      for kind in ("ply", "sog", "environment", "cameras")),
    Case("maps", command=_named(MAPS.replace("npy", "exr"), name), ci=True),
    Case("a film", command=film),
    change=rename("run", name), passes=A_NAME, prints=NO_ERROR,
)  # fmt: skip


def _ascii() -> None:
    """A console that knows ASCII alone."""
    sys.stdout.reconfigure(encoding="ascii", errors="strict")  # type: ignore[union-attr]


def _object_of_markup() -> None:
    truth(objid=np.ones((20, 24), np.uint16))()
    write_json("scene/scene.json", {"objects": [{"id": 1, "name": "[/red]\x1b[2J"}]})()


def _in_the_model(name: str) -> Change:
    model = "scene/sparse/0/images.txt"

    def change() -> None:
        with open(model) as file:
            text = file.read()
        write(model, text.replace("v001.png", f"{name}.png".replace(" ", "")))()

    return several(renamed_view("v001", name), change)

script = "</title><script>alert(1)</script><img src=x onerror=alert(1)><!--"
CASES += [
    *table(
        "control characters of", TRAIN,
        Case("a view without a pose", _in_the_model(CONTROL), READ, ci=True),
        Case("a picture of no view", copy(PICTURE, f"scene/polar/{CONTROL}.png"), READ),
        Case("a scene", rename("scene", CONTROL), ["priors", CONTROL, *READ.split()[2:]], passes="it is shown without them"),
        Case("an option", more=["--recipe", CONTROL], ci=True),
        Case("a verb", command=[CONTROL]),
        check=no_control,
    ),
    Case("page of a hostile title", nothing, SHARE, ["--title", script, "--caption", script], passes=ESCAPED,
         check=no_script, ci=True),
    Case("inspection of a hostile name", rename("scene", HOSTILE), _named(INSPECT, source=HOSTILE), passes=ESCAPED,
         check=no_script),
    Case("console of ASCII: eval", _ascii, EVAL, passes=A_NAME),
    Case("console of ASCII: priors", _ascii, _named(MAPS, "n\u2603"), passes=A_NAME, ci=True),
]  # fmt: skip
