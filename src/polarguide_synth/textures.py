"""Procedural pictures in linear RGB: textures of surfaces, and panoramas of environment light.

A scene describes a texture or an environment by data such as ``{"type": "wood", ...}``. Each type is a function below,
and the fields are its parameters. The type ``image`` reads a user's picture. A panorama is [H, W, 3] linear radiance.
Its rows go from the zenith down, its columns clockwise as seen from above, from +x.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import PolarguideError
from polarguide.geometry.vectors import unit_array as unit
from polarguide.optics.color import srgb_decode_array
from polarguide_synth.mesh import Array
from polarguide_synth.schema import make


def fractal_noise(points: Array, seed: int, octaves: int = 4) -> Array:
    """Compute smooth random values in [0, 1] at points [..., D].

    The values are a sum of octaves. The first octave has cells of size 1, and each further octave has half the scale
    and half the amplitude.
    """
    total = np.zeros(points.shape[:-1])
    for octave in range(octaves):
        total += 0.5**octave * _value(points * 2.0**octave + 17.3 * octave, seed * 31 + octave)
    return total / (2 - 2 * 0.5**octaves)


def _value(points: Array, seed: int) -> Array:
    """Compute one octave of noise at points by interpolating random numbers at integer points.

    The interpolation is a quintic, whose second derivative is continuous.
    """
    cell = np.floor(points).astype(np.int64)
    t = points - cell
    t = t * t * t * (t * (6 * t - 15) + 10)
    total = np.zeros(points.shape[:-1])
    for corner in itertools.product((0, 1), repeat=points.shape[-1]):
        weight = np.prod([t[..., k] if c else 1 - t[..., k] for k, c in enumerate(corner)], axis=0)
        total += weight * _hash(cell + np.array(corner), seed)
    return total


def _hash(cell: np.ndarray, seed: int) -> Array:
    """Hash integer points [..., D] to random numbers in [0, 1)."""
    value = np.full(cell.shape[:-1], (seed * 0x9E3779B9 + 0x7F4A7C15) & 0xFFFFFFFF, np.uint64)
    for k in range(cell.shape[-1]):
        value = (value ^ (cell[..., k].astype(np.uint64) & np.uint64(0xFFFFFFFF))) * np.uint64(
            0x9E3779B97F4A7C15
        )
        value ^= value >> np.uint64(29)
    value *= np.uint64(0xBF58476D1CE4E5B9)
    value ^= value >> np.uint64(32)
    return (value & np.uint64(0xFFFFFF)).astype(np.float64) / 0x1000000


Color = tuple[float, float, float]


def wood(
    light: Color = (0.34, 0.19, 0.085), dark: Color = (0.13, 0.06, 0.025), planks: int = 5, seed: int = 0,
    pixels: int = 768,
) -> Array:  # fmt: skip
    """Draw wooden boards along u, with grain and dark joints."""
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
    """Draw a slightly worn chessboard."""
    u, v = _grid(pixels)
    odd = (np.floor(u * cells) + np.floor(v * cells)) % 2
    worn = 0.8 + 0.4 * fractal_noise(np.stack((u, v), -1) * 10, seed, 4)
    return np.asarray(np.where(odd[..., None] > 0, a, b) * worn[..., None])


def bricks(
    brick: Color = (0.30, 0.10, 0.06), mortar: Color = (0.38, 0.36, 0.33), rows: int = 16, columns: int = 8,
    joint: float = 0.07, seed: int = 0, pixels: int = 768,
) -> Array:  # fmt: skip
    """Draw a brick wall (running bond) whose bricks differ in tone."""
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
    """Mix two colors at random, to imitate plaster, stone, asphalt, cloth or rust."""
    u, v = _grid(pixels)
    mix = fractal_noise(np.stack((u, v), -1) * scale, seed, 6)
    mix = np.clip((mix - 0.5) * 2.5 * sharp + 0.5, 0, 1)[..., None]
    return np.asarray(np.array(a) * mix + np.array(b) * (1 - mix))


def stripes(
    colors: tuple[Color, ...] = ((0.6, 0.1, 0.08), (0.7, 0.68, 0.62)), count: int = 6, across: bool = False,
    seed: int = 0, pixels: int = 512,
) -> Array:  # fmt: skip
    """Draw slightly worn stripes of equal width along u. If ``across`` is True, draw them along v."""
    u, v = _grid(pixels)
    which = np.floor((u if across else v) * count).astype(int) % len(colors)
    worn = 0.85 + 0.3 * fractal_noise(np.stack((u, v), -1) * 12, seed, 4)
    return np.asarray(np.array(colors)[which] * worn[..., None])


def tiles(
    colors: tuple[Color, ...] = ((0.55, 0.5, 0.4), (0.5, 0.46, 0.38)), joint: Color = (0.16, 0.15, 0.14),
    cells: int = 6, seed: int = 0, pixels: int = 640,
) -> Array:  # fmt: skip
    """Draw square tiles in random colors of a palette, with joints."""
    u, v = _grid(pixels)
    row = np.floor(v * cells)
    column = np.floor(u * cells)
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
    """Draw a printed cover or poster, with a frame, a picture of colored shapes, and lines of text."""
    random = np.random.default_rng(seed)
    picture = np.tile(np.array(paper), (pixels, pixels, 1))
    u, v = _grid(pixels)
    block = (u > 0.1) & (u < 0.9) & (v > 0.1) & (v < 0.58)
    tone = fractal_noise(np.stack((u, v), -1) * 5, seed, 5)[..., None]
    sky = np.array(accent) * (1 - v[..., None]) + np.array([0.1, 0.2, 0.4]) * v[..., None]
    picture[block] = (sky * (0.5 + tone))[block]
    for _ in range(9):
        center = random.uniform((0.15, 0.15), (0.85, 0.53))
        disc = (np.hypot(u - center[0], v - center[1]) < random.uniform(0.03, 0.13)) & block
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
    """Read a user's picture. Files with 8 bits are decoded as sRGB; files with more bits are linear.

    Raises:
        PolarguideError: the file is not a color picture.
    """
    path = folder / file
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if stored is None or stored.ndim != 3 or stored.shape[2] < 3:
        raise PolarguideError(
            path,
            expected="a color picture (PNG, JPEG or Radiance .hdr)",
            found="a file of another kind" if path.is_file() else "nothing",
            remedy="Name textures and environments relative to the folder of the scene file.",
        )
    picture = stored[..., 2::-1].astype(np.float64)
    if stored.dtype == np.uint8:
        return srgb_decode_array(picture / 255)
    return picture / 65535 if stored.dtype == np.uint16 else picture


TEXTURES: dict[str, Callable[..., Array]] = {
    "wood": wood, "checker": checker, "bricks": bricks, "mottled": mottled, "stripes": stripes, "tiles": tiles,
    "printed": printed, "image": image,
}  # fmt: skip


def make_texture(data: dict[str, Any], where: str, folder: Path) -> Array:
    """Create the picture [H, W, 3] of a texture from its data.

    Args:
        data: type and fields.
        where: name of the object, for messages.
        folder: folder that file names are relative to.

    Raises:
        PolarguideError: the type, a field or a value is invalid.
    """
    return make(
        {**TEXTURES, "image": functools.partial(image, folder=folder)},
        data,
        f"{where} material.color",
        f'a color, "own", or a texture with type {", ".join(TEXTURES)}',
    )


def _grid(pixels: int) -> tuple[Array, Array]:
    """Return the texture coordinates u and v of pixel centers, [pixels, pixels] each."""
    at = (np.arange(pixels) + 0.5) / pixels
    v, u = np.meshgrid(at, at, indexing="ij")
    return u, v


def _random(number: Array, seed: int) -> Array:
    """Return a random number in [0, 1) for each integer."""
    return np.random.default_rng(seed).random(4096)[number.astype(int) % 4096]


HEIGHT = 256
"""Default height of a panorama in pixels."""


def directions(height: int) -> Array:
    """Return the unit directions of the pixel centers of a panorama, [height, 2 height, 3]."""
    polar = np.pi * (np.arange(height) + 0.5) / height
    turn = -2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    theta, phi = np.meshgrid(polar, turn, indexing="ij")
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)


def uniform(radiance: Color = (1.0, 1.0, 1.0), height: int = 16) -> Array:
    """Create a panorama with the same radiance in every direction."""
    return np.tile(np.array(radiance, float), (height, 2 * height, 1))


def sky(
    sun: tuple[float, float] = (40.0, 60.0), brightness: float = 1.0, sunlight: float = 40.0, clouds: float = 0.5,
    ground: Color = (0.12, 0.11, 0.10), skyline: float = 8.0, seed: int = 0, height: int = HEIGHT,
) -> Array:  # fmt: skip
    """Create a panorama of a sky with clouds, a hazy sun, and a skyline of houses and trees.

    ``sun`` is the elevation and azimuth of the sun in degrees.
    """
    d = directions(height)
    up = np.clip(d[..., 2], 0, 1)[..., None]
    blue = np.array([0.85, 0.92, 1.0]) * (1 - up) ** 3 + np.array([0.16, 0.33, 0.72]) * (1 - (1 - up) ** 3)
    across = d[..., :2] / np.maximum(d[..., 2:], 0.08)
    cover = fractal_noise(across * 0.7 + 20, seed, 6)
    cover = np.clip((cover - 0.62 + 0.3 * clouds) * 5, 0, 1)[..., None] * np.clip(up * 8, 0, 1)
    tone = fractal_noise(across * 1.6 + 50, seed + 1, 5)[..., None]
    picture = blue * (1 - cover) + np.array([1.0, 0.98, 0.95]) * (0.75 + 0.5 * tone) * cover
    cosine = d @ _direction(sun)
    glow = np.exp((cosine - 1) * 400) * sunlight + np.exp((cosine - 1) * 25) * sunlight * 0.02
    picture = brightness * (picture + glow[..., None] * np.array([1.0, 0.9, 0.72]))
    _skyline(picture, d, skyline, brightness, seed)
    below = d[..., 2] <= 0
    grit = 0.8 + 0.4 * fractal_noise(d[below] * 9, seed + 4, 4)
    picture[below] = brightness * np.array(ground) * grit[:, None]
    return picture


def _direction(angles: tuple[float, float]) -> Array:
    """Return the unit vector of a direction, given its elevation and azimuth in degrees."""
    high, azimuth = np.radians(angles)
    return np.array([np.cos(high) * np.cos(azimuth), np.cos(high) * np.sin(azimuth), np.sin(high)])


def _skyline(picture: Array, d: Array, highest: float, brightness: float, seed: int) -> None:
    """Paint houses with windows, and trees between them. They are up to ``highest`` degrees tall."""
    elevation = np.degrees(np.arcsin(np.clip(d[..., 2], -1, 1)))
    turn = np.degrees(np.arctan2(d[..., 1], d[..., 0])) % 360
    random = np.random.default_rng(seed + 9)
    at = 0.0
    while at < 360:
        width = random.uniform(8, 24)
        inside = (turn >= at) & (turn < at + width) & (elevation > -1)
        if random.random() < 0.55:
            top = random.uniform(0.45, 1) * highest
            wall = random.uniform(0.12, 0.45) * np.array([1, *random.uniform((0.7, 0.5), (1, 0.95))])
            block = inside & (elevation < top)
            picture[block] = brightness * wall
            panes = block & ((turn - at) % 2.4 > 1.1) & (elevation % 2.1 > 0.9) & (elevation < top - 0.8)
            picture[panes] = brightness * np.array([0.10, 0.14, 0.2])
        else:
            edge = highest * 0.75 * fractal_noise(np.stack((turn * 0.22, turn * 0), -1), seed + int(at), 5)
            leaves = fractal_noise(d * 40, seed + 2, 4)[..., None]
            trees = inside & (elevation < edge)
            picture[trees] = (brightness * np.array([0.05, 0.11, 0.03]) * (0.4 + 1.4 * leaves))[trees]
        at += width


def room(
    size: tuple[float, float, float] = (6.0, 5.0, 3.0), eye: float = 1.2, walls: Color = (0.42, 0.38, 0.32),
    ceiling: Color = (0.5, 0.49, 0.47), floor: Color = (0.16, 0.1, 0.06), window: float = 9.0, lamp: float = 5.0,
    warm: float = 0.25, seed: int = 0, height: int = HEIGHT,
) -> Array:  # fmt: skip
    """Create a panorama of a furnished room, with windows, ceiling lamps, pictures, shelves and a door."""
    d = directions(height)
    low = np.array([-size[0] / 2, -size[1] / 2, -eye])
    high = np.array([size[0] / 2, size[1] / 2, size[2] - eye])
    with np.errstate(divide="ignore"):
        reach = np.where(d > 0, high / d, low / d)
    axis = reach.argmin(-1)
    hit = d * reach.min(-1)[..., None]
    u = np.where(axis == 0, hit[..., 1], hit[..., 0])
    z = hit[..., 2] + eye
    light = 0.55 + 0.5 * fractal_noise(hit * 0.8 + 9, seed, 3)
    picture = np.where((axis == 2)[..., None], 0.0, np.array(walls)) * light[..., None]
    top = (axis == 2) & (d[..., 2] > 0)
    bottom = (axis == 2) & (d[..., 2] < 0)
    picture[top] = (np.array(ceiling) * light[..., None])[top]
    boards = 0.7 + 0.6 * fractal_noise(hit * np.array([1.0, 9.0, 1.0]), seed + 1, 3)
    picture[bottom] = (np.array(floor) * boards[..., None])[bottom]
    sides = {"east": (axis == 0) & (d[..., 0] > 0), "west": (axis == 0) & (d[..., 0] < 0),
             "north": (axis == 1) & (d[..., 1] > 0), "south": (axis == 1) & (d[..., 1] < 0)}  # fmt: skip
    cool = np.array([1 - warm * 0.5, 1.0, 1 + warm * 0.5])
    for side, start in (("east", -1.6), ("east", 0.35), ("north", -0.7)):
        pane = sides[side] & (u > start) & (u < start + 1.3) & (z > 0.9) & (z < 2.4)
        bars = pane & ((np.abs(u - start - 0.65) < 0.035) | (np.abs(z - 1.75) < 0.03))
        outside = np.where((z > 1.5)[..., None], window * cool, window * 0.45 * np.array([0.8, 1.0, 0.7]))
        picture[pane] = (outside * (0.7 + 0.6 * fractal_noise(hit * 2.5, seed + 3, 3)[..., None]))[pane]
        picture[bars] = 0.5
    for x, y in ((-1.3, 0.0), (1.3, 0.0)):
        picture[top & (np.hypot(hit[..., 0] - x, hit[..., 1] - y) < 0.33)] = lamp * np.array(
            [1 + warm, 1.0, 1 - warm]
        )
    _furniture(picture, sides, u, z, seed)
    return picture


def _furniture(picture: Array, sides: dict[str, NDArray[np.bool_]], u: Array, z: Array, seed: int) -> None:
    """Paint shelves of books, a door, framed pictures and a skirting board on the walls."""
    random = np.random.default_rng(seed + 5)
    west = sides["west"]
    for shelf in range(5):
        foot = 0.35 + 0.42 * shelf
        picture[west & (np.abs(u) < 1.6) & (z > foot - 0.05) & (z < foot)] = (0.16, 0.09, 0.04)
        at = -1.6
        while at < 1.55:
            thick = random.uniform(0.03, 0.09)
            book = west & (u > at) & (u < at + thick) & (z > foot) & (z < foot + random.uniform(0.22, 0.34))
            picture[book] = random.uniform(0.03, 0.5, 3)
            at += thick + (0.004 if random.random() < 0.9 else 0.2)
    south = sides["south"]
    picture[south & (u > 1.1) & (u < 2.0) & (z < 2.05)] = (0.3, 0.17, 0.08)
    for start, wide in ((-2.2, 0.9), (-0.9, 1.3)):
        frame = south & (u > start) & (u < start + wide) & (z > 1.2) & (z < 2.1)
        inner = frame & (u > start + 0.07) & (u < start + wide - 0.07) & (z > 1.27) & (z < 2.03)
        picture[frame] = (0.06, 0.045, 0.03)
        paint = random.uniform(0.1, 0.7, 3) * (
            0.3 + 1.2 * fractal_noise(np.stack((u, z), -1) * 4, seed + 7, 4)[..., None]
        )
        picture[inner] = paint[inner]
    wall = sides["east"] | sides["west"] | sides["north"] | sides["south"]
    picture[wall & (z < 0.12)] = (0.45, 0.43, 0.4)


def studio(
    boxes: tuple[dict[str, Any], ...] = (),
    floor: float = 0.08,
    top: float = 0.25,
    seed: int = 0,
    height: int = HEIGHT,
) -> Array:
    """Create a panorama of a dark studio with softboxes.

    Args:
        boxes: data of the softboxes. Each has ``at`` (elevation, azimuth), ``size`` in degrees, and ``radiance``.
        floor: radiance at the nadir.
        top: radiance at the zenith.
        seed: seed of the random variation.
        height: height of the panorama in pixels.
    """
    d = directions(height)
    picture = (floor + (top - floor) * (0.5 + 0.5 * d[..., 2:]) ** 2) * np.ones(3)
    picture *= 0.8 + 0.4 * fractal_noise(d * 3 + 5, seed, 4)[..., None]
    for item in boxes:
        toward = _direction(item["at"])
        right = unit(np.cross([0.0, 0, 1], toward))
        up = np.cross(toward, right)
        ahead = np.maximum(d @ toward, 1e-3)
        wide, tall = (np.tan(np.radians(s / 2)) for s in item["size"])
        x = d @ right / ahead / wide
        y = d @ up / ahead / tall
        shade = np.clip((1 - np.maximum(np.abs(x), np.abs(y))) * 12, 0, 1) * (d @ toward > 0)
        picture = picture * (1 - shade[..., None]) + shade[..., None] * np.array(item["radiance"], float)
    return picture


ENVIRONMENTS: dict[str, Callable[..., Array]] = {
    "uniform": uniform, "sky": sky, "room": room, "studio": studio, "image": image,
}  # fmt: skip


def make_environment(data: dict[str, Any], where: str, folder: Path) -> Array:
    """Create the panorama [H, W, 3] of an environment from its data. Arguments are as in ``make_texture``.

    Raises:
        PolarguideError: the type, a field or a value is invalid.
    """
    return make(
        {**ENVIRONMENTS, "image": functools.partial(image, folder=folder)},
        data,
        f"{where} (environment)",
        f"a type of {', '.join(ENVIRONMENTS)} with its fields",
    )
