"""What is spoiled: a tiny scene, a run trained on it, raw sources and a scene prepared from them, all made anew."""

from __future__ import annotations

import json
import os
import shutil
import sys
import traceback
from pathlib import Path

import numpy as np
from camera_files import behind, smooth_light, write_mosaics, write_shots
from damage import colmap_binary
from tiny_capture import NAMES, TinyCapture, ideal_intensities, write_picture

HEIGHT, WIDTH = 20, 24
STEPS, LOGGED_STEPS = 2, 10  # the log has a line for every tenth
FLAGS = ["--threads", "1", "--device", "cpu"]
TRAINING = ["--steps", str(LOGGED_STEPS), *FLAGS]
TRAIN = ["train", "scene", "--out", "new", "--steps", str(STEPS), *FLAGS]
READ = [
    "priors",
    "scene",
    "--out",
    "new",
    "--views",
    "v001",
    "--threads",
    "1",
]  # a command that reads a scene, and little more
RESUME = ["train", "scene", "--out", "run", "--resume", *TRAINING]
MOSAICS = ["prepare", "mosaics", "--out", "new", "--sensor", "IMX250MYR", "--bits", "16", "--poses", "none"]
EVAL = ["eval", "run", "--no-speed", "--device", "cpu", "--threads", "1"]
SHOTS = ["prepare", "shots", "--out", "new", "--poses", "none", "--no-align"]


def make_base(folder: Path) -> None:
    """Write the base; in a child, so that the caller computes nothing itself."""
    pid = os.fork()
    if not pid:
        status = 1
        try:
            _make(folder)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    if os.waitpid(pid, 0)[1]:
        raise RuntimeError("the base could not be made")


def _make(folder: Path) -> None:
    from polarguide.cli.app import run

    folder.mkdir(parents=True)
    os.chdir(folder)
    _write_scene(TinyCapture(folder / "scene"))
    for recipe, name in (("polarguide-stokes", "run"), ("ref-gs", "run-ref")):
        assert run(["train", "scene", "--out", name, "--recipe", recipe, *TRAINING]) == 0
    assert run(["eval", "run", "--no-speed", "--device", "cpu", "--threads", "1"]) == 0
    write_mosaics(folder / "mosaics", 3)
    for view in ("v000", "v001"):
        write_shots(folder / "shots", view, behind(smooth_light()))
    model = colmap_binary(folder / "model" / "sparse" / "0")
    assert model.is_dir()
    assert run([*MOSAICS[:3], "prepared", *MOSAICS[4:]]) == 0
    shutil.copytree("prepared", "unfinished")
    (folder / "unfinished" / "scene.json").rename(folder / "unfinished" / "prepare.json")
    path = {"frames_per_second": 30, "cameras": []}
    (folder / "empty_path.json").write_text(json.dumps(path))
    (folder / "calibration.json").write_text(json.dumps({"gains": [1.0, 1.0, 1.0, 1.0], "zero": 0.0}))


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
