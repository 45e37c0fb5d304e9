"""Irradiance of a mesh under the learned light: what base color is divided by, so that no shading is left in it.

A smooth dielectric with a diffuse base of albedo a has, seen at normal incidence, the diffuse radiance

    D = a T(0) E,   E = (1 / pi) integral of T(i) L(w) cos(i) dw

with T the share of light that passes its surface. L is the environment's radiance where nothing is in the way, else the
diffuse layer of what is hit: one bounce, of light that the run has measured with all bounces before it. Rays begin at
the vertices, where light is kept as spherical harmonics; normals are those of the texels, so that edges are sharp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polarguide.core.errors import optional_import
from polarguide.core.progress import Advance
from polarguide.gaussians.harmonics import sh_basis
from polarguide.geometry.vectors import spread_directions
from polarguide.optics import reflectances_from_cosine
from polarguide.results.export.model.topology import Places
from polarguide.results.rendering.mesh import ColoredMesh

RAYS = 384
"""Rays from each vertex to all sides: the noise of their mean is a few percent, and textures smooth it between
vertices."""
DEGREE = 2
"""Of the harmonics that light is kept in: a cosine lobe passes hardly any of the others.

Ramamoorthi and Hanrahan 2001 have shown it."""
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


def arriving_light(points: Places, normals: Places, around: Surroundings, advance: Advance) -> Places:
    """Harmonics [V, K, 3] of the light that arrives at points [V, 3] of a surface with unit normals [V, 3].

    Raises:
        PolarguideError: embreex is not installed.
    """
    rays = _Rays(around.occluder)
    offset = OFFSET * float(np.linalg.norm(np.ptp(around.occluder.surface.vertices, axis=0)))
    random = np.random.default_rng(0)
    spread = spread_directions(RAYS).numpy()
    total = np.zeros((len(points), (DEGREE + 1) ** 2, 3))
    step = max(1, _TOGETHER // RAYS)
    for begin in range(0, len(points), step):
        part = slice(begin, begin + step)
        # Each turned at random: else all would share a pattern.
        turns = Rotation.random(len(points[part]), random).as_matrix()
        directions = spread @ turns
        origins = np.repeat(points[part] + offset * normals[part], RAYS, axis=0)
        light = rays.arriving(origins, directions.reshape(-1, 3), around.radiance).reshape(-1, RAYS, 3)
        total[part] = 4 * math.pi / RAYS * _basis(directions).swapaxes(1, 2) @ light
        advance(min(begin + step, len(points)))
    return total


def irradiance(light: NDArray[Any], normals: NDArray[Any], index: float) -> NDArray[np.float32]:
    """E [M, 3] on surfaces of a refractive index with unit normals [M, 3], of light in harmonics [M, K, 3]."""
    cosines, weights = np.polynomial.legendre.leggauss(64)
    cosines = (cosines + 1) / 2
    weights = weights / 2
    passed = 2 * weights * cosines * (1 - _reflectance(cosines, index))
    lobe = [
        (passed * legendre(cosines)).sum()
        for legendre in map(np.polynomial.Legendre.basis, range(DEGREE + 1))
    ]
    each = np.repeat(lobe, 2 * np.arange(DEGREE + 1) + 1)  # a harmonic of degree l has 2 l + 1 orders
    return np.asarray(np.einsum("mk,mkc->mc", each * _basis(normals), light), np.float32)


def _basis(directions: NDArray[Any]) -> Places:
    return np.asarray(sh_basis(torch.from_numpy(directions).double(), DEGREE).numpy())


def delit(diffuse: NDArray[np.float32], light: NDArray[np.float32], index: float) -> NDArray[np.float32]:
    """Base color [..., 3] of the diffuse layer and irradiance; see the module's text."""
    floored = np.maximum(light, np.float32(FLOOR * light.mean()))
    passed = np.float32(1 - _reflectance(np.ones(1), index)[0])
    return np.asarray(diffuse / (floored * passed), np.float32)


def _reflectance(cosine: NDArray[np.float64], index: float) -> NDArray[np.float64]:
    s, p = reflectances_from_cosine(torch.from_numpy(cosine), index)
    return np.asarray((0.5 * (s + p)).numpy())


class _Rays:
    """Rays against a mesh, by Embree.

    Raises:
        PolarguideError: embreex is not installed.
    """

    def __init__(self, mesh: ColoredMesh) -> None:
        scenes: Any = optional_import("embreex.rtcore_scene", WHAT)
        meshes: Any = optional_import("embreex.mesh_construction", WHAT)
        self._faces = mesh.surface.faces
        self._colors = mesh.colors
        corners = np.ascontiguousarray(mesh.surface.vertices[self._faces], np.float32)
        self._scene = scenes.EmbreeScene()
        self._geometry = meshes.TriangleMesh(self._scene, corners)  # the scene keeps no reference to it

    def arriving(self, origins: Places, directions: Places, radiance: Radiance) -> Places:
        """Radiance [N, 3] at origins from unit directions [N, 3]: the mesh's colors, or from afar past it."""
        starts, rays = (np.ascontiguousarray(values, np.float32) for values in (origins, directions))
        hits = self._scene.run(starts, rays, output=True)
        light = radiance(directions)
        hit = hits["primID"] >= 0
        corners = self._faces[hits["primID"][hit]]
        second = hits["u"][hit][:, None]
        third = hits["v"][hit][:, None]
        a, b, c = (self._colors[corners[:, k]] for k in range(3))
        light[hit] = (1 - second - third) * a + second * b + third * c
        return light
