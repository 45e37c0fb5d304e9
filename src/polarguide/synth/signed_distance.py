"""Signed distances to the primitives of a solid."""

from __future__ import annotations

from typing import Any

import numpy as np

from polarguide.synth.mesh import Array, rotation


def primitive_distance(points: Array, part: dict[str, Any]) -> Array:
    """Signed distance from points [..., 3] to one primitive (for an ellipsoid to first order), [...]."""
    kind = part["kind"]
    if "from" in part:
        start, end = np.array(part["from"], float), np.array(part["to"], float)
        axis = end - start
        along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
        if kind == "capsule":
            radius = part["radius"] + (part.get("end", part["radius"]) - part["radius"]) * along
            return np.asarray(np.linalg.norm(points - start - along[..., None] * axis, axis=-1) - radius)
        if kind == "cylinder":
            length, round_ = float(np.linalg.norm(axis)), part.get("round", 0.0)
            height = (points - start) @ axis / length
            across = np.linalg.norm(points - start - (height / length)[..., None] * axis, axis=-1)
            sides = np.stack((across - part["radius"], np.abs(height - length / 2) - length / 2), -1) + round_
            return _outside(sides) - round_
    local = points - np.array(part["at"], float)
    if "rotation" in part:
        local = local @ rotation(tuple(part["rotation"]))
    if kind == "ellipsoid":
        size = np.array(part["size"], float)
        near, slope = np.linalg.norm(local / size, axis=-1), np.linalg.norm(local / size**2, axis=-1)
        return np.asarray(near * (near - 1) / np.maximum(slope, 1e-9))
    if kind == "box":
        round_ = part.get("round", 0.0)
        return _outside(np.abs(local) - np.array(part["size"], float) + round_) - round_
    if kind == "ring":
        across = np.linalg.norm(local[..., :2], axis=-1) - part["radius"]
        return np.asarray(np.hypot(across, local[..., 2]) - part["thick"])
    raise ValueError(f"no part of a solid is a {kind!r}")


def _outside(sides: Array) -> Array:
    """Signed distance to a box, given the signed distances to its pairs of sides."""
    return np.asarray(np.linalg.norm(np.maximum(sides, 0), axis=-1) + np.minimum(sides.max(-1), 0))
