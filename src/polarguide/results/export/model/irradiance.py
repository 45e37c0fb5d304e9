"""Irradiance of a mesh under the learned light: what base color is divided by, so that no shading is left in it.

A smooth dielectric with a diffuse base of albedo a has, seen at normal incidence, the diffuse radiance

    D = a T(0) E,   E = (1 / pi) integral of T(i) L(w) cos(i) dw

with T the share of light that passes its surface. L is the environment's radiance where nothing is in the way, else the
diffuse layer of what is hit: one bounce, of light that the run has measured with all bounces before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.core.errors import optional_import
from polarguide.core.progress import Advance
from polarguide.optics import reflectances_from_cosine
from polarguide.results.export.model.topology import Places
from polarguide.results.rendering.mesh import ColoredMesh

RAYS = 192
"""Rays from each vertex: the noise of their mean is a few percent, and textures smooth it between vertices."""
_TOGETHER = 1 << 19
"""Rays traced together: about 100 MB."""
OFFSET = 2.5e-3
"""How far from the surface rays begin, as a share of the diagonal of all that can be hit."""
FLOOR = 0.05
"""Irradiance counts at least as this share of its mean over the mesh: division by less would only enlarge noise."""

WHAT = "--base-color delit"
Radiance = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What lights a mesh.

    Attributes:
        radiance: from afar, [N, 3] of unit directions [N, 3]. occluder: what stands in its way, with linear diffuse
            radiance at its vertices.
    """

    radiance: Radiance
    occluder: ColoredMesh


def irradiance(
    points: Places, normals: Places, around: Surroundings, index: float, advance: Advance
) -> Places:
    """E [V, 3] at points [V, 3] with unit normals [V, 3], floored, for surfaces of a refractive index.

    Raises:
        PolarguideError: embreex is not installed.
    """
    rays = _Rays(around.occluder)
    offset = OFFSET * float(np.linalg.norm(np.ptp(around.occluder.surface.vertices, axis=0)))
    random = np.random.default_rng(0)
    local = _cosine_directions(random)
    transmitted = 1 - _reflectance(local[:, 2], index)
    total = np.zeros((len(points), 3))
    step = max(1, _TOGETHER // RAYS)
    for begin in range(0, len(points), step):
        part = slice(begin, begin + step)
        frames = _frames(normals[part], random)
        directions = np.einsum("vij,rj->vri", frames, local).reshape(-1, 3)
        origins = np.repeat(points[part] + offset * normals[part], RAYS, axis=0)
        light = rays.arriving(origins, directions, around.radiance).reshape(-1, RAYS, 3)
        total[part] = (transmitted[None, :, None] * light).mean(axis=1)
        advance(min(begin + step, len(points)))
    return np.maximum(total, FLOOR * total.mean())


def delit(diffuse: NDArray[np.float32], light: NDArray[np.float32], index: float) -> NDArray[np.float32]:
    """Base color [..., 3] of the diffuse layer and irradiance; see the module's text."""
    return diffuse / (light * np.float32(1 - _reflectance(np.ones(1), index)[0]))


def _reflectance(cosine: NDArray[np.float64], index: float) -> NDArray[np.float64]:
    s, p = reflectances_from_cosine(torch.from_numpy(cosine), index)
    return np.asarray((0.5 * (s + p)).numpy())


def _cosine_directions(random: np.random.Generator) -> Places:
    """Directions [RAYS, 3] about +z, as many as the cosine of their angle to it: a spiral, so that they lie evenly."""
    golden = math.pi * (3 - math.sqrt(5))
    share = (np.arange(RAYS) + random.random(RAYS)) / RAYS
    radius, turn = np.sqrt(share), golden * np.arange(RAYS)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - share)], axis=1)


def _frames(normals: Places, random: np.random.Generator) -> NDArray[np.float64]:
    """Rotations [V, 3, 3] from +z to the normals, each turned by a random angle: else all would share a pattern."""
    helper = np.where(np.abs(normals[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2 * math.pi * random.random(len(normals))[:, None]
    turned = np.cos(angle) * first + np.sin(angle) * second
    return np.stack([turned, np.cross(normals, turned), normals], axis=2)


class _Rays:
    """Rays against a mesh, by Embree.

    Raises:
        PolarguideError: embreex is not installed.
    """

    def __init__(self, mesh: ColoredMesh) -> None:
        scenes: Any = optional_import("embreex.rtcore_scene", WHAT, extra="model")
        meshes: Any = optional_import("embreex.mesh_construction", WHAT, extra="model")
        self._faces, self._colors = mesh.surface.faces, mesh.colors
        corners = np.ascontiguousarray(mesh.surface.vertices[self._faces], np.float32)
        self._scene = scenes.EmbreeScene()
        self._geometry = meshes.TriangleMesh(self._scene, corners)  # the scene keeps no reference to it

    def arriving(self, origins: Places, directions: Places, radiance: Radiance) -> Places:
        """Radiance [N, 3] at origins from unit directions [N, 3]: the mesh's colors, or from afar past it."""
        starts, rays = (np.ascontiguousarray(values, np.float32) for values in (origins, directions))
        hits = self._scene.run(starts, rays, output=True)
        light, hit = radiance(directions), hits["primID"] >= 0
        corners = self._faces[hits["primID"][hit]]
        second, third = hits["u"][hit][:, None], hits["v"][hit][:, None]
        a, b, c = (self._colors[corners[:, k]] for k in range(3))
        light[hit] = (1 - second - third) * a + second * b + third * c
        return light
