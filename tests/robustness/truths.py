"""Ground truth: archives that unfold to more than they say, heads of arrays that lie, values that cannot be."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
import spoil
from base import EVAL, HEIGHT, READ, TRUTH, WIDTH
from case import Case, Change, table
from changes import CHECKED, truth

CASES: list[Case] = []

FLAT = np.ones((HEIGHT, WIDTH), np.float32)
LIGHT = np.ones((HEIGHT, WIDTH, 3), np.float32)
GOOD = made.header("{'descr': '<f4', 'fortran_order': False, 'shape': (20, 24), }") + bytes(4 * 480)

named = ("header", "encrypted", "objects", "not finite")
CASES += table(
    "gt", READ,
    *(Case(f"bytes {how}", spoil.bytes_of(TRUTH, how), passes=CHECKED, seeds=2, ci=how == "flip")
      for how in spoil.BYTES),
    *(Case(how, spoil.archive(TRUTH, how), passes="unknown values are zeros" if how == "zeros" else "", seeds=2,
           where=r"scene/gt/v000\.npz" if how in named else "", ci=how != "bomb") for how in spoil.ARRAYS),
)  # fmt: skip


def _member(data: bytes, method: int = zipfile.ZIP_DEFLATED) -> Change:
    return lambda: made.archive(Path(TRUTH), [("depth.npy", data)], method)


def _lies(unfolds: int, method: int = zipfile.ZIP_DEFLATED) -> Change:
    return lambda: made.lying_archive(Path(TRUTH), "depth.npy", unfolds, says=len(GOOD), method=method)


def _alone(**arrays: Any) -> Change:
    return lambda: np.savez(TRUTH, **arrays)


CASES += table(
    "gt", READ,
    Case("lies about its size", _lies(3 << 30), ci=True),
    Case("is junk in LZMA", _lies(0, zipfile.ZIP_LZMA), ci=True),
    Case("has a broken head", _member(made.header("{'descr': (") + bytes(2000)), ci=True),
    Case("has a head of brackets", _member(made.header("(" * 3000) + bytes(2000)), ci=True),
    Case("has records", _member(made.header("{'descr': [('a', '|O')], 'fortran_order': False, 'shape': (20, 24), }"))),
    Case("has normals of four numbers", truth(normal=np.zeros((HEIGHT, WIDTH, 4)))),
)  # fmt: skip
CASES += table(
    "gt has", EVAL,
    Case("numbers of objects that are fractions", truth(objid=FLAT * 1.5)),
    Case("huge depths", _alone(depth=FLAT.astype(float) * 1e300), READ, ci=True),
    Case("negative depths", _alone(depth=-5 * FLAT, mask=FLAT), READ, ci=True),
    Case("depth behind the camera", truth(depth=-FLAT), expected="0 or more", ci=True),
    Case("negative light", truth(specular=-LIGHT, diffuse=LIGHT), expected="0 or more", ci=True),
    Case("normals without a length", truth(normal=0 * LIGHT, mask=FLAT * 0), passes="there is nothing to score"),
)  # fmt: skip
