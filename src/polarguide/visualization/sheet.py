"""A table of pictures with labels, as one picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""uint8 RGB [H, W, 3]."""

BACKGROUND = 255
INK = (32, 32, 32)
FONT = cv2.FONT_HERSHEY_SIMPLEX
FONT_SCALE = 0.6
SMALLEST_FONT_SCALE = 0.35
LINE_HEIGHT = 28


def contact_sheet(
    rows: Sequence[Sequence[Picture | None]],
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    *,
    footer: Sequence[Picture | None] = (),
    minimum_width: int = 256,
    maximum_width: int = 640,
    gutter: int = 8,
    caption: str = "",
) -> Picture:
    """Lay pictures out in rows and columns, with labels on top and to the left, on white.

    All tiles get one size. Small pictures are enlarged by a whole factor to at least ``minimum_width``
    without smoothing, large ones reduced to ``maximum_width`` by area averages. A picture of another size
    than the rest is fitted into its tile and centered.

    Args:
        rows: the pictures, uint8 RGB [H, W, 3]; None, or a row that ends early, leaves the place blank.
        row_labels: one per row.
        column_labels: one per column. Characters outside ASCII are drawn as "?".
        footer: pictures below the columns, such as scales, as wide as a tile and as high as they then are.
        minimum_width, maximum_width: bounds of a tile's width in pixels.
        gutter: pixels between tiles and around the sheet.
        caption: a line of text below everything.

    Returns:
        uint8 RGB picture.

    Raises:
        ValueError: labels that do not match the rows, no picture at all, or something that is not a picture.
    """
    columns = len(column_labels)
    if len(rows) != len(row_labels) or any(len(row) > columns for row in rows):
        raise ValueError(
            f"contact sheet: expected {len(row_labels)} rows of at most {columns} pictures, "
            f"found rows of {[len(row) for row in rows]}"
        )
    pictures = [picture for row in rows for picture in row if picture is not None]
    for picture in pictures:
        check_picture(picture, "contact sheet")
    if not pictures:
        raise ValueError("contact sheet: expected at least one picture, found none")
    width, height = _tile_size(pictures, minimum_width, maximum_width)
    margin = max((_text_width(label, FONT_SCALE) for label in row_labels), default=0)
    left = gutter + (margin + gutter if margin else 0)
    top = gutter + (LINE_HEIGHT if any(column_labels) else 0)
    sheet: Picture = np.full(
        (top + len(rows) * (height + gutter), left + columns * (width + gutter), 3), BACKGROUND, np.uint8
    )
    for j, label in enumerate(column_labels):
        _write(sheet, label, left + j * (width + gutter), gutter + LINE_HEIGHT // 2, width)
    for i, (row, label) in enumerate(zip(rows, row_labels, strict=True)):
        y = top + i * (height + gutter)
        _write(sheet, label, gutter, y + height // 2, margin)
        for j, cell in enumerate(row):
            if cell is not None:
                _place(sheet[y : y + height, left + j * (width + gutter) :][:, :width], cell)
    if any(cell is not None for cell in footer):
        sheet = np.concatenate((sheet, _strip(footer, sheet.shape[1], width, left, gutter)))
    if not caption:
        return sheet
    line: Picture = np.full((LINE_HEIGHT, sheet.shape[1], 3), BACKGROUND, np.uint8)
    _write(line, caption, gutter, LINE_HEIGHT // 2, sheet.shape[1] - 2 * gutter)
    return np.concatenate((sheet, line))


def _strip(cells: Sequence[Picture | None], across: int, width: int, left: int, gutter: int) -> Picture:
    """One more row, as high as its pictures need, ``across`` pixels wide."""
    height = max(round(width * cell.shape[0] / cell.shape[1]) for cell in cells if cell is not None)
    strip: Picture = np.full((height + gutter, across, 3), BACKGROUND, np.uint8)
    for j, cell in enumerate(cells):
        if cell is not None:
            check_picture(cell, "contact sheet")
            _place(strip[:height, left + j * (width + gutter) :][:, :width], cell)
    return strip


def check_picture(picture: Picture, name: str) -> None:
    """Raise ValueError unless ``picture`` is uint8 [H, W, 3] and not empty."""
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise ValueError(f"{name}: expected uint8 [H, W, 3], found {picture.dtype} {list(picture.shape)}")


def _tile_size(pictures: Sequence[Picture], minimum: int, maximum: int) -> tuple[int, int]:
    """Width and height of every tile: as wide as the bounds want, as high as the tallest needs."""
    widest = max(picture.shape[1] for picture in pictures)
    # A whole factor keeps the pixels of an enlarged picture square and equal.
    width = min(widest * max(1, math.ceil(minimum / widest)), maximum)
    return width, max(1, max(round(width * p.shape[0] / p.shape[1]) for p in pictures))


def _place(tile: Picture, picture: Picture) -> None:
    """Fit a picture into a tile, centered."""
    scale = min(tile.shape[1] / picture.shape[1], tile.shape[0] / picture.shape[0])
    width, height = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    fitted = cv2.resize(picture, (width, height), interpolation=how)
    y, x = (tile.shape[0] - height) // 2, (tile.shape[1] - width) // 2
    tile[y : y + height, x : x + width] = fitted


def _text_width(text: str, scale: float) -> int:
    return cv2.getTextSize(text, FONT, scale, 1)[0][0] if text else 0


def _write(sheet: Picture, text: str, x: int, y: int, width: int) -> None:
    """Draw text centered in ``width`` pixels from ``x``, around the line ``y``; smaller if it has to be."""
    if not text:
        return
    text = text.encode("ascii", "replace").decode()
    scale = FONT_SCALE
    while _text_width(text, scale) > width and scale > SMALLEST_FONT_SCALE:
        scale -= 0.05
    (drawn, height), _ = cv2.getTextSize(text, FONT, scale, 1)
    origin = (x + max(0, (width - drawn) // 2), y + height // 2)
    cv2.putText(sheet, text, origin, FONT, scale, INK, 1, cv2.LINE_AA)
