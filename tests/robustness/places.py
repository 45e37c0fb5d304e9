"""Places to read that are something else, places to write that hold something, and links that lead elsewhere."""

from __future__ import annotations  # noqa: I001

import os
from pathlib import Path

from base import (
    CHECKPOINT, COMPARE, EVAL, FLAGS, INSPECT, MOSAIC, MOSAICS, ONE, READ, RENDER, RESUME, SHARE, TRAIN,
    export, into, of, posed,
)  # fmt: skip
from case import Case, nothing, table
from changes import OUTSIDE, REPLACED, SAME, deferred, link, put, several, write

CASES: list[Case] = []
FILM = f"render run --path orbit --frames 2 --layers final {ONE}"
MAPS = f"priors shots --out new --no-align --formats npy {ONE}"
UNFINISHED = into("unfinished", MOSAICS)
A_FOLDER = "a folder to write"

CASES += table(
    "place:", MOSAICS,
    Case("prepare of a picture", command=of(MOSAIC, MOSAICS)),
    Case("prepare of the folder above", command=of(".", MOSAICS)),
    Case("prepare of an empty name", command=["prepare", "", *MOSAICS.split()[2:]], ci=True),
    Case("train of mosaics", command=of("mosaics", TRAIN), ci=True),
    Case("eval of a scene", command=of("scene", EVAL), ci=True),
    Case("inspect of mosaics", command=of("mosaics", INSPECT)),
    Case("present of mosaics", command="present mosaics --title x", ci=True),
    Case("present of a file", command=f"present {MOSAIC} --title x"),
    Case("a wrong verb", command="trian --help", ci=True),
    Case("prepare into its source", command=into("mosaics", MOSAICS), ci=True),
    Case("prepare into a run", command=into("run", MOSAICS)),
    Case("train into a finished run", command=into("run", TRAIN), ci=True),
    Case("train into a file", command=into("calibration.json", TRAIN), expected=A_FOLDER, ci=True),
    Case("compare into a file", command=into("calibration.json", COMPARE), expected=A_FOLDER, ci=True),
    Case("page over the checkpoint", command=f"share run --out {CHECKPOINT} {ONE}", ci=True),
    Case("page over a link", link("new.html"), SHARE, passes=SAME, ci=True),
    Case("a scene among its mosaics", command=into("mosaics/new", MOSAICS), passes="folders in it are not read"),
)  # fmt: skip
CASES += [
    Case(f"out a {how} {verb}", put("new", how), command, ci=how == "pipe")
    for how in ("pipe", "empty", "device", "dangling", "loop")
    for verb, command in (("train", TRAIN), ("priors", READ), ("export", export("cameras")))
]
CASES.append(Case("out under a file", nothing, into("run/run.json/x", TRAIN)))


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
CASES += table(
    "place:", TRAIN,
    Case("train into its scene", command=into("scene", TRAIN), where="^scene$", ci=True),
    Case("priors into their scene", command=into("scene", READ), ci=True),
    Case("compare into its scene", command=into("scene", COMPARE), ci=True),
    Case("bench among the pictures", command="bench --out scene/polar/x --scenes car --render-only"),
    Case("render among the pictures", command=into("scene/polar", RENDER), ci=True),
    Case("inspect into its scene", command=into("scene", INSPECT)),
    Case("cameras over the scene's", command=into("scene", export("cameras")), ci=True),
    Case("a film into a scene", command=f"{FILM} --out scene", ci=True),
    Case("a film among the pictures of a scene", command=f"{FILM} --video scene/polar/film.mp4", ci=True),
    check=_scene_as_it_was,
)  # fmt: skip
CASES.append(
    Case("place: cameras over another model", write("model/sparse/0/more.txt", "mine"),
         into("model", export("cameras")), check=_model_kept, ci=True)
)  # fmt: skip


@deferred
def _guessed(path: str) -> None:
    """What somebody who guesses the number of the process puts where its temporary file will be."""
    folder, name = os.path.split(path)
    os.symlink(OUTSIDE, f"{folder}/.{name}.{os.getpid()}.tmp")


AWAY = "../../../outside"
DATABASE = "unfinished/.sfm/database.db"
# Links in folders of strangers that lead what is written elsewhere.
CASES += table(
    "link for the", RESUME,
    Case("pictures of a run", link("run/render"), f"render run {FLAGS}", ci=True),
    Case("film of a run", link("run/render"), FILM, ci=True),
    Case("exports of a run", link("run/export"), "export run --format ply", ci=True),
    Case("maps of shots", link("new/v000", AWAY), MAPS, ci=True),
    Case("maps of shots, over another link", several(link("new/other"), link("new/v000", "other")), MAPS, ci=True),
    Case("maps of a scene", link("new/v001", AWAY), f"{READ} --formats npy", ci=True),
) + table(
    "link for the", RESUME,
    Case("log of a run", link("run/log.jsonl", OUTSIDE), ci=True),
    Case("scores of a run", link("run/metrics.json", OUTSIDE), EVAL),
    Case("page of a run", link("run/share.html", OUTSIDE), f"share run {ONE}", ci=True),
    Case("folder of cameras in exports", link("new/sparse"), export("cameras")),
    Case("folder of normal maps in exports", link("new/brush/normals", AWAY), export("normals"), ci=True),
    Case("lock of a new run", link("new/.lock", OUTSIDE), TRAIN),
    Case("pictures of an unfinished scene", link("unfinished/polar"), UNFINISHED, ci=True),
    Case("database of an unfinished scene", link(DATABASE, f"{AWAY}/made.db"), posed("sfm", UNFINISHED)),
    Case("temporary file of a record", _guessed("run/run.json"), ci=True),
    Case("temporary file of the scores", _guessed("run/metrics.json"), EVAL),
    Case("temporary file of a page", _guessed("run/share.html"), f"share run {ONE}"),
    passes=REPLACED,
)  # fmt: skip
