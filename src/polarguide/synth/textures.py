"""Procedural textures: linear RGB pictures that tile or fill a surface.

A texture is data, ``{"type": "wood", ...}``; each function below is a type, and its parameters are the fields. Colors
are linear sRGB. The type ``image`` reads a user's picture.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polarguide.color import srgb_decode_array
from polarguide.errors import PolarguideError
from polarguide.synth.mesh import Array
from polarguide.synth.noise import fractal_noise

Color = tuple[float, float, float]


def wood(
    light: Color = (0.34, 0.19, 0.085), dark: Color = (0.13, 0.06, 0.025), planks: int = 5, seed: int = 0,
    pixels: int = 768,
) -> Array:  # fmt: skip
    """Boards along u with grain and dark joints."""
    u, v = _grid(pixels)
    board = np.floor(v * planks)
    inner = v * planks - board
    shift = _random(board, seed)
    grain = fractal_noise(np.stack((u * 3 + 7 * shift, v * planks * 9 + 13 * shift), -1), seed, 4)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (inner * 2.5 + 1.6 * grain + 3 * shift))
    fine = fractal_noise(np.stack((u * 14 + 3 * shift, v * planks * 70), -1), seed + 1, 2)
    mix = np.clip(0.55 * rings + 0.35 * fine + 0.5 * (shift - 0.5), 0, 1)[..., None]
    picture = np.array(dark) * mix + np.array(light) * (1 - mix)
    joint = np.minimum(inner, 1 - inner) * pixels / planks
    return np.asarray(picture * np.clip(0.25 + joint / 3, 0, 1)[..., None])


def checker(
    a: Color = (0.6, 0.58, 0.52),
    b: Color = (0.12, 0.13, 0.15),
    cells: int = 8,
    pixels: int = 512,
    seed: int = 0,
) -> Array:
    """A chessboard, a little worn."""
    u, v = _grid(pixels)
    odd = (np.floor(u * cells) + np.floor(v * cells)) % 2
    worn = 0.8 + 0.4 * fractal_noise(np.stack((u, v), -1) * 10, seed, 4)
    return np.asarray(np.where(odd[..., None] > 0, a, b) * worn[..., None])


def bricks(
    brick: Color = (0.30, 0.10, 0.06), mortar: Color = (0.38, 0.36, 0.33), rows: int = 16, columns: int = 8,
    joint: float = 0.07, seed: int = 0, pixels: int = 768,
) -> Array:  # fmt: skip
    """A running bond whose stones differ in tone."""
    u, v = _grid(pixels)
    row = np.floor(v * rows)
    shifted = u * columns + 0.5 * (row % 2)
    column = np.floor(shifted) % columns
    edge_u = np.minimum(shifted - np.floor(shifted), np.ceil(shifted) - shifted) * rows / columns * 1.2
    edge = np.minimum(np.minimum(v * rows - row, 1 - (v * rows - row)), edge_u)
    tone = 0.55 + 0.9 * _random(row * 57 + column, seed)
    grit = 0.7 + 0.6 * fractal_noise(np.stack((u, v), -1) * 60, seed, 3)
    stone = np.clip((edge - joint / 2) * 25, 0, 1)[..., None]
    picture = np.array(mortar) * (1 - stone) + np.array(brick) * tone[..., None] * stone
    return np.asarray(np.clip(picture * grit[..., None], 0, 0.95))


def mottled(
    a: Color = (0.5, 0.48, 0.44), b: Color = (0.3, 0.29, 0.27), scale: float = 6.0, sharp: float = 1.0, seed: int = 0,
    pixels: int = 512,
) -> Array:  # fmt: skip
    """Two colors mixed at random: plaster, stone, asphalt, cloth, rust."""
    u, v = _grid(pixels)
    mix = fractal_noise(np.stack((u, v), -1) * scale, seed, 6)
    mix = np.clip((mix - 0.5) * 2.5 * sharp + 0.5, 0, 1)[..., None]
    return np.asarray(np.array(a) * mix + np.array(b) * (1 - mix))


def stripes(
    colors: tuple[Color, ...] = ((0.6, 0.1, 0.08), (0.7, 0.68, 0.62)), count: int = 6, across: bool = False,
    seed: int = 0, pixels: int = 512,
) -> Array:  # fmt: skip
    """Even stripes along u, or along v where ``across``; a little worn."""
    u, v = _grid(pixels)
    which = np.floor((u if across else v) * count).astype(int) % len(colors)
    worn = 0.85 + 0.3 * fractal_noise(np.stack((u, v), -1) * 12, seed, 4)
    return np.asarray(np.array(colors)[which] * worn[..., None])


def tiles(
    colors: tuple[Color, ...] = ((0.55, 0.5, 0.4), (0.5, 0.46, 0.38)), joint: Color = (0.16, 0.15, 0.14),
    cells: int = 6, seed: int = 0, pixels: int = 640,
) -> Array:  # fmt: skip
    """Square tiles in random colors of a palette, with joints."""
    u, v = _grid(pixels)
    row, column = np.floor(v * cells), np.floor(u * cells)
    which = (_random(row * 31 + column, seed) * len(colors)).astype(int)
    edge = np.minimum.reduce(
        [u * cells - column, column + 1 - u * cells, v * cells - row, row + 1 - v * cells]
    )
    face = np.clip((edge - 0.02) * 60, 0, 1)[..., None]
    tone = 0.8 + 0.4 * fractal_noise(np.stack((u, v), -1) * cells * 2, seed, 4)
    return np.asarray((np.array(colors)[which] * face + np.array(joint) * (1 - face)) * tone[..., None])


def printed(
    paper: Color = (0.72, 0.69, 0.6), ink: Color = (0.05, 0.06, 0.1), accent: Color = (0.55, 0.08, 0.05),
    seed: int = 0, pixels: int = 512,
) -> Array:  # fmt: skip
    """A cover or poster: a frame, a picture of colored shapes, lines of words."""
    random = np.random.default_rng(seed)
    picture = np.tile(np.array(paper), (pixels, pixels, 1))
    u, v = _grid(pixels)
    block = (u > 0.1) & (u < 0.9) & (v > 0.1) & (v < 0.58)
    tone = fractal_noise(np.stack((u, v), -1) * 5, seed, 5)[..., None]
    sky = np.array(accent) * (1 - v[..., None]) + np.array([0.1, 0.2, 0.4]) * v[..., None]
    picture[block] = (sky * (0.5 + tone))[block]
    for _ in range(9):
        center, radius = random.uniform((0.15, 0.15), (0.85, 0.53)), random.uniform(0.03, 0.13)
        disc = (np.hypot(u - center[0], v - center[1]) < radius) & block
        picture[disc] = random.uniform(0.03, 0.75, 3)
    for line in range(7):
        top = 0.63 + 0.045 * line
        start = 0.1
        while start < 0.86:
            width = random.uniform(0.02, 0.1)
            height = 0.03 if line == 0 else 0.018
            word = (u > start) & (u < min(start + width, 0.9)) & (v > top) & (v < top + height)
            picture[word] = ink if line else accent
            start += width + 0.015
    return picture


def image(file: str, folder: Path = Path(".")) -> Array:
    """A picture of the user's; 8-bit files are taken as sRGB, others as linear."""
    path = folder / file
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if stored is None or stored.ndim != 3 or stored.shape[2] < 3:
        raise PolarguideError(
            path,
            expected="a color picture (PNG, JPEG or Radiance .hdr)",
            found="one of another kind" if path.is_file() else "nothing",
            remedy="File names of textures and environments start at the folder of the scene file.",
        )
    picture = stored[..., 2::-1].astype(np.float64)
    if stored.dtype == np.uint8:
        picture /= 255
        return srgb_decode_array(picture)
    return picture / 65535 if stored.dtype == np.uint16 else picture


TEXTURES: dict[str, Callable[..., Array]] = {
    "wood": wood, "checker": checker, "bricks": bricks, "mottled": mottled, "stripes": stripes, "tiles": tiles,
    "printed": printed, "image": image,
}  # fmt: skip


def make_texture(data: dict[str, Any], where: str, folder: Path) -> Array:
    """The picture [H, W, 3] that the data of a texture describe.

    Raises:
        PolarguideError: the type or a field is unknown, or a value makes no sense.
    """
    fields = dict(data)
    kind = fields.pop("type", None)
    maker = TEXTURES.get(kind) if isinstance(kind, str) else None
    if maker is None:
        raise PolarguideError(
            f"{where} material.color",
            expected=f'a color, "own", or a texture with type {", ".join(TEXTURES)}',
            found=repr(data),
            remedy="docs/reference/scene-files.md describes them.",
        )
    if kind == "image":
        fields["folder"] = folder
    try:
        return maker(**fields)
    except (TypeError, ValueError, IndexError) as error:
        raise PolarguideError(
            f"{where} texture",
            expected=f"the fields of {kind}",
            found=str(error),
            remedy="docs/reference/scene-files.md has them.",
        ) from error


def _grid(pixels: int) -> tuple[Array, Array]:
    at = (np.arange(pixels) + 0.5) / pixels
    v, u = np.meshgrid(at, at, indexing="ij")
    return u, v


def _random(number: Array, seed: int) -> Array:
    """A random number in [0, 1) for each whole number."""
    return np.random.default_rng(seed).random(4096)[number.astype(int) % 4096]
