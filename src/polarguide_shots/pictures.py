"""The maps of a shot as pictures with a legend: what the colors mean, and how far they are stretched."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.visualization import figures
from polarguide.visualization.figures import FONT, INK, Picture
from polarguide_shots.maps import Reason, ShotMaps
from polarguide_shots.read import SurfaceMaps, tiles

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
        strength = torch.from_numpy(np.ascontiguousarray(dolp)) / stretch.high
        picture = figures.aolp_to_rgb(numbers, strength)
    elif kind.look == "normal":
        return _normal_colors(numbers)
    else:
        picture = figures.scalar_to_rgb(numbers * kind.factor, stretch.low, stretch.high, kind.color_map)
        picture[~np.isfinite(values)] = NOTHING
    picture[reason > Reason.NOISE] = NOTHING
    return picture


def _normal_colors(normals: Tensor) -> Picture:
    there = (normals != 0).any(dim=-1, keepdim=True)
    colors = torch.where(
        there, (normals * torch.tensor([1.0, -1.0, -1.0]) + 1) / 2 * 255, torch.tensor(NOTHING)
    )
    return np.asarray(torch.floor(colors + 0.5).clamp(0, 255).to(torch.uint8).numpy())


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
    grays = _grays(kind)
    lines.append(("; ".join(filter(None, (kind.note, grays))), 0.5))
    y = 0.0
    for text, size in lines:
        y += 30 * scale
        _text(strip, text, round(14 * scale), round(y), size * scale, room)
    return np.concatenate((picture, strip))


def _grays(kind: MapKind) -> str:
    if kind.look in ("scalar", "angle"):
        return "gray: dark, saturated or masked"
    return "gray: no angle (noise, dark, saturated, masked)" if kind.look == "normal" else ""


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
    thickness = max(1, round(1.4 * size))
    cv2.putText(picture, text, (x, y), FONT, size, INK, thickness, cv2.LINE_AA)


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
