"""Regions of interest, the figures of one region of one shot, and its differences to a golden part."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.layout import angle_of_folder
from polarguide.core.errors import PolarguideError
from polarguide.core.records import shortened
from polarguide.shots.exposures import ExposureSet, find_shots
from polarguide.shots.maps import Map, Reason, ShotMaps
from polarguide.shots.measurement.fields import COMPARED, DIFFERENCE_PERCENTILE, PERCENTILES, Value
from polarguide.shots.options import ShotOptions
from polarguide.shots.read import read_shot

WHOLE = "all"
"""The region that is measured where none is given."""
_FORM = re.compile(r"(?:(?P<name>[^=]*)=)?(?P<numbers>-?[0-9]{1,9}(?:,-?[0-9]{1,9}){3})")
_LONGEST_NAME = 64
_MOST = 1_000_000


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels, its top-left corner included, ``x + width`` and ``y + height`` not."""

    name: str
    x: int
    y: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """Its rows."""
        return slice(self.y, self.y + self.height)

    @property
    def columns(self) -> slice:
        """Its columns."""
        return slice(self.x, self.x + self.width)


def parse_regions(texts: Sequence[str]) -> tuple[Region, ...]:
    """Regions as the command line states them: ``x,y,width,height`` or ``name=x,y,width,height``.

    Those without a name are called roi1, roi2, ... by their place among all.

    Raises:
        PolarguideError: one has another form or no pixel, or two have one name.
    """
    found: dict[str, Region] = {}
    for number, text in enumerate(texts, 1):
        region = _parse(text, number)
        if region.name in found:
            raise PolarguideError(
                "--roi",
                expected="one region of each name",
                found=f"{region.name} twice",
                remedy="Rename one of them.",
            )
        found[region.name] = region
    return tuple(found.values())


def _parse(text: str, number: int) -> Region:
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise _wrong("x,y,width,height or name=x,y,width,height in whole pixels", shortened(text))
    name = f"roi{number}" if match["name"] is None else match["name"].strip()
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise _wrong(f"a name of 1 to {_LONGEST_NAME} printable characters", repr(name))
    x, y, width, height = (int(part) for part in match["numbers"].split(","))
    if min(x, y) < 0 or min(width, height) < 1 or max(x, y, width, height) > _MOST:
        raise _wrong("x and y of 0 or more, width and height of 1 or more", repr(text))
    return Region(name, x, y, width, height)


def _wrong(expected: str, found: str) -> PolarguideError:
    return PolarguideError(
        "--roi",
        expected=expected,
        found=found if len(found) <= 100 else f"{found[:100]}...",
        remedy="Correct the region.",
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
                remedy="Correct --roi; it counts pixels of the developed picture.",
            )
    return tuple(regions) or (Region(WHOLE, 0, 0, width, height),)


Floats = NDArray[np.floating[Any]]


def region_figures(maps: ShotMaps, region: Region, threshold: float) -> dict[str, Value]:
    """Counts, S0, DoLP and AoLP of a region; None where it has no pixel to take a figure from.

    Means and standard deviations (over n, not n - 1) are computed in float64. AoLP is axial: with doubled angles,
    C = mean cos 2a and S = mean sin 2a over usable pixels, R = sqrt(C^2 + S^2), the mean is atan2(S, C) / 2, the
    standard deviation sqrt(-2 ln R) / 2 (Mardia and Jupp 2000, "Directional Statistics").

    Args:
        maps: the shot. region: within its size.
        threshold: DoLP over which pixels count in ``dolp_share``.

    Returns:
        By ``Field.key``, ``pixels`` to ``aolp_concentration``; angles in degrees.
    """
    at = region.rows, region.columns
    reason = maps.reason[at]
    counts = [int(np.count_nonzero(reason == kind)) for kind in Reason]
    total = reason.size
    measured, usable = reason <= Reason.NOISE, reason == Reason.USABLE
    dolp = _chosen(maps.dolp_debiased[at], measured)
    return {
        "pixels": total,
        "usable": counts[Reason.USABLE],
        "noise": counts[Reason.NOISE],
        "dark": counts[Reason.DARK],
        "saturated": counts[Reason.SATURATED],
        "masked": counts[Reason.MASKED],
        "usable_share": counts[Reason.USABLE] / total,
        **_distribution("s0", _chosen(maps.s0[at], measured)),
        **_distribution("dolp", dolp),
        "dolp_threshold": threshold,
        "dolp_share": float(np.count_nonzero(dolp > threshold)) / dolp.size if dolp.size else None,
        **_angles(_chosen(maps.aolp[at], usable)),
    }


def _chosen(values: Floats, mask: NDArray[np.bool_]) -> Floats:
    return values.ravel() if mask.all() else values[mask]


def _distribution(key: str, values: Floats) -> dict[str, Value]:
    names = (f"{key}_mean", f"{key}_deviation", *(f"{key}_p{p}" for p in PERCENTILES))
    if not values.size:
        return dict.fromkeys(names)
    mean, deviation = (float(found[0, 0]) for found in cv2.meanStdDev(values))  # one pass, in float64
    return dict(zip(names, (mean, deviation, *map(float, np.percentile(values, PERCENTILES))), strict=True))


def _angles(aolp: Floats) -> dict[str, Value]:
    if not aolp.size:
        return dict.fromkeys(("aolp_mean", "aolp_deviation", "aolp_concentration"))
    mean, length = axial_mean(aolp)
    degrees = math.degrees(mean) % 180.0
    return {
        "aolp_mean": 0.0 if degrees == 180.0 else degrees,  # what is just below 0 is rounded to 180
        "aolp_deviation": math.degrees(math.sqrt(-2 * math.log(max(length, 1e-300)))) / 2,
        "aolp_concentration": length,
    }


def axial_mean(angles: Floats) -> tuple[float, float]:
    """Circular mean of angles modulo pi, in [-pi/2, pi/2], and the mean resultant length of the doubled ones."""
    doubled = 2 * angles
    cosine, sine = np.cos(doubled).mean(dtype=np.float64), np.sin(doubled).mean(dtype=np.float64)
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
        self._s0, self._dolp, self._aolp = maps.s0.copy(), maps.dolp_debiased, maps.aolp
        self._measured, self._usable = maps.measured, maps.usable

    @classmethod
    def read(cls, path: Path, options: ShotOptions) -> Reference:
        """Read a reference.

        Args:
            path: of a mosaic, of one of four shots through a filter (the others lie beside it), or of a folder with
                one shot.
            options: as for the shots that it is compared with.

        Raises:
            PolarguideError: it is not one shot, or cannot be read.
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
        both, angles = maps.measured & self._measured, maps.usable & self._usable
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
    return dict(_figures(differences, region))


def _figures(differences: Differences, region: Region) -> Iterator[tuple[str, Value]]:
    at = region.rows, region.columns
    s0, dolp, aolp = (
        values[np.isfinite(values)]
        for values in (differences.s0[at], differences.dolp[at], differences.aolp[at])
    )
    yield "compared", int(s0.size)
    yield "compared_angles", int(aolp.size)
    for key, values in (("s0", s0), ("dolp", dolp), ("aolp", np.degrees(aolp))):
        if not values.size:
            yield from ((f"{key}{name}", None) for name in _NAMES)
            continue
        mean = math.degrees(axial_mean(aolp)[0]) if key == "aolp" else float(values.mean(dtype=np.float64))
        yield f"{key}{_NAMES[0]}", mean
        yield f"{key}{_NAMES[1]}", float(np.sqrt(np.mean(values.astype(np.float64) ** 2)))
        yield f"{key}{_NAMES[2]}", float(np.percentile(np.abs(values), DIFFERENCE_PERCENTILE))


_NAMES = ("_difference", "_difference_rms", f"_difference_p{DIFFERENCE_PERCENTILE}")
