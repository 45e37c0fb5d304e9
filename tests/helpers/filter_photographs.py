"""A hand-held capture through a polarizing filter: JPEGs of a painted plane by known cameras."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from polarguide.geometry.camera import Camera, look_at, quaternion
from polarguide_synth.sensor import FilterShot, Sensor, behind_filter, filter_jpeg

WIDTH, HEIGHT, FOCAL = 96, 72, 110.0
ORIENTATIONS = (1, 6, 8, 3)


@dataclass
class Photographed:
    """What was photographed: by view the camera, the shot and the Stokes vectors [3, H, W, 3]."""

    folder: Path
    model: Path
    cameras: dict[str, Camera] = field(default_factory=dict)
    shots: dict[str, FilterShot] = field(default_factory=dict)
    stokes: dict[str, np.ndarray] = field(default_factory=dict)

    def light(self, view: str) -> np.ndarray:
        """What passes the filter of a view, before exposure, upright."""
        return behind_filter(self.stokes[view], rays_of(self.cameras[view]), self.shots[view].angle)


def rays_of(camera: Camera) -> np.ndarray:
    return camera.rays(dtype=torch.float64).numpy()


def painted_plane(camera: Camera) -> np.ndarray:
    """Stokes vectors of the plane z = 0: a matte texture, which polarizes light in stripes and nowhere else."""
    rays = camera.world_rays(dtype=torch.float64).numpy()
    center = camera.center.numpy()
    place = center + rays * (-center[2] / rays[..., 2])[..., None]
    x, y = place[..., 0], place[..., 1]
    texture = 0.45 + 0.2 * np.sin(3.1 * x + 1.0) * np.cos(2.3 * y) + 0.15 * np.sin(5.3 * y - 2.1 * x)
    s0 = 0.8 * texture[..., None] * np.array([1.0, 0.85, 0.7])
    dolp, aolp = 0.4 * np.clip(np.sin(6.0 * x), 0.0, 1.0), 1.5 * y
    return np.stack(
        [s0, s0 * (dolp * np.cos(2 * aolp))[..., None], s0 * (dolp * np.sin(2 * aolp))[..., None]]
    )


def photograph_plane(root: Path, *, views: int = 8, noted: bool = True, seed: int = 0) -> Photographed:
    """Write ``shots/v0_a30.jpg``, ... and a COLMAP model with tracks to ``sparse/0``."""
    rng = np.random.default_rng(seed)
    found = Photographed(root / "shots", root / "model")
    found.folder.mkdir(parents=True)
    for number in range(views):
        turn = 2 * np.pi * number / views
        eye = np.array([2.0 * np.cos(turn), 2.0 * np.sin(turn), 3.0])
        pose = look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *pose)
        shot = FilterShot(
            angle=15.0 * int(rng.integers(12)),
            stops=float(rng.uniform(-0.3, 0.3)),
            orientation=ORIENTATIONS[number % len(ORIENTATIONS)],
            noted=noted,
        )
        name = f"v{number}"
        found.cameras[name], found.shots[name] = camera, shot
        found.stokes[name] = painted_plane(camera)
        data = filter_jpeg(found.stokes[name], rays_of(camera), shot, 1.0, rng, Sensor())
        (found.folder / f"{name}_a{shot.body_angle}.jpg").write_bytes(data)
    _write_model(found.model, found.cameras, rng)
    return found


def _write_model(folder: Path, cameras: dict[str, Camera], rng: np.random.Generator) -> None:
    """Points of the plane, each observed by all views that have it in the picture."""
    folder.mkdir()
    points = np.column_stack([rng.uniform(-0.9, 0.9, (150, 2)), np.zeros(150)])
    tracks: list[list[str]] = [[] for _ in points]
    images = []
    for number, (name, camera) in enumerate(cameras.items(), 1):
        local = points @ camera.rotation.numpy().T + camera.translation.numpy()
        x, y = (FOCAL * local[:, k] / local[:, 2] + side / 2 for k, side in ((0, WIDTH), (1, HEIGHT)))
        inside = np.flatnonzero((x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT))
        for place, point in enumerate(inside):
            tracks[point].append(f"{number} {place}")
        pose = " ".join(f"{v:.12g}" for v in (*quaternion(camera.rotation), *camera.translation.tolist()))
        seen = " ".join(f"{x[p]:.6g} {y[p]:.6g} {p + 1}" for p in inside)
        images.append(f"{number} {pose} 1 {name}.jpg\n{seen}\n")
    inner = f"{FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}"
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {inner}\n")
    (folder / "images.txt").write_text("".join(images))
    lines = [
        f"{k} {p[0]:.9g} {p[1]:.9g} {p[2]:.9g} 9 9 9 0.5 {' '.join(t)}\n"
        for k, (p, t) in enumerate(zip(points, tracks, strict=True), 1)
    ]
    (folder / "points3D.txt").write_text("".join(lines))
