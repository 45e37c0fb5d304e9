# ruff: noqa: E501
"""Presentations, runs of others, records of comparisons, and files of scenes that are to be rendered."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import spoil
from base import EVAL, RESUME, TRAIN
from further_folders import SYNTH
from making import Change, MadeCase, made_case, nothing, of_json, put, sparse

SCRIPT = "</script></title><script>alert(1)</script><img src=x onerror=alert(1)><!--"
RUNS = ["--threads", "1"]
SHARE = ["share", "run", "--out", "new.html", *RUNS]
ESCAPED = "it is escaped"


def no_script(folder: Path) -> None:
    """No page that was written runs what stands in a record."""
    for path in [*folder.glob("*.html"), *folder.glob("new/**/*.html"), *folder.glob("new/**/*.svg")]:
        shown = path.read_text(errors="replace")
        assert "<script>alert(1)" not in shown, path
        assert "<img src=x" not in shown, path


def presentation_cases() -> Iterator[MadeCase]:
    """``presentation.json`` of a stranger's scene or run."""
    box = {"low": [-0.5, -0.5, -0.5], "high": [0.5, 0.5, 0.5]}

    def export(kind: str) -> list[str]:
        return ["export", "run", "--format", kind, "--out", "new", *RUNS]

    for name, content, command, reason in (
        ("with scripts, shared", {"title": SCRIPT, "author": SCRIPT, "license": SCRIPT, "provenance": SCRIPT}, SHARE, ESCAPED),
        ("with scripts, inspected", {"title": SCRIPT, "author": SCRIPT}, ["inspect", "scene", "--normals", "points", "--out", "new"], ESCAPED),
        ("with formulas, exported", {"title": "=1+1", "author": "\u00e9\U0001f98b"}, export("ply"), "a PLY is no table"),
        ("with a title of two lines", {"title": "a\nend_header"}, export("ply"), ""),
        ("with a title that turns", {"title": "\u202eevil"}, export("cameras"), ""),
        ("with a title of 1001 letters", {"title": "x" * 1001}, SHARE, ""),
        ("with a title of half a character", {"title": "\ud800"}, SHARE, ""),
        ("with a title that is a number", {"title": 5}, SHARE, ""),
        ("of a meter of nothing", {"meters_per_unit": 0}, SHARE, ""),
        ("of a meter of 1e-300", {"meters_per_unit": 1e-300}, export("ply"), ""),
        ("of a meter of 1e9", {"meters_per_unit": 1e9}, export("spz"), "a unit may be long"),
        ("of an axis of zeros", {"up_axis": [0, 0, 0]}, SHARE, ""),
        ("of an axis of 1e308", {"up_axis": [1e308, 1e308, 0]}, SHARE, ""),
        ("of an axis of two numbers", {"up_axis": [0, 1]}, SHARE, ""),
        ("of a white of zeros", {"white_balance": [0, 0, 0]}, SHARE, ""),
        ("of a white of four", {"white_balance": [1, 1, 1, 1]}, SHARE, ""),
        ("of a box turned inside out", {"crop": {"low": box["high"], "high": box["low"]}}, export("ply"), ""),
        ("of a box with nothing in it", {"crop": {"low": [90, 90, 90], "high": [91, 91, 91]}}, export("ply"), ""),
        ("of a box with nothing in it, shared", {"crop": {"low": [90, 90, 90], "high": [91, 91, 91]}}, SHARE, ""),
        ("of a box with nothing in it, as points", {"crop": {"low": [90, 90, 90], "high": [91, 91, 91]}}, export("points"), ""),
        ("of a box with nothing in it, as a mesh", {"crop": {"low": [90, 90, 90], "high": [91, 91, 91]}}, export("mesh"), ""),
        ("of a box with nothing in it, as SOG", {"crop": {"low": [90, 90, 90], "high": [91, 91, 91]}}, export("sog"), ""),
        ("of a box whose up is nothing", {"crop": {**box, "up": [0, 0, 0]}}, export("ply"), ""),
        ("with a word too many", {"titel": "x"}, SHARE, ""),
        ("as a list", [], SHARE, ""),
    ):  # fmt: skip
        at = "scene" if "inspected" in name else "run"
        yield made_case(
            f"further presentation {name}",
            of_json(f"{at}/presentation.json", content),
            command,
            reason,
            no_script,
        )
    for how in ("folder", "pipe", "device", "loop", "dangling", "outside"):
        yield made_case(f"further presentation is {how}", put("run/presentation.json", how), SHARE)
    yield made_case(
        "further presentation to be written over a link",
        put("run/presentation.json", "dangling"),
        ["present", "run", "--title", "x"],
    )
    for name, words in {
        "a title of two lines": ["--title", "a\nb"],
        "two points in one place": ["--points", "0,0,0", "0,0,0", "--distance", "1m"],
        "points far away": ["--points", "1e308,0,0", "-1e308,0,0", "--distance", "1m"],
        "one point": ["--points", "0,0,0", "--distance", "1m"],
        "points without a distance": ["--points", "0,0,0", "1,0,0"],
        "a length of nothing": ["--points", "0,0,0", "1,0,0", "--distance", "0mm"],
        "a length in other digits": ["--points", "0,0,0", "1,0,0", "--distance", "\u0665mm"],
        "a length in parsecs": ["--points", "0,0,0", "1,0,0", "--distance", "1pc"],
        "a length of 1e999": ["--points", "0,0,0", "1,0,0", "--distance", "1e999mm"],
        "a scale of a negative number": ["--meters-per-unit=-1"],
        "a scale in words": ["--meters-per-unit", "one"],
        "a box of two numbers": ["--crop=1,2"],
        "a box of NaN": ["--crop=nan,1,1,1,1,1"],
        "an axis in words": ["--up-axis", "upwards"],
        "a place in no view": ["--white-balance", "nowhere,1,1"],
        "a place beyond the view": ["--white-balance", "v000,1000000000,1"],
        "a place that is none": ["--white-balance", "v000,nan,inf"],
        "gains of zeros": ["--white-balance", "0,0,0"],
        "an empty axis": ["--up-axis="],
    }.items():
        yield made_case(
            f"further present with {name}",
            nothing,
            ["present", "run", *words, *RUNS],
            "an option without a text is as one that is not given" if "empty" in name else "",
        )


def run_cases() -> Iterator[MadeCase]:
    """Runs of other versions, of other scenes, in parts."""

    def field(key: str, value: Any) -> Change:
        return lambda f: spoil.json_field(f / "run/run.json", (key,), value)

    def only(*names: str) -> Change:
        def change(folder: Path) -> None:
            for path in list((folder / "run").iterdir()):
                if path.name not in names:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()

        return change

    def ours(folder: Path) -> None:
        """The run's scene is that of the case, not the base's own."""
        spoil.json_field(folder / "run/run.json", ("scene",), str(folder / "scene"))

    def gone(folder: Path) -> None:
        ours(folder)
        shutil.rmtree(folder / "scene")

    def another(folder: Path) -> None:
        ours(folder)
        path = folder / "scene/polar/v001_045.png"
        shutil.copyfile(folder / "scene/polar/v002_045.png", path)

    def fewer(folder: Path) -> None:
        ours(folder)
        for path in (folder / "scene").rglob("v008*"):
            path.unlink()

    for name, change, command, reason in (
        ("of version 0.1.0", field("version", "0.1.0"), EVAL, ""),
        ("of version 9.9.9", field("version", "9.9.9"), EVAL, ""),
        ("of no version", field("version", ""), EVAL, ""),
        ("of a version that is a number", field("version", 0.2), EVAL, ""),
        ("of a version of control characters", field("version", "0.9\x1b[2J"), EVAL, ""),
        ("with nothing in it", only(), EVAL, ""),
        ("with its settings alone", only("run.json"), EVAL, ""),
        ("with its checkpoint alone", only("checkpoint.safetensors"), EVAL, ""),
        ("with the checkpoint of another recipe", lambda f: shutil.copyfile(f / "run-ref/checkpoint.safetensors", f / "run/checkpoint.safetensors"), EVAL, ""),
        ("whose scene is gone, scored", gone, EVAL, ""),
        ("whose scene is gone, rendered", gone, ["render", "run", "--out", "new", *RUNS], ""),
        ("whose scene is gone, exported", gone, ["export", "run", "--format", "ply", "--out", "new", *RUNS], "a PLY takes no pictures"),
        ("whose scene is gone, shared", gone, SHARE, ""),
        ("whose scene is gone, gone on with", gone, RESUME, ""),
        ("whose scene has another picture, scored", another, EVAL, ""),
        ("whose scene has another picture, gone on with", another, RESUME, ""),
        ("whose scene has a view less, gone on with", fewer, RESUME, ""),
        ("whose scene is a file", lambda f: (gone(f), (f / "scene").write_text("")), EVAL, ""),
        ("that is gone on with with another seed", nothing, [*RESUME, "--seed", "7"], ""),
        ("that is gone on with with fewer steps", nothing, ["train", "scene", "--out", "run", "--resume", "--steps", "3", *TRAIN[6:]], ""),
        ("that is gone on with with another recipe", nothing, [*RESUME, "--recipe", "3dgs"], ""),
        ("that is gone on with at another size", nothing, [*RESUME, "--downscale", "2"], ""),
        ("with a log that is a folder", put("run/log.jsonl", "folder"), RESUME, ""),
        ("with scores that are a folder", put("run/metrics.json", "folder"), EVAL, ""),
        ("with a page that is a folder", put("run/share.html", "folder"), ["share", "run", *RUNS], ""),
        ("with an export that is a file", put("run/export", "file"), ["export", "run", "--format", "cameras", *RUNS], ""),
        ("compared with for priors, of another scene", nothing, ["priors", "prepared", "--out", "new", "--run", "run", *RUNS], ""),
        ("for priors that is none", nothing, ["priors", "scene", "--out", "new", "--run", "mosaics", *RUNS], ""),
        ("of recipe data that is a text", field("recipe_data", "x"), EVAL, ""),
        ("of settings without steps", field("settings", {}), EVAL, ""),
        ("of a key twice", lambda f: (f / "run/run.json").write_text((f / "run/run.json").read_text().rstrip()[:-1] + ', "scene": "/nowhere"}'), EVAL, ""),
    ):  # fmt: skip
        yield made_case(f"further run {name}", change, command, reason)


def table_cases() -> Iterator[MadeCase]:
    """``results.json``."""

    def record(edit: Any = lambda r: r, more: Any = None) -> Change:
        def change(folder: Path) -> None:
            from comparison_records import results, run

            whole = json.loads(
                json.dumps(results([run("s", name, 0, psnr=20.0 + k) for k, name in enumerate(("a", "b"))]))
            )
            edited = copy.deepcopy(whole)
            edited = edit(edited) or edited
            for name, content in (("a", edited), ("b", more if more is not None else whole)):
                (folder / name).mkdir(exist_ok=True)
                (folder / name / "results.json").write_text(json.dumps(content))

        return change

    def renamed(kind: str, name: str) -> Any:
        def edit(r: Any) -> Any:
            old = r[f"{kind}s"][0]["name"]
            return json.loads(json.dumps(r).replace(json.dumps(old), json.dumps(name)))

        return edit

    one, two = ["tables", "a", "--out", "new"], ["tables", "a", "b", "--out", "new"]
    shown = "a name is shown as it is"
    for name, change, command, reason in (
        ("of nothing", record(lambda r: {"x": 1}), one, ""),
        ("as a list", record(lambda r: [r]), one, ""),
        ("of an unknown format", record(lambda r: r.update(format="polarguide-results-99")), one, ""),
        ("of the former format, broken", record(lambda r: r.update(format="polarguide-results-1", runs=3)), one, ""),
        ("twice", record(), two, ""),
        ("into its own folder", record(), ["tables", "a", "--out", "a"], "the record of one part is the same again"),
        ("of two into the folder of one", record(lambda r: json.loads(json.dumps(r).replace('"s"', '"t"'))), ["tables", "a", "b", "--out", "a"], ""),
        ("of NaN", record(lambda r: r["runs"][0]["metrics"].update(psnr=float("nan"))), one, ""),
        ("of 1e308", record(lambda r: r["runs"][0]["metrics"].update(psnr=1e308)), one, "a number may be large"),
        ("of 1e308 twice", record(lambda r: [run["metrics"].update(psnr=1e308 * (-1) ** k) for k, run in enumerate(r["runs"])] and None), [*one, "--against", "b"], "a number may be large"),
        ("of a score that is text", record(lambda r: r["runs"][0]["metrics"].update(psnr="20")), one, ""),
        ("of a seed of 10^30", record(lambda r: r["runs"][0].update(seed=10**30)), one, "a seed is a name"),
        ("of a negative seed", record(lambda r: r["runs"][0].update(seed=-1)), one, "a seed is a name"),
        ("of a run twice", record(lambda r: r["runs"].append(r["runs"][0])), one, ""),
        ("of a scene called like a script", record(renamed("scene", SCRIPT)), one, shown),
        ("of a recipe called like a script", record(renamed("recipe", SCRIPT)), one, shown),
        ("of a scene called like a formula", record(renamed("scene", "=cmd|' /C calc'!A0")), one, shown),
        ("of a scene called like a command of LaTeX", record(renamed("scene", "\\input{/etc/passwd}$%&_#")), one, shown),
        ("of a scene called like a table of Markdown", record(renamed("scene", "a|b\n|-|\n[x](javascript:alert(1))")), one, shown),
        ("of a scene of control characters", record(renamed("scene", "\x1b[2J\u202e")), one, shown),
        ("of half a character", record(renamed("scene", "\ud800")), one, "it is written as its escape"),
        ("of a scene of a million letters", record(renamed("scene", "x" * 300_000)), one, shown),
        ("of no scenes", record(lambda r: r.update(scenes=[])), one, ""),
        ("of runs of no scene", record(lambda r: r["runs"][0].update(scene="elsewhere")), one, ""),
        ("against nobody", record(), [*one, "--against", "nobody"], ""),
        ("with a folder that leaves", record(lambda r: r["runs"][0].update(folder="../../../outside")), one, "the folder is a note"),
        ("of 2 GiB", lambda f: ((f / "a").mkdir(), sparse(f / "a/results.json", (1 << 31) - 1, b"{")), one, ""),
        ("into a file", record(), ["tables", "a", "--out", "calibration.json"], ""),
        ("into links", lambda f: (record()(f), (f / "new").mkdir(), (f / "new/results.csv").symlink_to("../../outside/victim.txt"), (f / "new/report.html").symlink_to("../../outside/victim.txt")), one, "a link is replaced, and what it led to stays"),
    ):  # fmt: skip
        check = no_script if "script" in name else _no_formula if "formula" in name else None
        yield made_case(f"further results {name}", change, command, reason, check)


def _no_formula(folder: Path) -> None:
    for line in (folder / "new/results.csv").read_text().splitlines():
        assert not line.startswith(("=", "@", "+", "-", "\t")), line


def synth_cases() -> Iterator[MadeCase]:
    """Files of scenes that ``synth`` is to render."""
    ball = {"name": "ball", "shape": {"type": "ball", "radius": 1}}
    spec: dict[str, Any] = {
        "name": "one", "camera": {"rings": [{"radius": 4, "height": 1}], "views": 3}, "things": [ball],
        "environment": {"type": "uniform", "radiance": [1, 1, 1]},
    }  # fmt: skip

    def thing(**changed: Any) -> dict[str, Any]:
        return {**spec, "things": [{**ball, **changed}]}

    def camera(**changed: Any) -> dict[str, Any]:
        return {**spec, "camera": {**spec["camera"], **changed}}

    for name, content, words, reason in (
        ("of a name that leaves", {**spec, "name": "../../outside/x"}, [], "the folder is that of --out"),
        ("of a thing that leaves", thing(name="../../../outside/made"), [], ""),
        ("of a mesh outside", thing(shape={"type": "mesh", "file": "../../outside/victim.txt"}), [], ""),
        ("of a mesh that is a device", thing(shape={"type": "mesh", "file": "/dev/zero"}), [], ""),
        ("of a picture that is a device", {**spec, "environment": {"type": "image", "file": "/dev/zero"}}, [], ""),
        ("of a picture that is a pipe", {**spec, "environment": {"type": "image", "file": "pipe.hdr"}}, [], ""),
        ("of 10^9 views", camera(views=10**9), [], ""),
        ("of a field of view of 200 degrees", camera(fov=200), [], ""),
        ("of rings of nothing", camera(rings=[{"radius": 0, "height": 0}]), [], ""),
        ("of rings of 1e300", camera(rings=[{"radius": 1e300, "height": 1}]), [], ""),
        ("of rings of text", camera(rings=[{"radius": "far", "height": 1}]), [], ""),
        ("of an unknown shape", thing(shape={"type": "teapot"}), [], ""),
        ("of a ball of nothing", thing(shape={"type": "ball", "radius": 0}), [], ""),
        ("of a ball of -1", thing(shape={"type": "ball", "radius": -1}), [], ""),
        ("of a ball of 1e300", thing(shape={"type": "ball", "radius": 1e300}), [], ""),
        ("of a scale of nothing", thing(scale=0), [], ""),
        ("of a lathe of one point", thing(shape={"type": "lathe", "profile": [[1, 0]]}), [], ""),
        ("of a tube of 10^5 points", thing(shape={"type": "tube", "radius": 0.1, "path": [[0, 0, 0.001 * k] for k in range(100_000)]}), [], ""),
        ("of waves of 10^9", thing(shape={"type": "waves", "size": [1e9, 1e9], "height": 1, "length": 1e-9}), [], ""),
        ("of an environment of NaN", {**spec, "environment": {"type": "uniform", "radiance": ["nan", 1, 1]}}, [], ""),
        ("of negative light", {**spec, "environment": {"type": "uniform", "radiance": [-1, -1, -1]}}, [], ""),
        ("of 300 things", {**spec, "things": [{**ball, "name": f"b{k}"} for k in range(300)]}, [], ""),
        ("of a name twice", {**spec, "things": [ball, ball]}, [], ""),
        ("of paths of 10^9 surfaces", {**spec, "depth": 10**9}, [], ""),
        ("of an exposure of nothing", {**spec, "exposure": 0}, [], ""),
        ("of a color that is a device", thing(material={"color": {"type": "image", "file": "/dev/zero"}}), [], ""),
        ("of an index of 1", thing(material={"index": 1}), [], ""),
        ("at a size of 0", spec, ["--size", "0x0"], ""),
        ("at a size of words", spec, ["--size", "small"], ""),
        ("at a size of a million", spec, ["--size", "1000000x1000000"], ""),
        ("with 10^18 samples", spec, ["--samples", str(10**18)], ""),
        ("with noise of infinity", spec, ["--noise", "inf"], ""),
        ("with a sweep of nothing", spec, ["--sweep", "views="], ""),
        ("with a sweep of words", spec, ["--sweep", "views=a,b"], ""),
        ("with a sweep of a million", spec, ["--sweep", "views=" + ",".join(map(str, range(3, 5000)))], ""),
    ):  # fmt: skip
        command = [*SYNTH, *words]
        if words and words[0] in SYNTH:
            at = SYNTH.index(words[0])
            command = [*SYNTH[:at], *words, *SYNTH[at + 2 :]]

        def change(folder: Path, content: Any = content, name: str = name) -> None:
            of_json("spec.json", content)(folder)
            if "pipe" in name:
                put("pipe.hdr", "pipe")(folder)

        yield made_case(f"further scene file {name}", change, command, reason)
