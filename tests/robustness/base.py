"""What is spoiled: a tiny scene, a run trained on it, raw sources and a scene prepared from them, all made anew."""

from __future__ import annotations

import importlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
from camera_files import behind, smooth_light, write_mosaics, write_shots
from damage import colmap_binary
from tiny_capture import NAMES, TinyCapture, ideal_intensities, write_picture

HEIGHT, WIDTH = 20, 24
ONE = "--threads 1"
FLAGS = f"{ONE} --device cpu"
SENSOR = "--sensor IMX250MYR --bits 16"
TRAIN = f"train scene --out new --steps 2 {FLAGS}"
READ = f"priors scene --out new --views v001 {ONE}"
"""A command that reads a scene, and little more."""
TRAINED = f"--steps 10 {FLAGS}"
"""The log has a line for every tenth step."""
RESUME = f"train scene --out run --resume {TRAINED}"
EVAL = f"eval run --no-speed {FLAGS}"
SHARE = f"share run --out new.html {ONE}"
RENDER = f"render run --out new --layers final {ONE}"
INSPECT = f"inspect scene --normals points --out new {ONE}"
COMPARE = f"compare scene --out new --recipes 3dgs --steps 2 --jobs 1 --report-views 0 {FLAGS}"
MOSAICS = f"prepare mosaics --out new {SENSOR} --poses none"
SHOTS = "prepare shots --out new --poses none --no-align"
MAPS = f"priors mosaics --out new {SENSOR} --formats npy"
MEASURE = f"measure mosaics --out new {SENSOR} {ONE}"
WATCH = f"measure --watch mosaics --out new {SENSOR} {ONE} --settle 0.05 --idle 0.6"
CALIBRATE = f"calibrate polarizer --out new.safetensors --sensor IMX250MZR {ONE}"
SYNTH = f"synth spec.json --out new --size 16x16 --samples 1 {ONE}"
PICTURE, TRUTH, MOSAIC = "scene/polar/v001_045.png", "scene/gt/v000.npz", "mosaics/v001.png"
MASK, CHECKPOINT = "scene/masks/v001.png", "run/checkpoint.safetensors"


def export(kind: str) -> str:
    """An export of the run."""
    return f"export run --format {kind} --out new {ONE}"


def into(out: str, command: str) -> str:
    """A command that writes elsewhere."""
    return command.replace(" --out new", f" --out {out}")


def of(source: str, command: str) -> str:
    """A command that reads something else."""
    verb, _, *more = command.split()
    return " ".join([verb, source, *more])


def posed(poses: str, command: str = MOSAICS) -> str:
    """A preparation with poses."""
    return command.replace("--poses none", f"--poses {poses}")


def make_base(folder: Path) -> None:
    """Write the base; in a fork, so that the caller computes nothing itself."""
    run = importlib.import_module("polarguide.cli.app").run
    folder.mkdir(parents=True)
    os.chdir(folder)
    _write_scene(TinyCapture(folder / "scene"))
    for recipe, name in (("polarguide-stokes", "run"), ("ref-gs", "run-ref")):
        assert run(f"train scene --out {name} --recipe {recipe} {TRAINED}".split()) == 0
    assert run(EVAL.split()) == 0
    write_mosaics(folder / "mosaics", 3)
    for view in ("v000", "v001"):
        write_shots(folder / "shots", view, behind(smooth_light()))
    assert colmap_binary(folder / "model" / "sparse" / "0").is_dir()
    assert run(into("prepared", MOSAICS).split()) == 0
    shutil.copytree("prepared", "unfinished")
    Path("unfinished/scene.json").rename("unfinished/prepare.json")
    Path("calibration.json").write_text(json.dumps({"gains": [1.0, 1.0, 1.0, 1.0], "zero": 0.0}))


def _write_scene(tiny: TinyCapture) -> None:
    """Nine views on a line, and everything that a scene may have besides pictures and poses."""
    for index, name in enumerate(NAMES):
        tiny.write_view(name, ideal_intensities(index, height=HEIGHT, width=WIDTH))
        write_picture(tiny.root / "masks" / f"{name}.png", np.ones((HEIGHT, WIDTH)), bits=8)
    model = tiny.root / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 {WIDTH / 2} {HEIGHT / 2}\n")
    poses = (
        f"{k + 1} 1 0 0 0 {0.1 * k - 0.4} {0.05 * (k % 3)} 2.5 1 {name}.png\n\n"
        for k, name in enumerate(NAMES)
    )
    (model / "images.txt").write_text("".join(poses))
    points = (
        "7 0.5 0.25 0.5 10 20 30 0.5",
        "2 -0.4 0 0 255 0 128 0.5",
        "3 0 0 0.3 1 2 3 0.5",
        "4 0.2 0.2 0 4 5 6 0.5",
    )
    (model / "points3D.txt").write_text("\n".join(points) + "\n")
    tiny.write_json("scene.json", {"refractive_index": 1.5, "objects": [{"material": {"ior": 1.5}}]})
    tiny.write_json("split.json", {"test": ["v000", "v004"]})
    write_picture(tiny.root / "invalid" / "v001.png", np.eye(HEIGHT, WIDTH), bits=8)
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    normal[..., 2] = -1
    flat = np.ones((HEIGHT, WIDTH), np.float32)
    tiny.write_truth("v000", normal=normal, depth=flat, mask=flat > 0)
