# ruff: noqa: E501
"""Options of the verbs, alone and together, and the files that they name."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from base import FLAGS, TRAIN
from fifth_runs import RENDER, export
from fourth_names import ball
from further_folders import SYNTH
from further_records import RUNS
from making import Change, MadeCase, made_case, nothing, of_bytes, of_json

CAMERA: dict[str, Any] = {
    "width": 32, "height": 24, "fx": 40, "fy": 40, "cx": 16, "cy": 12,
    "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 3],
}  # fmt: skip


def train_cases() -> Iterator[MadeCase]:
    """Numbers of a training, and where it goes."""
    start = ["train", "scene", "--out", "new", *FLAGS]
    for name, command, accepted in (
        ("steps of 21 digits", [*start, "--steps", "9" * 21], ""),
        ("boxes larger than the pictures", [*TRAIN, "--downscale", "1000"], ""),
        ("memory in parsecs", [*TRAIN, "--memory", "12 parsecs"], ""),
        ("no memory", [*TRAIN, "--memory", "1e-9"], ""),
        ("a port that there is not", [*TRAIN, "--viewer", "--viewer-port", "70000"], ""),
        ("its scene to go to", ["train", "scene", "--out", "scene", *TRAIN[4:]], ""),
        ("one Gaussian", [*TRAIN, "--gaussians", "1"], "the number bounds what is added to those of the beginning"),
    ):  # fmt: skip
        yield made_case(f"fifth train with {name}", nothing, command, accepted)
    one = [*TRAIN, "--downscale", "20"]
    yield made_case("fifth train on pictures of one pixel", nothing, one, "a picture may be small")


def _path(*cameras: dict[str, Any], speed: float = 10) -> Change:
    return of_json(
        "p.json", {"frames_per_second": speed, "cameras": [{**CAMERA, **camera} for camera in cameras]}
    )


def _panorama(value: float) -> Change:
    def change(folder: Path) -> None:
        import OpenEXR

        pixels = np.full((8, 16, 3), value, np.float32)
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": pixels}).write(str(folder / "e.exr"))

    return change


def _nothing_left(folder: Path) -> None:
    assert not list(folder.glob(".*.tmp*"))


def render_cases() -> Iterator[MadeCase]:
    """Paths, films, environments and layers."""
    along = [*RENDER, "--path", "p.json"]
    film = ["render", "run", "--layers", "final", "--path", "p.json", "--video", "new.mp4", *RUNS]
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2000000 +X 2000000\n" + bytes(100)
    for name, change, command in (
        ("path of pictures of 10^6 a side", _path({"width": 10**6, "height": 10**6}), along),
        ("path that mirrors", _path({"rotation": [-2, 0, 0, 0, 1, 0, 0, 0, 1]}), along),
        ("path without speed", _path({}, {}, speed=0), film),
        ("path of two sizes", _path({}, {"width": 64}), along),
        ("path of two sizes, as a film", _path({}, {"width": 64}), film),
        ("film by another name", nothing, ["render", "run", "--path", "orbit", "--frames", "1", "--video", "new.xyz", *RUNS]),
        ("views that there are not", nothing, [*RENDER, "--views", "v000,v000,nothing"]),
        ("environment of 2000000 pixels a side", of_bytes("e.hdr", head), [*RENDER, "--environment", "e.hdr"]),
        ("environment turned by no number", nothing, [*RENDER, "--rotate-environment", "nan"]),
        ("environment that is no number", _panorama(math.nan), [*RENDER, "--environment", "e.exr"]),
        ("environment without light", _panorama(0.0), [*RENDER, "--environment", "e.exr"]),
    ):  # fmt: skip
        yield made_case(f"fifth {name}", change, command, "", _nothing_left)
    odd = ["render", "run", "--out", "new", "--layers", ",final,,final", *RUNS]
    yield made_case("fifth layers twice and left out", nothing, odd, "each is written once", _layers_once)


def _layers_once(folder: Path) -> None:
    assert len(list((folder / "new").glob("*_final.png"))) == 2


def synth_cases() -> Iterator[MadeCase]:
    """Descriptions of scenes."""

    def shaped(**shape: Any) -> dict[str, object]:
        return ball(things=[{"name": "b", "shape": shape}])

    two = [{"name": "../../evil", "shape": {"type": "ball", "radius": 0.5}}] * 2
    for name, content, says in (
        ("a mesh outside", shaped(type="mesh", file="../../../../etc/passwd"), ""),
        ("a mesh without a suffix", shaped(type="mesh", file="mesh"), "a name that ends in nothing"),
        ("two things of one name that leaves", ball(things=two), ""),
        ("a ring of nothing", ball(camera={"rings": [{"radius": 0, "height": 0}], "views": 4}), ""),
        ("a lens of 180 degrees", ball(camera={"rings": [{"radius": 4, "height": 1}], "fov": 180, "views": 4}), ""),
        ("no views", ball(camera={"rings": [{"radius": 4, "height": 1}], "views": 0}), ""),
        ("a lathe of one point", shaped(type="lathe", profile=[[0, 0]]), r"array of shape \[1, 2\]"),
        ("a lathe of words", shaped(type="lathe", profile="abc"), ""),
        ("a lathe of lists of all lengths", shaped(type="lathe", profile=[[0, 0], [1]]), "not all 2 numbers"),
        ("a tube without a path", shaped(type="tube", path=[], radius=1), ""),
        ("nothing in it", ball(things=[]), ""),
        ("a panorama of words", ball(environment={"type": "image", "file": "spec.json"}), ""),
    ):  # fmt: skip

        def described(folder: Path, content: dict[str, object] = content) -> None:
            (folder / "mesh").write_text("no mesh")
            (folder / "spec.json").write_text(json.dumps(content))

        yield made_case(f"fifth scene file of {name}", described, SYNTH, says=says)
    for name, more in {
        "pictures of nothing": ["--size", "0x0"],
        "pictures of 10^8 columns": ["--size", "99999999x1"],
        "a sweep of nothing": ["--sweep", "views="],
        "a sweep of words": ["--sweep", "views=3,abc"],
    }.items():
        yield made_case(f"fifth synth with {name}", nothing, ["synth", "proof", "--out", "new", *more])


def other_cases() -> Iterator[MadeCase]:
    """All other verbs."""
    compare = ["compare", "scene", "--steps", "2", "--out", "new", "--jobs", "1", "--report-views", "0"]
    for name, command in {
        "compare of one recipe twice": [*compare, "--recipes", "3dgs", "3dgs"],
        "compare of no seeds": [*compare, "--recipes", "3dgs", "--seeds", "0"],
        "compare against what is no row": [*compare, "--recipes", "3dgs", "--against", "3dgs-dr"],
        "compare of jobs below zero": [*compare, "--recipes", "3dgs", "--jobs", "-3"],
        "ablate of nothing that there is": [
            "ablate",
            "scene",
            "--steps",
            "2",
            "--out",
            "new",
            "--only",
            "nothing-of-the-kind",
        ],
        "mesh of 100000 voxels": [*export("mesh"), "--resolution", "100000"],
        "mesh of -1 voxels": [*export("mesh"), "--resolution", "-1"],
        "cameras into a file": ["export", "run", "--format", "cameras", "--out", "calibration.json", *RUNS],
        "page by another name": ["share", "run", "--out", "new", "--title", "</script>", *RUNS],
        "present of a pixel outside": [
            "present",
            "run",
            "--points",
            "v000,99999,1",
            "v001,1,1",
            "--distance",
            "85mm",
        ],
        "present of a length below zero": [
            "present",
            "run",
            "--points",
            "v000,1,1",
            "v001,1,1",
            "--distance=-5mm",
        ],
        "scale of no number": ["scale", "--diameter", "nan"],
        "scale of a kilometer": ["scale", "--diameter", "1e9"],
        "bench of a scene that is held back": ["bench", "--out", "new", "--scenes", "cup"],
        "bench into a file": ["bench", "--out", "calibration.json", "--scenes", "kit", "--render-only"],
        "inspect into its scene": [
            "inspect",
            "scene",
            "--normals",
            "points",
            "--out",
            "new",
            "--fix",
            "scene",
            *RUNS,
        ],
    }.items():
        yield made_case(f"fifth {name}", nothing, command)
    yield made_case(
        "fifth scale into a folder that is not there",
        nothing,
        ["scale", "--diameter", "70", "--out", "no/such/new.svg"],
        "folders are made",
    )
    rubbish = of_json(
        "results.json",
        {
            "format": "polarguide-results-2",
            "runs": [{"scene": None, "recipe": "<b>", "metrics": {"psnr": "abc"}}],
        },
    )
    yield made_case("fifth tables of rubbish", rubbish, ["tables", "results.json", "--out", "new"])
