"""The maps of shots as files: PNG with legends, EXR and NPY of the numbers, and a page that asks for no other file."""

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
from polarguide.core.errors import PolarguideError, optional_import
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
                misnamed = name_fault(shot)
                if misnamed is not None:
                    raise misnamed
                folder = Path(out) / shot.name
                require_own_folder(shot, folder)
                require_inside(Path(out), folder)
                maps = read_shot(shot, options)
                write_maps(
                    maps,
                    surface_maps(maps, camera_of(shot, maps.size, intrinsics), refractive_index),
                    folder,
                    formats,
                )
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
            folders[view.name] = write_maps(
                maps, surface_maps(maps, view.camera, refractive_index), folder, formats
            )
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
            figures.write_png(
                folder / f"{kind.key}.png",
                with_legend(drawn(kind, values, maps, stretch), kind, stretch, maps.name),
            )
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


Look = Literal["radiance", "scalar", "angle", "normal", "reason"]
_OF_S0 = "linear radiance in units of S0 (2 is full scale of all four intensities)"


@dataclass(frozen=True)
class MapKind:
    """A kind of map of a shot, such as the DoLP: how it is computed, written and drawn.

    Attributes:
        key: name in file names.
        label: name for people.
        unit: unit of the values in files.
        look: way in which it is drawn.
        values: function that computes it.
        color_map: color map of a scalar.
        fixed: range of the colors; None: it fits the values of each map.
        factor: factor from ``unit`` to ``shown_unit``.
        shown_unit: unit in the picture.
        note: limitation that is written beside it.
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
_GUESSED = "needs normals: with those of polarization alone all light goes to the lobe that was guessed"

KINDS: tuple[MapKind, ...] = (
    MapKind("S0", "S0", _OF_S0, "radiance", lambda m, s: m.intensities.sum(axis=0) / np.float32(2)),
    MapKind("DoLP", "DoLP", "1 (0 to 1)", "scalar", lambda m, s: m.dolp),
    MapKind("DoLP_debiased", "DoLP, debiased", "1 (0 to 1)", "scalar", lambda m, s: m.dolp_debiased,
            note="without what noise adds on average (Plaszczynski et al. 2014)"),
    MapKind("AoLP", "AoLP", "radians (0 to pi), counter-clockwise from the image's horizontal", "angle",
            lambda m, s: m.aolp, factor=_DEGREES, shown_unit="deg"),
    MapKind("sigma_DoLP", "sigma of DoLP", "1", "scalar", lambda m, s: m.sigma_dolp, "viridis",
            note="standard deviation by the sensor's noise"),
    MapKind("sigma_AoLP", "sigma of AoLP", "radians", "scalar", lambda m, s: m.sigma_aolp, "viridis", (0.0, 52.0),
            _DEGREES, "deg", note="standard deviation by the sensor's noise; 52 deg: nothing is known"),
    MapKind("specular_exact", "specular, exact", _OF_S0, "radiance", lambda m, s: s.specular_exact, note=_GUESSED),
    MapKind("diffuse_exact", "diffuse, exact", _OF_S0, "radiance", lambda m, s: s.diffuse_exact, note=_GUESSED),
    MapKind("specular_paper", "specular, paper", _OF_S0, "radiance", lambda m, s: s.specular_paper, note=_COARSE),
    MapKind("diffuse_paper", "diffuse, paper", _OF_S0, "radiance", lambda m, s: s.diffuse_paper, note=_COARSE),
    MapKind("normal", "normal", "unit vector, camera axes x right, y down, z forward; 0 where there is none", "normal",
            lambda m, s: s.normal, note="one of six candidates: the one nearest to facing the camera, a little upward"),
    MapKind("zenith_diffuse", "zenith if diffuse", "radians", "scalar", lambda m, s: s.zeniths[0], "viridis",
            (0.0, 90.0), _DEGREES, "deg",
            note="candidates at azimuth AoLP and AoLP + 180 deg; none above the limit of diffuse light"),
    MapKind("zenith_specular_below", "zenith if specular, below Brewster", "radians", "scalar",
            lambda m, s: s.zeniths[1], "viridis", (0.0, 90.0), _DEGREES, "deg",
            note="candidates at azimuth AoLP +- 90 deg"),
    MapKind("zenith_specular_above", "zenith if specular, above Brewster", "radians", "scalar",
            lambda m, s: s.zeniths[2], "viridis", (0.0, 90.0), _DEGREES, "deg",
            note="candidates at azimuth AoLP +- 90 deg"),
    MapKind("reason", "usable pixels", "0 usable, 1 noise, 2 dark, 3 saturated, 4 masked", "reason",
            lambda m, s: m.reason),
)  # fmt: skip
"""The maps of every shot, in the order in which they are shown."""

_OF_SETS: tuple[MapKind, ...] = (
    MapKind("residual", "residual", "standard deviations of the noise", "scalar", lambda m, s: _required(m.residual),
            "viridis", (0.0, 5.0), note="what the fit leaves of all pictures; 1 is noise alone, more is motion, "
            "clipping or a wrong angle"),
    MapKind("left_out", "samples left out", "samples", "scalar", lambda m, s: _required(m.left_out), "viridis",
            note="at full scale, or against the other pictures of the set"),
)  # fmt: skip
ALL_KINDS = (*KINDS, *_OF_SETS)
"""With those that only sets at other angles have."""


def kinds_of(maps: ShotMaps) -> tuple[MapKind, ...]:
    """The maps that a shot has."""
    there = {"residual": maps.residual is not None, "left_out": maps.left_out is not None}
    return tuple(kind for kind in ALL_KINDS if there.get(kind.key, True))


def _required(values: NDArray[Any] | None) -> NDArray[Any]:
    assert values is not None
    return values


REASON_COLORS: dict[Reason, tuple[int, int, int]] = {
    Reason.USABLE: (238, 240, 242),
    Reason.NOISE: (120, 128, 140),
    Reason.DARK: (38, 62, 130),
    Reason.SATURATED: (230, 60, 50),
    Reason.MASKED: (245, 190, 60),
}


NOTHING = (96, 100, 110)
"""Color of pixels without a measurement."""
_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_SAMPLES = 200_000
_NARROWEST = 640


@dataclass(frozen=True)
class Stretch:
    """How numbers become colors.

    Attributes:
        low, high: the numbers at both ends, in the picture's unit; a radiance is divided by ``high``.
        text: the same in words.
    """

    low: float
    high: float
    text: str


def stretch_of(kind: MapKind, values: NDArray[Any], maps: ShotMaps) -> Stretch:
    """The stretch that shows the numbers of a map: nearly all measured ones fit into it.

    Layers share the stretch of S0, so that they can be compared.
    """
    if kind.fixed is not None:
        low, high = kind.fixed
        return Stretch(low, high, f"{low:g} to {high:g} {kind.shown_unit}".strip())
    if kind.look == "radiance":
        top = _nice(_quantile(maps.s0 / 2, maps.measured))
        return Stretch(0.0, top, f"sRGB; white is S0/2 = {top:g} of full scale (x{1 / top:.3g})")
    if kind.look == "angle":
        top = _nice(_quantile(maps.dolp, maps.measured, 0.75))
        return Stretch(0.0, top, f"hue: angle; full brightness from DoLP {top:g} on")
    if kind.look == "scalar":
        top = _nice(_quantile(values, maps.measured, 0.98) * kind.factor)
        return Stretch(0.0, top, f"0 to {top:g}; 98 % of the pixels are in it")
    return Stretch(0.0, 1.0, "")


def drawn(kind: MapKind, values: NDArray[Any], maps: ShotMaps, stretch: Stretch, step: int = 1) -> Picture:
    """The map in colors, without legend, every ``step``-th pixel: uint8 RGB [H, W, 3]."""
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
        table = np.array([REASON_COLORS[code] for code in Reason], np.uint8)
        return np.asarray(table[values])
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
"""Meaning of gray pixels, by the way in which a map is drawn."""


def with_legend(picture: Picture, kind: MapKind, stretch: Stretch, title: str) -> Picture:
    """The picture with a strip below it that says what it shows."""
    width = picture.shape[1]
    if width < _NARROWEST:  # a legend that can be read is wider than a small picture
        picture = np.pad(picture, ((0, 0), (0, _NARROWEST - width), (0, 0)), constant_values=255)
        width = _NARROWEST
    scale = width / 1224
    strip: Picture = np.full((round(96 * max(scale, 0.6)), width, 3), 255, np.uint8)
    scale = max(scale, 0.6)
    mark = _mark(kind, stretch, scale)
    strip[: mark.shape[0], width - mark.shape[1] :] = mark
    room = width - mark.shape[1] - round(30 * scale)
    lines = [
        (f"{kind.label}   {title}", 0.75),
        (f"stretch: {stretch.text}" if stretch.text else kind.unit, 0.6),
    ]
    lines.append(("; ".join(filter(None, (kind.note, _GRAYS.get(kind.look)))), 0.5))
    y = 0.0
    for text, size in lines:
        y += 30 * scale
        _text(strip, text, round(14 * scale), round(y), size * scale, room)
    return np.concatenate((picture, strip))


def _mark(kind: MapKind, stretch: Stretch, scale: float) -> Picture:
    """The key of the colors: a bar, a wheel, a ball or patches, as wide as it needs."""
    high = round(96 * scale)
    if kind.look == "scalar":
        return _bar(kind, stretch, scale)
    if kind.look == "angle":
        return figures.angle_wheel(high / 113)
    if kind.look == "normal":
        return figures.normal_ball(high, round(1.2 * high))
    if kind.look == "reason":
        return _patches(high, scale)
    return np.full((high, 1, 3), 255, np.uint8)


def _bar(kind: MapKind, stretch: Stretch, scale: float) -> Picture:
    wide = round(320 * scale)
    high = round(96 * scale)
    margin = round(20 * scale)
    mark: Picture = np.full((high, wide + 2 * margin, 3), 255, np.uint8)
    ramp = torch.linspace(stretch.low, stretch.high, wide).expand(round(34 * scale), -1)
    top = round(16 * scale)
    mark[top : top + ramp.shape[0], margin : margin + wide] = figures.scalar_to_rgb(
        ramp, stretch.low, stretch.high, kind.color_map
    )
    for share in (0.0, 0.5, 1.0):
        number = stretch.low + share * (stretch.high - stretch.low)
        text = f"{number:g}" + (f" {kind.shown_unit}" if share == 1 and kind.shown_unit else "")
        (drawn_width, _), _ = cv2.getTextSize(text, FONT, 0.55 * scale, 1)
        x = round(margin + share * wide - drawn_width / 2)
        x = min(max(x, 2), mark.shape[1] - drawn_width - 2)
        _text(mark, text, x, top + ramp.shape[0] + round(24 * scale), 0.55 * scale, mark.shape[1])
    return mark


def _patches(high: int, scale: float) -> Picture:
    mark: Picture = np.full((high, round(520 * scale), 3), 255, np.uint8)
    for number, (code, color) in enumerate(REASON_COLORS.items()):
        x = round((12 + 170 * (number % 3)) * scale)
        y = round((14 + 40 * (number // 3)) * scale)
        side = round(24 * scale)
        mark[y : y + side, x : x + side] = color
        cv2.rectangle(mark, (x, y), (x + side, y + side), INK, 1)
        _text(
            mark,
            code.name.lower(),
            x + side + round(8 * scale),
            y + side - round(6 * scale),
            0.55 * scale,
            999,
        )
    return mark


def _text(picture: Picture, text: str, x: int, y: int, size: float, room: int) -> None:
    """Draw text; smaller if it has to be, in ASCII."""
    text = text.encode("ascii", "replace").decode()
    while size > 0.3 and cv2.getTextSize(text, FONT, size, 1)[0][0] > room:
        size *= 0.95
    cv2.putText(picture, text, (x, y), FONT, size, INK, max(1, round(1.4 * size)), cv2.LINE_AA)


def _quantile(values: NDArray[Any], where: NDArray[np.bool_], q: float = 0.995) -> float:
    step = max(1, math.isqrt(values.size // _SAMPLES))
    numbers = values[::step, ::step][where[::step, ::step]]
    numbers = numbers[np.isfinite(numbers)]
    return float(np.quantile(numbers, q)) if numbers.size else 1.0


def _nice(value: float) -> float:
    """The next round number, at most 1 for shares near it."""
    if not value > 1e-6:
        return 1e-3
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{next(n * power for n in _NICE if n * power >= value * 0.999):.6g}")
