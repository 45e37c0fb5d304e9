"""Whether the matches of two pictures agree on a geometry better than wrong matches would by chance.

Some epipolar geometry fits a part of any matches, and in small pictures a large one. Moisan and Stival 2004, "A
probabilistic criterion to detect rigid point matches between two images and estimate the fundamental matrix", count
how many geometries one would expect to find that fit as many of so many matches between random places. A geometry
means something where that number is below one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import pycolmap

SAMPLE = 7
"""Matches that determine an epipolar geometry."""


def log_false_alarms(matches: int, agreeing: int, share: float) -> float:
    """Natural logarithm of the number of geometries expected by chance that fit as many of the matches.

    Args:
        matches: of the two pictures. agreeing: those of them that fit.
        share: of the picture's area that fits an epipolar line, at most: the probability that a wrong match does.
    """
    if agreeing <= SAMPLE:
        return math.inf
    choices = _log_choices(matches, agreeing) + _log_choices(agreeing, SAMPLE)
    return math.log(matches - SAMPLE) + choices + (agreeing - SAMPLE) * math.log(min(share, 1.0))


def _log_choices(count: int, chosen: int) -> float:
    return math.lgamma(count + 1) - math.lgamma(chosen + 1) - math.lgamma(count - chosen + 1)


def connected_views(database: Path, sizes: Mapping[str, tuple[int, int]]) -> int:
    """How many views there are in the largest group that pairs connect which agree better than by chance.

    Args:
        database: of COLMAP, with matches and verified geometries of ``<view>.png``.
        sizes: width and height of every picture, by view.
    """
    error = pycolmap.TwoViewGeometryOptions().ransac.max_error
    with pycolmap.Database.open(database) as link:
        names = {image.image_id: image.name.removesuffix(".png") for image in link.read_all_images()}
        matches = dict(zip(*link.read_all_matches(), strict=True))
        verified = dict(zip(*link.read_two_view_geometries(), strict=True))
    group = {name: {name} for name in names.values()}
    for pair, geometry in verified.items():
        first, second = (names[number] for number in pycolmap.pair_id_to_image_pair(pair))
        width, height = sizes[second]
        share = 2 * error * math.hypot(width, height) / (width * height)
        if log_false_alarms(len(matches[pair]), len(geometry.inlier_matches), share) < 0:
            joined = group[first] | group[second]
            group |= dict.fromkeys(joined, joined)
    return max(map(len, group.values()), default=0)
