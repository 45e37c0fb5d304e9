# ruff: noqa: E501
"""Folders that are the wrong ones, names that are odd, and text files as other programs save them."""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

from base import EVAL, MOSAICS, SHOTS, TRAIN
from making import MOSAIC, SAME, MadeCase, made_case, nothing, of_bytes, put

MEASURE = ["measure", "mosaics", "--out", "new", *MOSAICS[4:8], "--threads", "1"]
CALIBRATE = ["calibrate", "polarizer", "--out", "new.safetensors", "--sensor", "IMX250MZR", "--threads", "1"]
SYNTH = ["synth", "spec.json", "--out", "new", "--size", "16x16", "--samples", "1", "--threads", "1"]
NAME_IS_A_NAME = "a name may be any that the disk takes"


def place_cases() -> Iterator[MadeCase]:
    """The wrong folder for a verb, and places that are no folders."""
    of_run = ["--threads", "1"]
    for name, command in {
        "prepare of a picture": ["prepare", MOSAIC, *MOSAICS[2:]],
        "prepare of the folder above": ["prepare", ".", *MOSAICS[2:]],
        "prepare of a run": ["prepare", "run", *MOSAICS[2:]],
        "prepare of an empty name": ["prepare", "", *MOSAICS[2:]],
        "prepare of a dash": ["prepare", "-", *MOSAICS[2:]],
        "prepare of the standard input": ["prepare", "/dev/stdin", *MOSAICS[2:]],
        "prepare of the memory": ["prepare", "/proc/self/mem", *MOSAICS[2:]],
        "prepare of a folder of the system": ["prepare", "/proc/self", *MOSAICS[2:]],
        "prepare into its source": ["prepare", "mosaics", "--out", "mosaics", *MOSAICS[4:]],
        "prepare into a scene": ["prepare", "mosaics", "--out", "scene", *MOSAICS[4:]],
        "prepare into a run": ["prepare", "mosaics", "--out", "run", *MOSAICS[4:]],
        "prepare into the root": ["prepare", "mosaics", "--out", "/", *MOSAICS[4:]],
        "prepare into /proc": ["prepare", "mosaics", "--out", "/proc/new", *MOSAICS[4:]],
        "prepare into a device": ["prepare", "mosaics", "--out", "/dev/null/x", *MOSAICS[4:]],
        "prepare into a name of 300 letters": ["prepare", "mosaics", "--out", "x" * 300, *MOSAICS[4:]],
        "prepare into a path of 5000 letters": ["prepare", "mosaics", "--out", "x/" * 2500, *MOSAICS[4:]],
        "train of mosaics": ["train", "mosaics", *TRAIN[2:]],
        "train of a run": ["train", "run", *TRAIN[2:]],
        "train of a scene without poses": ["train", "prepared", *TRAIN[2:]],
        "train into its scene": ["train", "scene", "--out", "scene", *TRAIN[4:]],
        "train into a finished run": ["train", "scene", "--out", "run", *TRAIN[4:]],
        "eval of a scene": ["eval", "scene", *EVAL[2:]],
        "eval of a checkpoint": ["eval", "run/checkpoint.safetensors", *EVAL[2:]],
        "view of a scene": ["view", "scene", *of_run],
        "share of mosaics": ["share", "mosaics", *of_run],
        "share over the checkpoint": ["share", "run", "--out", "run/checkpoint.safetensors", *of_run],
        "render of a scene": ["render", "scene", *of_run],
        "export of a scene": ["export", "scene", "--format", "ply", *of_run],
        "priors of a run": ["priors", "run", "--out", "new", *of_run],
        "priors into its scene": ["priors", "scene", "--out", "scene", "--views", "v001", *of_run],
        "inspect of mosaics": ["inspect", "mosaics", *of_run],
        "inspect of a run": ["inspect", "run", "--out", "new", *of_run],
        "inspect with a fix over the scene": ["inspect", "scene", "--normals", "points", "--out", "new", "--fix", "scene", *of_run],
        "present of mosaics": ["present", "mosaics", "--title", "x", *of_run],
        "present of a file": ["present", MOSAIC, "--title", "x", *of_run],
        "measure of a run": ["measure", "run", *MEASURE[2:]],
        "measure into a scene": ["measure", "mosaics", "--out", "scene", *MEASURE[4:]],
        "measure of the same twice": ["measure", "mosaics", "mosaics", *MEASURE[2:]],
        "measure of the standard input": ["measure", "/dev/stdin", *MEASURE[2:]],
        "calibrate of a scene": ["calibrate", "scene", *CALIBRATE[2:]],
        "calibrate of mosaics": ["calibrate", "mosaics", *CALIBRATE[2:]],
        "tables of a run": ["tables", "run", "--out", "new"],
        "tables of the standard input": ["tables", "/dev/stdin", "--out", "new"],
        "tables of a device": ["tables", "/dev/zero", "--out", "new"],
        "compare of mosaics": ["compare", "mosaics", "--recipes", "3dgs", "--out", "new", *of_run],
        "ablate of an unknown base": ["ablate", "scene", "--base", "../run", "--out", "new", *of_run],
        "demo into a scene": ["demo", "--out", "scene", "--steps", "1", *of_run],
        "demo into a file": ["demo", "--out", MOSAIC, "--steps", "1", *of_run],
        "synth of a folder": ["synth", "scene", *SYNTH[2:]],
        "synth of a preset that leaves": ["synth", "../../synth/presets/proof", *SYNTH[2:]],
        "help of a wrong verb": ["trian", "--help"],
        "no verb but options": ["--steps", "3"],
        "no words at all": [],
    }.items():  # fmt: skip
        reason = {
            "measure into a scene": "a table may lie in any folder",
        }.get(name, "")
        yield made_case(f"further {name}", nothing, command, reason)


def name_cases() -> Iterator[MadeCase]:
    """Files that are called as nobody expects, or are no files."""

    def called(name: str, *others: str) -> None:
        def change(folder: Path) -> None:
            os.rename(folder / MOSAIC, os.path.join(folder, "mosaics", name))
            for other in others:
                shutil.copyfile(folder / "mosaics/v000.png", os.path.join(folder, "mosaics", other))

        return change

    for name, change, reason in (
        ("of two lines", called("v0\n01.png"), NAME_IS_A_NAME),
        ("of pictures", called("🦋\u200d🔥.png"), NAME_IS_A_NAME),
        ("of escapes", called("\x1b[2J\u202ev.png"), NAME_IS_A_NAME),
        ("of 251 letters", called("x" * 251 + ".png"), ""),
        ("of a dash", called("--out.png"), NAME_IS_A_NAME),
        ("of a percent sign", called("%s%n{0}.png"), NAME_IS_A_NAME),
        ("of two points", called("...png"), "names that begin with a point are passed over"),
        ("with its suffix twice", called("v001.png.png"), NAME_IS_A_NAME),
        ("with capital suffix", called("v001.PNG"), NAME_IS_A_NAME),
        ("with suffixes of both cases", called("v001.png", "v001.PNG"), ""),
        ("of a formula", called("=HYPERLINK(1).png"), NAME_IS_A_NAME),
        ("that is no UTF-8", lambda f: os.rename(f / MOSAIC, os.fsencode(f / "mosaics") + b"/v\xff\xfe.png"), NAME_IS_A_NAME),
        ("of a Mac's shadow", lambda f: (f / "mosaics/._v001.png").write_bytes(b"\0\5\x16\7"), "names that begin with a point are passed over"),
        ("of a folder", lambda f: (f / "mosaics/v009.png").mkdir(), ""),
        ("of a socket", lambda f: _socket(f / "mosaics"), ""),
        ("of a link to its folder", lambda f: (f / "mosaics/v009.png").symlink_to("."), ""),
        ("of a link to another mosaic", lambda f: (f / "mosaics/v009.png").symlink_to("v001.png"), "links among pictures are followed"),
        ("of nothing", put(MOSAIC, "empty"), ""),
        ("that may not be read", put(MOSAIC, "dangling"), ""),
    ):  # fmt: skip
        yield made_case(f"further mosaic called {name}", change, MOSAICS, reason)

    def shots(change: object) -> object:
        return lambda folder: change(folder / "shots")

    for name, change, reason in (
        ("without one angle", shots(lambda s: shutil.rmtree(s / "45")), ""),
        ("with an angle twice", shots(lambda s: shutil.copytree(s / "0", s / "000")), ""),
        ("at angles of 30 degrees", shots(lambda s: [(s / a).rename(s / b) for a, b in (("45", "60"), ("135", "120"))]), ""),
        ("with an empty angle", shots(lambda s: [p.unlink() for p in (s / "90").iterdir()]), ""),
        ("with one view in one angle", shots(lambda s: shutil.copyfile(s / "90/v000.png", s / "90/extra.png")), ""),
        ("with angles in capitals", shots(lambda s: [(s / a).rename(s / f"POL-{a}DEG") for a in ("0", "45", "90", "135")]), NAME_IS_A_NAME),
        ("with two suffixes", shots(lambda s: shutil.copyfile(s / "90/v000.png", s / "90/v000.PNG")), ""),
        ("that all are one file", shots(lambda s: [((s / a / "v000.png").unlink(), (s / a / "v000.png").symlink_to("../0/v000.png")) for a in ("45", "90", "135")]), ""),
        ("with a file as an angle", shots(lambda s: (shutil.rmtree(s / "45"), (s / "45").write_text(""))), ""),
        ("in a loop of folders", shots(lambda s: (shutil.rmtree(s / "45"), (s / "45").symlink_to("."))), ""),
    ):  # fmt: skip
        yield made_case(f"further shots {name}", change, SHOTS, reason)


def _socket(folder: Path) -> None:
    here = os.getcwd()
    os.chdir(folder)  # the path of a socket has at most 108 bytes
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("v009.png")
    os.chdir(here)


def text_cases() -> Iterator[MadeCase]:
    """JSON as Windows and careless programs save it, for everything that is read as JSON."""
    spec = {"name": "one", "camera": {"rings": [{"radius": 4, "height": 1}], "views": 3},
            "things": [{"name": "ball", "shape": {"type": "ball", "radius": 1}}],
            "environment": {"type": "uniform", "radiance": [1, 1, 1]}}  # fmt: skip
    kinds = {
        "calibration.json": ({"order": [0, 45, 90, 135], "zero": 0.0}, "zero", [*MOSAICS, "--calibration", "calibration.json"]),
        "limits.json": ({"format": 1, "limits": {"dolp_mean": {"max": 1.0}}}, "format", [*MEASURE, "--limits", "limits.json"]),
        "scene/presentation.json": ({"meters_per_unit": 1.0}, "meters_per_unit", ["present", "scene"]),
        "spec.json": (spec, "depth", SYNTH),
    }  # fmt: skip
    for path, (content, number, command) in kinds.items():
        plain = json.dumps(content)
        inside = plain[1:-1]
        for name, data, reason in (
            ("with a mark of its bytes", b"\xef\xbb\xbf" + plain.encode(), SAME),
            ("with lines as Windows has them", json.dumps(content, indent=1).replace("\n", "\r\n").encode(), SAME),
            ("with a number of 1e400", f'{{{inside}, "{number}": 1e400}}'.encode(), ""),
            ("with a number of 400 digits", f'{{{inside}, "{number}": {"9" * 400}}}'.encode(), ""),
            ("with true for a number", f'{{{inside}, "{number}": true}}'.encode(), ""),
            ("with a comment", b"// mine\n" + plain.encode(), ""),
            ("with a comma too many", plain[:-1].encode() + b",}", ""),
            ("in Latin-1", f'{{"na\u00efve": 1, {inside}}}'.encode("latin-1"), ""),
        ):  # fmt: skip
            if not (path == "spec.json" and reason and "Windows" in name):
                yield made_case(f"further {path} {name}", of_bytes(path, data), command, reason)
