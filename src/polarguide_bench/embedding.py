"""Pictures of a view for a report, as data URIs that fit a limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from polarguide.visualization.figures import Picture
from polarguide.visualization.pages import data_uri

SIDES = (1600, 1200, 800, 600, 400, 300, 200)
"""Longest sides in pixels to try until a view fits its share of the file."""


@dataclass(frozen=True, eq=False)
class Tile:
    """One method (or the ground truth) on one view: its layers, and its scores there as a line of text a layer."""

    name: str
    pictures: Mapping[str, Picture]
    scores: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class EmbeddedView:
    """One view of a scene with all its tiles as data URIs.

    Attributes:
        scene, view: names. width, height: those of the captured pictures, for the shape of the tiles.
        tiles: for each its name, its layers as data URIs, and its lines of scores.
    """

    scene: str
    view: str
    width: int
    height: int
    tiles: tuple[tuple[str, dict[str, str], dict[str, str]], ...]


def embed(scene: str, view: str, tiles: Sequence[Tile], limit: int) -> tuple[EmbeddedView | None, str | None]:
    """Encode one view, smaller if it has to be.

    Args:
        scene, view: names.
        tiles: at least one, of pictures of one size.
        limit: bytes that the data URIs may take.

    Returns:
        The view, or None if it does not fit; and a sentence on what was reduced or left out, or None.
    """
    height, width = next(iter(tiles[0].pictures.values())).shape[:2]
    longest = max(height, width)
    for side in (longest, *(side for side in SIDES if side < longest)):
        encoded = tuple(
            (t.name, {key: data_uri(p, key, side) for key, p in t.pictures.items()}, dict(t.scores))
            for t in tiles
        )
        if sum(len(uri) for _, uris, _ in encoded for uri in uris.values()) <= limit:
            note = f"{scene}, {view}: pictures reduced from {longest} to {side} pixels."
            return EmbeddedView(scene, view, width, height, encoded), note if side < longest else None
    return None, f"{scene}, {view}: pictures left out, they would make the file too large."


def chosen_views(names: Sequence[str], count: int) -> list[str]:
    """At most ``count`` of the names, evenly spread, the first among them."""
    if count >= len(names):
        return list(names)
    return [names[index * len(names) // count] for index in range(count)]
