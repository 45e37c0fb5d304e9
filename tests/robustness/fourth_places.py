"""Places to write that hold something else: scenes, models, shots; and checkpoints of nothing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from base import MOSAICS, RESUME, TRAIN
from forked import Case
from further_folders import MEASURE
from further_records import RUNS
from making import MOSAIC, MadeCase, made_case, nothing

SHOWN = ["--sensor", "IMX250MYR", "--bits", "16", "--formats", "npy"]


def _scene_as_it_was(folder: Path) -> None:
    """The scene has the files that it had."""
    model = folder / "scene/sparse/0"
    assert sorted(path.name for path in model.iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    assert "PINHOLE 24 20" in (model / "cameras.txt").read_text()
    assert not [path for path in (folder / "scene/polar").iterdir() if path.suffix != ".png"]


def _mosaic_as_it_was(folder: Path) -> None:
    assert (folder / "S0/S0.png").read_bytes() == (folder / MOSAIC).read_bytes()


def place_cases() -> Iterator[MadeCase]:
    """What is written over or among what is read."""
    compare = ["--recipes", "3dgs", "--steps", "2", "--jobs", "1", "--report-views", "0"]
    for name, command in {
        "compare into its scene": ["compare", "scene", "--out", "scene", *compare],
        "compare among the pictures": ["compare", "scene", "--out", "scene/polar", *compare],
        "ablate into its scene": ["ablate", "scene", "--out", "scene", "--steps", "2"],
        "bench into a scene": ["bench", "--out", "scene", "--scenes", "car", "--render-only"],
        "bench among the pictures": ["bench", "--out", "scene/polar/x", "--scenes", "car", "--render-only"],
        "train among the pictures": ["train", "scene", "--out", "scene/polar", *TRAIN[4:]],
        "train into the model": ["train", "scene", "--out", "scene/sparse/0/new", *TRAIN[4:]],
        "render among the pictures": ["render", "run", "--layers", "final", "--out", "scene/polar", *RUNS],
        "inspect into its scene": ["inspect", "scene", "--normals", "points", "--out", "scene", *RUNS],
        "inspect among the pictures": [
            "inspect",
            "scene",
            "--normals",
            "points",
            "--out",
            "scene/polar",
            *RUNS,
        ],
        "export of cameras over the scene's": [
            "export",
            "run",
            "--format",
            "cameras",
            "--out",
            "scene",
            *RUNS,
        ],
        "export of cameras into the model": [
            "export",
            "run",
            "--format",
            "cameras",
            "--out",
            "scene/sparse/0",
            *RUNS,
        ],
        "export of a mesh into the ground truth": [
            "export",
            "run",
            "--format",
            "mesh",
            "--resolution",
            "16",
            "--out",
            "scene/gt",
            *RUNS,
        ],
        "tables into a scene": ["tables", "nothing", "--out", "scene"],
    }.items():
        yield made_case(f"fourth place: {name}", nothing, command, "", _scene_as_it_was)

    def model_alone(folder: Path) -> None:
        (folder / "model/sparse/0/more.txt").write_text("mine")

    def kept(folder: Path) -> None:
        assert (folder / "model/sparse/0/more.txt").read_text() == "mine"
        assert not (folder / "model/transforms.json").exists()

    yield made_case(
        "fourth place: export of cameras over another model",
        model_alone,
        ["export", "run", "--format", "cameras", "--out", "model", *RUNS],
        "",
        kept,
    )

    def named_like_a_map(folder: Path) -> None:
        (folder / "S0").mkdir()
        shutil.copyfile(folder / MOSAIC, folder / "S0/S0.png")

    png = [*SHOWN[:-1], "png"]
    yield made_case(
        "fourth place: maps over their mosaic",
        named_like_a_map,
        ["priors", "S0/S0.png", "--out", ".", *png],
        "",
        _mosaic_as_it_was,
    )
    for name, command in {
        "maps among mosaics": ["priors", "mosaics", "--out", "mosaics", *SHOWN],
        "a table among mosaics": [*MEASURE[:2], "--out", "mosaics", *MEASURE[4:]],
        "a table in the watched folder": [
            "measure",
            "--watch",
            "mosaics",
            "--out",
            "mosaics",
            *MEASURE[4:],
            "--idle",
            "0.3",
        ],
        "a calibration among its shots": [
            "calibrate",
            "mosaics",
            "--out",
            "mosaics/new.safetensors",
            "--sensor",
            "IMX250MYR",
        ],
    }.items():
        yield made_case(f"fourth place: {name}", nothing, command)
    yield made_case(
        "fourth place: a scene among its mosaics",
        nothing,
        ["prepare", "mosaics", "--out", "mosaics/new", *MOSAICS[4:]],
        "mosaics are read from their folder alone, not from those in it",
    )


def checkpoint_cases() -> Iterator[Case]:
    """Checkpoints without a Gaussian."""

    def empty(folder: Path) -> None:
        from safetensors.torch import load_file, save_file

        path = folder / "run/checkpoint.safetensors"
        tensors = load_file(path)
        count = len(tensors["gaussians.means"])
        emptied = {
            name: values[..., :0]
            if name.startswith("statistics")
            else values[:0]
            if values.shape[:1] == (count,)
            else values
            for name, values in tensors.items()
        }
        save_file({name: values.contiguous() for name, values in emptied.items()}, path)

    render = ["render", "run", "--out", "new", "--layers", "final", *RUNS]
    for verb, command in (("rendered", render), ("resumed", [*RESUME[:-6], *RESUME[-6:]])):
        yield made_case(f"fourth checkpoint of no Gaussian, {verb}", empty, command)
