"""Textures of a scene: each texel is the weighted mean of its pixels in the views.

A view contributes to a texel only if its rendered surface lies at the depth of the texel. So occluders and the
background do not stain the texture. The weight of a view is the squared cosine of the viewing angle.

Dividing the diffuse layer by the irradiance of the mesh under the learned light removes shading. A smooth dielectric
with a diffuse base of albedo a has, at normal incidence, the diffuse radiance

    D = a T(0) E,   E = (1 / pi) integral of T(i) L(w) cos(i) dw

with the share T of light that passes its surface. L is the radiance of the environment, or the diffuse layer
of an occluder. The diffuse layer already contains all further bounces. Rays start at the vertices, and their light is
stored as spherical harmonics. The integral uses the normals of the texels, so that edges stay sharp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from polarguide.capture import View
from polarguide.core.errors import optional_import
from polarguide.core.progress import Advance, Reporter
from polarguide.gaussians.harmonics import sh_basis
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, spread_directions, unit
from polarguide.optics import reflectances_from_cosine
from polarguide.raster.surface import WIDTH
from polarguide.results.export.model.topology import Places
from polarguide.results.rendering.mesh import OPAQUE, ColoredMesh
from polarguide.runs.model import GaussianModel
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult
from polarguide.shading.surface import GltfTexture

RAYS = 384
"""Number of rays per vertex. The noise of their mean is a few percent, and interpolation smooths it."""
DEGREE = 2
"""Degree of the harmonics of incident light. A cosine lobe removes higher degrees (Ramamoorthi and Hanrahan 2001)."""
_RAY_BATCH = 1 << 19  # rays, about 100 MB
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
    step = max(1, _RAY_BATCH // RAYS)
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


ColorSource = Literal["diffuse", "final", "photograph"]
"""Layer that provides the base color."""
STEEPEST = 0.15
"""Cosine of the viewing angle below which a view is ignored. A pixel covers seven times its width there."""
NEAR = 2.0
"""Maximum distance between a texel and the rendered surface at a perpendicular view, in voxels."""
SEEN = 0.05
"""Sum of weights above which a texel counts as seen. One view at a cosine of 0.22 reaches it."""
_BATCH = 1 << 19  # texels
_FILLED_FROM = 200_000
"""Maximum number of seen texels that are searched for the nearest one of an unseen texel."""


@dataclass(frozen=True, eq=False)
class Baked:
    """Baked values of M texels, in single precision.

    Attributes:
        color: [M, 3] linear.
        roughness: [M] roughness as defined by glTF.
        metalness: [M] share of metal.
        strength: [M] strength of the reflection.
        reflectance: [M, 3] reflectance of metals at normal incidence.
        index: [M] refractive index.
        normal: [M, 3] learned normals, not normalized.
        seen: [M] bool, texels that are visible in at least one view.
        nearest: [U] index of the nearest seen texel for each unseen texel, which takes its values.
        added: [M, C] values in [0, 1] of each surface property that has its own texture.
    """

    color: NDArray[np.float32]
    roughness: NDArray[np.float32]
    metalness: NDArray[np.float32]
    strength: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    index: NDArray[np.float32]
    normal: NDArray[np.float32]
    seen: NDArray[np.bool_]
    nearest: NDArray[np.int64]
    added: Sequence[tuple[GltfTexture, NDArray[np.float32]]] = ()

    def filled(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Replace the values [M, C] of unseen texels by values of the nearest seen texels."""
        values = values.copy()
        values[~self.seen] = values[self.nearest]
        return values


CHANNELS = {
    "color": 3,
    "roughness": 1,
    "metalness": 1,
    "strength": 1,
    "reflectance": 3,
    "index": 1,
    "normal": 3,
}
"""Number of channels of each baked quantity. Surface properties with a texture of their own follow."""
CONSTANTS = {"roughness": 1.0, "metalness": 0.0, "strength": 0.0}
"""Default values for recipes that do not learn these quantities. They describe a matte dielectric."""


@torch.no_grad()
def bake(
    run: OpenedRun,
    views: Sequence[View],
    places: NDArray[np.float32],
    normals: NDArray[np.float32],
    color: ColorSource,
    voxel: float,
    reporter: Reporter,
) -> Baked:
    """Average pixels of the views at points of the surface.

    Args:
        run: the run.
        views: views to sample.
        places, normals: [M, 3] in the scene, unit normals.
        color: layer to sample for the base color, or the photographs.
        voxel: side of a voxel in the fusion of depth maps.
        reporter: receives progress.
    """
    model = run.model
    points = torch.from_numpy(places)
    facing = torch.from_numpy(normals)
    added = [row for row in model.shading.surface if row.gltf is not None]
    channels = {**CHANNELS, **{row.name: row.channels for row in added}}
    total = torch.zeros(len(points), sum(channels.values()))
    weights = torch.zeros(len(points))
    with reporter.track("baking textures", len(views)) as progress:
        for count, view in enumerate(views, 1):
            result = run.result(view.camera).to("cpu")
            layers = _layers(model, result, view, color)
            layers |= {row.name: result.layers[row.name].view(*result.alpha.shape, -1) for row in added}
            picture = torch.cat([*layers.values()], dim=-1)
            depth = _reliable_depth(result, view if color == "photograph" else None)
            for begin in range(0, len(points), _BATCH):
                part = slice(begin, begin + _BATCH)
                rows, weight, pixels = _visible(points[part], facing[part], view.camera, depth, voxel)
                sampled = grid_sample(picture.permute(2, 0, 1)[None], pixels[None, None], align_corners=False)
                total[part].index_add_(0, rows, weight[:, None] * sampled[0, :, 0].T)
                weights[part].index_add_(0, rows, weight)
            progress(count)
    visible = (weights > SEEN).numpy()
    nearest = _nearest_seen(places, visible)
    total /= weights.clamp(min=1e-6)[:, None]
    values = total.numpy()
    values[~visible] = values[nearest]
    parts = dict(zip(channels, np.split(values, np.cumsum([*channels.values()])[:-1], axis=1), strict=True))
    named = {name: parts[name] if CHANNELS[name] == 3 else parts[name][:, 0] for name in CHANNELS}
    textures = [(row.gltf, parts[row.name]) for row in added if row.gltf is not None]
    return Baked(**named, added=textures, seen=visible, nearest=nearest)


def _layers(model: GaussianModel, result: RenderResult, view: View, color: ColorSource) -> dict[str, Tensor]:
    """Return a picture [H, W, C] of each baked quantity. Division by alpha removes the background."""
    alpha = result.alpha.clamp(min=0.05)[..., None]
    size = result.alpha.shape
    if color == "photograph":
        colors = view.photograph().cpu()
    elif color == "final":
        colors = result.final / alpha
    else:
        colors = result.layers.get("diffuse", result.base) / alpha
    layers = {"color": colors}
    for name, constant in CONSTANTS.items():
        values = result.layers.get(name)
        layers[name] = torch.full((*size, 1), constant) if values is None else values[..., None]
    layers["strength"] = (layers["strength"] / alpha).clamp(max=1)
    layers["reflectance"] = result.layers.get("reflectance", torch.zeros(*size, 3))
    index = result.layers.get("index", torch.full(size, model.shading.refractive_index))
    layers["index"] = index[..., None]
    layers["normal"] = result.normal
    return layers


def _reliable_depth(result: RenderResult, view: View | None) -> Tensor:
    """Return the depth [H, W] of the surface, with 0 at unreliable pixels.

    Unreliable pixels are translucent, on an outline, or invalid in the photograph of ``view``.
    """
    depth = result.depth
    far = max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
    near = -max_pool2d(-depth[None, None], 3, 1, 1)[0, 0]
    # If depths next to a pixel differ by more than the surface thickness, the pixel mixes two surfaces.
    solid = (result.alpha > OPAQUE) & (far - near < 2 * WIDTH * depth)
    if view is not None:
        solid &= ~view.invalid.cpu()
    return torch.where(solid, depth, 0.0)


def _visible(
    points: Tensor, normals: Tensor, camera: Camera, depth: Tensor, voxel: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the points that are visible in a view.

    Returns:
        The rows [K] of the visible points in ``points``, their weights [K], and their positions [K, 2] in the picture,
        in [-1, 1] as for ``grid_sample``.
    """
    offsets = points - camera.center.float()
    cosine = -dot(unit(offsets), normals)
    rows = (cosine > STEEPEST).nonzero()[:, 0]
    x, y, z = camera.to_camera(offsets[rows]).unbind(-1)
    column = camera.fx * x / z + camera.cx
    row = camera.fy * y / z + camera.cy
    inside = (
        (z > 0) & (column > 0.5) & (column < camera.width - 0.5) & (row > 0.5) & (row < camera.height - 0.5)
    )
    rows = rows[inside]
    z = z[inside]
    column = column[inside]
    row = row[inside]
    surface = depth[row.long(), column.long()]
    cosine = cosine[rows]
    # The depth of an inclined surface changes within half a pixel.
    tolerance = (NEAR * voxel + 0.5 * z / camera.fx) / cosine.clamp(min=0.3)
    visible = (surface > 0) & ((surface - z).abs() < tolerance)
    places = torch.stack((2 * column / camera.width - 1, 2 * row / camera.height - 1), dim=-1)
    return rows[visible], cosine[visible].square(), places[visible]


def _nearest_seen(places: NDArray[np.float32], visible: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the index of an approximately nearest visible texel for each invisible texel.

    Without visible texels, return the index of each texel itself.
    """
    known = visible.nonzero()[0]
    unseen = (~visible).nonzero()[0]
    if not len(known) or not len(unseen):
        return unseen
    known = known[:: -(-len(known) // _FILLED_FROM)]
    return np.asarray(known[cKDTree(places[known]).query(places[unseen])[1]])
