"""Which views are held out to be scored on, where the capture does not say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from polarguide.core.options import Split
from polarguide.geometry.camera import Camera

TEST_EVERY = 8
"""One view in so many is held out."""
FAR = 2.5
"""A held-out view is far from training if its nearest training view is this many times as far as views usually are from
each other."""
FEWEST_IN_BAND = 4
"""Views from which on a band of heights counts as one."""
SAME_HEIGHT = 1e-3
"""Heights that differ by less than this share of how far they spread are those of one ring."""
_ROUNDS = 10


def chosen_views(cameras: Mapping[str, Camera], split: Split) -> tuple[str, ...]:
    """The names of the views to hold out, one in ``TEST_EVERY``, sorted; none of a single view.

    Args:
        cameras: of the views, by name. split: "every-8th" takes every 8th in the order of the names, starting with the
            first. "directions" takes the middle one of each of as many groups of neighboring views, so that every
            held-out view has training views around it, and no part of the directions is held out as a whole.
    """
    names = sorted(cameras)
    if len(names) < 2:
        return ()
    if split == "every-8th":
        return tuple(names[::TEST_EVERY])
    apart = _distances([cameras[name] for name in names])
    return tuple(names[k] for k in sorted(_middles(apart, -(-len(names) // TEST_EVERY))))


def far_from_training(cameras: Mapping[str, Camera], tests: Sequence[str]) -> list[str]:
    """The held-out views that are far from all training views, see ``FAR``, sorted."""
    names = sorted(cameras)
    trains = [k for k, name in enumerate(names) if name not in tests]
    if len(names) < 3 or not trains:
        return []
    apart = _distances([cameras[name] for name in names])
    others = apart + np.diag(np.full(len(names), np.inf))
    usual = float(np.median(others.min(axis=1)))
    return [name for k, name in enumerate(names) if name in tests and apart[k, trains].min() > FAR * usual]


def held_out_band(cameras: Mapping[str, Camera], tests: Sequence[str]) -> list[str]:
    """The held-out views of a band of heights in which no view is trained on, such as a whole ring; empty if none.

    Told are bands of at least ``FEWEST_IN_BAND`` views and half of those that are held out. Heights are along the mean
    of what is up in the pictures.
    """
    names = sorted(cameras)
    if not names:
        return []
    up = -np.stack([cameras[name].rotation[1].double().numpy() for name in names]).mean(axis=0)
    heights = np.stack([cameras[name].center.double().numpy() for name in names]) @ up
    apart = max(SAME_HEIGHT * float(np.ptp(heights)), 1e-12)
    rings: list[list[int]] = []
    for k in (int(place) for place in np.argsort(heights, kind="stable")):
        if rings and heights[k] - heights[rings[-1][0]] < apart:
            rings[-1].append(k)
        else:
            rings.append([k])
    bands: list[list[str]] = [[]]
    for ring in rings:
        if all(names[k] in tests for k in ring):
            bands[-1] += [names[k] for k in ring]
        else:
            bands.append([])
    longest = max(bands, key=len)
    enough = len(longest) >= FEWEST_IN_BAND and 2 * len(longest) >= len(tests) and len(tests) < len(names)
    return sorted(longest) if enough else []


def _distances(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """[V, V] distances: of the centers, in units of how far they spread, and of the viewing directions."""
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    looks = np.stack([camera.rotation[2].double().numpy() for camera in cameras])
    spread = np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max()
    places = np.concatenate([centers / max(spread, 1e-12), looks], axis=1)
    return np.asarray(np.linalg.norm(places[:, None] - places[None], axis=-1))


def _middles(apart: NDArray[np.float64], count: int) -> list[int]:
    """The views in the middle of ``count`` groups: k-medoids from the views that are farthest from each other.

    Groups of one or two views have no middle: in their place views are taken of the largest groups, far from those that
    are taken already.
    """
    middles = [int(apart.sum(axis=1).argmin())]
    while len(middles) < count:
        reach = apart[:, middles].min(axis=1)
        reach[middles] = -1.0  # never twice, also of cameras in one place
        middles.append(int(reach.argmax()))
    for _ in range(_ROUNDS):
        group = apart[:, middles].argmin(axis=1)
        group[middles] = np.arange(count)
        members = [np.flatnonzero(group == k) for k in range(count)]
        found = [int(m[apart[np.ix_(m, m)].sum(axis=1).argmin()]) for m in members]
        if found == middles:
            break
        middles = found
    taken = [middle for middle, m in zip(middles, members, strict=True) if len(m) > 2]
    while len(taken) < count:
        free = [int(k) for m in members if len(m) > 2 for k in m if k not in taken]
        if not free:  # every group is that small
            return middles
        reach = apart[np.ix_(free, taken)].min(axis=1)
        taken.append(free[int(reach.argmax())])
    return taken
