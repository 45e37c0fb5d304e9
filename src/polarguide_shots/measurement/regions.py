"""Regions of interest, the figures of one region of one shot, and its differences to a golden part."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.layout import angle_of_folder
from polarguide.core.errors import PolarguideError
from polarguide.core.records import shortened
from polarguide_shots.exposures import find_shots
from polarguide_shots.maps import Map, Reason, ShotMaps
from polarguide_shots.measurement.fields import COMPARED, DIFFERENCE_PERCENTILE, PERCENTILES, Value
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot
from polarguide_shots.sets import ExposureSet

WHOLE = "all"
"""The region that is measured where none is given."""
_NAME = r"(?:(?P<name>[^=]*)=)?"
_FORM = re.compile(_NAME + r"(?P<numbers>-?[0-9]{1,9}(?:,-?[0-9]{1,9}){3})")
_POLYGON = re.compile(_NAME + r"(?P<corners>[0-9]{1,7},[0-9]{1,7}(?:;[0-9]{1,7},[0-9]{1,7}){2,99})")
_OUTSIDE = 255
"""In place of a ``Reason``, of pixels of a rectangle that are not of the polygon in it."""
_LONGEST_NAME = 64
_MOST = 1_000_000


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels, its top-left corner included, ``x + width`` and ``y + height`` not; or a polygon in it.

    Attributes:
        name, x, y, width, height: those of the rectangle.
        corners: corners of the polygon, relative to the rectangle's top-left corner; none: the rectangle itself.
    """

    name: str
    x: int
    y: int
    width: int
    height: int
    corners: tuple[tuple[int, int], ...] = ()

    @property
    def inside(self) -> NDArray[np.bool_] | None:
        """Pixels of the rectangle whose centers lie in the polygon, [height, width]; None: all."""
        return _filled(self.corners, self.width, self.height) if self.corners else None

    @property
    def place(self) -> tuple[slice, slice]:
        """Its rows and columns."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


@lru_cache(maxsize=64)
def _filled(corners: tuple[tuple[int, int], ...], width: int, height: int) -> NDArray[np.bool_]:
    """Pixels with an odd number of edges of a polygon to their right, [height, width]; not to be written to."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    inside = np.zeros((height, width), bool)
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if y0 != y1:
            inside ^= ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def parse_regions(texts: Sequence[str]) -> tuple[Region, ...]:
    """Regions as the command line states them: ``x,y,width,height``, or the corners ``x,y;x,y;x,y`` of a polygon; each
    with ``name=`` before it.

    Those without a name are called roi1, roi2, ... by their place among all.

    Raises:
        PolarguideError: one has another form or no pixel, or two have one name.
    """
    regions: dict[str, Region] = {}
    for number, text in enumerate(texts, 1):
        region = _parse(text, number)
        if region.name in regions:
            raise PolarguideError(
                "--roi",
                expected="one region of each name",
                found=f"{region.name} twice",
                remedy="Rename one of them.",
            )
        regions[region.name] = region
    return tuple(regions.values())


def _parse(text: str, number: int) -> Region:
    match = _FORM.fullmatch(text.strip()) or _POLYGON.fullmatch(text.strip())
    if match is None:
        expected = "x,y,width,height, or corners x,y;x,y;x,y, in whole pixels, also as name=..."
        raise _wrong(expected, shortened(text))
    name = f"roi{number}" if match["name"] is None else match["name"].strip()
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise _wrong(f"a name of 1 to {_LONGEST_NAME} printable characters", repr(name))
    if match.re is _POLYGON:
        return _polygon(name, [tuple(map(int, p.split(","))) for p in match["corners"].split(";")], text)
    x, y, width, height = (int(part) for part in match["numbers"].split(","))
    if min(x, y) < 0 or min(width, height) < 1 or max(x, y, width, height) > _MOST:
        raise _wrong("x and y of 0 or more, width and height of 1 or more", repr(text))
    return Region(name, x, y, width, height)


def _polygon(name: str, corners: Sequence[tuple[int, ...]], text: str) -> Region:
    """A polygon of corners (x, y) in pixels of the maps."""
    left, top = np.min(corners, axis=0).tolist()
    width, height = np.ptp(corners, axis=0).tolist()
    region = Region(name, left, top, width, height, tuple((x - left, y - top) for x, y in corners))
    if max(left + width, top + height) > _MOST or min(width, height) < 1 or not np.any(region.inside):
        raise _wrong("corners around at least one pixel", repr(text))
    return region


def _wrong(expected: str, found: str) -> PolarguideError:
    return PolarguideError(
        "--roi",
        expected=expected,
        found=found if len(found) <= 100 else f"{found[:100]}...",
        remedy="Write a region as --roi NAME=X,Y,WIDTH,HEIGHT, in pixels.",
    )


def placed(regions: Sequence[Region], size: tuple[int, int], where: Path | str) -> tuple[Region, ...]:
    """The regions of a picture of this width and height; the whole picture where there are none.

    Raises:
        PolarguideError: one reaches beyond the picture.
    """
    width, height = size
    for region in regions:
        if region.x + region.width > width or region.y + region.height > height:
            raise PolarguideError(
                where,
                expected=f"the region {region.name} within {width}x{height} pixels",
                found=f"{region.x},{region.y},{region.width},{region.height}",
                remedy="Make the region smaller, or move it; --roi counts pixels of the developed picture.",
            )
    return tuple(regions) or (Region(WHOLE, 0, 0, width, height),)


def box_of(regions: Sequence[Region]) -> tuple[int, int, int, int] | None:
    """The smallest rectangle around regions: x, y, width, height; None where there are none."""
    if not regions:
        return None
    left = min(r.x for r in regions)
    top = min(r.y for r in regions)
    width = max(r.x + r.width for r in regions) - left
    return left, top, width, max(r.y + r.height for r in regions) - top


Floats = NDArray[np.floating[Any]]


def region_figures(maps: ShotMaps, region: Region, threshold: float) -> dict[str, Value]:
    """Counts, S0, DoLP and AoLP of a region; None where it has no pixel to take a figure from.

    Means and standard deviations (over n, not n - 1) are computed in float64. AoLP is axial: with doubled angles,
    C = mean cos 2a and S = mean sin 2a over usable pixels, R = sqrt(C^2 + S^2), the mean is atan2(S, C) / 2, the
    standard deviation sqrt(-2 ln R) / 2 (Mardia and Jupp 2000, "Directional Statistics"). Standard errors of the
    means are those of the sensor's noise alone, of pixels that share samples where they were interpolated.

    Args:
        maps: the shot. region: within its size.
        threshold: DoLP over which pixels count in ``dolp_share``.

    Returns:
        By ``Field.key``, ``pixels`` to ``aolp_concentration``; angles in degrees.
    """
    at = region.place
    reason = maps.reason[at]
    inside = region.inside
    if inside is not None:
        reason = np.where(inside, reason, np.uint8(_OUTSIDE))
    counts = [int(np.count_nonzero(reason == kind)) for kind in Reason]
    total = reason.size if inside is None else int(inside.sum())
    measured = reason <= Reason.NOISE
    usable = reason == Reason.USABLE
    dolp = _chosen(maps.dolp_debiased[at], measured)
    s0 = _chosen(maps.s0[at], measured)
    noise_of_s0 = None
    if maps.mean_variance is not None and s0.size:
        variance = maps.noise.floor + maps.noise.slope * max(float(s0.mean(dtype=np.float64)) / 2, 0.0)
        noise_of_s0 = math.sqrt(maps.mean_variance * variance / s0.size)
    return {
        "pixels": total,
        "usable": counts[Reason.USABLE],
        "noise": counts[Reason.NOISE],
        "dark": counts[Reason.DARK],
        "saturated": counts[Reason.SATURATED],
        "masked": counts[Reason.MASKED],
        "usable_share": counts[Reason.USABLE] / total,
        **_distribution("s0", s0, noise_of_s0),
        **_distribution("dolp", dolp, _error_of_mean(maps, _chosen(maps.sigma_dolp[at], measured))),
        "dolp_threshold": threshold,
        "dolp_share": float(np.count_nonzero(dolp > threshold)) / dolp.size if dolp.size else None,
        **_angles(_chosen(maps.aolp[at], usable), _error_of_mean(maps, _chosen(maps.sigma_aolp[at], usable))),
    }


def _chosen(values: Floats, mask: NDArray[np.bool_]) -> Floats:
    return values.ravel() if mask.all() else values[mask]


def _error_of_mean(maps: ShotMaps, deviations: Floats) -> float | None:
    """Standard error of a mean over pixels of these standard deviations, which share samples; None without any."""
    if not deviations.size:
        return None
    shared = 1.0 if maps.mean_variance is None else maps.mean_variance / maps.pixel_variance
    error = math.sqrt(shared * float(np.square(deviations, dtype=np.float64).mean()) / deviations.size)
    return error if math.isfinite(error) else None


def _distribution(key: str, values: Floats, error: float | None) -> dict[str, Value]:
    names = (f"{key}_mean", f"{key}_error", f"{key}_deviation", *(f"{key}_p{p}" for p in PERCENTILES))
    if not values.size:
        return dict.fromkeys(names)
    mean, deviation = (float(moment[0, 0]) for moment in cv2.meanStdDev(values))  # one pass, in float64
    percentiles = map(float, np.percentile(values, PERCENTILES))
    return dict(zip(names, (mean, error, deviation, *percentiles), strict=True))


def _angles(aolp: Floats, error: float | None) -> dict[str, Value]:
    if not aolp.size:
        return dict.fromkeys(("aolp_mean", "aolp_error", "aolp_deviation", "aolp_concentration"))
    mean, length = axial_mean(aolp)
    degrees = math.degrees(mean) % 180.0
    return {
        "aolp_mean": 0.0 if degrees == 180.0 else degrees,  # what is just below 0 is rounded to 180
        "aolp_error": None if error is None else math.degrees(error),
        "aolp_deviation": math.degrees(math.sqrt(-2 * math.log(max(length, 1e-300)))) / 2,
        "aolp_concentration": length,
    }


def axial_mean(angles: Floats) -> tuple[float, float]:
    """Circular mean of angles modulo pi, in [-pi/2, pi/2], and the mean resultant length of the doubled ones."""
    doubled = 2 * angles
    cosine = np.cos(doubled).mean(dtype=np.float64)
    sine = np.sin(doubled).mean(dtype=np.float64)
    return math.atan2(sine, cosine) / 2, min(1.0, math.hypot(cosine, sine))


Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Differences:
    """A shot less the reference; nothing is registered: one camera, one place.

    Attributes:
        s0, dolp: [H, W]; NaN where either has none. The DoLP is the debiased one.
        aolp: [H, W] radians in [-pi/2, pi/2]; NaN where a pixel is not usable in both.
    """

    s0: Map
    dolp: Map
    aolp: Map


class Reference:
    """The golden part. Keeps the maps that are compared, and no more."""

    def __init__(self, shot: ExposureSet, maps: ShotMaps) -> None:
        self.shot = shot
        self.name = maps.name
        self.size = maps.size
        self._s0 = maps.s0.copy()
        self._dolp = maps.dolp_debiased
        self._aolp = maps.aolp
        self._measured = maps.measured
        self._usable = maps.usable

    @classmethod
    def read(cls, path: Path, options: ShotOptions) -> Reference:
        """Read a reference.

        Args:
            path: of a mosaic, of one of four shots through a filter (the others lie beside it), or of a folder with
                one shot.
            options: as for the shots that it is compared with.

        Raises:
            PolarguideError: the path is not one shot, or cannot be read.
        """
        shot = _reference_shot(path, options)
        return cls(shot, read_shot(shot, options))

    def differences(self, maps: ShotMaps) -> Differences:
        """The maps of a shot less those of the reference.

        Raises:
            PolarguideError: the sizes differ.
        """
        if maps.size != self.size:
            raise PolarguideError(
                maps.files[0] if maps.files else maps.name,
                expected=f"{self.size[0]}x{self.size[1]} pixels like the reference {self.name}",
                found=f"{maps.size[0]}x{maps.size[1]}",
                remedy="Take both with one camera and one region, and develop them alike.",
            )
        both = maps.measured & self._measured
        angles = maps.usable & self._usable
        turned = np.remainder(maps.aolp - self._aolp + math.pi / 2, math.pi) - math.pi / 2
        return Differences(
            _where(both, maps.s0 - self._s0),
            _where(both, maps.dolp_debiased - self._dolp),
            _where(angles, turned),
        )


def _where(mask: Mask, values: Map) -> Map:
    return np.where(mask, values, np.float32(np.nan)).astype(np.float32, copy=False)


def _reference_shot(path: Path, options: ShotOptions) -> ExposureSet:
    if path.is_file() and options.sensor is None:
        same = path.resolve()
        folder = same.parent if angle_of_folder(same.parent) is None else same.parent.parent
        beside = find_shots([folder], options)
        found = [shot for shot in beside if any(file.resolve() == same for file in shot.paths)]
    else:
        found = find_shots([path], options)
    if len(found) != 1:
        raise PolarguideError(
            "--reference",
            expected="one shot",
            found=f"{len(found)} in {path}",
            remedy="Name its file; one of the four where they are four.",
        )
    return found[0]


def difference_figures(differences: Differences | None, region: Region) -> dict[str, Value]:
    """Figures of the differences in a region, ``compared`` and the fields after it; None without a reference."""
    if differences is None:
        return dict.fromkeys(COMPARED)
    inside = region.inside
    s0, dolp, aolp = (
        values[region.place][np.isfinite(values[region.place]) & (True if inside is None else inside)]
        for values in (differences.s0, differences.dolp, differences.aolp)
    )
    figures: dict[str, Value] = {
        **dict.fromkeys(COMPARED),
        "compared": int(s0.size),
        "compared_angles": int(aolp.size),
    }
    for key, values in (("s0", s0), ("dolp", dolp), ("aolp", np.degrees(aolp))):
        if values.size:
            mean = (
                math.degrees(axial_mean(aolp)[0]) if key == "aolp" else float(values.mean(dtype=np.float64))
            )
            largest = float(np.percentile(np.abs(values), DIFFERENCE_PERCENTILE))
            figures[f"{key}_difference"] = mean
            figures[f"{key}_difference_rms"] = float(np.sqrt(np.mean(values.astype(np.float64) ** 2)))
            figures[f"{key}_difference_p{DIFFERENCE_PERCENTILE}"] = largest
    return figures
