"""Pictures of shots that are beyond their limits, and of differences to a golden part."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.optics.color import srgb_encode_array
from polarguide.visualization.figures import (
    FONT,
    INK,
    LINE_HEIGHT,
    Picture,
    aolp_to_rgb,
    contact_sheet,
    dolp_to_rgb,
)
from polarguide_shots.maps import Map, Reason, ShotMaps
from polarguide_shots.measurement.fields import NO_LIMITS, Bound, Limits
from polarguide_shots.measurement.regions import Differences, Region

S0_RANGE = 0.2
"""Difference of S0 with the full color, in full scales."""
DOLP_RANGE = 0.1
"""Difference of DoLP with the full color."""
AOLP_RANGE = 20.0
"""Difference of AoLP with the full color, degrees."""
_WIDEST = 1600
_NARROWEST = 640
_WITHIN = (64, 200, 64)
_BEYOND = (255, 32, 32)
_DEFECT = (255, 224, 0)
_NOT_COMPARED = 110
_BAR = 256


Beyond = Sequence[tuple[Region, Sequence[str]]]
"""Regions of a shot, and for each the limits that it is beyond, in words that begin with the field."""
_LOST = {"noise": Reason.NOISE, "dark": Reason.DARK, "saturated": Reason.SATURATED, "masked": Reason.MASKED}
"""Fields that count pixels, and the reason of these."""
_OF_NO_PIXEL = ("_error", "_deviation", "_share", "_concentration")
"""Ends of fields whose limits say nothing of a single pixel."""
_SPECKLE = 5
"""Side of the square whose majority counts as beyond: interpolation carries the noise of a sample three pixels wide."""


def regions_picture(
    maps: ShotMaps, regions: Beyond, limits: Limits = NO_LIMITS, differences: Differences | None = None
) -> Picture:
    """The layers in which a shot is beyond its limits, and its photograph, below one another, and what is beyond.

    Regions beyond their limits are red, and the pixels in them that are beyond a limit themselves are outlined.

    Args:
        maps: the shot. regions: its regions. limits: that they were compared with.
        differences: to the golden part, where limits bound them.

    Returns:
        uint8 RGB, 640 to 1600 pixels wide where the shot does not force more.
    """
    layers = _layers(maps, differences)
    failed = {field: _layer_of(field) for _, beyond in regions for field in map(_field, beyond)}
    shown = [name for name in layers if name in failed.values() and name != PHOTOGRAPH]
    parts = []
    for name in (*shown, PHOTOGRAPH):
        title, picture, values = layers[name]
        panel, scale = _enlarged(picture)
        for region, beyond in regions:
            bounds = limits.of(region.name)
            for field in map(_field, beyond):
                if failed[field] == name and field in bounds:
                    _outline(panel, _pixels_beyond(maps, values, region, field, bounds[field]))
        _boxes(panel, scale, regions)
        parts += [_strip([(f"{maps.name}: {title}", INK)], panel.shape[1]), panel]
    reasons = [(f"{region.name}: {', '.join(beyond)}", (176, 0, 0)) for region, beyond in regions if beyond]
    return np.concatenate([*parts, _strip(reasons, parts[-1].shape[1])])


PHOTOGRAPH = "photograph"


def _field(words: str) -> str:
    return words.partition(" ")[0]


def _layer_of(field: str) -> str:
    """The layer that shows a field."""
    key = field.partition("_")[0]
    if "_difference" in field:
        return f"{key}_difference"
    return key if key in ("dolp", "aolp") else PHOTOGRAPH


def _layers(maps: ShotMaps, differences: Differences | None) -> dict[str, tuple[str, Picture, Map]]:
    """Titles, pictures and values of the layers of a shot, in the units of the fields."""
    dolp, aolp = (
        torch.from_numpy(np.ascontiguousarray(values)) for values in (maps.dolp_debiased, maps.aolp)
    )
    gray = np.rint(255 * srgb_encode_array(np.clip(maps.s0 / 2, 0, 1))).astype(np.uint8)
    layers = {
        "dolp": ("DoLP, bright at 0.5", dolp_to_rgb(dolp, 0.5), maps.dolp_debiased),
        "aolp": ("AoLP as hue", aolp_to_rgb(aolp), np.degrees(maps.aolp)),
        PHOTOGRAPH: (
            "photograph (S0 / 2); red: beyond a limit, outlined: its pixels",
            np.repeat(gray[..., None], 3, axis=2),
            maps.s0,
        ),
    }
    of_part = {
        key: (
            f"{name} less the golden part's, red more (+{most:g}), blue less",
            diverging(values, most),
            values,
        )
        for key, (values, most, name) in (_difference_panels(differences) if differences else {}).items()
    }
    return {**of_part, **layers}


def _pixels_beyond(
    maps: ShotMaps, values: Map, region: Region, field: str, bound: Bound
) -> NDArray[np.bool_]:
    """Pixels of a region that are beyond a limit themselves, [H, W]; none for a limit of no single pixel."""
    beyond = np.zeros(maps.reason.shape, bool)
    low = -math.inf if bound.min is None else bound.min
    high = math.inf if bound.max is None else bound.max
    if field in _LOST:
        part = maps.reason[region.place] == _LOST[field]
    elif (_layer_of(field) == PHOTOGRAPH and not field.startswith("s0")) or field.endswith(_OF_NO_PIXEL):
        return beyond
    else:
        sizes = values[region.place]
        if "_difference_" in field:
            sizes = np.abs(sizes)
        part = (sizes < low) | (sizes > high) if low <= high else (sizes > high) & (sizes < low)
        part &= maps.measured[region.place]
    beyond[region.place] = part if region.inside is None else part & region.inside
    return beyond


def _outline(panel: Picture, mask: NDArray[np.bool_]) -> None:
    """Draw the outline of pixels; single ones among others are noise."""
    whole = cv2.medianBlur(mask.astype(np.uint8), _SPECKLE)
    large = cv2.resize(whole, panel.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    thick = max(1, round(panel.shape[1] / 500))
    cv2.drawContours(panel, outlines, -1, (0, 0, 0), 3 * thick)
    cv2.drawContours(panel, outlines, -1, _DEFECT, thick)


def _boxes(panel: Picture, scale: float, regions: Beyond) -> None:
    """Draw regions and their names: red beyond their limits, green within."""
    thick = max(1, round(panel.shape[1] / 500))
    for region, beyond in sorted(regions, key=lambda pair: bool(pair[1])):
        color = _BEYOND if beyond else _WITHIN
        size = np.array((region.width, region.height))
        corners = np.array(region.corners or ((0, 0), (1, 0), (1, 1), (0, 1)) * size)
        places = np.rint(scale * (corners + (region.x, region.y))).astype(np.int32)
        # What lies beyond the last pixel is drawn on it.
        ends = np.rint(scale * (size + (region.x, region.y))).astype(np.int32) - 1
        places = np.maximum(np.minimum(places, ends), places.min(axis=0))
        cv2.polylines(panel, [places], True, color, 2 * thick if beyond else thick)
        left, top = places.min(axis=0).tolist()
        _name(panel, region.name, left, top, color)


def _strip(lines: Sequence[tuple[str, tuple[int, int, int]]], width: int) -> Picture:
    """Lines of text on white, wrapped."""
    wrapped = [(part, color) for line, color in lines for part in _wrapped(line, width - 16)]
    strip: Picture = np.full((LINE_HEIGHT * len(wrapped) + 8, width, 3), 255, np.uint8)
    for number, (line, color) in enumerate(wrapped):
        cv2.putText(strip, line, (8, LINE_HEIGHT * (number + 1) - 6), FONT, 0.5, color, 1, cv2.LINE_AA)
    return strip


def _enlarged(picture: Picture) -> tuple[Picture, float]:
    """A picture at the width of a page, and how much larger it is; a copy, to be drawn on."""
    width = picture.shape[1]
    if width > _WIDEST:
        scale = _WIDEST / width
        smaller = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return np.asarray(smaller, np.uint8), scale
    scale = float(max(1, math.ceil(_NARROWEST / width)))
    return picture.repeat(int(scale), axis=0).repeat(int(scale), axis=1), scale


def _name(picture: Picture, name: str, x: int, y: int, color: tuple[int, int, int]) -> None:
    """A region's name beside its top-left corner, dark on its color; inside where there is no room above."""
    text = _ascii(name)
    (width, height), base = cv2.getTextSize(text, FONT, 0.5, 1)
    x = max(0, min(x, picture.shape[1] - width - 6))
    bottom = y if y >= height + base + 4 else y + height + base + 4
    cv2.rectangle(picture, (x, bottom - height - base - 4), (x + width + 6, bottom), color, -1)
    cv2.putText(picture, text, (x + 3, bottom - base - 1), FONT, 0.5, (0, 0, 0), 1, cv2.LINE_AA)


def _wrapped(line: str, width: int) -> list[str]:
    """A line in pieces that fit."""
    first, *words = _ascii(line).split(" ")
    pieces = [first]
    for word in words:
        longer = f"{pieces[-1]} {word}"
        if cv2.getTextSize(longer, FONT, 0.5, 1)[0][0] > width:
            pieces.append(f"    {word}")
        else:
            pieces[-1] = longer
    return pieces


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()


def difference_picture(differences: Differences, shot: str, reference: str) -> Picture:
    """The three differences beside one another: red more, blue less than the reference, gray not compared."""
    panels = _difference_panels(differences).values()
    return contact_sheet(
        [[diverging(values, most) for values, most, _ in panels]],
        [""],
        [f"{name}: {_short(shot)} - {_short(reference)}" for _, _, name in panels],
        footer=[_bar(most) for _, most, _ in panels],
        minimum_width=480,
        maximum_width=960,
    )


def _difference_panels(differences: Differences) -> dict[str, tuple[Map, float, str]]:
    """Values in the units of the fields, the difference with the full color, and a name, by field."""
    return {
        "s0_difference": (differences.s0, S0_RANGE, "S0"),
        "dolp_difference": (differences.dolp, DOLP_RANGE, "DoLP"),
        "aolp_difference": (np.degrees(differences.aolp), AOLP_RANGE, "AoLP, degrees"),
    }


def _short(name: str) -> str:
    return name if len(name) <= 24 else f"{name[:21]}..."


def diverging(values: Map, most: float) -> Picture:
    """Blue at ``-most``, light at 0, red at ``most``, gray where there is no number; uint8 RGB [H, W, 3]."""
    known = np.isfinite(values)
    place = np.clip(np.where(known, values, 0) / most, -1, 1)
    ramp = np.abs(place)
    picture = np.empty((*values.shape, 3), np.float32)
    picture[..., 0] = np.where(place > 0, 240 - 62 * ramp, 240 - 207 * ramp)
    picture[..., 1] = np.where(place > 0, 240 - 216 * ramp, 240 - 138 * ramp)
    picture[..., 2] = np.where(place > 0, 240 - 197 * ramp, 240 - 68 * ramp)
    picture[~known] = _NOT_COMPARED
    return np.rint(picture).astype(np.uint8)


def _bar(most: float) -> Picture:
    """The colors with their numbers below."""
    bar: Picture = np.full((44, _BAR, 3), 255, np.uint8)
    bar[:22] = diverging(np.linspace(-most, most, _BAR, dtype=np.float32)[None].repeat(22, axis=0), most)
    for text, share in ((f"-{most:g}", 0.0), ("0", 0.5), (f"+{most:g}", 1.0)):
        (width, _), _ = cv2.getTextSize(text, FONT, 0.5, 1)
        cv2.putText(bar, text, (round(share * (_BAR - width)), 39), FONT, 0.5, INK, 1, cv2.LINE_AA)
    return bar
