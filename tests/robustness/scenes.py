"""Scene folders: their records, their tables, and the folder as a whole."""

from __future__ import annotations  # noqa: I001

import os
from pathlib import Path
from typing import Any

import numpy as np
import spoil
from base import EVAL, INSPECT, PICTURE, READ, TRAIN, of
from case import Case, Change, table
from changes import (
    A_NAME, OF_FILES, OPTIONAL, PLAUSIBLE, UNUSED, copy, deferred, field, put, several, sparse, truth, write,
    write_json,
)  # fmt: skip
from tiny_capture import NAMES

CASES: list[Case] = []

TWICE = "a view may be named twice"
SCENE, SPLIT = "scene/scene.json", "scene/split.json"
KEYS = {"scene.json": b'"refractive_index": 1.5', "split.json": b'"test": ["v000"]'}


for file, key in KEYS.items():
    path, first = f"scene/{file}", file == "scene.json"
    CASES += table(
        file, READ,
        *(Case(how, spoil.bytes_of(path, how), passes=PLAUSIBLE, seeds=2, ci=how in ("cut", "flip"))
          for how in spoil.BYTES),
        *(Case(f"field {how}", spoil.json_of(path, how), passes=OPTIONAL, seeds=3, ci=first) for how in spoil.FIELDS),
        *(Case(f"is a {how}", put(path, how), ci=True) for how in OF_FILES if first),
        Case("with half a character", write(path, b'{"x": "\\ud800", ' + key + b"}"), passes=UNUSED),
        Case("as a list", write(path, b"[{" + key + b"}]"), ci=True),
    )  # fmt: skip
CASES += table(
    "scene.json", READ,
    Case("of 2 GiB", sparse(SCENE, (1 << 31) - 1, b"{"), ci=True),
    Case("with a key twice", write(SCENE, '{"refractive_index": 1.5, "refractive_index": 1.9}'),
         found="occurs twice", ci=True),
    Case("with a polarizer of brackets", write_json(SCENE, {"polarizer": {"a": [1]}})),
    Case("of a prepared scene, with gains of words", field("prepared/scene.json", "gains", to={"0": 0, "45": "x"}),
         of('prepared', INSPECT), passes=UNUSED),
)  # fmt: skip


def _labeled(objects: Any) -> Change:
    return several(write_json(SCENE, {"objects": objects}), truth(objid=np.ones((20, 24), np.uint16)))


where = {"where": r"scene/scene\.json", "ci": True}
many, most = ([{"id": k % 65535 + 1, "name": f"n{k}"} for k in range(n)] for n in (60000, 65535))
CASES += table(
    "scene.json", READ,
    Case("objects a number", write_json(SCENE, {"objects": 3}), **where),
    Case("objects an ior", write_json(SCENE, {"objects": [{"material": {"ior": "1.5"}}]}), **where),
    Case("with 60000 objects", _labeled(many), passes="there may be many", ci=True),
    Case("with as many objects as there may be", _labeled(most), EVAL, passes="a scene may have them",
         prints="the 100 largest of 65,535 objects"),
    Case("with two objects of one number", _labeled([{"id": 1, "name": "a"}, {"id": 1, "name": "b"}])),
    Case("with an object of number 0", _labeled([{"id": 0, "name": "a"}]), ci=True),
    Case("with an object called by a tag", _labeled([{"id": 1, "name": "[/red]\x1b[2J", "material": "[bold]"}]), EVAL,
         passes=A_NAME, ci=True),
)  # fmt: skip

CASES += table(
    "split.json", TRAIN,
    *(Case(name, write_json(SPLIT, {"test": value}), passes=reason, ci=ci) for name, value, reason, ci in (
        ("of all views", NAMES, "", True),
        ("of no views", [], "a training may have no test views", False),
        ("of a way out", ["../polar/v000"], "", True),
        ("of a name 300000 times", ["v000"] * 300_000, TWICE, False),
    )),
)  # fmt: skip

HEAD = "file,view,angle"
CASES += table(
    "angles.csv with", READ,
    *(Case(name, write("scene/angles.csv", f"{HEAD}{columns}\n{row}\n"), ci=ci) for name, columns, row, ci in (
        ("an angle in other digits", "", "v000_000.png,v000,\u0664\u0665", True),
        ("a file outside", "", "../../outside/victim.txt,v000,10", True),
        ("a gain of 1_0", ",gain", "v000_000.png,v000,45,1_0", True),
        ("a gain of 1e-300", ",gain", "v000_000.png,v000,45,1e-300", True),
        ("the column of angles twice", ",angle", "v000_000.png,v000,0,90", False),
    )),
    Case("bytes of UTF-16", write("scene/angles.csv", HEAD.encode("utf-16"))),
)  # fmt: skip


@deferred
def _fewer(count: int) -> None:
    for path in Path("scene").rglob("v00*"):
        if int(path.name[1:4]) >= count:
            path.unlink()
    Path(SPLIT).unlink()


CASES += table(
    "scene", TRAIN,
    *(Case(f"of {count} views", _fewer(count), ci=True) for count in (0, 2)),
    Case("with a name that is no UTF-8", lambda: os.rename(PICTURE, b"scene/polar/v\xff\xfe_045.png"), ci=True),
    Case("with two suffixes of one picture", copy(PICTURE, "scene/polar/v001_045.PNG"), READ),
    Case("whose four angles are one file", copy("scene/polar/v001_000.png", *(
        f"scene/polar/v001_{angle}.png" for angle in ("045", "090", "135"))), ci=True),
)  # fmt: skip

none = "a folder may hold none of what is looked for"
optional = ("scene/gt", "scene/invalid")
CASES += [
    Case(f"{path} is {how}", put(path, how), READ, ci=path == "scene/polar" or how == "pipe",
         passes=none if how in ("root", "itself") and path in optional else "")
    for path in ("scene", "scene/polar", "scene/sparse/0", *optional)
    for how in ("file", "pipe", "loop", "root", "itself")
]  # fmt: skip
