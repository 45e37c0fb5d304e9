# ruff: noqa: E501
"""What is beside the pictures of a scene, and the folder itself."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from base import READ, TRAIN
from forked import Case
from making import PICTURE, SAME, TRUTH, UNUSED, Change, of_bytes, of_json, put, sparse
from making import more_case as case

INSPECT = ["inspect", "scene", "--normals", "points", "--out", "new"]


def _objects(objects: Any) -> Change:
    def change(folder: Path) -> None:
        (folder / "scene/scene.json").write_text(json.dumps({"objects": objects}))
        np.savez(folder / TRUTH, objid=np.ones((20, 24), np.int32))

    return change


def scene_cases() -> Iterator[Case]:
    """The files beside the pictures, and the folder itself."""
    whole = b'{"refractive_index": 1.5}'
    for file in ("scene.json", "split.json"):
        at = f"scene/{file}"
        key = b'"test": ["v000"]' if file == "split.json" else b'"refractive_index": 1.5'
        for name, data, reason in (
            ("in UTF-16", (b"{" + key + b"}").decode().encode("utf-16"), SAME),
            ("with a mark of its bytes", b"\xef\xbb\xbf{" + key + b"}", SAME),
            ("with a key twice", b"{" + key + b", " + key.replace(b"1.5", b"1.4").replace(b"v000", b"v001") + b"}", "the last one counts, as Python's JSON has it"),
            ("with a number of 5000 digits", b'{"x": ' + b"9" * 5000 + b", " + key + b"}", ""),
            ("with half a character", b'{"x": "\\ud800", ' + key + b"}", UNUSED),
            ("with zeros behind", b"{" + key + b"}" + bytes(4096), ""),
            ("as a list", b"[{" + key + b"}]", ""),
            ("as a number", b"1", ""),
            ("of many brackets", b'{"x": [' + b"[]," * 2_000_000 + b"[]], " + key + b"}", UNUSED),
        ):  # fmt: skip
            yield case(f"{file} {name}", of_bytes(at, data), READ, reason)
        yield case(f"{file} of 2 GiB", lambda f, at=at: sparse(f / at, (1 << 31) - 1, b"{"), READ)
    del whole
    many = [{"id": k % 65535 + 1, "name": f"n{k}"} for k in range(60000)]
    for name, objects in {
        "60000 objects": many,
        "two objects of one number": [{"id": 1, "name": "a"}, {"id": 1, "name": "b"}],
        "two objects of one name": [{"id": 1, "name": "a"}, {"id": 2, "name": "a"}],
        "an object of number 0": [{"id": 0, "name": "a"}],
        "an object of a negative roughness": [{"id": 1, "name": "a", "material": {"alpha": -1}}],
        "an object without a name": [{"id": 1, "name": ""}],
        "an object as a text": ["ball"],
        "an object of half a character": [{"id": 1, "name": "\ud800"}],
        "an object with markup": [{"id": 1, "name": "<img src=x onerror=alert(1)>", "material": "[bold]"}],
    }.items():
        reason = {
            "60000 objects": "there may be many",
            "an object with markup": "a name is shown as it is",
            "an object of half a character": "any name will do",
        }.get(name, "")
        yield case(f"scene with {name}", _objects(objects), READ, reason)
    yield case("split with half a character", of_json("scene/split.json", {"test": ["\ud800"]}), READ)
    yield case(
        "split with a name of a million letters",
        of_json("scene/split.json", {"test": ["x" * 1_000_000]}),
        READ,
    )
    yield case(
        "split with a name 300000 times",
        of_json("scene/split.json", {"test": ["v000"] * 300_000}),
        READ,
        "a view may be named twice",
    )
    yield case(
        "scene with corrections that are none",
        of_json("scene/scene.json", {"corrections": 5}),
        [*INSPECT, "--fix", "fixed"],
        UNUSED,
    )

    def exchanged(folder: Path, more: Change = lambda folder: None) -> None:
        """So that there is something to fix: the pictures of two angles change places."""
        for path in sorted((folder / "scene/polar").glob("*_000.png")):
            other = path.with_name(path.name.replace("_000", "_090"))
            kept = path.read_bytes()
            path.write_bytes(other.read_bytes())
            other.write_bytes(kept)
        more(folder)

    def rings(folder: Path) -> None:
        for name in "abcd":
            (folder / "scene/masks" / name).symlink_to("../masks")

    yield case(
        "masks with links to themselves", lambda f: exchanged(f, rings), [*INSPECT, "--fix", "fixed"], UNUSED
    )
    yield case(
        "corrections that are a number",
        lambda f: exchanged(f, of_json("scene/scene.json", {"corrections": 5})),
        [*INSPECT, "--fix", "fixed"],
        "there is nothing to fix where geometry does not decide",
    )

    for path in ("scene", "scene/polar", "scene/sparse", "scene/sparse/0", "scene/gt", "scene/invalid"):
        for how in ("file", "pipe", "loop", "root", "itself"):
            reason = (
                "a folder may hold none of what is looked for"
                if how in ("root", "itself") and path in ("scene/gt", "scene/invalid")
                else ""
            )
            yield case(f"{path} is {how}", put(path, how), READ, reason)

    def suffixes(folder: Path) -> None:
        shutil.copyfile(folder / PICTURE, folder / "scene/polar/v001_045.PNG")

    def cases(folder: Path) -> None:
        for path in list((folder / "scene/polar").glob("v001_*")):
            shutil.copyfile(path, path.with_name(path.name.upper()))

    def composed(folder: Path) -> None:
        for path in list((folder / "scene/polar").glob("v001_*")):
            shutil.copyfile(path, path.with_name(path.name.replace("v001", "caf\u00e9")))
            shutil.copyfile(path, path.with_name(path.name.replace("v001", "cafe\u0301")))

    yield case("two suffixes of one picture", suffixes, READ)
    yield case("names that differ in case", cases, TRAIN)
    yield case("names that differ in composition", composed, TRAIN)
