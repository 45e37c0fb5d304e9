"""Single shots that are measured: regions, limits, golden parts, tables, watched folders.

A bad shot of a folder ends in an error of one line, and in a line of the table beside those of the good ones.
"""

from __future__ import annotations  # noqa: I001

import importlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from base import MEASURE, MOSAIC, ONE, WATCH, into
from case import Case, Change, table
from changes import (
    PLAUSIBLE, beside, copy, edit_bytes, no_formula, put, remove, rename, several, write, write_json,
)  # fmt: skip
from raw import text_forms

CASES: list[Case] = []

SHOTS = "measure shots --out new --threads 1 --no-align"
WATCHED_SHOTS = f"measure --watch shots --out new {ONE} --no-align --settle 0.05 --patience 0.2 --idle 1"
LIMITED = f"{MEASURE} --limits limits.json"
FORMULA = "a formula is written as text"
CLOCK = "a clock may be wrong"


def _lines(**status: str) -> Callable[[], None]:
    """The table that a command has to leave: shot and status."""

    def check() -> None:
        lines = [json.loads(line) for line in Path("new/table.jsonl").read_text(encoding="utf-8").splitlines()]
        found = {(line["shot"], line["status"]) for line in lines}
        assert set(status.items()) <= found, found
        assert len(lines) == len(found), found

    return check

twice = "one picture of v000 at 45 degrees"
of_two = _lines(v000="unread", v001="measured")
CASES += [
    *table(
        "measured shots", SHOTS,
        Case("of two files of an angle", copy("shots/45/v000.png", "shots/45/v000.jpg"), expected=twice,
             found="v000.jpg and v000.png", check=of_two, ci=True),
        Case("of three of four", remove("shots/90/v000.png"), prints="none at 90", check=of_two, ci=True),
        Case("without an angle", remove("shots/90"), expected="four folders"),
        Case("with two folders of an angle", lambda: os.mkdir("shots/I-45"), expected="one folder for 45", ci=True),
    ),
    *table(
        "measured mosaics", MEASURE,
        *(Case(f"with a {how} that is called like a picture", put("mosaics/w.png", how), where=r"w\.png",
               check=_lines(w="unread", v001="measured"), ci=True) for how in ("folder", "pipe", "loop")),
        Case("with a name of a new line and a command of the terminal", copy(MOSAIC, "mosaics/a\n\x1b[2Jb.png"),
             more="--roi 0,0,99,99", expected="roi1 within", ci=True),
        Case("with a name as long as it can be", copy(MOSAIC, f"mosaics/{'x' * 251}.png"),
             more=f"--reference {MOSAIC}", prints="name", check=_lines(v001="measured")),
        Case("of the same twice", command=["measure", "mosaics", *MEASURE.split()[1:]], passes="each is measured once"),
    ),
]  # fmt: skip

good = _lines(v000="measured", v001="measured", v002="measured", w="unread")
raw = "raw mosaic"
CASES += table(
    "measured mosaic", MEASURE,
    *(Case(f"of {name}", lambda values=values: np.save("mosaics/w.npy", values), prints=prints, check=good, ci=ci)
      for name, values, prints, ci in (
        ("floats that are none", np.full((32, 32), np.nan, np.float32), raw, True),
        ("three pixels", np.zeros((1, 3), np.uint16), "at least 16x16 pixels", True),
        ("more pixels than the sensor", np.zeros((2058, 2466), np.uint16), "at most 2464x2056 pixels", True),
    )),
    Case("packed, of unknown size", write("mosaics/w.raw", bytes(4608)), prints="width, height and packing", check=good),
    Case("with a dark frame of another size", lambda: np.save("dark.npy", np.zeros((16, 16), np.uint16)),
         more="--dark-frame dark.npy", prints="dark frame of 64x48", check=_lines(v000="unread")),
)  # fmt: skip

CASES += table(
    "region", MEASURE,
    *(Case(name, more=["--roi", text], passes=reason, ci=ci) for name, text, reason, ci in (
        ("of other digits", "\u0661,2,3,4", "", True),
        ("of 5000 digits", f"1,2,3,{'9' * 5000}", "", True),
        ("of no width", "1,2,0,4", "", True),
        ("of negative places", "a=-1,2,3,4", "", False),
        ("beyond the picture", "60,40,9,9", "", True),
        ("that is called by a new line", "a\nb=0,0,1,1", "", True),
        ("of a name that is a formula", "@SUM(1)=1,1,2,2", FORMULA, True),
    )),
    Case("one name twice", more="--roi a=1,1,2,2 --roi a=2,2,2,2", ci=True),
    Case("a name like that of another", more="--roi roi2=1,1,2,2 --roi 2,2,2,2"),
    Case("300 of them", more=" ".join(f"--roi r{k}=1,1,2,2" for k in range(300)), passes="there may be many"),
)  # fmt: skip

CASES += table(
    "measure with", MEASURE,
    *(Case(name, more=more, passes=reason, ci=ci) for name, more, reason, ci in (
        ("noise without a full well", "--read-noise 5", "", True),
        ("a watched folder beside shots", "--watch mosaics", "", True),
        ("a settle without a watch", "--settle 2", "", False),
        ("a saturation of 1", "--saturation 1", "the table says that all are saturated", False),
        ("a reference of another size", "--reference scene/polar/v000_000.png", "", True),
    )),
    Case("three golden parts", more="--reference mosaics", expected="one shot", found="3", ci=True),
)  # fmt: skip

CASES += table(
    "limits", LIMITED,
    *(Case(f"that are a {how}", put("limits.json", how)) for how in ("folder", "device")),
    *(Case(name, write("limits.json", text), ci=ci) for name, text, ci in (
        ("of a bound that is no number", '{"limits": {"dolp_mean": {"max": NaN}}}', False),
        ("of half a character", b'{"limits": {"dolp_mean\xff": {"max": 1}}}', True),
    )),
    *(Case(name, write_json("limits.json", content), ci=ci) for name, content, ci in (
        ("of an unknown field", {"limits": {"dolp_men": {"max": 1}}}, True),
        ("of a bound of nothing", {"limits": {"dolp_mean": {}}}, False),
        ("of bounds the wrong way", {"limits": {"dolp_mean": {"min": 0.9, "max": 0.1}}}, True),
        ("of an unknown region", {"regions": {"../x": {"dolp_mean": {"max": 1}}}}, True),
        ("with 200000 fields", {"limits": {f"f{k}": {"max": 1} for k in range(200_000)}}, False),
    )),
    *(Case(name, change, passes=reason) for name, change, reason in text_forms(
        "limits.json", {"format": 1, "limits": {"dolp_mean": {"max": 1.0}}}, "format")),
)  # fmt: skip


ENTRY = {
    "format": 1, "shot": "a", "files": [], "status": "measured", "why": "", "notes": [], "regions": [],
}  # fmt: skip


def _measured() -> None:
    importlib.import_module("polarguide.cli.app").run(MEASURE.split())


def _line(**changed: Any) -> bytes:
    return json.dumps({**ENTRY, **changed}).encode() + b"\n"

there = {"path": "/x/a.png", "bytes": 1, "modified": 1}
torn = "a last line without an end is one that a kill has torn"
replaced = "a link is replaced, and what it led to stays"
command = "=cmd|' /C calc'!A0"

def dated(nanoseconds: int) -> bytes:
    return _line(files=[{**there, "modified": nanoseconds}])

def mine() -> None:
    assert Path("new/table.csv").read_text() == "mine"

new = lambda: os.mkdir("new")  # noqa: E731
others = several(new, write("new/table.csv", "mine"))
beyond = several(new, lambda: os.symlink("../../outside", "new/beyond"),
                 write_json("limits.json", {"limits": {"dolp_mean": {"max": 0}}}))  # fmt: skip
CASES += table(
    "table", MEASURE,
    *(Case(name, several(_measured, write("new/table.jsonl", data)), passes=reason, ci=ci, check=check)
      for name, data, reason, ci, check in (
        ("of zeros", bytes(4096), torn, False, None),
        ("of a line that is none", b"{}\n" + _line(), "", True, None),
        ("of a line of another format", _line(format=99), "", True, None),
        ("of a status that there is not", _line(status="fine"), "", False, None),
        ("of 10^30 nanoseconds", dated(10**30), "", True, None),
        ("of a negative time", dated(-(10**18)), CLOCK, False, None),
        ("of formulas", _line(shot=command, status="unread", why="@SUM(1)"), FORMULA, True, no_formula("new/table.csv")),
        ("of unknown figures", _line(regions=[{"region": "a", "stranger": 3}]), PLAUSIBLE, False, None),
        ("of one line of 40 MB", _line(why="x" * 40_000_000), "a line may be long", False, None),
    )),
    *(Case(f"with {name}", several(_measured, write("new/measure.json", data)), where=r"measure\.json", ci=ci)
      for name, data, ci in (("other options", b'{"format": 1}\n', True),
                             ("options in a list", b"[]", False), )),
    *(Case(name, several(_measured, change), passes=reason, ci=ci) for name, change, reason, ci in (
        ("whose CSV is a folder", put("new/table.csv", "folder"), "", False),
        ("whose CSV is a link outside", put("new/table.csv", "outside"), replaced, False),
        ("whose lines are a link outside", put("new/table.jsonl", "outside"), "", True),
        ("whose lines are a pipe", put("new/table.jsonl", "pipe"), "", True),
        ("whose lock is a link outside", put("new/.lock", "outside"), "", False),
    )),
    Case("whose pictures go outside", beyond, LIMITED, ci=True),
    Case("whose pictures are a file", several(new, write("new/differences", "mine")),
         more=f"--reference {MOSAIC}", prints="differences"),
    Case("over another's", others, check=mine, ci=True),
    Case("over another's, as asked", others, more="--overwrite", passes="it is asked for"),
    Case("into a scene", command=into("scene", MEASURE), passes="a table may lie in any folder"),
    Case("among mosaics", command=into("mosaics", MEASURE)),
)  # fmt: skip

good = {"v000": "measured", "v001": "measured", "v002": "measured"}
edit_bytes(MOSAIC, lambda data: data[:900])
patient = f"{WATCH} --patience 0.2"

def watched(folder: str) -> str:
    return WATCH.replace("--watch mosaics", f"--watch {folder}")

CASES += table(
    "watched folder", WATCH,
    Case("that is a file", command=watched(MOSAIC), where=MOSAIC, ci=True),
    Case("of its own table", command=watched("new"), ci=True),
    Case("into itself", command=into("mosaics", WATCH)),
    Case("that goes away", beside(rename("mosaics", "elsewhere"), "new/table.jsonl"), passes="a folder of the network may come back"),
    Case("with half a file", several(copy(MOSAIC, "mosaics/w.png"), edit_bytes("mosaics/w.png", lambda data: data[:99])),
         patient, prints="cut short", check=_lines(w="unread", **good), ci=True),
    Case("with a pipe", put("mosaics/w.png", "pipe"), check=_lines(**good), passes="what is no file is passed over"),
    Case("with two files of an angle", copy("shots/45/v000.png", "shots/45/v000.tif"), WATCHED_SHOTS,
         prints="one picture of v000 at 45 degrees", check=_lines(v000="unread", v001="measured")),
    Case("without one of its angles", remove("shots/90"), WATCHED_SHOTS, expected="four folders"),
)  # fmt: skip

removed = "removed, renamed or replaced"
gone_over = several(remove("new/table.jsonl"), write("new/table.jsonl", ""))
acts: Sequence[tuple[str, Change]] = (
    ("removed", lambda: shutil.rmtree("new")), ("renamed", rename("new", "old")), ("replaced", gone_over),
)  # fmt: skip
CASES += [
    Case(f"watch whose table is {name}", beside(act, "new/table.csv"), WATCH.replace("0.6", "1.5"), prints=removed,
         ci=name == "replaced") for name, act in acts
]  # fmt: skip
