"""Shots of a textured relief by known cameras on an arc: something that features can be found on."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from camera_files import behind, write_shots

from polarguide.capture.colmap.model import PosedCamera

DEPTHS = (0.0, 0.25)
"""World z of ground and step is minus these."""


def write_relief(folder: Path) -> dict[str, PosedCamera]:
    """Write filter shots v0, v1, ... of 320x240 and return their cameras."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 1, (600, 600)).astype(np.float32), (0, 0), 1.5)
    texture = np.clip((texture - texture.mean()) * 4 + 0.5, 0.05, 1.0)
    inner = np.array([[260.0, 0, 160], [0, 260, 120], [0, 0, 1]])  # pixels of OpenCV
    cameras = {}
    for index, angle in enumerate(np.radians([-30, -18, -6, 6, 18, 30])):
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        layers = []
        for depth, part in zip(DEPTHS, (np.s_[:, :], np.s_[150:450, 150:450]), strict=True):
            offset = turn @ [-0.5, -0.5, -depth] + [0, 0, 1.3]
            plane = inner @ np.column_stack([turn[:, 0] / 600, turn[:, 1] / 600, offset])
            mask = np.zeros_like(texture)
            mask[part] = 1
            layer = texture if depth == 0 else texture[::-1].copy()
            layers.append([cv2.warpPerspective(image, plane, (320, 240)) for image in (layer, mask)])
        s0 = np.where(layers[1][1] > 0.5, layers[1][0], layers[0][0])[..., None] * np.ones(3)
        write_shots(folder, f"v{index}", behind(np.stack([s0, 0.1 * s0, 0.05 * s0])))
        parameters = (260.0, 260.0, 160.5, 120.5)  # COLMAP counts from the corner
        cameras[f"v{index}"] = PosedCamera(
            320, 240, "PINHOLE", parameters, turn, np.array([0, 0, 1.3])
        )  # fmt: skip
    return cameras
