"""Procedural environment lights: panoramas of sky, room and studio.

A panorama is [H, W, 3] linear radiance; rows go from the zenith down, columns clockwise as seen from above, from +x.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.errors import PolarguideError
from polarguide.synth.mesh import Array
from polarguide.synth.noise import fractal_noise
from polarguide.synth.textures import image
from polarguide.vectors import unit_array as unit

HEIGHT = 256
Color = tuple[float, float, float]


def directions(height: int) -> Array:
    """Unit directions of the pixel centers of a panorama, [height, 2 height, 3]."""
    polar = np.pi * (np.arange(height) + 0.5) / height
    turn = -2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    theta, phi = np.meshgrid(polar, turn, indexing="ij")
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)


def uniform(radiance: Color = (1.0, 1.0, 1.0), height: int = 16) -> Array:
    """The same radiance from every direction."""
    return np.tile(np.array(radiance, float), (height, 2 * height, 1))


def sky(
    sun: tuple[float, float] = (40.0, 60.0), brightness: float = 1.0, sunlight: float = 40.0, clouds: float = 0.5,
    ground: Color = (0.12, 0.11, 0.10), skyline: float = 8.0, seed: int = 0, height: int = HEIGHT,
) -> Array:  # fmt: skip
    """A sky with clouds, a hazy sun (elevation and azimuth in degrees), and a skyline of houses and trees."""
    d = directions(height)
    up = np.clip(d[..., 2], 0, 1)[..., None]
    blue = np.array([0.85, 0.92, 1.0]) * (1 - up) ** 3 + np.array([0.16, 0.33, 0.72]) * (1 - (1 - up) ** 3)
    across = d[..., :2] / np.maximum(d[..., 2:], 0.08)
    cover = fractal_noise(across * 0.7 + 20, seed, 6)
    cover = np.clip((cover - 0.62 + 0.3 * clouds) * 5, 0, 1)[..., None] * np.clip(up * 8, 0, 1)
    tone = fractal_noise(across * 1.6 + 50, seed + 1, 5)[..., None]
    picture = blue * (1 - cover) + np.array([1.0, 0.98, 0.95]) * (0.75 + 0.5 * tone) * cover
    high, azimuth = np.radians(sun)
    toward = np.array([np.cos(high) * np.cos(azimuth), np.cos(high) * np.sin(azimuth), np.sin(high)])
    cosine = d @ toward
    glow = np.exp((cosine - 1) * 400) * sunlight + np.exp((cosine - 1) * 25) * sunlight * 0.02
    picture = brightness * (picture + glow[..., None] * np.array([1.0, 0.9, 0.72]))
    _skyline(picture, d, skyline, brightness, seed)
    below = d[..., 2] <= 0
    grit = 0.8 + 0.4 * fractal_noise(d[below] * 9, seed + 4, 4)
    picture[below] = brightness * np.array(ground) * grit[:, None]
    return picture


def _skyline(picture: Array, d: Array, highest: float, brightness: float, seed: int) -> None:
    """Houses with windows, and trees between them, painted up to ``highest`` degrees."""
    elevation = np.degrees(np.arcsin(np.clip(d[..., 2], -1, 1)))
    turn = np.degrees(np.arctan2(d[..., 1], d[..., 0])) % 360
    random = np.random.default_rng(seed + 9)
    at = 0.0
    while at < 360:
        width = random.uniform(8, 24)
        inside = (turn >= at) & (turn < at + width)
        if random.random() < 0.55:
            top = random.uniform(0.45, 1) * highest
            wall = random.uniform(0.12, 0.45) * np.array(
                [1, random.uniform(0.7, 1), random.uniform(0.5, 0.95)]
            )
            block = inside & (elevation < top) & (elevation > -1)
            picture[block] = brightness * wall
            panes = block & ((turn - at) % 2.4 > 1.1) & (elevation % 2.1 > 0.9) & (elevation < top - 0.8)
            picture[panes] = brightness * np.array([0.10, 0.14, 0.2])
        else:
            edge = highest * 0.75 * fractal_noise(np.stack((turn * 0.22, turn * 0), -1), seed + int(at), 5)
            leaves = fractal_noise(d * 40, seed + 2, 4)[..., None]
            trees = inside & (elevation < edge) & (elevation > -1)
            picture[trees] = (brightness * np.array([0.05, 0.11, 0.03]) * (0.4 + 1.4 * leaves))[trees]
        at += width


def room(
    size: tuple[float, float, float] = (6.0, 5.0, 3.0), eye: float = 1.2, walls: Color = (0.42, 0.38, 0.32),
    ceiling: Color = (0.5, 0.49, 0.47), floor: Color = (0.16, 0.1, 0.06), window: float = 9.0, lamp: float = 5.0,
    warm: float = 0.25, seed: int = 0, height: int = HEIGHT,
) -> Array:  # fmt: skip
    """A furnished room as seen from its center: two windows, ceiling lamps, pictures, shelves, a door."""
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
    top, bottom = (axis == 2) & (d[..., 2] > 0), (axis == 2) & (d[..., 2] < 0)
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
    """Shelves of books, a door, framed pictures and a skirting board on the walls."""
    random = np.random.default_rng(seed + 5)
    west = sides["west"]
    for shelf in range(5):
        foot = 0.35 + 0.42 * shelf
        picture[west & (np.abs(u) < 1.6) & (z > foot - 0.05) & (z < foot)] = (0.16, 0.09, 0.04)
        at = -1.6
        while at < 1.55:
            thick, tall = random.uniform(0.03, 0.09), random.uniform(0.22, 0.34)
            book = west & (u > at) & (u < at + thick) & (z > foot) & (z < foot + tall)
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
    """A dark studio with softboxes: each ``at`` (elevation, azimuth) and of ``size`` in degrees, with ``radiance``."""
    d = directions(height)
    picture = (floor + (top - floor) * (0.5 + 0.5 * d[..., 2:]) ** 2) * np.ones(3)
    picture *= 0.8 + 0.4 * fractal_noise(d * 3 + 5, seed, 4)[..., None]
    for item in boxes:
        high, azimuth = np.radians(item["at"])
        toward = np.array([np.cos(high) * np.cos(azimuth), np.cos(high) * np.sin(azimuth), np.sin(high)])
        right = unit(np.cross([0.0, 0, 1], toward))
        up = np.cross(toward, right)
        ahead = np.maximum(d @ toward, 1e-3)
        wide, tall = (np.tan(np.radians(s / 2)) for s in item["size"])
        x, y = d @ right / ahead / wide, d @ up / ahead / tall
        shade = np.clip((1 - np.maximum(np.abs(x), np.abs(y))) * 12, 0, 1) * (d @ toward > 0)
        picture = picture * (1 - shade[..., None]) + shade[..., None] * np.array(item["radiance"], float)
    return picture


ENVIRONMENTS: dict[str, Callable[..., Array]] = {
    "uniform": uniform, "sky": sky, "room": room, "studio": studio, "image": image,
}  # fmt: skip


def make_environment(data: dict[str, Any], where: str, folder: Path) -> Array:
    """The panorama [H, W, 3] of an environment as data.

    Raises:
        PolarguideError: the type or a field is unknown, or a value is invalid.
    """
    fields = dict(data)
    kind = fields.pop("type", None)
    maker = ENVIRONMENTS.get(kind) if isinstance(kind, str) else None
    try:
        if maker is None:
            raise ValueError(f"the type {kind!r}")
        return maker(**fields, **({"folder": folder} if kind == "image" else {}))
    except (TypeError, ValueError, KeyError) as error:
        raise PolarguideError(
            f"{where} (environment)",
            expected=f"a type of {', '.join(ENVIRONMENTS)} with its fields",
            found=str(error),
            remedy="docs/reference/scene-files.md describes them.",
        ) from error
