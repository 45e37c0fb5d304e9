"""Compare exported models in Blender (Cycles, on the CPU) from held-out cameras with the photographs.

    python3.11 -m venv ENV && ENV/bin/pip install bpy==5.0.1          # 1 GB, in its own environment
    python benchmarks/accuracy/blender.py RUN MODEL.glb ... --bpy ENV/bin/python --room SCENE > blender.md

The models are exports of RUN in the scene's own units. They are lit by the run's exported environment, and then by the
environment of another scene. ``polarguide synth`` must have rendered that scene with the same objects and cameras in
another room; its pictures are the reference in the other room. The record has the run of seed 0 of the bench's cup, and
for SCENE the preset cup with environment and exposure of the preset rough and without lights
(--size 192x144 --views 56 --test-every 7 --samples 16).

PSNR is of sRGB values in the mask of the foreground, without a factor and with the best factor of the light for all
views, because the brightness is ambiguous. Files with "unlit" in their names are drawn without light, and only in the
first room. "not black" covers dielectrics with an albedo above 0.05, with their own best factor.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from polarguide import open_run
from polarguide.capture.formats.pictures import read_radiance
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode_array
from polarguide.results.rendering.relight import write_exr
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.visualization import figures

HEIGHT = 512
BLACK = 0.05
"""Albedo under which bodies show little more than reflections."""
FACTORS = np.exp(np.linspace(-1.5, 1.5, 121))


def frame_of(camera: Camera, axes: np.ndarray) -> dict[str, Any]:
    """Return a camera for Blender: its pose in OpenGL's axes, its lens, and its shift in widths of the picture."""
    pose = np.eye(4)
    pose[:3, :3] = axes.T @ camera.rotation.T.numpy() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = axes.T @ camera.center.numpy()
    return {
        "pose": pose.tolist(),
        "width": camera.width,
        "height": camera.height,
        "lens": camera.fx / camera.width,
        "stretch": camera.fx / camera.fy,
        "shift": [0.5 - camera.cx / camera.width, (camera.cy - camera.height / 2) / camera.width],
    }


def room_light(scene: Path, axes: np.ndarray) -> torch.Tensor:
    """Return the panorama [H, 2 H, 3] of a scene's true environment, upright in a run's axes (columns of [3, 3])."""
    exposure = json.loads((scene / "scene.json").read_text())["exposure"]
    true = read_radiance(scene / "environment.hdr") * exposure / 2  # photographs are S0 / 2
    height, width = true.shape[:2]
    latitude = np.pi * (0.5 - (np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT)
    longitude = np.pi * ((np.arange(2 * HEIGHT)[None] + 0.5) / HEIGHT - 1)
    local = np.stack([np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude,
                      -np.cos(latitude) * np.cos(longitude)], axis=-1)  # fmt: skip
    x, y, z = np.moveaxis(local @ axes.T, -1, 0)
    row = ((0.5 - np.arcsin(np.clip(z, -1, 1)) / np.pi) * height - 0.5).astype(np.float32)
    column = (np.mod(-np.arctan2(y, x) / (2 * np.pi), 1) * width - 0.5).astype(np.float32)
    found = cv2.remap(true.astype(np.float32), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return torch.from_numpy(found)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Return the PSNR of linear colors in dB, in sRGB."""
    shown = [srgb_encode_array(np.clip(values, 0, 1)) for values in (first, second)]
    return float(-10 * np.log10(np.mean((shown[0] - shown[1]) ** 2)))


def best_factor(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Return the PSNR with the best of the factors on the first picture, and that factor."""
    return max((psnr(factor * first, second), float(factor)) for factor in FACTORS)


def chosen(found: list[np.ndarray], true: list[np.ndarray], masks: list[np.ndarray]) -> list[np.ndarray]:
    """Return all masked pixels of both pictures in one row, [N, 3]."""
    return [np.concatenate([p[m] for p, m in zip(each, masks, strict=True)]) for each in (found, true)]


def drawn(
    path: Path, folder: Path, frames: dict[str, Any], arguments: argparse.Namespace
) -> list[np.ndarray]:
    """Return Blender's pictures [H, W, 3] of a model in linear radiance. The folder has the light, and gets files."""
    job = {"model": str(path.resolve()), "environment": str(folder / "environment.exr"),
           "unlit": "unlit" in path.stem, "samples": arguments.samples, "frames": frames,
           "out": str(folder)}  # fmt: skip
    (folder / "job.json").write_text(json.dumps(job))
    command = [arguments.bpy, Path(__file__).with_name("blender_draw.py"), folder / "job.json"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr[-2000:])
    return [read_radiance(folder / f"{name}.exr")[..., :3] for name in frames]


class Room:
    """Light, cameras and photographs of held-out views.

    Args:
        run: the run whose models are drawn.
        lit: scene that has the light and the photographs, or None for the run's own.
        count: number of views.
        folder: empty folder for the environment and the files of Blender.
    """

    def __init__(self, run: OpenedRun, lit: Path | None, count: int, folder: Path) -> None:
        self.folder = folder
        axes = run.frame.panorama_axes().numpy()
        if lit is None:
            run.export("environment", folder)
        else:
            write_exr(folder / "environment.exr", room_light(lit, axes))
        scene = run.scene if lit is None else read_scene(lit)
        views = [scene.view(view.name) for view in run.scene.test_views[:count]]
        self.cameras = [view.camera for view in views]
        self.frames = {view.name: frame_of(view.camera, axes) for view in views}
        self.photographs = [view.photograph().numpy() for view in views]
        self.masks = []
        self.bodies = []
        for view in views:
            with np.load(run.scene.root / "gt" / f"{view.name}.npz") as truth:
                mask = truth["mask"] > 0
                self.masks.append(mask)
                self.bodies.append(mask & (truth["metalness"] == 0) & (truth["albedo"].mean(-1) > BLACK))

    def cells(self, pictures: list[np.ndarray]) -> list[str]:
        """Return PSNR, PSNR with the best factor, this factor, and PSNR of bodies that are not black."""
        inside, colored = (chosen(pictures, self.photographs, part) for part in (self.masks, self.bodies))
        best, factor = best_factor(*inside)
        return [f"{psnr(*inside):.1f}", f"{best:.1f}", f"{factor:.2f}", f"{best_factor(*colored)[0]:.1f}"]


def main() -> None:
    """Print a table of all models, and of our own pictures in the light of the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--bpy", type=Path, required=True, help="a Python that has bpy")
    parser.add_argument(
        "--room", type=Path, required=True, help="a scene with the same objects and cameras in another light"
    )
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--samples", type=int, default=48)
    parser.add_argument("--sheet", type=Path, help="picture of the models in both rooms beside a photograph")
    parser.add_argument("--shown", type=int, default=1, help="number of the view of the sheet")
    arguments = parser.parse_args()
    run = open_run(arguments.run)
    columns = ["best factor", "that factor", "not black"]
    print(f"| model | learned light | {' | '.join(columns)} | another room | {' | '.join(columns)} |")
    print(f"|---{2 * (1 + len(columns)) * '|---'}|")
    with tempfile.TemporaryDirectory() as own, tempfile.TemporaryDirectory() as other:
        rooms = {
            "learned": Room(run, None, arguments.views, Path(own)),
            "other": Room(run, arguments.room, arguments.views, Path(other)),
        }
        shown: dict[str, dict[str, np.ndarray]] = {name: {} for name in rooms}
        for path in arguments.models:
            row = [f"`{path.stem}`"]
            for name, room in rooms.items():
                if name == "other" and "unlit" in path.stem:
                    row.extend([""] * (1 + len(columns)))
                    continue
                pictures = drawn(path, room.folder, room.frames, arguments)
                row.extend(room.cells(pictures))
                if "unlit" not in path.stem:
                    shown[name][path.stem] = pictures[arguments.shown]
            print(f"| {' | '.join(row)} |", flush=True)
        room = rooms["learned"]
        ours = [run.result(camera).to("cpu").final.numpy() for camera in room.cameras]
        print(f"| {' | '.join(['polarguide', *room.cells(ours)] + [''] * (1 + len(columns)))} |")
    if arguments.sheet:
        for name, room in rooms.items():
            shown[name]["photograph"] = room.photographs[arguments.shown]
        tiles = [
            [figures.radiance_to_rgb(torch.from_numpy(p).float()) for p in row.values()]
            for row in shown.values()
        ]
        sheet = figures.contact_sheet(tiles, ["", ""], list(shown["learned"]))
        figures.write_png(arguments.sheet, sheet)


if __name__ == "__main__":
    main()
