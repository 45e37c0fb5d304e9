"""``polarguide render --path``: a run seen along a path of cameras, as a video or as pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from rich.progress import track

from polarguide.camera import Camera
from polarguide.cli.common import OpenRun, console
from polarguide.errors import PolarguideError
from polarguide.rendering.video import write_video
from polarguide.trajectory import interpolated, orbit, read_path, spiral
from polarguide.visualization import figures
from polarguide.visualization.layers import Picture, layer_picture

PATHS = {"orbit": orbit, "spiral": spiral, "interpolate": interpolated}
FRAMES_PER_SECOND = 30.0


def path_cameras(opened: OpenRun, path: str, frames: int) -> tuple[list[Camera], float]:
    """Cameras of ``--path``, and their frames a second."""
    if not 1 <= frames <= 100_000:
        raise PolarguideError(
            "--frames", expected="1 to 100000", found=str(frames), remedy="Choose such a number."
        )
    if path in PATHS:
        return PATHS[path](list(opened.cameras.values()), frames), FRAMES_PER_SECOND
    return read_path(Path(path))


def film(
    opened: OpenRun,
    layers: list[str],
    *,
    path: str,
    frames: int,
    video: Path | None,
    out: Path,
) -> None:
    """Render layers side by side along a path, into a video or else into PNG files in ``out``."""
    cameras, speed = path_cameras(opened, path, frames)
    pictures = _pictures(opened, layers, cameras)
    if video is not None:
        if video.suffix.lower() != ".mp4":
            raise PolarguideError(
                "--video", expected="a name that ends in .mp4", found=str(video), remedy="Choose such a name."
            )
        video.parent.mkdir(parents=True, exist_ok=True)
        count = write_video(video, pictures, frames_per_second=speed)
        console.print(f"video: {video} ({count} pictures, {count / speed:.1f} s)", markup=False)
        return
    out.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        figures.write_png(out / f"path_{number:05d}.png", picture)
    console.print(f"pictures: {out}/path_*.png", markup=False)


def _pictures(opened: OpenRun, layers: list[str], cameras: list[Camera]) -> Iterator[Picture]:
    depths = _depths(opened, cameras) if "depth" in layers else None
    shape: tuple[int, ...] | None = None
    for camera in track(cameras, description="rendering", console=console, transient=True):
        result = opened.render_camera(camera, depth="depth" in layers)
        found = {name: layer_picture(result, name, camera, depths) for name in layers}
        absent = [name for name, picture in found.items() if picture is None]
        if absent:
            raise PolarguideError(
                "--layers",
                expected="layers of this recipe",
                found=f"{', '.join(absent)}, which it has not",
                remedy="Leave them out.",
            )
        picture = np.concatenate([p for p in found.values() if p is not None], axis=1)
        if shape is not None and picture.shape != shape:
            raise PolarguideError(
                "--path",
                expected="cameras of one size",
                found="several",
                remedy="Give all the same width and height.",
            )
        shape = picture.shape
        yield picture


def _depths(opened: OpenRun, cameras: list[Camera]) -> tuple[float, float]:
    """One range of depths for the whole path, so that its colors do not flicker: that of a few of its cameras."""
    values = []
    for camera in cameras[:: max(1, len(cameras) // 4)]:
        result = opened.render_camera(camera, depth=True)
        assert result.depth is not None
        values.append(result.depth[result.alpha > 0.5])
    joined = torch.cat(values)[:1_000_000]
    if not joined.numel():
        return 0.0, 1.0
    near, far = float(joined.quantile(0.02)), float(joined.quantile(0.95))
    return near, max(far, near + 1e-6)
