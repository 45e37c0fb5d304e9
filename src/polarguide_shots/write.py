"""Write the maps of shots: PNG files with legends, EXR and NPY files with numbers, and a self-contained page."""

from __future__ import annotations

import base64
import dataclasses
import math
import os
import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture.view import View
from polarguide.core.errors import PolarguideError, optional_import, require
from polarguide.core.files import atomic, in_utf8, make_folder, require_inside, write_text, write_whole
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import to_json
from polarguide.visualization import figures
from polarguide.visualization.figures import FONT, INK, Picture
from polarguide.visualization.pages import data_uri, page, page_part, script_json
from polarguide_shots.exposures import find_shots, name_fault, require_elsewhere, require_own_folder
from polarguide_shots.maps import REASONS, Reason, ShotMaps
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import (
    UNREADABLE,
    SurfaceMaps,
    camera_of,
    check_files,
    fault_of,
    read_shot,
    surface_maps,
    tiles,
)
from polarguide_shots.sets import ExposureSet

FORMATS = ("png", "exr", "npy", "page")
"""Names of the file formats in which maps can be written."""
UNITS_FILE = "maps.json"
"""Name of the file that lists the unit of each map."""


@dataclass(frozen=True)
class WrittenShots:
    """Result of ``write_shots``: the folders that were written, and the shots that failed.

    Attributes:
        folders: folders of the written shots, by name.
        faults: errors of the shots that failed, by name.
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
    """Write all maps of one or many shots, each shot in its own folder.

    If a shot cannot be read or written, the remaining shots are still written. Files of an earlier call in other
    formats are removed.

    Args:
        paths: files and folders for ``find_shots``, or its results.
        out: folder to write, with a folder for each shot.
        options: options of reading.
        formats: names from ``FORMATS``: png (pictures with legends), exr and npy (numbers, with units in
            ``maps.json``), page (HTML).
        intrinsics: ``fx,fy,cx,cy`` of the developed pictures. If None, the poses of a scene are used. Without poses,
            rays are assumed to be parallel.
        refractive_index: refractive index of all surfaces. If None, the default of ``surface_maps`` is used.
        reporter: receiver of messages and progress.

    Raises:
        PolarguideError: there are no shots, or an option is invalid. If all shots failed, the error of the first shot
            is raised.
    """
    options = (options or ShotOptions()).checked()
    check_formats(formats)
    shots = [s for s in paths if isinstance(s, ExposureSet)]
    sources = [p for p in paths if not isinstance(p, ExposureSet)]
    if sources or not paths:
        shots += find_shots(sources, options)
    require_elsewhere(sources, Path(out))
    check_files(options)
    folders: dict[str, Path] = {}
    faults: dict[str, PolarguideError] = {}
    with reporter.track("shots", len(shots)) as advance:
        for number, shot in enumerate(shots, 1):
            try:
                misnamed = name_fault(shot)
                if misnamed is not None:
                    raise misnamed
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
    """Write all maps of views of a scene, each view in its own folder, and return the folders by name.

    Args:
        views: views whose pictures determine Stokes vectors.
        out: folder to write, as in ``write_shots``.
        options: options of reading. Only ``full_well``, ``read_noise`` and ``snr`` apply.
        formats: formats that ``check_formats`` has accepted.
        refractive_index: refractive index of all surfaces, as in ``write_shots``.
        reporter: receiver of messages and progress.

    Raises:
        PolarguideError: the pictures of a view do not determine Stokes vectors, or an option is invalid.
    """
    options = (options or ShotOptions()).checked()
    folders = {view.name: Path(out) / view.name for view in views}
    with reporter.track("maps", len(views)) as advance:
        for number, view in enumerate(views, 1):
            require_inside(Path(out), folders[view.name])
            maps = read_shot(view, options)
            write_maps(maps, surface_maps(maps, view.camera, refractive_index), folders[view.name], formats)
            advance(number)
    return folders


def check_formats(formats: Collection[str]) -> None:
    """Validate the names of file formats of maps.

    Raises:
        PolarguideError: there are no formats, a format is unknown, or the package that writes it is missing.
    """
    unknown = sorted(set(formats) - set(FORMATS))
    require(
        formats and not unknown,
        "formats",
        expected=f"some of {', '.join(FORMATS)}",
        found=", ".join(unknown) or "none",
        remedy=f"Choose from {', '.join(FORMATS)}.",
    )
    if "exr" in formats:
        optional_import("OpenEXR", "EXR files")


def write_maps(
    maps: ShotMaps, surface: SurfaceMaps, folder: Path, formats: Collection[str] = FORMATS
) -> None:
    """Write the maps of one shot into a folder, and remove maps of an earlier call in other formats.

    Args:
        maps: polarization maps of the shot.
        surface: normals and layers of the shot.
        folder: folder to write.
        formats: formats of the files.

    Raises:
        PolarguideError: the folder cannot be created.
    """
    make_folder(folder)
    kinds = kinds_of(maps)
    # A folder without the record may contain other files of these names.
    previous = _files_of(FORMATS, ALL_KINDS) if (folder / UNITS_FILE).is_file() else []
    outdated = set(previous) - set(_files_of(formats, kinds))
    for kind in kinds:
        values = kind.values(maps, surface)
        if "png" in formats:
            stretch = stretch_of(kind, values, maps)
            figures.write_png(
                folder / f"{kind.key}.png",
                with_legend(drawn(kind, values, maps, stretch), kind, stretch, maps.name),
            )
        if values.shape[2:] == (1,):
            values = values[..., 0]
        if "npy" in formats:
            with atomic(folder / f"{kind.key}.npy") as temporary, open(temporary, "wb") as file:
                np.save(file, values)
        if "exr" in formats:
            _write_exr(folder / f"{kind.key}.exr", values, kind.unit, kind.note)
    write_whole(folder / UNITS_FILE, to_json(_record(maps, surface)))
    if "page" in formats:
        write_text(folder / PAGE, shot_page(maps, surface))
    for name in outdated:
        if not (folder / name).is_dir():
            (folder / name).unlink(missing_ok=True)


def _files_of(formats: Collection[str], kinds: Sequence[MapKind]) -> list[str]:
    """Return the names of the files that are written for some formats and kinds of maps."""
    names = [f"{kind.key}.{suffix}" for suffix in formats if suffix != "page" for kind in kinds]
    return [*names, PAGE] if "page" in formats else names


def _shares(maps: ShotMaps) -> dict[str, float]:
    """Return the share of the pixels that have each ``Reason``, by its name."""
    shares = np.bincount(maps.reason.ravel(), minlength=len(Reason)) / maps.reason.size
    return {code.name.lower(): float(shares[code]) for code in Reason}


def _record(maps: ShotMaps, surface: SurfaceMaps) -> dict[str, Any]:
    """Return the content of ``maps.json``."""
    return {
        "version": 1,
        "shot": maps.name,
        "files": [str(path) for path in maps.files],
        "size": list(maps.size),
        "maps": {kind.key: {"unit": kind.unit, "note": kind.note} for kind in kinds_of(maps)},
        "shares": {name: round(share, 6) for name, share in _shares(maps).items()},
        "noise": {"floor": maps.noise.floor, "slope": maps.noise.slope, "source": maps.noise.source},
        "pair_ratio": maps.pair_ratio,
        **({"pictures": [dataclasses.asdict(fit) for fit in maps.pictures]} if maps.pictures else {}),
        "refractive_index": surface.refractive_index,
        "rays": "of a pinhole camera" if surface.perspective else "parallel",
        "notes": list(maps.notes),
    }


def _write_exr(path: Path, values: NDArray[Any], unit: str, note: str) -> None:
    """Write one map as 32-bit floats, with its unit in the header.

    A map of one component is channel Y. A map of three components is R, G, B, which are x, y, z for a normal.

    Raises:
        OSError: the file cannot be written.
    """
    exr = optional_import("OpenEXR", "EXR files")
    numbers = np.ascontiguousarray(values, np.float32)
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage, "unit": unit, "comments": note}
    channels = {"Y": numbers} if numbers.ndim == 2 else {"RGB": numbers}
    with atomic(path) as temporary, in_utf8(temporary) as name, exr.File(header, channels) as file:
        try:
            file.write(str(name))
        except RuntimeError as error:
            raise OSError(str(error).strip().splitlines()[-1]) from None


PAGE = "shot.html"
"""Name of the HTML file of a shot."""
SIDE = 816
"""Largest width or height of the pictures on the page in pixels, a third of a sensor."""
_HIDDEN = ("zenith_diffuse", "zenith_specular_below", "zenith_specular_above")
"""Maps whose values are in the page, but which are not shown as pictures."""
_SMALLEST_SIGMA = 1e-6
_LARGEST_SIGMA = 10.0
_PACKAGE = "polarguide_shots"


def shot_page(maps: ShotMaps, surface: SurfaceMaps) -> str:
    """Create the HTML page of a shot. All names and texts are escaped.

    To limit its size, the page contains every k-th pixel of each row and column without averaging. The longer side has
    at most ``SIDE`` pixels.
    """
    step = max(1, math.ceil(max(maps.size) / SIDE))
    layers = []
    shown = []
    for kind in (kind for kind in kinds_of(maps) if kind.key not in _HIDDEN):
        values = kind.values(maps, surface)
        stretch = stretch_of(kind, values, maps)
        picture = drawn(kind, values, maps, stretch, step)
        # Reasons are lossless like normals. Lossless noise of other maps would make the page large.
        layers.append(data_uri(picture, "normal" if kind.look == "reason" else "", SIDE))
        shown.append((kind, stretch))
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
        shown=shown,
        gradient=figures.color_gradient,
        wheel=data_uri(figures.angle_wheel(), "aolp", SIDE),
        reasons={code.name.lower(): color for code, color in REASON_COLORS.items()},
        width=width,
        height=height,
        facts=_facts(maps, surface),
    )


def _numbers(maps: ShotMaps, surface: SurfaceMaps, step: int) -> tuple[str, dict[str, float]]:
    """Encode the values of the maps for the page.

    Returns:
        The values as bytes, compressed and in base64; and the scales that convert them to numbers.
    """
    at = np.s_[::step, ::step]

    def split(share: NDArray[Any]) -> list[NDArray[np.uint8]]:
        code = np.rint(np.clip(np.nan_to_num(share), 0, 1) * 65535).astype(np.uint16)
        return [(code >> 8).astype(np.uint8), (code & 255).astype(np.uint8)]

    def logarithmic(sigma: NDArray[Any]) -> NDArray[np.uint8]:
        limited = np.clip(np.nan_to_num(sigma, posinf=_LARGEST_SIGMA), _SMALLEST_SIGMA, _LARGEST_SIGMA)
        share = np.log(limited / _SMALLEST_SIGMA) / math.log(_LARGEST_SIGMA / _SMALLEST_SIGMA)
        return np.asarray(np.rint(share * 255).astype(np.uint8))

    top = max(float(maps.s0.max()), 1e-6)
    s0 = maps.s0[at]
    planes = split(s0 / top) + split(maps.dolp[at]) + split(maps.aolp[at] / math.pi)
    planes += [logarithmic(maps.sigma_dolp[at]), logarithmic(maps.sigma_aolp[at])]
    planes += [np.rint(surface.normal[at][..., axis] * 127 + 128).astype(np.uint8) for axis in range(3)]
    for layer in (surface.specular_exact, surface.specular_paper):
        share = layer[at].mean(axis=-1) / np.maximum(s0, 1e-6)
        planes.append(np.rint(np.clip(share, 0, 1) * 255).astype(np.uint8))
    data = zlib.compress(np.stack([*planes, maps.reason[at]]).tobytes(), 6)
    return base64.b64encode(data).decode(), {
        "top": top,
        "least": _SMALLEST_SIGMA,
        "most": _LARGEST_SIGMA,
        "index": surface.refractive_index,
    }


def _facts(maps: ShotMaps, surface: SurfaceMaps) -> dict[str, str]:
    """Return the properties of a shot that the page lists, by label."""
    ratio = "too dark" if maps.pair_ratio is None else f"{maps.pair_ratio:.4f} (1 for ideal polarizers)"
    wells = f", {1 / maps.noise.slope:,.0f} electrons at full scale" if maps.noise.slope > 0 else ""
    return {
        "pixels": ", ".join(f"{name} {share:.1%}" for name, share in _shares(maps).items() if share > 0),
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
    """Return the properties of a set at any angles: its angles as stated and as estimated, and its residuals."""
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


Look = Literal["radiance", "scalar", "angle", "normal", "reason"]
_OF_S0 = "linear radiance in units of S0 (2 is full scale of all four intensities)"


@dataclass(frozen=True)
class MapKind:
    """Description of a kind of map, such as the DoLP: its values, its unit, and its colors in pictures.

    Attributes:
        key: name in file names.
        label: name in pictures and pages.
        unit: unit of the values in files.
        look: type of picture, which selects how values become colors.
        values: function that computes the map.
        color_map: color map of a scalar.
        fixed: lowest and highest value of the colors. If None, the range is chosen for each map.
        factor: factor from ``unit`` to ``shown_unit``.
        shown_unit: unit in the picture.
        note: limitation, for the legend.
    """

    key: str
    label: str
    unit: str
    look: Look
    values: Callable[[ShotMaps, SurfaceMaps], NDArray[Any]]
    color_map: str = "inferno"
    fixed: tuple[float, float] | None = None
    factor: float = 1.0
    shown_unit: str = ""
    note: str = ""


_DEGREES = 180 / np.pi
_COARSE = "coarse, of PolarGuide-GSDR: needs no normal, and its layers do not add up to S0"
_GUESSED = "needs normals: with normals of polarization only, all light goes to the guessed lobe"

KINDS: tuple[MapKind, ...] = (
    MapKind("S0", "S0", _OF_S0, "radiance", lambda m, s: m.intensities.sum(axis=0) / np.float32(2)),
    MapKind("DoLP", "DoLP", "1 (0 to 1)", "scalar", lambda m, s: m.dolp),
    MapKind("DoLP_debiased", "DoLP, debiased", "1 (0 to 1)", "scalar", lambda m, s: m.dolp_debiased,
            note="without the mean bias by noise (Plaszczynski et al. 2014)"),
    MapKind("AoLP", "AoLP", "radians (0 to pi), counter-clockwise from the image's horizontal", "angle",
            lambda m, s: m.aolp, factor=_DEGREES, shown_unit="deg"),
    MapKind("sigma_DoLP", "sigma of DoLP", "1", "scalar", lambda m, s: m.sigma_dolp, "viridis",
            note="standard deviation by the sensor's noise"),
    MapKind("sigma_AoLP", "sigma of AoLP", "radians", "scalar", lambda m, s: m.sigma_aolp, "viridis", (0.0, 52.0),
            _DEGREES, "deg", note="standard deviation by the sensor's noise; 52 deg is a random angle"),
    MapKind("specular_exact", "specular, exact", _OF_S0, "radiance", lambda m, s: s.specular_exact, note=_GUESSED),
    MapKind("diffuse_exact", "diffuse, exact", _OF_S0, "radiance", lambda m, s: s.diffuse_exact, note=_GUESSED),
    MapKind("specular_paper", "specular, paper", _OF_S0, "radiance", lambda m, s: s.specular_paper, note=_COARSE),
    MapKind("diffuse_paper", "diffuse, paper", _OF_S0, "radiance", lambda m, s: s.diffuse_paper, note=_COARSE),
    MapKind("normal", "normal", "unit vector, camera axes x right, y down, z forward; 0 without a normal", "normal",
            lambda m, s: s.normal, note="the candidate of six nearest to facing the camera, a little upward"),
    MapKind("zenith_diffuse", "zenith if diffuse", "radians", "scalar", lambda m, s: s.zeniths[0], "viridis",
            (0.0, 90.0), _DEGREES, "deg",
            note="candidates at azimuth AoLP and AoLP + 180 deg; gray above the limit of diffuse light"),
    MapKind("zenith_specular_below", "zenith if specular, below Brewster", "radians", "scalar",
            lambda m, s: s.zeniths[1], "viridis", (0.0, 90.0), _DEGREES, "deg",
            note="candidates at azimuth AoLP +- 90 deg"),
    MapKind("zenith_specular_above", "zenith if specular, above Brewster", "radians", "scalar",
            lambda m, s: s.zeniths[2], "viridis", (0.0, 90.0), _DEGREES, "deg",
            note="candidates at azimuth AoLP +- 90 deg"),
    MapKind("reason", "usable pixels", "0 usable, 1 noise, 2 dark, 3 saturated, 4 masked", "reason",
            lambda m, s: m.reason),
)  # fmt: skip
"""Kinds of maps that every shot has, in the order of the page."""
ALL_KINDS: tuple[MapKind, ...] = (
    *KINDS,
    MapKind("residual", "residual", "standard deviations of the noise", "scalar", lambda m, s: np.asarray(m.residual),
            "viridis", (0.0, 5.0), note="residual of the fit of all pictures; 1 is noise alone, more is motion, "
            "clipping or a wrong angle"),
    MapKind("left_out", "samples left out", "samples", "scalar", lambda m, s: np.asarray(m.left_out), "viridis",
            note="at full scale, or against the other pictures of the set"),
)  # fmt: skip
"""All kinds of maps, including those that only sets at any angles have."""


def kinds_of(maps: ShotMaps) -> tuple[MapKind, ...]:
    """Return the kinds of maps that a shot has. ``residual`` and ``left_out`` are optional."""
    return tuple(kind for kind in ALL_KINDS if getattr(maps, kind.key, kind) is not None)


REASON_COLORS: dict[Reason, tuple[int, int, int]] = {
    Reason.USABLE: (238, 240, 242),
    Reason.NOISE: (120, 128, 140),
    Reason.DARK: (38, 62, 130),
    Reason.SATURATED: (230, 60, 50),
    Reason.MASKED: (245, 190, 60),
}
"""Color of each reason in the map of usable pixels."""
NOTHING = (96, 100, 110)
"""Color of pixels without a measurement."""
_ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_SAMPLES = 200_000
_NARROWEST = 640


@dataclass(frozen=True)
class Stretch:
    """Range of values that the colors of a picture cover.

    Attributes:
        low: number at the lower end, in the unit of the picture.
        high: number at the upper end, in the unit of the picture. A radiance is divided by it.
        text: description of the range.
    """

    low: float
    high: float
    text: str


def stretch_of(kind: MapKind, values: NDArray[Any], maps: ShotMaps) -> Stretch:
    """Choose a range that contains nearly all measured values of a map. Layers share the range of S0."""
    if kind.fixed is not None:
        low, high = kind.fixed
        return Stretch(low, high, f"{low:g} to {high:g} {kind.shown_unit}".strip())
    if kind.look == "radiance":
        top = _rounded_up(_quantile(maps.s0 / 2, maps.measured))
        return Stretch(0.0, top, f"sRGB; white is S0/2 = {top:g} of full scale (x{1 / top:.3g})")
    if kind.look == "angle":
        top = _rounded_up(_quantile(maps.dolp, maps.measured, 0.75))
        return Stretch(0.0, top, f"hue: angle; full brightness from DoLP {top:g}")
    if kind.look == "scalar":
        top = _rounded_up(_quantile(values, maps.measured, 0.98) * kind.factor)
        return Stretch(0.0, top, f"0 to {top:g}, which contains 98 % of the pixels")
    return Stretch(0.0, 1.0, "")


def drawn(kind: MapKind, values: NDArray[Any], maps: ShotMaps, stretch: Stretch, step: int = 1) -> Picture:
    """Draw every ``step``-th pixel of a map without a legend, as uint8 RGB [H, W, 3]."""
    values = values[::step, ::step]
    dolp = maps.dolp[::step, ::step]
    reason = maps.reason[::step, ::step]
    height, width = reason.shape
    picture: Picture = np.empty((height, width, 3), np.uint8)
    for part in tiles(height, width):
        picture[part] = _colored(kind, values[part], dolp[part], reason[part], stretch)
    return picture


def _colored(
    kind: MapKind, values: NDArray[Any], dolp: NDArray[Any], reason: NDArray[np.uint8], stretch: Stretch
) -> Picture:
    if kind.look == "reason":
        return np.asarray(np.array([REASON_COLORS[code] for code in Reason], np.uint8)[values])
    numbers = torch.from_numpy(np.ascontiguousarray(values))
    if kind.look == "radiance":
        return figures.radiance_to_rgb((numbers / (2 * stretch.high)).expand(-1, -1, 3))
    if kind.look == "angle":
        picture = figures.aolp_to_rgb(numbers, torch.from_numpy(np.ascontiguousarray(dolp)) / stretch.high)
    elif kind.look == "normal":
        colors = torch.where(
            (numbers != 0).any(dim=-1, keepdim=True),
            (numbers * torch.tensor([1.0, -1.0, -1.0]) + 1) / 2 * 255,
            torch.tensor(NOTHING),
        )
        return np.asarray(torch.floor(colors + 0.5).clamp(0, 255).to(torch.uint8).numpy())
    else:
        picture = figures.scalar_to_rgb(numbers * kind.factor, stretch.low, stretch.high, kind.color_map)
        picture[~np.isfinite(values)] = NOTHING
    picture[reason > Reason.NOISE] = NOTHING
    return picture


_GRAYS: dict[Look, str] = {
    "scalar": "gray: dark, saturated or masked",
    "angle": "gray: dark, saturated or masked",
    "normal": "gray: no angle (noise, dark, saturated, masked)",
}
"""Meaning of gray pixels in the legend, by type of picture."""


def with_legend(picture: Picture, kind: MapKind, stretch: Stretch, title: str) -> Picture:
    """Add a legend below a picture. A narrow picture also gets a white margin at the right."""
    width = max(picture.shape[1], _NARROWEST)
    picture = np.pad(picture, ((0, 0), (0, width - picture.shape[1]), (0, 0)), constant_values=255)
    scale = max(width / 1224, 0.6)
    strip: Picture = np.full((round(96 * scale), width, 3), 255, np.uint8)
    key = _color_key(kind, stretch, scale)
    strip[: key.shape[0], width - key.shape[1] :] = key
    lines = (
        (f"{kind.label}   {title}", 0.75),
        (f"stretch: {stretch.text}" if stretch.text else kind.unit, 0.6),
        ("; ".join(filter(None, (kind.note, _GRAYS.get(kind.look)))), 0.5),
    )
    for line, (text, size) in enumerate(lines, 1):
        place = (round(14 * scale), round(30 * line * scale))
        _text(strip, text, place, size * scale, width - key.shape[1] - round(30 * scale))
    return np.concatenate((picture, strip))


def _color_key(kind: MapKind, stretch: Stretch, scale: float) -> Picture:
    """Draw the explanation of the colors: a bar, a wheel, a ball, or patches."""
    high = round(96 * scale)
    if kind.look == "scalar":
        middle = f"{(stretch.low + stretch.high) / 2:g}"
        bar = figures.scale_bar(stretch.low, stretch.high, kind.color_map, kind.shown_unit, middle=middle)
        bar = np.pad(bar, ((12, 12), (16, 16), (0, 0)), constant_values=255)
        size = (round(bar.shape[1] * high / bar.shape[0]), high)
        return np.asarray(cv2.resize(bar, size, interpolation=cv2.INTER_AREA))
    if kind.look == "angle":
        return figures.angle_wheel(high / 113)
    if kind.look == "normal":
        return figures.normal_ball(high, round(1.2 * high))
    key: Picture = np.full((high, round(520 * scale) if kind.look == "reason" else 1, 3), 255, np.uint8)
    for number, (code, color) in enumerate(REASON_COLORS.items() if kind.look == "reason" else ()):
        x = round((12 + 170 * (number % 3)) * scale)
        y = round((14 + 40 * (number // 3)) * scale)
        end = (x + round(24 * scale), y + round(24 * scale))
        cv2.rectangle(key, (x, y), end, color, -1)
        cv2.rectangle(key, (x, y), end, INK, 1)
        _text(
            key, code.name.lower(), (end[0] + round(8 * scale), end[1] - round(6 * scale)), 0.55 * scale, high
        )
    return key


def _text(picture: Picture, text: str, place: tuple[int, int], size: float, width: int) -> None:
    """Draw ASCII text at a place, with a font that is small enough for a width."""
    text = text.encode("ascii", "replace").decode()
    while size > 0.3 and cv2.getTextSize(text, FONT, size, 1)[0][0] > width:
        size *= 0.95
    cv2.putText(picture, text, place, FONT, size, INK, max(1, round(1.4 * size)), cv2.LINE_AA)


def _quantile(values: NDArray[Any], where: NDArray[np.bool_], q: float = 0.995) -> float:
    """Return a quantile of the finite values inside a mask; return 1 if there are no such values."""
    step = max(1, math.isqrt(values.size // _SAMPLES))
    numbers = values[::step, ::step][where[::step, ::step]]
    numbers = numbers[np.isfinite(numbers)]
    return float(np.quantile(numbers, q)) if numbers.size else 1.0


def _rounded_up(value: float) -> float:
    """Return the next round number above a value. A round number may be smaller than the value by a thousandth."""
    if not value > 1e-6:
        return 1e-3
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{next(n * power for n in _ROUND if n * power >= value * 0.999):.6g}")
