"""Presentations of runs, and records of comparisons."""

from __future__ import annotations  # noqa: I001

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from base import INSPECT, ONE, SHARE, export
from case import Case, Change, table
from changes import (
    A_NAME, OUTSIDE, REPLACED, deferred, link, no_formula, no_script, put, several, text_forms, write,
    write_json,
)  # fmt: skip
from comparison_records import content, run

CASES: list[Case] = []

SCRIPT = "</script></title><script>alert(1)</script><img src=x onerror=alert(1)><!--"
ESCAPED = "it is escaped"
PRESENTED = "run/presentation.json"
TABLES = "tables a --out new"

BOX = {"low": [0.5, 0.5, 0.5], "high": [-0.5, -0.5, -0.5]}
AWAY = {"crop": {"low": [90, 90, 90], "high": [91, 91, 91]}}
SCRIPTS = dict.fromkeys(("title", "author", "license", "provenance"), SCRIPT)
CASES += table(
    "presentation", SHARE,
    *(Case(name, write_json(PRESENTED, content), command, ci=ci) for name, content, command, ci in (
        ("with a title of two lines", {"title": "a\nend_header"}, export("ply"), True),
        ("with a word too many", {"titel": "x"}, SHARE, True),
        ("of a meter of 1e-300", {"meters_per_unit": 1e-300}, export("ply"), True),
        ("of a box turned inside out", {"crop": BOX}, export("ply"), True),
        ("of a box with nothing in it, as a mesh", AWAY, export("mesh"), True),
        ("of a box with nothing in it, shared", AWAY, SHARE, False),
    )),
    Case("with scripts, shared", write_json(PRESENTED, SCRIPTS), passes=ESCAPED, check=no_script, ci=True),
    Case("with scripts as options, shared", more=["--title", SCRIPT, "--caption", SCRIPT], passes=ESCAPED,
         check=no_script, ci=True),
    Case("with scripts, inspected", write_json("scene/presentation.json", SCRIPTS), INSPECT, passes=ESCAPED,
         check=no_script),
    Case("with a key twice", write(PRESENTED, '{"title": "a", "title": "b"}'), export("ply"),
         found="occurs twice", ci=True),
    Case("is a pipe", put(PRESENTED, "pipe"), ci=True),
    *(Case(name, change, "present scene", passes=reason) for name, change, reason in text_forms(
        "scene/presentation.json", {"meters_per_unit": 1.0}, "meters_per_unit")),
)  # fmt: skip

points = ["--points", "0,0,0", "1,0,0"]
CASES += table(
    "present with", f"present run {ONE}",
    *(Case(name, more=words, ci=ci) for name, words, ci in (
        ("two points in one place", "--points 0,0,0 0,0,0 --distance 1m", True),
        ("points without a distance", points, False),
        ("a point outside of its picture", "--points v000,99999,1 v001,1,1 --distance 85mm", False),
        ("a length of nothing", [*points, "--distance", "0mm"], True),
        ("a scale of a negative number", "--meters-per-unit=-1", False),
        ("a scale in words", "--meters-per-unit one", False),
        ("an axis in words", "--up-axis upwards", False),
        ("a box of two numbers", "--crop=1,2", False),
        ("a box of NaN", "--crop=nan,1,1,1,1,1", False),
        ("a place beyond the view", "--white-balance v000,1000000000,1", True),
        ("gains of 1_0", "--white-balance 1_0,1,1", True),
        ("gains in other digits", "--white-balance \uff11,1,1", True),
    )),
    Case("an empty axis", more="--up-axis=", passes="an option without a text is as one that is not given"),
)  # fmt: skip


@deferred
def _record(edit: Callable[[Any], object] = lambda record: None) -> None:
    """Records of a comparison in the folders a and b; that in a is edited, in place or by what ``edit`` returns."""
    whole = json.dumps(content([run("s", name, 0, psnr=20.0 + k) for k, name in enumerate("ab")]))
    edited = json.loads(whole)
    returned = edit(edited)
    for name, text in (("a", json.dumps(returned or edited)), ("b", whole)):
        Path(name).mkdir(exist_ok=True)
        Path(name, "results.json").write_text(text)


def _run(**fields: Any) -> Change:
    return _record(lambda record: record["runs"][0].update(fields))


PART = {"material": None, "pixels": -1, "views": 1, "metrics": {}}
LINKS = several(_record(), link("new/results.csv", OUTSIDE), link("new/report.html", OUTSIDE))
OTHER = _record(lambda record: json.loads(json.dumps(record).replace('"s"', '"t"')))
CASES += table(
    "results", TABLES,
    Case("of an unknown format", _record(lambda record: record.update(format="polarguide-results-99")), ci=True),
    Case("into their own folder", _record(), "tables a --out a", passes="the record of one part is the same again"),
    Case("of two into the folder of one", OTHER, "tables a b --out a", ci=True),
    Case("into links", LINKS, passes=REPLACED, ci=True),
    Case("of NaN", _record(lambda record: record["runs"][0]["metrics"].update(psnr=float("nan"))), ci=True),
    Case("of a seed of 10^30", _run(seed=10**30), passes="a seed is a name"),
    Case("of a run twice", _record(lambda record: record["runs"].append(record["runs"][0])), ci=True),
    Case("of a part of -1 pixels", _run(objects={"o": PART}), prints="pixels", ci=True),
    Case("of -5 views", _record(lambda r: r["scenes"][0].update(views=-5)), prints="views", ci=True),
    Case("of runs of no scene", _run(scene="elsewhere")),
    Case("against nobody", _record(), more="--against nobody"),
)  # fmt: skip


def _called(kind: str, name: str) -> Change:
    def edit(record: Any) -> Any:
        old = record[f"{kind}s"][0]["name"]
        return json.loads(json.dumps(record).replace(json.dumps(old), json.dumps(name)))

    return _record(edit)


CASES += table(
    "results of", TABLES,
    Case("a scene called like a script", _called("scene", SCRIPT), passes=ESCAPED, check=no_script, ci=True),
    Case("a recipe called like a script", _called("recipe", SCRIPT), passes=ESCAPED, check=no_script),
    Case("a scene called like a formula", _called("scene", "=cmd|' /C calc'!A0"), passes=A_NAME, ci=True,
         check=no_formula("new/results.csv")),
    *(Case(name, _called("scene", given), passes=A_NAME, ci=ci) for name, given, ci in (
        ("a scene called like a command of LaTeX", "\\input{/etc/passwd}$%&_#", False),
        ("a scene of control characters", "\x1b[2J\u202e", False),
        ("half a character", "\ud800", True),
    )),
)  # fmt: skip
