"""Pictures of shots that are beyond their limits, and of differences to a golden part."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from polarguide.optics.color import srgb_encode_array
from polarguide.shots.maps import Map, ShotMaps
from polarguide.shots.measurement.regions import Differences, Region
from polarguide.visualization.figures import FONT, INK, LINE_HEIGHT, Picture, contact_sheet

S0_RANGE, DOLP_RANGE, AOLP_RANGE = 0.2, 0.1, 20.0
"""Differences with the full color: full scales of S0, DoLP, degrees of AoLP."""
_WIDEST, _NARROWEST = 1600, 640
_WITHIN, _BEYOND = (64, 200, 64), (255, 32, 32)
_NOT_COMPARED = 110
_BAR = 256


def regions_picture(maps: ShotMaps, regions: Sequence[tuple[Region, Sequence[str]]]) -> Picture:
    """The photograph of a shot with its regions, those beyond their limits in red, and below what is beyond.

    Args:
        maps: the shot. regions: its regions, and for each the limits that it is beyond, in words.

    Returns:
        uint8 RGB, 640 to 1600 pixels wide where the shot does not force more.
    """
    photograph, scale = _photograph(maps)
    thick = max(1, round(photograph.shape[1] / 500))
    for region, beyond in sorted(regions, key=lambda pair: bool(pair[1])):
        color, width = _BEYOND if beyond else _WITHIN, 2 * thick if beyond else thick
        right, low = region.width, region.height
        corners = region.corners or ((0, 0), (right, 0), (right, low), (0, low))
        places = np.rint(scale * (np.array(corners) + (region.x, region.y))).astype(np.int32)
        # What lies beyond the last pixel is drawn on it.
        ends = np.rint(scale * np.array((region.x + right, region.y + low))).astype(np.int32) - 1
        places = np.maximum(np.minimum(places, ends), places.min(axis=0))
        cv2.polylines(photograph, [places], True, color, width)
        left, top = places.min(axis=0).tolist()
        _name(photograph, region.name, left, top, color)
    lines = [
        (f"{maps.name}: photograph (S0 / 2), red: beyond a limit", INK),
        *((f"{region.name}: {', '.join(beyond)}", (176, 0, 0)) for region, beyond in regions if beyond),
    ]
    wrapped = [(part, color) for line, color in lines for part in _wrapped(line, photograph.shape[1] - 16)]
    strip: Picture = np.full((LINE_HEIGHT * len(wrapped) + 8, photograph.shape[1], 3), 255, np.uint8)
    for number, (line, color) in enumerate(wrapped):
        cv2.putText(strip, line, (8, LINE_HEIGHT * (number + 1) - 6), FONT, 0.5, color, 1, cv2.LINE_AA)
    return np.concatenate((photograph, strip))


def _photograph(maps: ShotMaps) -> tuple[Picture, float]:
    """S0 / 2 as a display shows it, and how much larger it is than the maps."""
    linear = maps.s0 / 2
    gray = np.rint(255 * srgb_encode_array(np.clip(linear, 0, 1))).astype(np.uint8)
    width = gray.shape[1]
    if width > _WIDEST:
        scale = _WIDEST / width
        gray = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    else:
        scale = float(max(1, math.ceil(_NARROWEST / width)))
        gray = gray.repeat(int(scale), axis=0).repeat(int(scale), axis=1)
    return np.repeat(gray[..., None], 3, axis=2), scale


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
    pieces, piece = [], ""
    for word in _ascii(line).split(" "):
        longer = f"{piece} {word}" if piece else word
        if piece and cv2.getTextSize(longer, FONT, 0.5, 1)[0][0] > width:
            pieces.append(piece)
            longer = f"    {word}"
        piece = longer
    return [*pieces, piece]


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()


def difference_picture(differences: Differences, shot: str, reference: str) -> Picture:
    """The three differences beside one another: red more, blue less than the reference, gray not compared."""
    panels = (
        (differences.s0, S0_RANGE, "S0"),
        (differences.dolp, DOLP_RANGE, "DoLP"),
        (np.degrees(differences.aolp), AOLP_RANGE, "AoLP, degrees"),
    )
    sheet = contact_sheet(
        [[diverging(values, most) for values, most, _ in panels]],
        [""],
        [f"{name}: {_short(shot)} - {_short(reference)}" for _, _, name in panels],
        footer=[_bar(most) for _, most, _ in panels],
        minimum_width=480,
        maximum_width=960,
    )
    return sheet


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
