"""Measure regions of interest in a shot, and compare them with a reference part."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.layout import angle_of_folder
from polarguide.core.errors import PolarguideError, require
from polarguide.core.records import shortened
from polarguide_shots.exposures import find_shots
from polarguide_shots.maps import Map, Part, Reason, ShotMaps
from polarguide_shots.measurement.table import COMPARED, DIFFERENCE_PERCENTILE, PERCENTILES, Value
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot

WHOLE = "all"
"""Name of the default region, which is the whole picture."""
_NAME = r"(?:(?P<name>[^=]*)=)?"
_FORM = re.compile(_NAME + r"(?P<numbers>-?[0-9]{1,9}(?:,-?[0-9]{1,9}){3})")
_POLYGON = re.compile(_NAME + r"(?P<corners>[0-9]{1,7},[0-9]{1,7}(?:;[0-9]{1,7},[0-9]{1,7}){2,99})")
_OUTSIDE = 255
"""Placeholder in a map of reasons for pixels outside of the polygon of a region."""
_LONGEST_NAME = 64
_MOST = 1_000_000


@dataclass(frozen=True)
class Region:
    """A region of interest: a rectangle of pixels, or a polygon inside of it.

    Attributes:
        name: name of the region.
        x: left column of the rectangle.
        y: top row of the rectangle.
        width: width of the rectangle.
        height: height of the rectangle.
        corners: corners of the polygon relative to the rectangle's top-left corner; empty for a rectangle.
    """

    name: str
    x: int
    y: int
    width: int
    height: int
    corners: tuple[tuple[int, int], ...] = ()

    @property
    def inside(self) -> NDArray[np.bool_] | None:
        """Mask [height, width] of the pixels whose centers are in the polygon. None if the region is a rectangle."""
        return _filled(self.corners, self.width, self.height) if self.corners else None

    @property
    def place(self) -> tuple[slice, slice]:
        """Slices of the rows and columns of the rectangle."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


@lru_cache(maxsize=64)
def _filled(corners: tuple[tuple[int, int], ...], width: int, height: int) -> NDArray[np.bool_]:
    """Return a mask [height, width] of the pixels inside a polygon.

    A pixel is inside if an odd number of edges is to its right. The mask is cached and must not be modified.
    """
    y, x = np.mgrid[0:height, 0:width] + 0.5
    inside = np.zeros((height, width), bool)
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if y0 != y1:
            inside ^= ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def parse_regions(texts: Sequence[str]) -> tuple[Region, ...]:
    """Parse regions ``x,y,width,height``, or polygons ``x,y;x,y;x,y``. A prefix ``name=`` is optional.

    Regions without a name are called roi1, roi2, ... by their position.

    Raises:
        PolarguideError: a text is invalid, a region has no pixel, or two regions have the same name.
    """
    regions: dict[str, Region] = {}
    for number, text in enumerate(texts, 1):
        region = _parse(text, number)
        require(
            region.name not in regions,
            "--roi",
            expected="one region of each name",
            found=f"{region.name} twice",
            remedy="Rename one of them.",
        )
        regions[region.name] = region
    return tuple(regions.values())


def _parse(text: str, number: int) -> Region:
    """Parse one region. ``number`` is its position in the list, which names it if it has no name.

    Raises:
        PolarguideError: the text is invalid, or the region has no pixel.
    """
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
    """Create a polygon with corners (x, y) in pixels of the maps.

    Raises:
        PolarguideError: the polygon has no pixel.
    """
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
    """Return the regions of a picture. If no regions are requested, return one region for the whole picture.

    Args:
        regions: the requested regions.
        size: width and height of the picture.
        where: the shot, for messages.

    Raises:
        PolarguideError: a region exceeds the picture.
    """
    width, height = size
    for region in regions:
        require(
            region.x + region.width <= width and region.y + region.height <= height,
            where,
            expected=f"the region {region.name} within {width}x{height} pixels",
            found=f"{region.x},{region.y},{region.width},{region.height}",
            remedy="Make the region smaller, or move it; --roi counts pixels of the developed picture.",
        )
    return tuple(regions) or (Region(WHOLE, 0, 0, width, height),)


def box_of(regions: Sequence[Region]) -> Part | None:
    """Return the smallest rectangle that contains all regions, or None if there are no regions."""
    if not regions:
        return None
    left, top = np.min([(r.x, r.y) for r in regions], axis=0).tolist()
    right, bottom = np.max([(r.x + r.width, r.y + r.height) for r in regions], axis=0).tolist()
    return left, top, right - left, bottom - top


Floats = NDArray[np.floating[Any]]


def region_figures(maps: ShotMaps, region: Region, threshold: float) -> dict[str, Value]:
    """Compute statistics of S0, DoLP and AoLP in a region, and numbers of its pixels.

    Means and standard deviations (over n, not n - 1) are computed in float64. AoLP is axial. Let C = mean cos 2a and S
    = mean sin 2a over usable pixels, and R = sqrt(C^2 + S^2). The mean is atan2(S, C) / 2, and the standard deviation
    is sqrt(-2 ln R) / 2 (Mardia and Jupp 2000, "Directional Statistics"). Standard errors of means contain only the
    noise of the sensor. They take into account that interpolated pixels share samples.

    Args:
        maps: maps of the shot.
        region: region inside the maps.
        threshold: DoLP above which pixels count in ``dolp_share``.

    Returns:
        Values by ``Field.key``, from ``pixels`` to ``aolp_concentration``, with angles in degrees. Values that cannot
        be computed, because no pixel is usable, become None.
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
        **{kind.name.lower(): counts[kind] for kind in Reason},
        "usable_share": counts[Reason.USABLE] / total,
        **_distribution("s0", s0, noise_of_s0),
        **_distribution("dolp", dolp, _error_of_mean(maps, _chosen(maps.sigma_dolp[at], measured))),
        "dolp_threshold": threshold,
        "dolp_share": float(np.count_nonzero(dolp > threshold)) / dolp.size if dolp.size else None,
        **_angles(_chosen(maps.aolp[at], usable), _error_of_mean(maps, _chosen(maps.sigma_aolp[at], usable))),
    }


def _chosen(values: Floats, mask: NDArray[np.bool_]) -> Floats:
    """Return the values inside a mask. If the mask is full, no copy is made."""
    return values.ravel() if mask.all() else values[mask]


def _error_of_mean(maps: ShotMaps, deviations: Floats) -> float | None:
    """Return the standard error of a mean over pixels, given the standard deviation of each pixel.

    Return None if there are no pixels.
    """
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
    return dict(
        zip(names, (mean, error, deviation, *map(float, np.percentile(values, PERCENTILES))), strict=True)
    )


def _angles(aolp: Floats, error: float | None) -> dict[str, Value]:
    if not aolp.size:
        return dict.fromkeys(("aolp_mean", "aolp_error", "aolp_deviation", "aolp_concentration"))
    mean, length = axial_mean(aolp)
    degrees = math.degrees(mean) % 180.0
    return {
        "aolp_mean": 0.0 if degrees == 180.0 else degrees,  # % rounds tiny negative angles to 180
        "aolp_error": None if error is None else math.degrees(error),
        "aolp_deviation": math.degrees(math.sqrt(-2 * math.log(max(length, 1e-300)))) / 2,
        "aolp_concentration": length,
    }


def axial_mean(angles: Floats) -> tuple[float, float]:
    """Return the circular mean of angles modulo pi, and the concentration of the angles.

    The mean is in [-pi/2, pi/2]. The concentration is the resultant length of the doubled angles, in [0, 1].
    """
    doubled = 2 * angles
    cosine = np.cos(doubled).mean(dtype=np.float64)
    sine = np.sin(doubled).mean(dtype=np.float64)
    return math.atan2(sine, cosine) / 2, min(1.0, math.hypot(cosine, sine))


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences between the maps of a shot and of the reference, pixel by pixel, without registration.

    Attributes:
        s0: [H, W] difference of S0. NaN if the pixel is not measured in both shots.
        dolp: [H, W] difference of the debiased DoLP. NaN if the pixel is not measured in both shots.
        aolp: [H, W] difference of AoLP, radians in [-pi/2, pi/2]. NaN if the pixel is not usable in both shots.
    """

    s0: Map
    dolp: Map
    aolp: Map


def subtract(maps: ShotMaps, golden: ShotMaps) -> Differences:
    """Subtract the maps of the reference part from the maps of a shot.

    Raises:
        PolarguideError: the sizes differ.
    """
    require(
        maps.size == golden.size,
        maps.files[0] if maps.files else maps.name,
        expected=f"{golden.size[0]}x{golden.size[1]} pixels like the reference {golden.name}",
        found=f"{maps.size[0]}x{maps.size[1]}",
        remedy="Take both shots with the same camera and region, and develop them with the same options.",
    )
    reason = np.maximum(maps.reason, golden.reason)
    angle = np.remainder(maps.aolp - golden.aolp + math.pi / 2, math.pi) - math.pi / 2
    nan = np.float32(np.nan)
    return Differences(
        np.where(reason <= Reason.NOISE, maps.s0 - golden.s0, nan),
        np.where(reason <= Reason.NOISE, maps.dolp_debiased - golden.dolp_debiased, nan),
        np.where(reason == Reason.USABLE, angle, nan),
    )


def read_reference(path: Path, options: ShotOptions) -> ShotMaps:
    """Read the maps of a reference part. Its intensities are not kept.

    Args:
        path: path of a mosaic, of one of four shots through a filter, or of a folder with one shot.
        options: options of the shots.

    Raises:
        PolarguideError: the path does not contain exactly one shot, or it cannot be read.
    """
    if path.is_file() and options.sensor is None:
        file = path.resolve()
        folder = file.parent if angle_of_folder(file.parent) is None else file.parent.parent
        shots = [shot for shot in find_shots([folder], options) if file in map(Path.resolve, shot.paths)]
    else:
        shots = find_shots([path], options)
    require(
        len(shots) == 1,
        "--reference",
        expected="one shot",
        found=f"{len(shots)} in {path}",
        remedy="Specify one file of the shot.",
    )
    maps = read_shot(shots[0], options)
    return replace(maps, intensities=maps.intensities[:, :0].copy())


def difference_figures(differences: Differences | None, region: Region) -> dict[str, Value]:
    """Return statistics of the differences in a region by ``Field.key``. The first key is ``compared``.

    Without a reference, each value equals None.
    """
    figures: dict[str, Value] = dict.fromkeys(COMPARED)
    if differences is None:
        return figures
    inside = region.inside
    s0, dolp, aolp = (
        values[region.place][np.isfinite(values[region.place]) & (True if inside is None else inside)]
        for values in (differences.s0, differences.dolp, differences.aolp)
    )
    figures |= {"compared": int(s0.size), "compared_angles": int(aolp.size)}
    for key, values in (("s0", s0), ("dolp", dolp), ("aolp", np.degrees(aolp))):
        if values.size:
            axial = key == "aolp"
            mean = math.degrees(axial_mean(aolp)[0]) if axial else float(values.mean(dtype=np.float64))
            largest = float(np.percentile(np.abs(values), DIFFERENCE_PERCENTILE))
            figures[f"{key}_difference"] = mean
            figures[f"{key}_difference_rms"] = float(np.sqrt(np.mean(values.astype(np.float64) ** 2)))
            figures[f"{key}_difference_p{DIFFERENCE_PERCENTILE}"] = largest
    return figures
