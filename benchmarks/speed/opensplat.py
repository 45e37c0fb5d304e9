"""Compare our training step on the CPU with OpenSplat, another program for Gaussian splatting, on the same pictures.

    python benchmarks/speed/opensplat.py SCENE --opensplat PATH [--downscale 2] [--steps 90] [--threads 1] [--turns 3]

PATH is the program ``opensplat``, which is not part of this project; build it yourself. Both get the training views'
photographs, poses and points. They train at full size and end before their first density control. They take turns. The
time before the first step, for reading and starting, is measured with one step and subtracted. Run it without other
work on the machine.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import pycolmap
import torch

from polarguide.capture import Scene, load_scene
from polarguide.capture.write import write_png_file
from polarguide.optics.color import srgb_encode
from polarguide.results.export.placement import write_colmap

MOST_STEPS = 98
"""Largest number of steps. Our density control begins after 100 steps, OpenSplat's after 500."""


def write_project(scene: Scene, folder: Path) -> None:
    """Write the training views as a COLMAP project of ordinary photographs."""
    (folder / "images").mkdir(parents=True)
    for view in scene.train_views:
        shown = srgb_encode(view.photograph().clamp(0, 1)) * 255
        write_png_file(folder / "images" / f"{view.name}.png", shown.round().to(torch.uint8).numpy())
    cameras = {view.name: view.camera for view in scene.train_views}
    model = folder / "sparse" / "0"
    write_colmap(model, cameras, scene.points, scene.point_colors)
    pycolmap.Reconstruction(str(model)).write_binary(str(model))  # OpenSplat reads no text models


def seconds(command: list[str], threads: int, folder: Path) -> tuple[float, float]:
    """Return processor and wall seconds of a command.

    Raises:
        SystemExit: the command failed. The message contains its last lines.
    """
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": str(threads),
        "MKL_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    before, begin = os.times(), os.times().elapsed
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    after = os.times()
    if done.returncode:
        words = (done.stdout + done.stderr).strip().splitlines()[-3:]
        raise SystemExit(f"{command[0]} ended with {done.returncode}: " + " | ".join(words))
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return used, after.elapsed - begin


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--opensplat", type=Path, required=True)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--steps", type=int, default=90)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    if not os.access(options.opensplat, os.X_OK):
        raise SystemExit(
            f"--opensplat {options.opensplat}: expected a program; build OpenSplat and give its path"
        )
    if not 10 <= options.steps <= MOST_STEPS:
        raise SystemExit(
            f"--steps {options.steps}: expected 10 to {MOST_STEPS}, before either controls the density"
        )
    scene = load_scene(options.scene, downscale=options.downscale)
    camera = scene.train_views[0].camera
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_project(scene, folder / "project")

        def theirs(steps: int) -> list[str]:
            words = [str(options.opensplat.resolve()), str(folder / "project"), "--cpu", "-n", str(steps)]
            return [*words, "--num-downscales", "0", "-o", str(folder / "splat.ply")]

        def ours(steps: int) -> list[str]:
            words = [sys.executable, "-m", "polarguide", "train", str(options.scene.resolve())]
            words += ["--recipe", "3dgs", "--downscale", str(options.downscale), "--steps", str(steps)]
            words += ["--device", "cpu", "--threads", str(options.threads)]
            return [*words, "--out", tempfile.mkdtemp(dir=folder)]

        taken: dict[str, list[tuple[float, float]]] = {"polarguide 3dgs": [], "OpenSplat": []}
        for _ in range(options.turns):
            for values, command in zip(taken.values(), (ours, theirs), strict=True):
                first, many = (
                    seconds(command(steps), options.threads, folder) for steps in (1, 1 + options.steps)
                )
                values.append(((many[0] - first[0]) / options.steps, (many[1] - first[1]) / options.steps))
    print(
        f"{camera.width} x {camera.height}, {len(scene.points):,} points, {options.steps} steps, "
        f"{options.threads} threads, medians of {options.turns} turns\n"
    )
    print("| program | processor ms per step | wall ms per step |\n|---|---|---|")
    for name, values in taken.items():
        used, wall = (1e3 * statistics.median(column) for column in zip(*values, strict=True))
        print(f"| {name} | {used:.1f} | {wall:.1f} |")


if __name__ == "__main__":
    main()
