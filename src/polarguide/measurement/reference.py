"""A golden part: the same quantities of a shot and of a reference, pixel by pixel."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.layout import angle_of_folder
from polarguide.errors import PolarguideError
from polarguide.measurement.fields import COMPARED, DIFFERENCE_PERCENTILE
from polarguide.measurement.region_figures import Value, axial_mean
from polarguide.measurement.regions import Region
from polarguide.shots.exposures import ExposureSet, find_shots
from polarguide.shots.maps import Map, ShotMaps
from polarguide.shots.options import ShotOptions
from polarguide.shots.read import read_shot

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
                maps.files[0],
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
