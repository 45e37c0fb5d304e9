"""Places to read that are something else, places to write that hold something, and links that lead elsewhere."""

from __future__ import annotations  # noqa: I001

import importlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from base import (
    CHECKPOINT, COMPARE, EVAL, FLAGS, INSPECT, MOSAIC, MOSAICS, ONE, READ, RENDER, RESUME, SHARE, TRAIN, export,
    into, of, posed,
)  # fmt: skip
from case import Case, Change, nothing, table
from changes import OUTSIDE, SAME, field, link, put, rename, several, write

CASES: list[Case] = []

LINK_REPLACED = "a link is replaced, and what it led to stays"
FILM = f"render run --path orbit --frames 2 --layers final {ONE}"
MAPS = f"priors shots --out new --no-align --formats npy {ONE}"
INTO = {
    "train": TRAIN, "prepare": MOSAICS, "render": RENDER, "priors": READ, "compare": COMPARE, "inspect": INSPECT,
    "export": export("cameras"),
}  # fmt: skip
UNFINISHED = into("unfinished", MOSAICS)

CASES += table(
    "place:", MOSAICS,
    *(Case(f"prepare of {name}", command=["prepare", path, *MOSAICS.split()[2:]], ci=ci) for name, path, ci in (
        ("a picture", MOSAIC, False), ("a run", "run", True), ("an empty name", "", True),
        ("the standard input", "/dev/stdin", False),
        )),
    *(Case(name, command=command, ci=ci) for name, command, ci in (
        ("train of mosaics", of("mosaics", TRAIN), True),
        ("train of a scene without poses", of("prepared", TRAIN), False),
        ("eval of a scene", of("scene", EVAL), True),
        ("view of a scene", f"view scene {ONE}", False),
        ("priors of a run", of("run", READ), False),
        ("inspect of mosaics", of("mosaics", INSPECT), False),
        ("present of mosaics", "present mosaics --title x", True),
        ("a wrong verb", "trian --help", True),
        ("no verb but options", "--steps 3", False),
    )),
    Case("given no words", command=["--", ""]),
)  # fmt: skip

stands = {
    "a file": put("new", "empty"), "a device": link("new", "/dev/null"), "a pipe": put("new", "pipe"),
    "a link to nothing": put("new", "dangling"), "a loop": put("new", "loop"),
}  # fmt: skip
_long, deep = "x" * 300, "x/" * 2500
CASES += [
    *(Case(f"out {name} {verb}", change, command, ci=name in ("a pipe", "a file") and verb in ("train", "export"))
      for name, change in stands.items() for verb, command in INTO.items()),
    *(Case(f"out under a file {verb}", nothing, into("run/run.json/x", command)) for verb, command in INTO.items()),
    *table(
        "place:", MOSAICS,
        *(Case(f"prepare into {name}", command=into(path, MOSAICS), ci=ci) for name, path, ci in (
            ("its source", "mosaics", True), ("a scene", "scene", False), ("a run", "run", False),
            ("a path of 5000 letters", deep, False))),
        Case("train into a finished run", command=into("run", TRAIN), ci=True),
        Case("train into a file", command=into("calibration.json", TRAIN), expected="a folder to write", ci=True),
        Case("compare into a file", command=into("calibration.json", COMPARE), expected="a folder to write", ci=True),
        Case("bench into a file", command="bench --out calibration.json --scenes kit --render-only"),
        Case("demo into a file", command=f"demo --out {MOSAIC} --steps 1 {ONE}"),
        Case("page over the checkpoint", command=f"share run --out {CHECKPOINT} {ONE}", ci=True),
        Case("page at a device", command="share run --out /dev/full"),
        Case("page over a link", link("new.html"), SHARE, passes=SAME, ci=True),
    ),
]  # fmt: skip


def _scene_as_it_was() -> None:
    """The scene has the files that it had."""
    model = Path("scene/sparse/0")
    assert sorted(path.name for path in model.iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    assert "PINHOLE 24 20" in (model / "cameras.txt").read_text()
    assert not [path for path in Path("scene/polar").iterdir() if path.suffix != ".png"]
    assert not [*Path("scene").rglob("path_*"), *Path("scene").rglob("*.mp4")]


def _model_kept() -> None:
    assert Path("model/sparse/0/more.txt").read_text() == "mine"
    assert not Path("model/transforms.json").exists()

# What would be written over or among what is read.
polar, model = "scene/polar", "scene/sparse/0"
rows = (
    ("train into its scene", into("scene", TRAIN), True),
    ("train into the model", into(f"{model}/new", TRAIN), False),
    ("priors into their scene", into("scene", READ), True),
    ("compare into its scene", into("scene", COMPARE), True),
    ("ablate into its scene", "ablate scene --out scene --steps 2", False),
    ("bench among the pictures", "bench --out scene/polar/x --scenes car --render-only", False),
    ("render among the pictures", into(polar, RENDER), True),
    ("inspect into its scene", into("scene", INSPECT), False),
    ("inspect with a fix over the scene", f"{INSPECT} --fix scene", True),
    ("cameras over the scene's", into("scene", export("cameras")), True),
    ("a mesh into the ground truth", into("scene/gt", f"{export('mesh')} --resolution 16"), False),
    ("a film into a scene", f"{FILM} --out scene", True),
    ("a film among the pictures of a scene", f"{FILM} --video scene/polar/film.mp4", True),
)
among = "mosaics are read from their folder alone, not from those in it"
CASES += [
    *(Case(f"place: {name}", nothing, command, check=_scene_as_it_was, ci=ci,
           where="^scene$" if name.startswith("train into its") else "") for name, command, ci in rows),
    Case("place: cameras over another model", write("model/sparse/0/more.txt", "mine"), into("model", export("cameras")),
         check=_model_kept, ci=True),
    Case("place: a calibration among its shots", nothing,
         "calibrate mosaics --out mosaics/new.safetensors --sensor IMX250MYR"),
    Case("place: a scene among its mosaics", nothing, into("mosaics/new", MOSAICS), passes=among),
]  # fmt: skip

# Links in folders of strangers that lead what is written elsewhere.
sfm = posed("sfm", UNFINISHED)
away = "../../../outside"
twice = several(link("new/other"), link("new/v000", "other"))
rows: tuple[tuple[str, Change, str, bool], ...] = (
    ("lock of a run", link("run/.lock", OUTSIDE), RESUME, False),
    ("log of a run", link("run/log.jsonl", OUTSIDE), RESUME, True),
    ("scores of a run", link("run/metrics.json", OUTSIDE), EVAL, False),
    ("page of a run", link("run/share.html", OUTSIDE), f"share run {ONE}", True),
    ("pictures of a run", link("run/render"), f"render run {FLAGS}", True),
    ("film of a run", link("run/render"), FILM, True),
    ("exports of a run", link("run/export"), "export run --format ply", True),
    ("folder of cameras in exports", link("new/sparse"), export("cameras"), False),
    ("lock of a new run", link("new/.lock", OUTSIDE), TRAIN, False),
    ("maps of shots", link("new/v000", away), MAPS, True),
    ("maps of shots, over another link", twice, MAPS, True),
    ("maps of a scene", link("new/v001", away), f"{READ} --formats npy", True),
    ("folder of an inspection", link("scene-inspection"), f"inspect scene --normals points {ONE}", False),
    ("lock of a comparison", link("new/.lock", OUTSIDE), COMPARE.replace("--steps 2", "--steps 0"), False),
    ("pictures of an unfinished scene", link("unfinished/polar"), UNFINISHED, True),
    ("model of an unfinished scene", link("unfinished/sparse"), posed("model", UNFINISHED), False),
    ("photographs of an unfinished scene", link("unfinished/.sfm/images", away), sfm, False),
    ("database of an unfinished scene", link("unfinished/.sfm/database.db", f"{away}/made.db"), sfm, False),
    ("journal of an unfinished scene", several(rename("unfinished/prepare.json", "kept.json"),
                                               link("unfinished/prepare.json", "../kept.json")), UNFINISHED, False),
    ("partial model of an unfinished scene", link("unfinished/.sparse.partial"), posed("model", UNFINISHED), False),
)  # fmt: skip
CASES += [Case(f"link for the {name}", change, command, passes=LINK_REPLACED, ci=ci) for name, change, command, ci in rows]

# What somebody who guesses the number of the process puts where its temporary file will be.

def at(path: str) -> Change:
    folder, name = os.path.split(path)
    return lambda: os.symlink(OUTSIDE, f"{folder}/.{name}.{os.getpid()}.tmp")

CASES += [
    *(Case(f"link for the temporary file of {path}", at(path), command, passes=LINK_REPLACED, ci=path == "run/run.json")
      for path, command in (("run/run.json", RESUME), ("run/metrics.json", EVAL), ("run/share.html", f"share run {ONE}"),
                            ("run/log.jsonl", RESUME))),
    Case("odd temporary name", write("run/.run.json.\u00b2.tmp", ""), RESUME, passes="it is nobody's"),
    Case("temporary folder of this process", lambda: os.makedirs(f"new/.sparse.{os.getpid()}.tmp"), export("cameras"),
         passes="what an earlier process of this number left is removed"),
]  # fmt: skip


def _bench(spoil: Callable[[str], object]) -> Change:
    """A folder of a bench with one scene that it has asked for, of which something is spoiled."""

    def change() -> None:
        bench = importlib.import_module("polarguide.experiments.bench")
        options = importlib.import_module("polarguide.experiments.bench_options")
        folder = importlib.import_module("polarguide.synth.folder")
        settings = importlib.import_module("polarguide.synth.settings")
        found = settings.find_scene(options.BenchOptions().chosen(options.BENCH)[0])
        spec = settings.Overrides(views=options.BENCH.views).apply(found)
        place = Path("new", bench.SCENES, spec.name)
        place.mkdir(parents=True)
        (place / "request.json").write_text(json.dumps(folder.scene_request(spec, options.BENCH.synth)))
        (place / "scene.json").write_text("{}")
        (place / "checksums.txt").write_text("")
        spoil(str(place))

    return change

def request(key: str, value: Any) -> Callable[[str], object]:
    return lambda place: field(f"{place}/request.json", key, to=value)()

def file(name: str, data: bytes | str) -> Callable[[str], object]:
    return lambda place: write(f"{place}/{name}", data)()

def pipe(name: str) -> Callable[[str], object]:
    return lambda place: put(f"{place}/{name}", "pipe")()

leaving = f"{'0' * 64}  ../../../../outside/victim.txt\n"
CASES += [
    Case(f"bench with {name}", _bench(spoil), "bench --out new --render-only --device cpu", ci=ci)
    for name, spoil, ci in (
        ("a request of a list", file("request.json", "[]"), False),
        ("a request that is a pipe", pipe("request.json"), True),
        ("checksums that leave", file("checksums.txt", leaving), True),
        ("a scene.json that is none", file("scene.json", b"\xff"), False),
    )
]  # fmt: skip
