"""Draw shots that exceed a limit, and the differences from a reference part."""

from __future__ import annotations

import math
import textwrap
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
    color_bar,
    contact_sheet,
    dolp_to_rgb,
)
from polarguide_shots.maps import Map, Reason, ShotMaps
from polarguide_shots.measurement.regions import Differences, Region
from polarguide_shots.measurement.table import NO_LIMITS, Bound, Limits

S0_RANGE = 0.2
"""Difference of S0 that gets the most saturated color, as a share of full scale."""
DOLP_RANGE = 0.1
"""Difference of DoLP that gets the most saturated color."""
AOLP_RANGE = 20.0
"""Difference of AoLP that gets the most saturated color, in degrees."""
_WIDEST = 1600
_NARROWEST = 640
_WITHIN = (64, 200, 64)
_BEYOND = (255, 32, 32)
_DEFECT = (255, 224, 0)
_NOT_COMPARED = 110
_CHARACTER = 9
"""Assumed width of a character in wrapped text, in pixels. Most texts are narrower."""
Beyond = Sequence[tuple[Region, Sequence[str]]]
"""Type of a list of regions, each with texts on its exceeded limits. A text starts with the name of the field."""
_LOST = {reason.name.lower(): reason for reason in Reason if reason != Reason.USABLE}
"""Reasons by the names of the table fields that count pixels with these reasons."""
_OF_NO_PIXEL = ("_error", "_deviation", "_share", "_concentration")
"""Endings of the names of fields whose limits apply to regions, not to single pixels."""
_SPECKLE = 5
"""Side of the median filter that removes speckle from outlines. Interpolation spreads noise over three pixels."""


def regions_picture(
    maps: ShotMaps, regions: Beyond, limits: Limits = NO_LIMITS, differences: Differences | None = None
) -> Picture:
    """Draw a shot that exceeds a limit: its photograph, the affected maps, and a text with the exceeded limits.

    Regions that exceed a limit are red. Pixels in them that exceed the limit are outlined.

    Args:
        maps: maps of the shot.
        regions: regions of the shot with their exceeded limits.
        limits: limits of the regions.
        differences: differences from the reference part, or None.

    Returns:
        uint8 RGB. The picture is 640 to 1600 pixels wide, except for shots of extreme sizes.
    """
    layers = _layers(maps, differences)
    exceeded = [(region, text.partition(" ")[0]) for region, beyond in regions for text in beyond]
    names = {_layer_of(field) for _, field in exceeded} | {PHOTOGRAPH}
    parts = []
    for name in (name for name in layers if name in names):
        title, picture, values = layers[name]
        panel, scale = _enlarged(picture)
        for region, field in exceeded:
            bound = limits.of(region.name).get(field)
            if _layer_of(field) == name and bound is not None:
                _outline(panel, _pixels_beyond(maps, values, region, field, bound))
        _boxes(panel, scale, regions)
        parts += [_strip([f"{maps.name}: {title}"], INK, panel.shape[1]), panel]
    reasons = [f"{region.name}: {', '.join(beyond)}" for region, beyond in regions if beyond]
    return np.concatenate([*parts, _strip(reasons, (176, 0, 0), parts[-1].shape[1])])


PHOTOGRAPH = "photograph"
"""Name of the panel with the photograph, which is the last one."""


def _layer_of(field: str) -> str:
    """Return the name of the panel that shows a field of the table."""
    key = field.partition("_")[0]
    if "_difference" in field:
        return f"{key}_difference"
    return key if key in ("dolp", "aolp") else PHOTOGRAPH


def _layers(maps: ShotMaps, differences: Differences | None) -> dict[str, tuple[str, Picture, Map]]:
    """Return the panels of a shot by name: for each its title, its picture, and its values in the unit of the field."""
    dolp, aolp = (
        torch.from_numpy(np.ascontiguousarray(values)) for values in (maps.dolp_debiased, maps.aolp)
    )
    gray = np.rint(255 * srgb_encode_array(np.clip(maps.s0 / 2, 0, 1))).astype(np.uint8)
    panels = {} if differences is None else _difference_panels(differences)
    return {
        **{
            key: (
                f"{name}, difference to the golden part: red above (+{most:g}), blue below",
                diverging(values, most),
                values,
            )
            for key, (values, most, name) in panels.items()
        },
        "dolp": ("DoLP, bright at 0.5", dolp_to_rgb(dolp, 0.5), maps.dolp_debiased),
        "aolp": ("AoLP as hue", aolp_to_rgb(aolp), np.degrees(maps.aolp)),
        PHOTOGRAPH: (
            "photograph (S0 / 2); red: beyond a limit, outlined: its pixels",
            np.repeat(gray[..., None], 3, axis=2),
            maps.s0,
        ),
    }


def _pixels_beyond(
    maps: ShotMaps, values: Map, region: Region, field: str, bound: Bound
) -> NDArray[np.bool_]:
    """Return a mask [H, W] of the pixels of a region that exceed a limit.

    The mask is empty if the limit applies to the region as a whole.
    """
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
    """Draw the outline of the pixels in a mask, without speckle."""
    smooth = cv2.medianBlur(mask.astype(np.uint8), _SPECKLE)
    large = cv2.resize(smooth, panel.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    thick = max(1, round(panel.shape[1] / 500))
    cv2.drawContours(panel, outlines, -1, (0, 0, 0), 3 * thick)
    cv2.drawContours(panel, outlines, -1, _DEFECT, thick)


def _boxes(panel: Picture, scale: float, regions: Beyond) -> None:
    """Draw regions with their names: red if they exceed a limit, else green."""
    thick = max(1, round(panel.shape[1] / 500))
    for region, beyond in sorted(regions, key=lambda pair: bool(pair[1])):
        color = _BEYOND if beyond else _WITHIN
        size = np.array((region.width, region.height))
        corners = np.array(region.corners or ((0, 0), (1, 0), (1, 1), (0, 1)) * size)
        places = np.rint(scale * (corners + (region.x, region.y))).astype(np.int32)
        # Corners beyond the last pixel are clamped to it.
        ends = np.rint(scale * (size + (region.x, region.y))).astype(np.int32) - 1
        places = np.maximum(np.minimum(places, ends), places.min(axis=0))
        cv2.polylines(panel, [places], True, color, 2 * thick if beyond else thick)
        left, top = places.min(axis=0).tolist()
        _name(panel, region.name, left, top, color)


def _strip(lines: Sequence[str], color: tuple[int, int, int], width: int) -> Picture:
    """Draw lines of wrapped text on white."""
    columns = max(20, (width - 16) // _CHARACTER)
    texts = [line.encode("ascii", "replace").decode() for line in lines]
    wrapped = [part for text in texts for part in textwrap.wrap(text, columns, subsequent_indent="    ")]
    strip: Picture = np.full((LINE_HEIGHT * len(wrapped) + 8, width, 3), 255, np.uint8)
    for number, part in enumerate(wrapped, 1):
        cv2.putText(strip, part, (8, LINE_HEIGHT * number - 6), FONT, 0.5, color, 1, cv2.LINE_AA)
    return strip


def _enlarged(picture: Picture) -> tuple[Picture, float]:
    """Return a copy of a picture that is scaled to the width of a page, and the scale factor."""
    width = picture.shape[1]
    scale = _WIDEST / width if width > _WIDEST else float(max(1, math.ceil(_NARROWEST / width)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    return np.array(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=way), np.uint8), scale


def _name(picture: Picture, name: str, x: int, y: int, color: tuple[int, int, int]) -> None:
    """Draw the name of a region above its top-left corner, or inside at the top of the picture."""
    text = name.encode("ascii", "replace").decode()
    (width, height), base = cv2.getTextSize(text, FONT, 0.5, 1)
    x = max(0, min(x, picture.shape[1] - width - 6))
    bottom = y if y >= height + base + 4 else y + height + base + 4
    cv2.rectangle(picture, (x, bottom - height - base - 4), (x + width + 6, bottom), color, -1)
    cv2.putText(picture, text, (x + 3, bottom - base - 1), FONT, 0.5, (0, 0, 0), 1, cv2.LINE_AA)


def difference_picture(differences: Differences, shot: str, reference: str) -> Picture:
    """Draw the differences of S0, DoLP and AoLP side by side.

    A pixel is red if it exceeds the reference, blue if it is below the reference, and gray if it was not compared.
    """
    panels = _difference_panels(differences).values()
    names = " - ".join(name if len(name) <= 24 else f"{name[:21]}..." for name in (shot, reference))
    return contact_sheet(
        [[diverging(values, most) for values, most, _ in panels]],
        [""],
        [f"{label}: {names}" for _, _, label in panels],
        footer=[_bar(most) for _, most, _ in panels],
        minimum_width=480,
        maximum_width=960,
    )


def _difference_panels(differences: Differences) -> dict[str, tuple[Map, float, str]]:
    """Return the panels of differences by name.

    Each panel has values in the unit of its field, the difference that gets the most saturated color, and a label.
    """
    return {
        "s0_difference": (differences.s0, S0_RANGE, "S0"),
        "dolp_difference": (differences.dolp, DOLP_RANGE, "DoLP"),
        "aolp_difference": (np.degrees(differences.aolp), AOLP_RANGE, "AoLP, degrees"),
    }


def diverging(values: Map, most: float) -> Picture:
    """Convert numbers to colors, uint8 RGB [H, W, 3].

    Colors are blue at ``-most``, light at 0, red at ``most``, and gray for NaN.
    """
    finite = np.isfinite(values)
    place = np.clip(np.where(finite, values, 0) / most, -1, 1)[..., None]
    fall = np.where(place > 0, np.array([62, 216, 197], np.float32), np.array([207, 138, 68], np.float32))
    picture = 240 - fall * np.abs(place)
    picture[~finite] = _NOT_COMPARED
    return np.rint(picture).astype(np.uint8)


def _bar(most: float) -> Picture:
    """Draw the color scale, with its numbers below."""
    ramp = np.linspace(-most, most, 256, dtype=np.float32)[None].repeat(22, axis=0)
    return color_bar(diverging(ramp, most), f"-{most:g}", "0", f"+{most:g}")
