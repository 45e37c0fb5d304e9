"""Place cameras, and simulate the COLMAP model that structure from motion would give, including its errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.core.files import make_folder, write_text
from polarguide.geometry.camera import Camera, look_at, quaternion
from polarguide_synth.build import BuiltScene
from polarguide_synth.ground_truth import intersect
from polarguide_synth.mesh import Array
from polarguide_synth.schema import CameraPath


def place_cameras(path: CameraPath, width: int, height: int, seed: int) -> list[Camera]:
    """Create the cameras of a path. They are sorted by ring, and within a ring by their angle about z.

    Radius, height and angle are changed randomly by a few percent, so that the views do not lie on exact circles.

    Args:
        path: data of the rings.
        width: width of the pictures in pixels.
        height: height of the pictures in pixels.
        seed: seed of the random changes.
    """
    random = np.random.default_rng((seed, 11))
    shares = np.array([float(ring.get("share", 1.0)) for ring in path.rings])
    ends = np.round(np.cumsum(shares) / shares.sum() * path.views).astype(int)
    counts = np.diff(np.concatenate([[0], ends]))
    focal = float(width / 2 / np.tan(np.radians(path.fov) / 2))
    inner = (width, height, focal, focal, width / 2, height / 2)
    cameras = []
    for ring, count in zip(path.rings, counts, strict=True):
        start = float(ring.get("from", 0.0))
        stop = float(ring.get("to", 360.0))
        circle = abs(stop - start) >= 360
        step = (stop - start) / max(1, count if circle else count - 1)
        if path.spacing is not None:
            step = float(path.spacing)
            start = (start + stop) / 2 - step * (count - 1) / 2
        for k in range(count):
            angle = np.radians(start + step * (k + random.uniform(-0.15, 0.15)))
            radius = float(ring["radius"]) * (1 + random.uniform(-0.03, 0.03))
            z = float(ring["height"]) * (1 + random.uniform(-0.04, 0.04))
            target = np.array(path.target, float) + path.wander * random.uniform(-1, 1, 3) * [1, 1, 0.4]
            offset = [radius * np.cos(angle), radius * np.sin(angle), z]
            eye = np.array(path.target, float) * [1, 1, 0] + offset
            cameras.append(Camera(*inner, *look_at(eye, target, (0.0, 0.0, 1.0))))
    return cameras


NOISE_PIXELS = 0.6
"""Standard deviation of the positions at which points are observed, in pixels."""
OUTLIERS = 0.01
"""Share of points that are placed at a wrong distance."""
VIRTUAL = 0.02
"""Share of points that are mirror images of reflected points."""
SMOOTH = 0.1
"""Roughness below which structure from motion can match points in reflections."""
MATCHED_SHARE = 0.6
"""Probability that a point is observed by a view that sees it."""


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points of a simulated COLMAP model, with their observations.

    Attributes:
        points: [M, 3] positions.
        colors: [M, 3] display-encoded colors.
        tracks: observations of each point, as triples of the view and the position x, y in pixels.
    """

    points: Array
    colors: NDArray[np.uint8]
    tracks: list[list[tuple[int, float, float]]]


def sample_sparse_points(
    built: BuiltScene, cameras: Sequence[Camera], pictures: Sequence[NDArray[np.uint8]], count: int, seed: int
) -> SparsePoints:
    """Sample points as structure from motion finds them: with noise, outliers, and mirror images of reflections.

    Args:
        built: the scene.
        cameras: cameras of the views.
        pictures: photographs of the views, display-encoded [H, W, 3].
        count: approximate number of points.
        seed: seed of the random numbers.
    """
    random = np.random.default_rng((seed, 23))
    samples = []
    amount = -(-count * 13 // 10 // len(cameras))
    for number, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        gray = picture.mean(-1)
        contrast = np.hypot(*np.gradient(gray)) + 2
        chosen = random.choice(gray.size, amount, p=(contrast / contrast.sum()).ravel())
        centers = np.broadcast_to(camera.center.numpy(), (amount, 3))
        rays = camera.world_rays().numpy().astype(np.float64).reshape(-1, 3)
        samples.append((centers, rays[chosen], picture.reshape(-1, 3)[chosen], np.full(amount, number)))
    origin, ray, color, view = (np.concatenate(column) for column in zip(*samples, strict=True))
    hits = intersect(built, origin, ray)
    places = origin + hits.distance[:, None] * ray
    visible = _visible(built, cameras, places) & (random.random((len(places), len(cameras))) < MATCHED_SHARE)
    ghost, places = _mirrored(built, origin, ray, places, hits.normal, hits.thing, random)
    # A reflection is consistent only between neighboring views.
    distance = np.abs(np.arange(len(cameras)) - view[:, None])
    visible = np.where(ghost[:, None], distance <= 1, visible) | (distance == 0)
    keep = np.flatnonzero(built.visible[hits.thing] & (visible.sum(1) >= 2))
    keep = np.sort(random.permutation(keep)[:count])
    tracks = [_track(places[k], np.flatnonzero(visible[k]), cameras, random) for k in keep]
    reach = np.linalg.norm(places - origin, axis=1)[keep]
    size = NOISE_PIXELS * reach / cameras[0].fx
    moved = places[keep] + size[:, None] * random.normal(size=(len(keep), 3))
    moved += (2 * size * random.normal(size=len(keep)))[:, None] * ray[keep]
    wrong = random.random(len(keep)) < OUTLIERS
    stretch = random.uniform(0.5, 1.8, len(keep))[:, None]
    moved = np.where(wrong[:, None], origin[keep] + stretch * (moved - origin[keep]), moved)
    return SparsePoints(moved, color[keep], tracks)


def _visible(built: BuiltScene, cameras: Sequence[Camera], places: Array) -> NDArray[np.bool_]:
    """Return a mask [M, V] that is True if a point is visible to a camera, for points [M, 3]."""
    visible = np.zeros((len(places), len(cameras)), bool)
    for number, camera in enumerate(cameras):
        x, y, z = _project(camera, places).T
        inside = np.flatnonzero(
            (z > 1e-3) & (x > 1) & (y > 1) & (x < camera.width - 1) & (y < camera.height - 1)
        )
        if len(inside) == 0:
            continue
        way = places[inside] - camera.center.numpy()
        length = np.linalg.norm(way, axis=1)
        hits = intersect(built, np.broadcast_to(camera.center.numpy(), way.shape), way / length[:, None])
        visible[inside, number] = np.abs(hits.distance - length) < 2e-3 * length
    return visible


def _mirrored(
    built: BuiltScene,
    origin: Array,
    ray: Array,
    places: Array,
    normal: Array,
    thing: NDArray[np.uint8],
    random: np.random.Generator,
) -> tuple[NDArray[np.bool_], Array]:
    """Replace some points on smooth surfaces by the mirror images of reflected points.

    Args:
        built: the scene.
        origin: camera center of each point, [M, 3].
        ray: direction from the camera to each point, [M, 3].
        places: the points [M, 3].
        normal: surface normals [M, 3].
        thing: numbers of the objects [M].
        random: generator of random numbers.

    Returns:
        A mask [M] of the replaced points; and all points [M, 3].
    """
    sharp = np.array([False] + [item.material.roughness < SMOOTH for item in built.spec.things])
    chosen = np.flatnonzero(
        sharp[thing] & (random.random(len(thing)) < VIRTUAL / max(sharp[thing].mean(), VIRTUAL))
    )
    ghost = np.zeros(len(places), bool)
    if len(chosen) == 0:
        return ghost, places
    d = ray[chosen]
    n = normal[chosen]
    hits = intersect(built, places[chosen] + 1e-4 * n, d - 2 * (d * n).sum(-1, keepdims=True) * n)
    hit = hits.distance > 0
    ghost[chosen[hit]] = True
    places = places.copy()
    places[chosen[hit]] += hits.distance[hit][:, None] * d[hit]
    return ghost, places


def _track(
    place: Array, views: NDArray[np.int64], cameras: Sequence[Camera], random: np.random.Generator
) -> list[tuple[int, float, float]]:
    """Simulate noisy observations of a point [3].

    Returns:
        Triples (view, x, y), one for each view in front of which the point lies.
    """
    track = []
    for view in views:
        x, y, z = _project(cameras[view], place[None])[0]
        dx, dy = random.normal(0, NOISE_PIXELS, 2)
        if z > 0:
            track.append((int(view), float(x + dx), float(y + dy)))
    return track


def _project(camera: Camera, places: Array) -> Array:
    """Project points [M, 3] to x and y in pixels, and the depth z, [M, 3]."""
    x, y, depth = (places @ camera.rotation.numpy().T + camera.translation.numpy()).T
    z = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return np.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, depth), -1)


def write_model(folder: Path, cameras: Sequence[Camera], names: Sequence[str], sparse: SparsePoints) -> None:
    """Write a COLMAP model as text files.

    Args:
        folder: folder to write.
        cameras: cameras of the views.
        names: names of the views.
        sparse: points with their observations.

    Raises:
        PolarguideError: a file cannot be written.
    """
    make_folder(folder)
    first = cameras[0]
    inner = " ".join(f"{float(v)!r}" for v in (first.fx, first.fy, first.cx, first.cy))
    write_text(folder / "cameras.txt", f"# one camera\n1 PINHOLE {first.width} {first.height} {inner}\n")
    observations: list[list[str]] = [[] for _ in names]
    rows = []
    for number, (place, color, track) in enumerate(
        zip(sparse.points, sparse.colors, sparse.tracks, strict=True), 1
    ):
        errors = [np.hypot(*(_project(cameras[k], place[None])[0, :2] - (x, y))) for k, x, y in track]
        numbers = [*(f"{v:.6f}" for v in place), *(str(int(c)) for c in color), f"{np.mean(errors):.4f}"]
        for view, x, y in track:
            numbers.append(f"{view + 1} {len(observations[view])}")
            observations[view].append(f"{x:.3f} {y:.3f} {number}")
        rows.append(f"{number} {' '.join(numbers)}\n")
    write_text(folder / "points3D.txt", "# points\n" + "".join(rows))
    lines = ["# two lines an image\n"]
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        pose = " ".join(f"{v:.15g}" for v in (*quaternion(camera.rotation), *camera.translation.tolist()))
        lines.append(f"{number + 1} {pose} 1 {name}.png\n{' '.join(observations[number])}\n")
    write_text(folder / "images.txt", "".join(lines))
