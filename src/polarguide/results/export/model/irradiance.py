"""Irradiance of a mesh under the learned light. Dividing the diffuse layer by the irradiance removes shading.

A smooth dielectric with a diffuse base of albedo a has, at normal incidence, the diffuse radiance

    D = a T(0) E,   E = (1 / pi) integral of T(i) L(w) cos(i) dw

with the share T of light that passes its surface. L is the radiance of the environment, or the diffuse layer
of an occluder. The diffuse layer already contains all further bounces. Rays start at the vertices, and their light is
stored as spherical harmonics. The integral uses the normals of the texels, so that edges stay sharp.
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
from polarguide.geometry.camera import spread_directions
from polarguide.optics import reflectances_from_cosine
from polarguide.results.export.model.topology import Places
from polarguide.results.rendering.mesh import ColoredMesh

RAYS = 384
"""Number of rays per vertex. The noise of their mean is a few percent, and interpolation smooths it."""
DEGREE = 2
"""Degree of the harmonics of incident light. A cosine lobe removes higher degrees (Ramamoorthi and Hanrahan 2001)."""
_BATCH = 1 << 19  # rays, about 100 MB
OFFSET = 2.5e-3
"""Offset of the rays from the surface, relative to the diagonal of the occluders."""
FLOOR = 0.05
"""Lower bound of the irradiance, relative to its mean over the mesh. Dividing by smaller values amplifies noise."""

WHAT = "--base-color delit"
Radiance = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Light sources of a mesh.

    Attributes:
        radiance: radiance of the environment.
        occluder: mesh that hides parts of the environment, with linear diffuse radiance at its vertices.
    """

    radiance: Radiance
    occluder: ColoredMesh


def arriving_light(points: Places, normals: Places, around: Surroundings, advance: Advance) -> Places:
    """Trace rays from points [V, 3] with unit normals [V, 3], and return harmonics [V, K, 3] of the incident light.

    Raises:
        PolarguideError: embreex is not installed.
    """
    rays = _Rays(around.occluder)
    offset = OFFSET * float(np.linalg.norm(np.ptp(around.occluder.surface.vertices, axis=0)))
    random = np.random.default_rng(0)
    spread = spread_directions(RAYS).numpy()
    total = np.zeros((len(points), (DEGREE + 1) ** 2, 3))
    step = max(1, _BATCH // RAYS)
    for begin in range(0, len(points), step):
        part = slice(begin, begin + step)
        # Random rotations avoid a common pattern.
        directions = spread @ Rotation.random(len(points[part]), random).as_matrix()
        origins = np.repeat(points[part] + offset * normals[part], RAYS, axis=0)
        light = rays.arriving(origins, directions.reshape(-1, 3), around.radiance).reshape(-1, RAYS, 3)
        total[part] = 4 * math.pi / RAYS * _basis(directions).swapaxes(1, 2) @ light
        advance(min(begin + step, len(points)))
    return total


def irradiance(light: NDArray[Any], normals: NDArray[Any], index: float) -> NDArray[np.float32]:
    """Compute the irradiance [M, 3] of a dielectric from harmonics of light [M, K, 3] and unit normals [M, 3]."""
    cosines, weights = np.polynomial.legendre.leggauss(64)
    cosines = (cosines + 1) / 2
    weights = weights / 2
    passed = 2 * weights * cosines * (1 - _reflectance(cosines, index))
    lobe = [
        (passed * legendre(cosines)).sum()
        for legendre in map(np.polynomial.Legendre.basis, range(DEGREE + 1))
    ]
    factors = np.repeat(lobe, 2 * np.arange(DEGREE + 1) + 1)  # Degree l has 2 l + 1 harmonics.
    return np.asarray(np.einsum("mk,mkc->mc", factors * _basis(normals), light), np.float32)


def _basis(directions: NDArray[Any]) -> Places:
    return np.asarray(sh_basis(torch.from_numpy(directions).double(), DEGREE).numpy())


def delit(diffuse: NDArray[np.float32], light: NDArray[np.float32], index: float) -> NDArray[np.float32]:
    """Compute the base color [..., 3] from the diffuse layer and the irradiance by the formula of this module."""
    floored = np.maximum(light, np.float32(FLOOR * light.mean()))
    passed = np.float32(1 - _reflectance(np.ones(1), index)[0])
    return np.asarray(diffuse / (floored * passed), np.float32)


def _reflectance(cosine: NDArray[np.float64], index: float) -> NDArray[np.float64]:
    s, p = reflectances_from_cosine(torch.from_numpy(cosine), index)
    return np.asarray((0.5 * (s + p)).numpy())


class _Rays:
    """Embree scene of a mesh, for ray tracing.

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
        self._geometry = meshes.TriangleMesh(self._scene, corners)  # The scene holds no reference.

    def arriving(self, origins: Places, directions: Places, radiance: Radiance) -> Places:
        """Return the radiance [N, 3] that arrives at each origin from a unit direction [N, 3].

        It comes from the mesh if the ray hits it, otherwise from the environment.
        """
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
