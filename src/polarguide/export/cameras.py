"""Poses as other programs read them: a COLMAP model, and ``transforms.json`` of nerfstudio."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.files import atomic_folder, write_text

# nerfstudio's cameras look along -z with y up: OpenGL's axes, not OpenCV's.
_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def write_colmap(
    folder: Path,
    cameras: Mapping[str, Camera],
    points: Tensor,
    colors: Tensor,
    suffix: str = ".png",
    *,
    comments: Sequence[str] = (),
) -> None:
    """Write a COLMAP model as text: one camera and one image a view, and points without tracks.

    Args:
        folder: made if there is none. cameras: by view. points: [M, 3]. colors: [M, 3] uint8.
        suffix: the images are called the view's name and this.
        comments: lines for the head of each file.
    """
    model = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        params = [camera.fx, camera.fy, camera.cx, camera.cy]
        inner = pycolmap.Camera(
            camera_id=number, model="PINHOLE", width=camera.width, height=camera.height, params=params
        )
        model.add_camera_with_trivial_rig(inner)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.rotation.numpy()), camera.translation.numpy())
        image = pycolmap.Image(name=name + suffix, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    for place, color in zip(points.double().numpy(), colors.numpy().astype(np.uint8), strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    with atomic_folder(folder) as temporary:
        model.write_text(str(temporary))
        head = "".join(f"# {line}\n" for line in comments).encode()
        for path in temporary.iterdir():
            path.write_bytes(head + path.read_bytes())
        _require_whole(temporary, len(cameras), len(points))


def _require_whole(folder: Path, images: int, points: int) -> None:
    """Read a model back: pycolmap does not say where the disk was full.

    Raises:
        OSError: it is not whole.
    """
    try:
        model = pycolmap.Reconstruction()
        model.read_text(str(folder))
        whole = (len(model.images), len(model.points3D)) == (images, points)
    except Exception:  # whatever C++ threw
        whole = False
    if not whole:
        raise OSError("a file that was cut short, as on a full disk")


def transforms(cameras: Mapping[str, Camera], suffix: str = ".png") -> dict[str, Any]:
    """The record of ``transforms.json``: intrinsics and camera-to-world matrices in OpenGL's axes, one frame a view."""
    frames = []
    for name, camera in cameras.items():
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = camera.rotation.T, camera.center
        frames.append(
            {
                "file_path": f"images/{name}{suffix}",
                **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
                **{"w": camera.width, "h": camera.height},
                "transform_matrix": (pose @ _OPENGL).tolist(),
            }
        )
    return {"camera_model": "OPENCV", "frames": frames}


def write_transforms(path: Path, cameras: Mapping[str, Camera], about: Mapping[str, Any] = {}) -> None:
    """Write ``transforms.json``, with more to say ``about`` it, which readers pass over."""
    write_text(path, json.dumps({**transforms(cameras), **about}, indent=1) + "\n")
