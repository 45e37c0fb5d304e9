"""``load_scene``: a capture folder -> Scene."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.camera import Camera
from polarguide.capture import checks
from polarguide.capture.colmap.model import ColmapModel, fit_camera, read_model, unused_poses
from polarguide.capture.formats.pictures import TRANSFERS
from polarguide.capture.layout import find_layout, select_views
from polarguide.capture.metadata import held_out, refractive_index_of
from polarguide.capture.view import Scene, listed
from polarguide.capture.view_reader import Files, ViewData, read_view
from polarguide.errors import PolarguideError
from polarguide.records import parse_json

_THREADS = 4


def load_scene(
    path: str | os.PathLike[str],
    *,
    downscale: int = 1,
    transfer: str = "linear",
    views: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Read a capture.

    Two layouts are read: ``polar/<view>_000|_045|_090|_135.<suffix>``, and one folder per angle (``I-00``,
    ``I-45``, ``I-90``, ``I-135``; also ``0``, ``045``, ``I_90``, ...) with equally named pictures. Pictures
    are PNG, TIFF or JPEG with 8 or 16 bits, undistorted. Beside them lie a COLMAP model in ``sparse/0`` or
    ``sparse`` (the image's name without suffix is the view) and, if wanted, ``masks/<view>.png``,
    ``invalid/<view>.png``, ``gt/<view>.npz``, ``split.json`` and ``scene.json``.

    Args:
        path: the capture folder.
        downscale: average over boxes of this many pixels each way, on linear values. A pixel stays foreground
            only where all of its box is; it is invalid or saturated where any of it is.
        transfer: how the files are encoded: "linear", or "srgb" for display-encoded pictures.
        views: names of the views to read; all if None. The split is that of the whole capture.
        progress: called with the number of views read and the number to read, after each view.

    Returns:
        The scene; ``Scene.warnings`` says what looks wrong without preventing its use.

    Raises:
        PolarguideError: something in the capture cannot be used; the message names the file and the remedy.
    """
    root = Path(path)
    _check_arguments(downscale, transfer)
    layout = find_layout(root)
    names = select_views(layout, views)
    model = read_model(root)
    files = Files()
    for file in model.files:
        files.read(file)
    tests = held_out(root / "split.json", _read_json(files, root / "split.json"), layout.names)
    index = refractive_index_of(root / "scene.json", _read_json(files, root / "scene.json"))
    for name in names:
        model.camera(name)  # a missing pose is to be found before the pictures are read

    def read(name: str) -> ViewData:
        return read_view(layout, name, factor=downscale, transfer=transfer)

    data: list[ViewData] = []
    cameras: list[Camera] = []
    with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
        for item in pool.map(read, names):
            data.append(item)
            cameras.append(
                fit_camera(model.camera(item.name), *item.size, folder=model.folder, view=item.name)
            )
            files.digests.update(item.digests)
            if progress is not None:
                progress(len(data), len(names))
    scale, warnings = _judge(data, transfer)
    return Scene(
        root=root,
        name=root.resolve().name,
        views=tuple(
            item.view(camera if downscale == 1 else camera.downscaled(downscale), scale)
            for item, camera in zip(data, cameras, strict=True)
        ),
        test_names=tuple(name for name in tests if name in names),
        points=model.points,
        point_colors=model.point_colors,
        refractive_index=index,
        downscale=downscale,
        transfer=transfer,
        digest=_digest_all(root, files),
        warnings=(*layout.warnings, *model.warnings, *_pose_warnings(model, layout.names, data), *warnings),
    )


def _check_arguments(downscale: int, transfer: str) -> None:
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise PolarguideError(
            "downscale",
            expected="a whole number from 1 up",
            found=repr(downscale),
            remedy="1 keeps the full size.",
        )
    if transfer not in TRANSFERS:
        raise PolarguideError(
            "transfer",
            expected="'linear' or 'srgb'",
            found=repr(transfer),
            remedy="Use srgb for display-encoded pictures, linear for all others.",
        )


def _read_json(files: Files, path: Path) -> dict[str, Any] | None:
    """The JSON object in a file, or None if there is no such file."""
    return parse_json(path, files.read(path)) if path.exists() else None


def _judge(data: list[ViewData], transfer: str) -> tuple[int | None, list[str]]:
    """The stored value at which the capture saturates (None: it does not), and what looks wrong."""
    kinds = {item.peak.dtype for item in data}
    if len(kinds) > 1:
        few = next(item.name for item in data if item.peak.dtype == np.uint8)
        many = next(item.name for item in data if item.peak.dtype == np.uint16)
        raise PolarguideError(
            "pictures",
            expected="one number of bits for all views",
            found=f"8 bits in view {few} and 16 in view {many}",
            remedy="Export all pictures alike.",
        )
    full = int(np.iinfo(kinds.pop()).max)
    scale = checks.full_scale(np.sum([item.histogram for item in data], axis=0), full)
    names = [item.name for item in data]
    measures = [checks.measure(item.codes, ~(item.invalid | item.saturated(scale))) for item in data]
    blown = [0.0 if scale is None else float((item.peak >= scale).mean()) for item in data]
    largest = max(int(item.peak.max()) for item in data)
    warnings = checks.exposure_warnings(names, measures, blown, largest, full)
    return scale, warnings + checks.polarization_warnings(names, measures, transfer)


def _pose_warnings(model: ColmapModel, all_names: list[str], data: list[ViewData]) -> list[str]:
    """What does not match between the COLMAP model and the pictures, where it could be put right."""
    warnings = unused_poses(model, all_names)
    sizes = {item.name: (model.camera(item.name).width, model.camera(item.name).height) for item in data}
    scaled = [item.name for item in data if item.size != sizes[item.name]]
    if scaled:
        found = ", ".join(f"{width}x{height}" for width, height in sorted({sizes[name] for name in scaled}))
        warnings.append(
            f"The intrinsics were made for another resolution ({found}) than that of the pictures and were "
            f"scaled in {len(scaled)} of {len(data)} views ({listed(scaled)}): right if the pictures were "
            "resized, wrong if they were cropped."
        )
    return warnings


def _digest_all(root: Path, files: Files) -> str:
    lines = sorted(
        f"{path.relative_to(root).as_posix()} {digest}\n" for path, digest in files.digests.items()
    )
    return hashlib.sha256("".join(lines).encode()).hexdigest()
