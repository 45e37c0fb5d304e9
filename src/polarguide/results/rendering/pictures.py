"""Pictures of a run's layers next to the ground truth, and along a camera path.

A rendering along a path becomes a video (MP4, H.264) or PNG files.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.layout import refuse_scene, require_memory
from polarguide.capture.presentation import Presentation
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import atomic, make_folder, require_inside, write_whole
from polarguide.core.options import PathLike, PictureFormat, check_choice, check_finite
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import to_json
from polarguide.geometry.camera import Camera
from polarguide.geometry.camera_path import interpolated, orbit, read_path
from polarguide.optics import luminance
from polarguide.results.rendering.mesh import part_shown, subject_of
from polarguide.results.rendering.relight import write_exr
from polarguide.runs.model import Within
from polarguide.runs.opened import OpenedRun, checked_layers
from polarguide.shading.result import POLARIZED, RenderResult
from polarguide.visualization import figures
from polarguide.visualization.figures import (
    Depths,
    Picture,
    contact_sheet,
    depth_range,
    layer_picture,
    layer_scale,
    reference_pictures,
    true_depths,
    true_name,
)

SHEET_VIEWS = 8
CONTACT_SHEET = "contact_sheet.png"
UNITS_FILE = "layers.json"
_RADIANCE = "linear radiance, R G B; 1 is full scale of the photograph S0/2"
UNITS = {
    **dict.fromkeys(("final", "base", "reflection", "specular", "diffuse"), _RADIANCE),
    "strength": "share of the reflection, 0 to 1",
    "roughness": "square root of GGX's alpha, 0 to 1, as in glTF; a mirror has the roughness of a texel of the light",
    "metalness": "share of metals, 0 to 1",
    "normal": "world axes of the scene, x y z; blended, with length 0 to 1, and 0 for the background",
    "depth": "distance along the camera's axis, in the scene's units",
    "alpha": "coverage, 0 to 1",
    "stokes": "predicted; npy: [3, H, W, 3] S0, S1, S2 of R G B, exr: S0 S1 S2 of their mean as R G B; S0 is twice the "
    "photograph, lens frame of each pixel",
    "dolp": "predicted degree of linear polarization of the mean of R G B, 0 to 1",
    "aolp": "predicted angle of linear polarization, radians from 0 to pi, counter-clockwise from the picture's "
    "horizontal",
}
"""Meaning and unit of the numbers in each layer's file."""


def views_named(scene: Scene, choice: str) -> tuple[View, ...]:
    """Return the views that an option names: ``test``, ``train``, ``all``, or names separated by commas.

    Raises:
        PolarguideError: a view does not exist, or the option names no view.
    """
    groups = {"test": scene.test_views, "train": scene.train_views, "all": scene.views}
    names = [name.strip() for name in choice.split(",") if name.strip()]
    chosen = groups[choice] if choice in groups else tuple(scene.view(name) for name in names)
    if not chosen:
        raise PolarguideError(
            "views", expected="at least one view", found="none", remedy="Name a view, or choose train."
        )
    return chosen


def write_pictures(
    run: OpenedRun,
    out: PathLike | None = None,
    *,
    views: str = "test",
    layers: Sequence[str] | None = None,
    format: PictureFormat = "png",
    transparent: bool = False,
    reporter: Reporter = SILENT,
) -> Path:
    """Write one file per layer and view, and a contact sheet that compares the layers with the ground truth.

    Args:
        run: the run; its scene is read.
        out: folder to write; default: ``render`` in the run's folder.
        views: ``test``, ``train``, ``all``, or names separated by commas.
        layers: names of layers; default: all layers of the run. A layer that the recipe lacks is skipped and reported.
        format: png files show the layers in the colors of the run's presentation. exr and npy files contain linear
            numbers, whose units ``layers.json`` states. The contact sheet is always a PNG file.
        transparent: write PNG files with a transparent background. Their colors are not blended with black, which would
            leave a dark rim on a bright background. The contact sheet is opaque.
        reporter: receives the progress.

    Returns:
        The path of the contact sheet.

    Raises:
        PolarguideError: a view or a layer does not exist.
    """
    check_choice("format", format, get_args(PictureFormat))
    if transparent and format != "png":
        raise PolarguideError(
            "transparent", expected="format png", found=format, remedy="Omit one of the two options."
        )
    folder = run.folder / "render" if out is None else Path(out)
    refuse_scene(folder)
    if out is None:
        require_inside(run.folder, folder)
    names = checked_layers(list(run.layers if layers is None else layers))
    chosen = views_named(run.scene, views)
    make_folder(folder)
    rows: list[tuple[str, dict[str, Picture]]] = []
    missing: set[str] = set()
    presentation = run.presentation
    polarization = run.polarization
    about = {"Polarization": polarization}
    depths = common_depths(run, chosen) if "depth" in names else None
    polarized = not {*names}.isdisjoint(POLARIZED)
    with reporter.track("rendering", len(chosen)) as advance:
        for number, view in enumerate(chosen):
            result = run.result(view.camera, polarized=polarized).to("cpu")
            pictures = _layer_pictures(result, names, view, depths, presentation)
            missing |= {*names} - pictures.keys()
            for name, picture in pictures.items():
                path = folder / f"{view.name}_{name}.{format}"
                if format != "png":
                    _write_numbers(path, result.layers[name])
                elif transparent:
                    colors = _layer_pictures(_unblended(result), [name], view, depths, presentation)[name]
                    alpha = (result.alpha.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
                    figures.write_png(path, colors, alpha, about)
                else:
                    figures.write_png(path, picture, about=about)
            if len(rows) < SHEET_VIEWS:
                rows.append((view.name, pictures | reference_pictures(view, presentation, depths)))
            advance(number + 1)
    if format != "png":
        write_whole(
            folder / UNITS_FILE, to_json({name: UNITS[name] for name in names if name not in missing})
        )
    sheet = folder / CONTACT_SHEET
    figures.write_png(sheet, _sheet(rows, names, f"polarization: {polarization}", depths), about=about)
    if missing:
        reporter.say(f"this recipe has no layer {', '.join(sorted(missing))}")
    return sheet


def _layer_pictures(
    result: RenderResult,
    names: Sequence[str],
    view: View,
    depths: Depths | None,
    presentation: Presentation,
) -> dict[str, Picture]:
    """Return pictures of the named layers; layers that the rendering lacks are omitted."""
    pictures = {
        name: layer_picture(
            result, name, view.camera, depths, exposed=name == "reflection", presentation=presentation
        )
        for name in names
    }
    return {name: picture for name, picture in pictures.items() if picture is not None}


def common_depths(run: OpenedRun, views: Sequence[View]) -> Depths:
    """Return one depth range for some views, so that their colors are comparable.

    If all views have true depths, the range is computed from them, otherwise from rendered depths of a few views.
    """
    true = [true_depths(view) for view in views]
    known = [depth for depth in true if depth is not None]
    if len(known) == len(views):
        joined = torch.cat([depth.flatten() for depth in known])
        return depth_range(joined, joined > 0)
    return rendered_depths(run, [view.camera for view in views])


def rendered_depths(run: OpenedRun, cameras: Sequence[Camera], within: Within | None = None) -> Depths:
    """Render depth for a few of the cameras and return its range.

    Args:
        run: the run.
        cameras: the cameras.
        within: part of the scene that is rendered.
    """
    values = []
    for camera in cameras[:: max(1, len(cameras) // 4)]:
        result = run.result(camera, within=within)
        values.append(result.depth[result.alpha > 0.5].flatten().cpu())
    joined = torch.cat(values)
    return depth_range(joined, joined > 0)


def _sheet(
    views: Sequence[tuple[str, dict[str, Picture]]], names: Sequence[str], caption: str, depths: Depths | None
) -> Picture:
    """Return a contact sheet with a row for each view, and a legend below.

    A column is left out if one of the views lacks it. A layer that has the same single color in all views, such as
    metalness without any metal, is also left out, and the caption names it.
    """
    titles = [column for name in names for column in (name, true_name(name), f"{name}, measured")]
    columns = [column for column in titles if all(column in cells for _, cells in views)]
    # A difference of one level is rounding.
    uniform = [
        column
        for column in columns
        if all(np.ptp(cells[column].reshape(-1, 3), axis=0).max() <= 1 for _, cells in views)
    ]
    columns = [column for column in columns if column not in uniform] or columns
    if uniform and columns != uniform:
        caption = f"{caption}; left out as uniform: {', '.join(uniform)}"
    rows = [[cells[column] for column in columns] for _, cells in views]
    scales = [layer_scale(column, depths) for column in columns]
    return contact_sheet(rows, [name for name, _ in views], columns, footer=scales, caption=caption)


def _unblended(result: RenderResult) -> RenderResult:
    """Divide the radiance layers of a rendering by alpha."""
    alpha = result.alpha.clamp(min=1e-3)[..., None]
    names = {"final", "base", "specular", "diffuse"} & result.layers.keys()
    return result.with_layers(**{name: result.layers[name] / alpha for name in names})


def _write_numbers(path: Path, values: Tensor) -> None:
    """Write a layer [H, W] or [H, W, 3], or Stokes vectors [3, H, W, 3], as linear float32 numbers."""
    numbers = values.detach().cpu().float().contiguous()
    if path.suffix == ".exr":
        numbers = numbers if numbers.ndim < 4 else luminance(numbers).movedim(0, -1).contiguous()
        write_exr(path, numbers if numbers.ndim == 3 else numbers[..., None].expand(-1, -1, 3))
        return
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.save(file, numbers.numpy())


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
    presentation = run.presentation
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
                picture = layer_picture(result, name, camera, depths, presentation=presentation)
                assert picture is not None
                tiles.append(figures.with_name(picture, name) if named else picture)
            advance(number + 1)
            yield np.concatenate(tiles, axis=1)
