"""Single shots that are measured: regions, limits, golden parts, tables, watched folders.

A bad shot of a folder ends in an error of one line, and in a line of the table beside those of the good ones.
"""

from __future__ import annotations  # noqa: I001

import importlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from base import MEASURE, MOSAIC, ONE, WATCH, into
from case import Case, table
from changes import (
    REPLACED, beside, copy, edit_bytes, no_formula, put, remove, rename, several, text_forms, write, write_json,
)  # fmt: skip

CASES: list[Case] = []
SHOTS = f"measure shots --out new {ONE} --no-align"
WATCHED_SHOTS = f"measure --watch shots --out new {ONE} --no-align --settle 0.05 --patience 0.2 --idle 1"
PATIENT = f"{WATCH} --patience 0.2"
LIMITED = f"{MEASURE} --limits limits.json"
FORMULA = "a formula is written as text"


def _lines(**status: str) -> Callable[[], None]:
    """The table that a command has to leave: shot and status."""

    def check() -> None:
        lines = map(json.loads, Path("new/table.jsonl").read_text(encoding="utf-8").splitlines())
        found = [(line["shot"], line["status"]) for line in lines]
        assert set(status.items()) <= set(found), found
        assert len(set(found)) == len(found), found

    return check


def _saved(path: str, *shape: int, value: float = 0, kind: str = "uint16") -> Callable[[], None]:
    return lambda: np.save(path, np.full(shape, value, kind))


GOOD = {"v000": "measured", "v001": "measured", "v002": "measured"}
CASES += table(
    "measured shots", SHOTS,
    Case("of two files of an angle", copy("shots/45/v000.png", "shots/45/v000.jpg"), found="v000.jpg and v000.png",
         expected="one picture of v000 at 45 degrees", check=_lines(v000="unread", v001="measured"), ci=True),
    Case("of three of four", remove("shots/90/v000.png"), prints="none at 90",
         check=_lines(v000="unread", v001="measured"), ci=True),
    Case("with two folders of an angle", lambda: os.mkdir("shots/I-45"), expected="one folder for 45", ci=True),
) + table(
    "measured mosaics", MEASURE,
    *(Case(f"with a {how} that is called like a picture", put("mosaics/w.png", how), where=r"w\.png",
           check=_lines(w="unread", v001="measured"), ci=True) for how in ("folder", "pipe", "loop")),
    *(Case(f"with one of {name}", _saved("mosaics/w.npy", *shape, value=value, kind=kind), prints=prints,
           check=_lines(w="unread", **GOOD), ci=True) for name, shape, value, kind, prints in (
        ("floats that are no numbers", (32, 32), np.nan, "float32", "raw mosaic"),
        ("three pixels", (1, 3), 0, "uint16", "at least 16x16 pixels"),
        ("more pixels than the sensor", (2058, 2466), 0, "uint16", "at most 2464x2056 pixels"),
    )),
    Case("with a name of a new line and a command of the terminal", copy(MOSAIC, "mosaics/a\n\x1b[2Jb.png"),
         more="--roi 0,0,99,99", expected="roi1 within", ci=True),
    Case("of the same twice", command=["measure", "mosaics", *MEASURE.split()[1:]], passes="each is measured once"),
    Case("with a dark frame of another size", _saved("dark.npy", 16, 16), more="--dark-frame dark.npy",
         prints="dark frame of 64x48", check=_lines(v000="unread")),
    Case("with three golden parts", more="--reference mosaics", expected="one shot", found="3", ci=True),
    Case("with a golden part of another size", _saved("g.npy", 32, 32), more="--reference g.npy"),
    *(Case(f"with {name}", more=more, passes=reason, ci=ci) for name, more, reason, ci in (
        ("noise without a full well", "--read-noise 5", "", True),
        ("a watched folder beside shots", "--watch mosaics", "", True),
        ("a settle without a watch", "--settle 2", "", False),
        ("a saturation of 1", "--saturation 1", "the table says that all are saturated", False),
        ("one region twice", "--roi a=1,1,2,2 --roi a=2,2,2,2", "", True),
        ("300 regions", " ".join(f"--roi r{k}=1,1,2,2" for k in range(300)), "there may be many", False),
    )),
) + table(
    "region", MEASURE,
    *(Case(name, more=["--roi", text], passes=reason, ci=True) for name, text, reason in (
        ("of other digits", "\u0661,2,3,4", ""),
        ("of 5000 digits", f"1,2,3,{'9' * 5000}", ""),
        ("of no width", "1,2,0,4", ""),
        ("beyond the picture", "60,40,9,9", ""),
        ("that is called by a new line", "a\nb=0,0,1,1", ""),
        ("of a name that is a formula", "@SUM(1)=1,1,2,2", FORMULA),
    )),
)  # fmt: skip

CASES += table(
    "limits", LIMITED,
    *(Case(f"of {name}", write_json("limits.json", content), ci=ci) for name, content, ci in (
        ("an unknown field", {"limits": {"dolp_men": {"max": 1}}}, True),
        ("a bound of nothing", {"limits": {"dolp_mean": {}}}, False),
        ("a bound that is no number", {"limits": {"dolp_mean": {"max": float("nan")}}}, False),
        ("bounds the wrong way", {"limits": {"dolp_mean": {"min": 0.9, "max": 0.1}}}, True),
        ("an angle of 900 degrees", {"limits": {"aolp_mean": {"min": -400, "max": 900}}}, False),
        ("an unknown region", {"regions": {"../x": {"dolp_mean": {"max": 1}}}}, True),
        ("another format", {"format": 2, "limits": {"dolp_mean": {"max": 1}}}, False),
        ("nothing", {}, False),
    )),
    Case("of half a character", write("limits.json", b'{"limits": {"dolp_mean\xff": {"max": 1}}}'), ci=True),
    *(Case(name, change, passes=reason) for name, change, reason in text_forms(
        "limits.json", {"format": 1, "limits": {"dolp_mean": {"max": 1.0}}}, "format")),
)  # fmt: skip


def _measured() -> None:
    importlib.import_module("polarguide.cli.app").run(MEASURE.split())


def _line(**changed: Any) -> bytes:
    entry = {
        "format": 1,
        "shot": "a",
        "files": [],
        "status": "measured",
        "why": "",
        "notes": [],
        "regions": [],
    }
    return json.dumps({**entry, **changed}).encode() + b"\n"


def _dated(nanoseconds: int) -> bytes:
    return _line(files=[{"path": "/x/a.png", "bytes": 1, "modified": nanoseconds}])


def _mine() -> None:
    assert Path("new/table.csv").read_text() == "mine"


LINES = "new/table.jsonl"
OTHERS = several(lambda: os.mkdir("new"), write("new/table.csv", "mine"))
FAILING = write_json("limits.json", {"limits": {"dolp_mean": {"max": 0}}})
CASES += table(
    "table", MEASURE,
    *(Case(name, several(_measured, write(LINES, data)), passes=reason, ci=ci) for name, data, reason, ci in (
        ("of zeros", bytes(4096), "a last line without an end is one that a kill has torn", False),
        ("of a line that is none", b"{}\n" + _line(), "", True),
        ("of a line that is no text", b"\xff\xfe\n", "", False),
        ("of a line of another format", _line(format=99), "", True),
        ("of 10^30 nanoseconds", _dated(10**30), "", True),
        ("of one line of 40 MB", _line(why="x" * 40_000_000), "a line may be long", False),
    )),
    *(Case(name, several(_measured, change), passes=reason, ci=ci) for name, change, reason, ci in (
        ("with other options", write("new/measure.json", '{"format": 1}\n'), "", True),
        ("whose CSV is a link outside", put("new/table.csv", "outside"), REPLACED, False),
        ("whose lines are a link outside", put(LINES, "outside"), "", True),
        ("whose lines are a pipe", put(LINES, "pipe"), "", True),
        ("whose lock is a link outside", put("new/.lock", "outside"), "", False),
    )),
    Case("of formulas", several(_measured, write(LINES, _line(shot="=1+1", status="unread", why="@SUM(1)"))),
         passes=FORMULA, check=no_formula("new/table.csv"), ci=True),
    Case("whose pictures go outside", several(
        lambda: os.mkdir("new"), lambda: os.symlink("../../outside", "new/beyond"), FAILING), LIMITED, ci=True),
    Case("over another's", OTHERS, check=_mine, ci=True),
    Case("over another's, as asked", OTHERS, more="--overwrite", passes="it is asked for"),
    Case("into a scene", command=into("scene", MEASURE), passes="a table may lie in any folder"),
    Case("among mosaics", command=into("mosaics", MEASURE)),
)  # fmt: skip

HALF = edit_bytes("mosaics/w.png", lambda data: data[:99])
CASES += table(
    "watched folder", WATCH,
    Case("that is a file", command=WATCH.replace("watch mosaics", f"watch {MOSAIC}"), where=MOSAIC, ci=True),
    Case("into itself", command=into("mosaics", WATCH)),
    Case("that goes away", beside(rename("mosaics", "elsewhere"), LINES),
         passes="a folder of the network may come back"),
    Case("with half a file", several(copy(MOSAIC, "mosaics/w.png"), HALF), PATIENT, prints="cut short",
         check=_lines(w="unread", **GOOD), ci=True),
    Case("with a pipe", put("mosaics/w.png", "pipe"), passes="what is no file is passed over", check=_lines(**GOOD)),
    Case("with two files of an angle", copy("shots/45/v000.png", "shots/45/v000.tif"), WATCHED_SHOTS,
         prints="one picture of v000 at 45 degrees", check=_lines(v000="unread", v001="measured")),
) + [
    Case(f"watch whose table is {name}", beside(act, LINES), WATCH.replace("0.6", "1.5"),
         ci=name == "replaced", prints="removed, renamed or replaced|No such file") for name, act in (
        ("removed", lambda: shutil.rmtree("new")), ("renamed", rename("new", "old")),
        ("replaced", several(remove(LINES), write(LINES, ""))))
]  # fmt: skip
