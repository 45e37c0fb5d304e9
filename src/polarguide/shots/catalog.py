"""The maps of a shot as they are written and shown: name, unit, colors, and where their numbers come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polarguide.shots.maps import Reason, ShotMaps
from polarguide.shots.surface import SurfaceMaps

Look = Literal["radiance", "scalar", "angle", "normal", "reason"]
_OF_S0 = "linear radiance in units of S0 (2 is full scale of all four intensities)"


@dataclass(frozen=True)
class MapKind:
    """One map.

    Attributes:
        key: its name in files. label: for people. unit: of the numbers in files.
        look: how it is drawn. values: its numbers. color_map: of a scalar. fixed: its range, None for one that fits.
        factor: from the file's unit to that of the picture, ``shown_unit``.
        note: what to know before trusting it.
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
"""All maps, in the order in which they are shown."""

REASON_COLORS: dict[Reason, tuple[int, int, int]] = {
    Reason.USABLE: (238, 240, 242),
    Reason.NOISE: (120, 128, 140),
    Reason.DARK: (38, 62, 130),
    Reason.SATURATED: (230, 60, 50),
    Reason.MASKED: (245, 190, 60),
}
