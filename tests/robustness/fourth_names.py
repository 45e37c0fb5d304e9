# ruff: noqa: E501
"""Names that a console takes for markup, that it cannot write, or that are no text; numbers without end; a bad environment."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from base import EVAL, MOSAICS, TRAIN
from further_folders import MEASURE, SYNTH
from further_records import RUNS
from making import MOSAIC, Change, MadeCase, made_case, nothing

NAMES = {
    "markup": "new[/red]",
    "escapes": "new\x1b[2J\u202e",
    "bytes that are no text": os.fsdecode(b"new\xff\xfe"),
}
A_NAME = "a name may be any that the disk takes"


def _quiet(folder: Path) -> None:
    """Nothing on the console is obeyed by it."""
    assert b"\x1b[2J" not in (folder.parent / "said").read_bytes()


def _moved(path: str, name: str) -> Change:
    def change(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)  # markup is closed with a slash
        os.rename(folder / path, folder / name)

    return change


def _ascii(then: Change = nothing) -> Change:
    """A console that knows ASCII alone."""

    def change(folder: Path) -> None:
        sys.stdout.reconfigure(encoding="ascii", errors="strict")  # type: ignore[union-attr]
        then(folder)

    return change


def name_cases() -> Iterator[MadeCase]:
    """Names of what is written and of what is read, with every verb that prints them."""
    for kind, name in NAMES.items():
        for verb, change, command in (
            ("train", nothing, ["train", "scene", "--out", name, *TRAIN[4:]]),
            ("eval", _moved("run", name), ["eval", name, *EVAL[2:]]),
            ("render", _moved("run", name), ["render", name, "--layers", "final", *RUNS]),
            ("export", _moved("run", name), ["export", name, "--format", "ply", *RUNS]),
            ("share", _moved("run", name), ["share", name, *RUNS]),
            ("inspect", nothing, ["inspect", "scene", "--normals", "points", "--out", name, *RUNS]),
            ("prepare", nothing, ["prepare", "mosaics", "--out", name, *MOSAICS[4:]]),
            ("priors", nothing, ["priors", "mosaics", "--out", name, *MOSAICS[4:6], "--formats", "npy"]),
            ("priors of a shot", _moved(MOSAIC, f"mosaics/{name}.png"), ["priors", "mosaics", "--out", "new", *MOSAICS[4:6], "--formats", "npy"]),
            ("measure", nothing, [*MEASURE[:2], "--out", name, *MEASURE[4:]]),
            ("calibrate", nothing, ["calibrate", "mosaics", "--out", f"{name}.safetensors", "--sensor", "IMX250MYR"]),
            ("tables", nothing, ["tables", name, "--out", "new"]),
        ):  # fmt: skip
            yield made_case(f"fourth name of {kind}: {verb}", change, command, A_NAME, _quiet)
        yield made_case(
            f"fourth name of {kind}: synth",
            _scene_file,
            ["synth", "spec.json", "--out", name, *SYNTH[4:]],
            A_NAME,
            _quiet,
        )
        yield made_case(
            f"fourth name of {kind}: a watched shot",
            _no_picture(name),
            [
                "measure",
                "--watch",
                "mosaics",
                "--out",
                "new",
                *MEASURE[4:],
                "--settle",
                "0.05",
                "--patience",
                "0.1",
                "--idle",
                "0.6",
            ],
            A_NAME,
            _quiet,
        )
    yield made_case("fourth name of markup: an object", _object_of_markup, EVAL, A_NAME)
    yield made_case("fourth console of ASCII: eval", _ascii(), EVAL, A_NAME)
    yield made_case(
        "fourth console of ASCII: priors",
        _ascii(),
        ["priors", "mosaics", "--out", "n\u2603", *MOSAICS[4:6], "--formats", "npy"],
        A_NAME,
    )


def _no_picture(name: str) -> Change:
    def change(folder: Path) -> None:
        (folder / f"mosaics/{name}.png").parent.mkdir(exist_ok=True)
        (folder / f"mosaics/{name}.png").write_text("no picture")

    return change


def _scene_file(folder: Path) -> None:
    """A ball under an even sky."""
    (folder / "spec.json").write_text(json.dumps(ball()))


def ball(**changed: object) -> dict[str, object]:
    """The smallest scene that can be rendered."""
    return {
        "name": "ball",
        "camera": {"rings": [{"radius": 4.0, "height": 1.0}], "views": 3},
        "environment": {"type": "uniform", "radiance": [1, 1, 1]},
        "exposure": 0.9,
        "things": [{"name": "ball", "shape": {"type": "ball", "radius": 0.8}}],
        **changed,
    }


def _object_of_markup(folder: Path) -> None:
    """Numbers of objects, one of which has a name that closes what nobody has opened."""
    import numpy as np

    path = folder / "scene/gt/v000.npz"
    arrays = dict(np.load(path))
    np.savez(path, **arrays, objid=np.ones(arrays["depth"].shape, np.uint16))
    record = {"objects": [{"id": 1, "name": "[/red]\x1b[2J"}]}
    (folder / "scene/scene.json").write_text(json.dumps(record))


def environment_cases() -> Iterator[MadeCase]:
    """Variables that torchrun sets, half or wrong."""
    two = {
        "WORLD_SIZE": "2",
        "RANK": "0",
        "LOCAL_RANK": "0",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": "29500",
    }
    for name, changed in {
        "no place to meet": {"MASTER_ADDR": ""},
        "no port": {"MASTER_PORT": ""},
        "a port of 99999999": {"MASTER_PORT": "99999999"},
        "a local rank in words": {"LOCAL_RANK": "x"},
    }.items():

        def change(folder: Path, changed: dict[str, str] = changed) -> None:
            os.environ.update({**two, **changed})

        yield made_case(f"fourth environment with {name}", change, TRAIN)


def limit_cases() -> Iterator[MadeCase]:
    """Numbers without end, and options that mean nothing where they stand."""
    compare = ["compare", "scene", "--recipes", "3dgs", "--steps", "2", "--out", "new", "--jobs", "1"]
    for name, command in {
        "a billion seeds": [*compare, "--seeds", "1000000000"],
        "a billion seeds of ablations": [
            "ablate",
            "scene",
            "--steps",
            "2",
            "--out",
            "new",
            "--seeds",
            "1000000000",
        ],
        "frames without a path": ["render", "run", "--out", "new", "--frames", "5", *RUNS],
        "a turn of 1e308 degrees": ["render", "run", "--out", "new", "--rotate-environment", "1e308", *RUNS],
        "a focal length of 1e308": [
            "priors",
            "mosaics",
            "--out",
            "new",
            *MOSAICS[4:6],
            "--intrinsics",
            "1e308,1e308,0,0",
        ],
        "a settle without a watch": [*MEASURE, "--settle", "2"],
        "an idle without a watch": [*MEASURE, "--idle", "2"],
        "a host of 70000 letters": ["view", "run", "--host", "a" * 70000],
        "a host of bytes that are no text": ["view", "run", "--host", os.fsdecode(b"\xff")],
        "a host that no network can have": ["view", "run", "--host", "xn--\u2603.."],
    }.items():
        yield made_case(f"fourth option of {name}", nothing, command)
    yield made_case(
        "fourth limits of an angle of 900 degrees", _limits, [*MEASURE, "--limits", "limits.json"]
    )


def _limits(folder: Path) -> None:
    (folder / "limits.json").write_text('{"limits": {"aolp_mean": {"min": -400, "max": 900}}}')
