"""Store scenes in one small file each, for a machine with torch and numpy that cannot read captures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarguide.capture import Scene, View
from polarguide.geometry.camera import Camera

SUFFIX = ".scene.npz"


def save_scene(scene: Scene, path: Path) -> None:
    """Write a scene without its ground truth. Pictures are stored losslessly, as differences along rows."""
    arrays: dict[str, Any] = {
        "points": scene.points.numpy(),
        "point_colors": scene.point_colors.numpy(),
        "about": np.array(json.dumps({"name": scene.name, "test": scene.test_names, "digest": scene.digest})),
    }
    for number, view in enumerate(scene.views):
        camera, codes = view.camera, view.codes.numpy()
        # Integer overflow wraps around, so the differences are exact.
        steps = np.diff(codes, axis=2, prepend=np.zeros_like(codes[:, :, :1]))
        arrays |= {
            f"{number}.name": np.array(view.name),
            f"{number}.high": (steps >> 8).astype(np.uint8),
            f"{number}.low": (steps & 255).astype(np.uint8),
            f"{number}.masks": np.packbits(torch.stack((view.invalid, view.saturated)).numpy()),
            f"{number}.intrinsics": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            f"{number}.pose": torch.cat((camera.rotation, camera.translation[:, None]), dim=1).numpy(),
        }
    np.savez_compressed(path, **arrays)


def read_scene(path: Path) -> Scene:
    """Invert ``save_scene``."""
    with np.load(path) as file:
        about = json.loads(str(file["about"]))
        count = sum(name.endswith(".name") for name in file.files)
        views = tuple(_view(file, number) for number in range(count))
        return Scene(
            root=path,
            name=about["name"],
            views=views,
            test_names=tuple(about["test"]),
            points=torch.from_numpy(file["points"]),
            point_colors=torch.from_numpy(file["point_colors"]),
            refractive_index=None,
            downscale=1,
            transfer="linear",
            digest=about["digest"],
            warnings=(),
        )


def _view(file: Any, number: int) -> View:
    steps = (file[f"{number}.high"].astype(np.uint16) << 8) | file[f"{number}.low"]
    codes = np.cumsum(steps, axis=2, dtype=np.uint16)
    height, width = codes.shape[1:3]
    masks = np.unpackbits(file[f"{number}.masks"], count=2 * height * width).astype(bool)
    invalid, saturated = torch.from_numpy(masks.reshape(2, height, width))
    fx, fy, cx, cy = (float(x) for x in file[f"{number}.intrinsics"])
    pose = torch.from_numpy(file[f"{number}.pose"])
    camera = Camera(width, height, fx, fy, cx, cy, pose[:, :3].contiguous(), pose[:, 3].contiguous())
    return View(str(file[f"{number}.name"]), camera, torch.from_numpy(codes), invalid, saturated)


def enlarged(scene: Scene, width: int, height: int, views: int) -> Scene:
    """Return the first training views at another size, by linear interpolation. It serves only for timing."""
    chosen = scene.train_views[:views]
    return Scene(
        **{**scene.__dict__, "views": tuple(_enlarged(v, width, height) for v in chosen), "test_names": ()}
    )


def _enlarged(view: View, width: int, height: int) -> View:
    def sized(pictures: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.interpolate(pictures, (height, width), mode="bilinear")

    camera = view.camera
    across, down = width / camera.width, height / camera.height
    larger = Camera(
        width,
        height,
        camera.fx * across,
        camera.fy * down,
        camera.cx * across,
        camera.cy * down,
        camera.rotation,
        camera.translation,
    )
    codes = sized(view.codes.float().movedim(-1, 1)).round().movedim(1, -1).to(torch.uint16).contiguous()
    saturated = sized(view.saturated.float()[None, None])[0, 0] > 0
    return View(view.name, larger, codes, torch.zeros_like(saturated), saturated)
