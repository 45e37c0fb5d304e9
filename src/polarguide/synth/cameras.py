"""Camera placement."""

from __future__ import annotations

import numpy as np

from polarguide.camera import Camera, look_at
from polarguide.synth.schema import CameraPath
from polarguide.synth.settings import TEST_EVERY


def place_cameras(path: CameraPath, width: int, height: int, seed: int) -> list[Camera]:
    """The cameras of a path, ring by ring, in the order of their angle about z.

    Radius, height and angle are jittered by a few percent, so that the views do not lie on exact circles.
    """
    random = np.random.default_rng((seed, 11))
    shares = np.array([float(ring.get("share", 1.0)) for ring in path.rings])
    ends = np.round(np.cumsum(shares) / shares.sum() * path.views).astype(int)
    counts = np.diff(np.concatenate([[0], ends]))
    focal = float(width / 2 / np.tan(np.radians(path.fov) / 2))
    size, center = (width, height), (width / 2, height / 2)
    cameras = []
    for ring, count in zip(path.rings, counts, strict=True):
        start, stop = float(ring.get("from", 0.0)), float(ring.get("to", 360.0))
        whole = abs(stop - start) >= 360
        step = (stop - start) / max(1, count if whole else count - 1)
        if path.spacing is not None:
            step = float(path.spacing)
            start = (start + stop) / 2 - step * (count - 1) / 2
        for k in range(count):
            angle = np.radians(start + step * (k + random.uniform(-0.15, 0.15)))
            radius = float(ring["radius"]) * (1 + random.uniform(-0.03, 0.03))
            z = float(ring["height"]) * (1 + random.uniform(-0.04, 0.04))
            target = np.array(path.target, float) + path.wander * random.uniform(-1, 1, 3) * np.array(
                [1, 1, 0.4]
            )
            eye = np.array(path.target, float) * [1, 1, 0] + [
                radius * np.cos(angle),
                radius * np.sin(angle),
                z,
            ]
            cameras.append(Camera(*size, focal, focal, *center, *look_at(eye, target, (0.0, 0.0, 1.0))))
    return cameras


def view_names(count: int) -> list[str]:
    """``v000``, ``v001``, ..."""
    digits = max(3, len(str(count - 1)))
    return [f"v{number:0{digits}d}" for number in range(count)]


def held_out_names(names: list[str], every: int = TEST_EVERY) -> list[str]:
    """One view in ``every``, starting with the first; none if there are fewer than two views."""
    return names[::every] if len(names) > 1 else []
