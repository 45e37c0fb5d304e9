"""The maps of shots as files: PNG with legends, EXR and NPY of the numbers, and a page that asks for no other file."""

from __future__ import annotations

import base64
import dataclasses
import math
import os
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.view import View
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import atomic, in_utf8, make_folder, require_inside, write_text, write_whole
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import to_json
from polarguide.visualization import figures
from polarguide.visualization.pages import data_uri, page, page_part, script_json
from polarguide_shots.develop import check_files
from polarguide_shots.exposures import find_shots, require_elsewhere, require_name, require_own_folder
from polarguide_shots.maps import REASONS, Reason, ShotMaps
from polarguide_shots.options import ShotOptions
from polarguide_shots.pictures import (
    ALL_KINDS,
    REASON_COLORS,
    MapKind,
    drawn,
    kinds_of,
    stretch_of,
    with_legend,
)
from polarguide_shots.read import UNREADABLE, SurfaceMaps, camera_of, fault_of, read_shot, surface_maps
from polarguide_shots.sets import ExposureSet

FORMATS = ("png", "exr", "npy", "page")
UNITS_FILE = "maps.json"


@dataclass(frozen=True)
class WrittenShots:
    """The outcome of several shots.

    Attributes:
        folders: folders of the shots that were written, by name.
        faults: the errors of the others, by name.
    """

    folders: dict[str, Path]
    faults: dict[str, PolarguideError]


def write_shots(
    paths: Sequence[str | os.PathLike[str]] | Sequence[ExposureSet],
    out: str | os.PathLike[str],
    options: ShotOptions | None = None,
    *,
    formats: Collection[str] = FORMATS,
    intrinsics: str | None = None,
    refractive_index: float | None = None,
    reporter: Reporter = SILENT,
) -> WrittenShots:
    """Write all maps of one or many shots, a folder for each.

    A shot that cannot be read, or whose maps cannot be written, does not stop the others. Files of an earlier call in
    other formats are removed.

    Args:
        paths: files and folders as ``find_shots`` takes them, or what it has found.
        out: folder to write; the maps of a shot are in the folder of its name there.
        options: how shots are read.
        formats: png (with legends), exr and npy (numbers; ``maps.json`` says their units), page.
        intrinsics: ``fx,fy,cx,cy`` of the developed pictures; without them, and without poses of a scene, rays are
            parallel.
        refractive_index: refractive index of all surfaces; None: as ``surface_maps`` takes it.
        reporter: where messages and progress go.

    Raises:
        PolarguideError: there are no shots, an option is wrong, or every shot failed: then the error of the first.
    """
    options = (options or ShotOptions()).checked()
    check_formats(formats)
    shots = [s for s in paths if isinstance(s, ExposureSet)]
    if len(shots) < len(paths) or not paths:
        shots += find_shots([p for p in paths if not isinstance(p, ExposureSet)], options)
    require_elsewhere([path for path in paths if not isinstance(path, ExposureSet)], Path(out))
    check_files(options)
    folders: dict[str, Path] = {}
    faults: dict[str, PolarguideError] = {}
    with reporter.track("shots", len(shots)) as advance:
        for number, shot in enumerate(shots, 1):
            try:
                require_name(shot)
                folder = Path(out) / shot.name
                require_own_folder(shot, folder)
                require_inside(Path(out), folder)
                maps = read_shot(shot, options)
                surface = surface_maps(maps, camera_of(shot, maps.size, intrinsics), refractive_index)
                write_maps(maps, surface, folder, formats)
            except UNREADABLE as error:
                fault = fault_of(shot, error)
                if len(shots) == 1:
                    raise fault from error
                faults[shot.name] = fault
                reporter.warn(str(fault))
            else:
                for note in maps.notes:
                    reporter.say(f"{shot.name}: {note}")
                folders[shot.name] = folder
            advance(number)
    if not folders:
        raise next(iter(faults.values()))
    return WrittenShots(folders, faults)


def write_view_maps(
    views: Sequence[View],
    out: str | os.PathLike[str],
    options: ShotOptions | None = None,
    *,
    formats: Collection[str] = FORMATS,
    refractive_index: float | None = None,
    reporter: Reporter = SILENT,
) -> dict[str, Path]:
    """Write all maps of views of a scene, a folder for each; returns the folders by name.

    Args:
        views: with pictures at 0, 45, 90 and 135 degrees; what is written is of these, as they are.
        formats: some of ``FORMATS``; ``check_formats`` is the caller's, before work begins.
        out, options, refractive_index, reporter: as for ``write_shots``; of the options ``full_well``, ``read_noise``
            and ``snr`` apply.

    Raises:
        PolarguideError: a view has other pictures, or an option is wrong.
    """
    options = (options or ShotOptions()).checked()
    folders: dict[str, Path] = {}
    with reporter.track("maps", len(views)) as advance:
        for number, view in enumerate(views, 1):
            require_inside(Path(out), folder := Path(out) / view.name)
            maps = read_shot(view, options)
            surface = surface_maps(maps, view.camera, refractive_index)
            folders[view.name] = write_maps(maps, surface, folder, formats)
            advance(number)
    return folders


def check_formats(formats: Collection[str]) -> None:
    """Check the names of formats of maps.

    Raises:
        PolarguideError: there is none, one is unknown, or its package is not there.
    """
    unknown = sorted(set(formats) - set(FORMATS))
    if unknown or not formats:
        raise PolarguideError(
            "formats",
            expected=f"some of {', '.join(FORMATS)}",
            found=", ".join(unknown) or "none",
            remedy=f"Choose from {', '.join(FORMATS)}.",
        )
    if "exr" in formats:
        optional_import("OpenEXR", "EXR files")


def write_maps(
    maps: ShotMaps, surface: SurfaceMaps, folder: Path, formats: Collection[str] = FORMATS
) -> Path:
    """Write the maps of one shot into a folder; returns the folder.

    Maps that were written there before in other formats are removed: all that is there is of this shot as read now.

    Raises:
        PolarguideError: the folder cannot be made.
    """
    make_folder(folder)
    kinds = kinds_of(maps)
    # Without the record, files of these names are not known to be this program's.
    there = _files_of(FORMATS, ALL_KINDS) if (folder / UNITS_FILE).is_file() else []
    earlier = [name for name in there if name not in _files_of(formats, kinds)]
    for kind in kinds:
        values = kind.values(maps, surface)
        if "png" in formats:
            stretch = stretch_of(kind, values, maps)
            picture = with_legend(drawn(kind, values, maps, stretch), kind, stretch, maps.name)
            figures.write_png(folder / f"{kind.key}.png", picture)
        if "npy" in formats:
            with atomic(folder / f"{kind.key}.npy") as temporary, open(temporary, "wb") as file:
                np.save(file, values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values)
        if "exr" in formats:
            _write_exr(folder / f"{kind.key}.exr", values, kind.unit, kind.note)
    write_whole(folder / UNITS_FILE, to_json(_record(maps, surface)))
    if "page" in formats:
        write_text(folder / PAGE, shot_page(maps, surface))
    for name in earlier:
        if not (folder / name).is_dir():
            (folder / name).unlink(missing_ok=True)
    return folder


def _files_of(formats: Collection[str], kinds: Sequence[MapKind]) -> list[str]:
    """Names of the files of formats."""
    names = [f"{kind.key}.{suffix}" for suffix in formats if suffix != "page" for kind in kinds]
    return [*names, PAGE] if "page" in formats else names


def _record(maps: ShotMaps, surface: SurfaceMaps) -> dict[str, Any]:
    """Units of the maps, and what is known of the shot."""
    counts = np.bincount(maps.reason.ravel(), minlength=len(Reason)) / maps.reason.size
    return {
        "version": 1,
        "shot": maps.name,
        "files": [str(path) for path in maps.files],
        "size": list(maps.size),
        "maps": {kind.key: {"unit": kind.unit, "note": kind.note} for kind in kinds_of(maps)},
        "shares": {code.name.lower(): round(float(counts[code]), 6) for code in Reason},
        "noise": {"floor": maps.noise.floor, "slope": maps.noise.slope, "source": maps.noise.source},
        "pair_ratio": maps.pair_ratio,
        **({"pictures": [dataclasses.asdict(fit) for fit in maps.pictures]} if maps.pictures else {}),
        "refractive_index": surface.refractive_index,
        "rays": "of a pinhole camera" if surface.perspective else "parallel",
        "notes": list(maps.notes),
    }


def _write_exr(path: Path, values: NDArray[Any], unit: str, note: str) -> None:
    """One map as 32-bit floats, its unit in the header; one channel Y, or R, G, B (x, y, z of a normal).

    Raises:
        OSError: the file cannot be written.
    """
    exr = optional_import("OpenEXR", "EXR files")
    numbers = np.ascontiguousarray(
        values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values, np.float32
    )
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage, "unit": unit, "comments": note}
    channels = {"Y": numbers} if numbers.ndim == 2 else {"RGB": numbers}
    with atomic(path) as temporary, in_utf8(temporary) as name, exr.File(header, channels) as file:
        try:
            file.write(str(name))
        except RuntimeError as error:
            raise OSError(str(error).strip().splitlines()[-1]) from None


PAGE = "shot.html"
SIDE = 816
"""Most pixels of the longer side of what is on the page: a third of a whole sensor."""
_HIDDEN = ("zenith_diffuse", "zenith_specular_below", "zenith_specular_above")
"""Maps that the page tells in numbers alone."""
_SMALLEST_SIGMA = 1e-6
_PACKAGE = "polarguide_shots"


def shot_page(maps: ShotMaps, surface: SurfaceMaps) -> str:
    """The HTML page; all names and texts in it are escaped.

    Pictures and numbers are those of every k-th pixel each way, k such that the longer side has at most ``SIDE``;
    nothing is averaged.
    """
    step = max(1, math.ceil(max(maps.size) / SIDE))
    kinds = [kind for kind in kinds_of(maps) if kind.key not in _HIDDEN]
    layers = []
    stretches = []
    for kind in kinds:
        values = kind.values(maps, surface)
        stretch = stretch_of(kind, values, maps)
        picture = drawn(kind, values, maps, stretch, step)
        # What is listed as lossless there stays exact; the noise of the others would make the page large.
        layers.append(data_uri(picture, "normal" if kind.look == "reason" else "", SIDE))
        stretches.append(stretch)
    height, width = maps.reason[::step, ::step].shape
    packed, scales = _numbers(maps, surface, step)
    data = {"width": width, "height": height, "step": step, "layers": layers, "numbers": packed, **scales,
            "reasons": [REASONS[code] for code in Reason]}  # fmt: skip
    w, h = maps.size
    return page(
        _PACKAGE,
        "shot.html",
        script=page_part(_PACKAGE, "shot.js").replace("$data", script_json(data)),
        title=maps.name,
        summary=f"{w} x {h} pixels" + (f"; every {step}. pixel each way is on this page" if step > 1 else ""),
        shown=list(zip(kinds, stretches, strict=True)),
        gradient=figures.color_gradient,
        wheel=data_uri(figures.angle_wheel(), "aolp", SIDE),
        reasons={code.name.lower(): color for code, color in REASON_COLORS.items()},
        width=width,
        height=height,
        facts=_facts(maps, surface),
    )


def _numbers(maps: ShotMaps, surface: SurfaceMaps, step: int) -> tuple[str, dict[str, float]]:
    """Bytes of all numbers, plane by plane, deflated and in base64; and what they are scaled with."""

    def picked(values: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(values[::step, ::step])

    def halves(share: NDArray[Any]) -> list[NDArray[np.uint8]]:
        code = np.rint(np.clip(np.nan_to_num(share), 0, 1) * 65535).astype(np.uint16)
        return [(code >> 8).astype(np.uint8), (code & 255).astype(np.uint8)]

    def logarithmic(sigma: NDArray[Any], top: float) -> NDArray[np.uint8]:
        span = math.log(top / _SMALLEST_SIGMA)
        share = (
            np.log(np.clip(np.nan_to_num(sigma, posinf=top), _SMALLEST_SIGMA, top) / _SMALLEST_SIGMA) / span
        )
        return np.asarray(np.rint(share * 255).astype(np.uint8))

    top = max(float(maps.s0.max()), 1e-6)
    s0 = picked(maps.s0)
    planes = halves(s0 / top) + halves(picked(maps.dolp)) + halves(picked(maps.aolp) / math.pi)
    planes += [logarithmic(picked(maps.sigma_dolp), 10.0), logarithmic(picked(maps.sigma_aolp), 10.0)]
    planes += [np.rint(picked(surface.normal)[..., axis] * 127 + 128).astype(np.uint8) for axis in range(3)]
    for layer in (surface.specular_exact, surface.specular_paper):
        share = picked(layer).mean(axis=-1) / np.maximum(s0, 1e-6)
        planes.append(np.rint(np.clip(share, 0, 1) * 255).astype(np.uint8))
    planes.append(picked(maps.reason))
    data = zlib.compress(np.stack(planes).tobytes(), 6)
    return base64.b64encode(data).decode(), {
        "top": top,
        "least": _SMALLEST_SIGMA,
        "most": 10.0,
        "index": surface.refractive_index,
    }


def _facts(maps: ShotMaps, surface: SurfaceMaps) -> dict[str, str]:
    counts = np.bincount(maps.reason.ravel(), minlength=len(Reason)) / maps.reason.size
    ratio = (
        "too dark to tell" if maps.pair_ratio is None else f"{maps.pair_ratio:.4f} (1 for ideal polarizers)"
    )
    wells = f", {1 / maps.noise.slope:,.0f} electrons at full scale" if maps.noise.slope > 0 else ""
    return {
        "pixels": ", ".join(f"{code.name.lower()} {counts[code]:.1%}" for code in Reason if counts[code] > 0),
        "median DoLP": f"{float(np.median(maps.dolp[maps.measured])):.4f}" if maps.measured.any() else "none",
        **(_facts_of_set(maps) if maps.pictures else {"(I0 + I90) / (I45 + I135)": ratio}),
        "noise of a sample": f"{maps.noise.source}: {maps.noise.floor**0.5:.2%} of full scale in the dark{wells}",
        "refractive index": f"{surface.refractive_index:g}",
        "rays": "of a pinhole camera"
        if surface.perspective
        else "parallel to the axis (--intrinsics gives others)",
        "files": ", ".join(path.name for path in maps.files) or "a view of a scene",
        **({"notes": " ".join(maps.notes)} if maps.notes else {}),
    }


def _facts_of_set(maps: ShotMaps) -> dict[str, str]:
    """Angles of a set as its pictures imply them, and their residuals."""
    rows = [
        f"{fit.label}: {fit.angle:g}°"
        + (f", looks like {fit.looks_like:.1f}°" if fit.looks_like is not None else "")
        + (" (left out)" if fit.left_out else "")
        for fit in maps.pictures
    ]
    facts = {"angles": "; ".join(rows)}
    if maps.residual is not None and maps.measured.any():
        facts["median residual"] = f"{float(np.median(maps.residual[maps.measured])):.2f} (1 is noise alone)"
    return facts
