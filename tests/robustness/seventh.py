"""More of the corpus, by a seventh tester: numbers that no camera of a path has, and counts below none."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fifth_runs import RENDER
from making import Change, MadeCase, made_case, of_json

LENS: dict[str, Any] = {
    "width": 32, "height": 24, "fx": 40, "fy": 40, "cx": 16, "cy": 12,
    "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 3],
}  # fmt: skip


def seventh_cases() -> Iterator[MadeCase]:
    """All cases: before what they showed was mended, each was taken without a word."""
    along = [*RENDER, "--path", "p.json"]
    for name, fields, says in (
        ("a focal length of nearly nothing", {"fx": 1e-30}, "positive focal lengths"),
        ("a principal point beyond all", {"cx": 1e300}, "principal point"),
        ("a place beyond all", {"translation": [1e38, 0, 0]}, "translation"),
    ):
        path = of_json("p.json", {"cameras": [LENS | fields]})
        yield made_case(f"seventh path: {name}", path, along, says=says)
    for name, edit, says in (
        ("a part of -1 pixels", _part, "pixels"),
        ("a share of -5", lambda record: record["scenes"][0].update(black_share=-5.0), "black_share"),
    ):
        yield made_case(f"seventh results: {name}", _record(edit), ["tables", "a", "--out", "new"], says=says)


def _part(record: Any) -> None:
    part = {"material": None, "pixels": -1, "views": 1, "metrics": {}}
    record["runs"][0].update(objects={"o": part})


def _record(edit: Callable[[Any], object]) -> Change:
    def change(folder: Path) -> None:
        from comparison_records import results, run

        record = json.loads(json.dumps(results([run("s", "a", 0, psnr=20.0)])))
        edit(record)
        (folder / "a").mkdir()
        (folder / "a/results.json").write_text(json.dumps(record))

    return change
