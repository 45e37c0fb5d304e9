"""Rendering of a run along a camera path, as a video (MP4, H.264) or as PNG files."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.capture.layout import refuse_scene, require_memory
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import atomic, make_folder, require_inside
from polarguide.core.options import PathLike, check_finite
from polarguide.core.progress import SILENT, Reporter
from polarguide.geometry.camera import Camera
from polarguide.geometry.trajectory import interpolated, orbit, read_path
from polarguide.results.rendering.pictures import rendered_depths
from polarguide.results.rendering.subject import part_shown, subject_of
from polarguide.runs.opened import OpenedRun, checked_layers
from polarguide.shading.result import POLARIZED
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, layer_picture


def write_video(path: Path, pictures: Iterable[Picture], *, frames_per_second: float) -> int:
    """Write uint8 RGB pictures [H, W, 3] of one size as a video.

    H.264 needs an even width and height. So the last column of an odd width and the last row of an odd height are cut
    off.

    Returns:
        The number of written pictures.

    Raises:
        PolarguideError: imageio-ffmpeg is not installed, or the encoder fails.
    """
    encoder = optional_import("imageio_ffmpeg", "--video")
    count = 0
    # The encoder chooses the format by the name's suffix.
    with atomic(path) as temporary:
        named = temporary.with_name(temporary.name + ".mp4")
        writer = None
        try:
            for picture in pictures:
                height, width = (side - side % 2 for side in picture.shape[:2])
                if writer is None:
                    writer = encoder.write_frames(
                        str(named),
                        (width, height),
                        fps=frames_per_second,
                        codec="libx264",
                        macro_block_size=2,
                        output_params=["-crf", "18", "-movflags", "+faststart"],
                    )
                    writer.send(None)
                writer.send(np.ascontiguousarray(picture[:height, :width]))
                count += 1
            if writer is not None:
                writer.close()
                _require_complete(encoder, named, count)
            named.replace(temporary)
        except (OSError, RuntimeError) as error:
            raise PolarguideError(
                path,
                expected="a video file",
                found=(str(error).strip() or "a failure").splitlines()[-1][:200],
                remedy="Free space on the disk, choose another folder, or reduce the layers.",
            ) from None
        finally:
            if writer is not None:
                with contextlib.suppress(OSError, RuntimeError):
                    writer.close()  # Otherwise the encoder would continue to write the unlinked file.
            named.unlink(missing_ok=True)
    return count


def _require_complete(encoder: Any, path: Path, count: int) -> None:
    """Check the number of frames of a written video, because the encoder does not report a full disk.

    Raises:
        OSError: the file has fewer frames than were written.
    """
    try:
        frames, _ = encoder.count_frames_and_secs(path)
    except RuntimeError:  # the file cannot be read
        frames = 0
    if frames != count:
        raise OSError(f"a file with {frames} of {count} pictures; the disk may be full")


SWINGS = {"orbit": 0.0, "spiral": 0.25}
"""Vertical amplitude of each path around the scene, as a share of the cameras' distance from its center."""
FILLED = 0.9
"""Share of the subject's Gaussians that every picture of a turntable contains. The outermost ones may be cut off."""
FRAMES_PER_SECOND = 30.0
RENDERED = 160
"""Lower bound of the memory of a rendering, in bytes per pixel."""


def path_cameras(
    run: OpenedRun, path: str, frames: int, size: tuple[int, int] | None = None
) -> tuple[list[Camera], float]:
    """Return the cameras of a path, and their frames per second.

    Args:
        run: the run whose cameras define the path.
        path: ``orbit``, ``turntable`` (around the subject, which fills the picture), ``spiral``,
            ``interpolate``, or a JSON file of cameras.
        frames: number of cameras; ignored for a file of cameras.
        size: width and height of the pictures. None takes the size of the photographs. A file of cameras has its own
            size.

    Raises:
        PolarguideError: there are too many frames, a size is specified together with a file, or the file cannot be
            read.
    """
    check_finite("frames", frames, 1, 100_000)
    cameras = list(run.cameras.values())
    if size is not None:
        cameras = [camera.extended(*size) for camera in cameras]
    if path == "turntable":
        return _turntable(run, cameras, frames), FRAMES_PER_SECOND
    if path == "interpolate":
        return interpolated(cameras, frames), FRAMES_PER_SECOND
    if path in SWINGS:
        return orbit(cameras, frames, swing=SWINGS[path], around=run.frame), FRAMES_PER_SECOND
    if size is not None:
        raise PolarguideError(
            "size",
            expected="a path without its own picture sizes",
            found=f"the file {path}",
            remedy="Set the width and height of its cameras.",
        )
    return read_path(Path(path))


def _turntable(run: OpenedRun, cameras: list[Camera], frames: int) -> list[Camera]:
    means = run.model.state.gaussians["means"].detach()
    inner = means[subject_of(run).holds(means)].cpu().double()
    center = inner.median(dim=0).values
    radius = float((inner - center).norm(dim=1).quantile(FILLED))
    lens = cameras[0]
    return orbit(
        cameras,
        frames,
        around=replace(run.frame, center=center),
        distance=radius / math.sin(math.atan(min(lens.width / lens.fx, lens.height / lens.fy) / 2)),
    )


def write_film(
    run: OpenedRun,
    out: PathLike,
    *,
    path: str = "orbit",
    layers: Sequence[str] = ("final",),
    frames: int = 120,
    size: tuple[int, int] | None = None,
    reporter: Reporter = SILENT,
) -> None:
    """Render layers of the subject side by side along a path. A video of several layers shows their names.

    Args:
        run: the run; its scene is read.
        out: MP4 file to write, or a folder for PNG files.
        path, frames: see ``path_cameras``.
        size: width and height of the film with all layers; None shows each layer in the size of the photographs.
        layers: names of layers.
        reporter: receives the progress.

    Raises:
        PolarguideError: a layer does not exist, the cameras have several sizes, or the video cannot be encoded.
    """
    out = Path(out)
    names = checked_layers(list(layers))
    refuse_scene(out if out.suffix.lower() != ".mp4" else out.parent)
    if out.parent == run.folder:  # The run may come from another user.
        require_inside(run.folder, out)
    tile = None if size is None else (size[0] // len(names), size[1])
    cameras, speed = path_cameras(run, path, frames, tile)
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        raise PolarguideError(
            "path",
            expected="cameras of one size",
            found=", ".join(f"{width}x{height}" for width, height in sizes[:4]),
            remedy="Set the same width and height for all cameras.",
        )
    width, height = sizes[0]
    require_memory(
        Path(path),
        RENDERED * width * height,
        f"pictures of {width}x{height}",
        remedy="Reduce the width and height of the cameras of the path.",
    )
    pictures = _pictures(run, names, cameras, reporter, named=out.suffix.lower() == ".mp4" and len(names) > 1)
    if size is not None:  # The remainder of the width is black.
        rest = size[0] % len(names)
        pictures = (np.pad(picture, ((0, 0), (0, rest), (0, 0))) for picture in pictures)
    if out.suffix.lower() == ".mp4":
        make_folder(out.parent)
        count = write_video(out, pictures, frames_per_second=speed)
        reporter.say(f"video: {out} ({count} pictures, {count / speed:.1f} s)")
        return
    make_folder(out)
    about = {"Polarization": run.polarization}
    for number, picture in enumerate(pictures):
        figures.write_png(out / f"path_{number:05d}.png", picture, about=about)
    reporter.say(f"pictures: {out}/path_*.png")


def _pictures(
    run: OpenedRun, layers: list[str], cameras: list[Camera], reporter: Reporter, *, named: bool
) -> Iterator[Picture]:
    """Yield one picture per camera, which shows the layers side by side; ``named`` adds their names."""
    within = part_shown(run, reporter)
    depths = rendered_depths(run, cameras, within) if "depth" in layers else None
    color = run.presentation.color
    surface = bool({"normal", "depth"} & {*layers})
    polarized = not {*layers}.isdisjoint(POLARIZED)
    with reporter.track("rendering", len(cameras)) as advance:
        for number, camera in enumerate(cameras):
            result = run.result(
                camera, depth="depth" in layers, surface=surface, polarized=polarized, within=within
            )
            run.chosen_layers(result, layers)
            tiles = []
            for name in layers:
                picture = layer_picture(result, name, camera, depths, color=color)
                assert picture is not None
                tiles.append(figures.with_name(picture, name) if named else picture)
            advance(number + 1)
            yield np.concatenate(tiles, axis=1)
