"""Textures of a scene: each texel is the weighted mean of its pixels in the views.

A view contributes to a texel only if its rendered surface lies at the depth of the texel. So occluders and the
background do not stain the texture. The weight of a view is the squared cosine of the viewing angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from polarguide.capture import View
from polarguide.core.progress import Reporter
from polarguide.geometry.camera import Camera, dot, unit
from polarguide.raster.surface import WIDTH
from polarguide.results.rendering.mesh import OPAQUE
from polarguide.runs.model import GaussianModel
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult
from polarguide.shading.surface import GltfTexture

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
