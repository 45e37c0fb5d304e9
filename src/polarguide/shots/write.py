"""The maps of shots as files: PNG with legends, EXR and NPY of the numbers, and a page."""

from __future__ import annotations

import dataclasses
import os
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
from polarguide.shots.develop import check_files
from polarguide.shots.exposures import (
    ExposureSet,
    find_shots,
    require_elsewhere,
    require_name,
    require_own_folder,
)
from polarguide.shots.maps import Reason, ShotMaps
from polarguide.shots.options import ShotOptions
from polarguide.shots.page_html import PAGE, shot_page
from polarguide.shots.pictures import ALL_KINDS, MapKind, drawn, kinds_of, stretch_of, with_legend
from polarguide.shots.read import UNREADABLE, SurfaceMaps, camera_of, fault_of, read_shot, surface_maps
from polarguide.visualization import figures

FORMATS = ("png", "exr", "npy", "page")
UNITS_FILE = "maps.json"


@dataclass(frozen=True)
class WrittenShots:
    """What came of several shots.

    Attributes:
        folders: of the shots that were written, by name.
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
        refractive_index: of all surfaces; None: as ``surface_maps`` takes it.
        reporter: where messages and progress go.

    Raises:
        PolarguideError: there are no shots, an option is wrong, or every shot failed: then the error of the first.
    """
    options = (options or ShotOptions()).checked()
    check_formats(formats)
    found = [s for s in paths if isinstance(s, ExposureSet)]
    if len(found) < len(paths) or not paths:
        found += find_shots([p for p in paths if not isinstance(p, ExposureSet)], options)
    require_elsewhere([path for path in paths if not isinstance(path, ExposureSet)], Path(out))
    check_files(options)
    folders: dict[str, Path] = {}
    faults: dict[str, PolarguideError] = {}
    with reporter.track("shots", len(found)) as advance:
        for number, shot in enumerate(found, 1):
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
                if len(found) == 1:
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
            remedy="Correct the name.",
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
        OSError: it cannot be written.
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
