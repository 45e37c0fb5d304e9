"""A contact sheet of a rendered scene: a few views with the layers of their ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from polarguide import optics
from polarguide.camera import Camera
from polarguide.synth.folder import display_encoded, write_file
from polarguide.synth.mesh import Array

COLUMNS = ("photograph", "DoLP", "AoLP", "specular", "diffuse", "normals", "depth")
ROWS = 3
QUALITY = 82


def write_sheet(out: Path, names: Sequence[str], cameras: Sequence[Camera]) -> Path:
    """Write ``sheet.jpg`` with up to three of these views; all must have ground truth."""
    chosen = sorted({round(k) for k in np.linspace(0, len(names) - 1, min(ROWS, len(names)))})
    rows = [np.concatenate(_layers(out / "gt" / f"{names[k]}.npz", cameras[k]), axis=1) for k in chosen]
    sheet = np.ascontiguousarray(np.concatenate(rows)[..., ::-1])
    width = sheet.shape[1] // len(COLUMNS)
    for number, label in enumerate(COLUMNS):
        place, size = (number * width + 6, 15), width / 420
        for color, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(sheet, label, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, thick, cv2.LINE_AA)
    _, data = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    write_file(out / "sheet.jpg", data.tobytes())
    return out / "sheet.jpg"


def _layers(path: Path, camera: Camera) -> list[NDArray[np.uint8]]:
    """The pictures of one view, [H, W, 3] each, in the order of ``COLUMNS``."""
    with np.load(path) as ground_truth:
        stokes, specular, diffuse = (
            ground_truth[name].astype(np.float64) for name in ("stokes", "specular", "diffuse")
        )
        normal, depth, known = (
            ground_truth["normal"].astype(np.float64),
            ground_truth["depth"].astype(np.float64),
            ground_truth["objid"] > 0,
        )
    mean = optics.luminance(torch.from_numpy(stokes))
    degree, angle = optics.dolp(mean).numpy(), optics.aolp(mean).numpy()
    facing = camera.to_camera(torch.from_numpy(normal)).numpy() * [1, -1, -1]
    near, far = np.percentile(depth[known], (1, 99)) if known.any() else (0.0, 1.0)
    return [
        display_encoded(stokes[0] / 2),
        _gray(np.sqrt(degree)),
        _hue(angle / np.pi, np.clip(degree * 4, 0, 1)),
        display_encoded(specular / 2),
        display_encoded(diffuse / 2),
        np.where(known[..., None], np.round(127.5 * (facing + 1)), 0).astype(np.uint8),
        _gray(np.where(known, 1 - 0.9 * np.clip((depth - near) / max(far - near, 1e-9), 0, 1), 0)),
    ]


def _gray(values: Array) -> NDArray[np.uint8]:
    return np.repeat(np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)[..., None], 3, axis=-1)


def _hue(turn: Array, strength: Array) -> NDArray[np.uint8]:
    """Angles in half turns as hues, dark where ``strength`` is small."""
    codes = np.stack((turn * 180 % 180, np.full_like(turn, 255), 255 * strength), -1).astype(np.uint8)
    return np.asarray(cv2.cvtColor(codes, cv2.COLOR_HSV2RGB), np.uint8)
