"""Measure the differences between the poses of two scenes with the same views.

The two models are aligned by the similarity of the camera centers with the least squared error (Umeyama 1991).
Positions are relative to the diagonal of the reference's camera path, so they need no unit.

    python benchmarks/accuracy/pose_error.py SCENE REFERENCE
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.model import ColmapModel, read_model

Array = NDArray[np.float64]


def similarity(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Return the scale, rotation and translation that best map points [N, 3] to others."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, spread, vt = np.linalg.svd(b.T @ a / len(a))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ mirror @ vt
    scale = float((spread * np.diag(mirror)).sum() / a.var(0).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Differences of the poses of common views, in the order of their names.

    Attributes:
        names: common views.
        views: number of views of the reference.
        positions: distances of the camera centers, relative to the diagonal of the camera path.
        rotations: angles between the cameras in degrees.
        focal_lengths: relative differences of the focal lengths.
    """

    names: list[str]
    views: int
    positions: Array
    rotations: Array
    focal_lengths: Array


def compare_poses(found: ColmapModel, true: ColmapModel) -> PoseErrors:
    """Align a model to a reference, and return the differences of their poses."""
    names = sorted(set(found.names) & set(true.names))
    pairs = [(found.camera(name), true.camera(name)) for name in names]
    ours, theirs = (np.stack([c.center.numpy() for c in side]) for side in zip(*pairs, strict=True))
    scale, rotation, offset = similarity(ours, theirs)
    distance = np.linalg.norm(ours @ (scale * rotation).T + offset - theirs, axis=1)
    path = float(np.linalg.norm(theirs.max(0) - theirs.min(0)))
    turns = []
    for a, b in pairs:
        between = a.rotation.numpy() @ rotation.T @ b.rotation.numpy().T
        turns.append(np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))))
    focal = np.array([a.fx / a.width / (b.fx / b.width) - 1 for a, b in pairs])
    return PoseErrors(names, len(true.names), distance / path, np.array(turns), focal)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("reference", type=Path)
    options = parser.parse_args()
    errors = compare_poses(read_model(options.scene), read_model(options.reference))
    print(f"{len(errors.names)} of {errors.views} views of the reference")
    for label, values, unit in (
        ("position / camera path", 100 * errors.positions, "%"),
        ("rotation", errors.rotations, "degrees"),
        ("focal length", 100 * errors.focal_lengths, "%"),
    ):
        worst = int(np.abs(values).argmax())
        print(
            f"{label}: median {np.median(values):+.3f}, mean {values.mean():+.3f}, "
            f"worst {values[worst]:+.3f} {unit} ({errors.names[worst]})"
        )


if __name__ == "__main__":
    main()
