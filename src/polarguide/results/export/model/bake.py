"""Textures from a trained scene: every texel has the weighted mean of what the views show of its place.

A view counts where its own rendered surface lies at the texel's depth, so that nothing is painted with what stands
before or behind it, and by the square of the cosine at which it looks.
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
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.raster.surface import WIDTH
from polarguide.results.rendering.mesh import OPAQUE
from polarguide.runs.model import GaussianModel
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult
from polarguide.shading.surface import GltfTexture

ColorSource = Literal["diffuse", "final", "photograph"]
STEEPEST = 0.15
"""Cosine below which a view does not count: its pixels are stretched seven times over the surface."""
NEAR = 2.0
"""Voxels by which a texel may lie off the rendered depth, where it is seen squarely."""
SEEN = 0.05
"""Sum of weights from which a texel counts as seen: one view at a cosine of 0.22."""
_TOGETHER = 1 << 19
_FILLED_FROM = 200_000
"""Seen texels among which the nearest one of an unseen texel is looked for, at most."""


@dataclass(frozen=True, eq=False)
class Baked:
    """Of M texels, single precision.

    Attributes:
        color: [M, 3] linear. roughness: [M] as glTF has it. metalness: [M]. strength: [M] of the reflection.
        reflectance: [M, 3] of metals at normal incidence. index: [M] refractive index.
        normal: [M, 3] learned, not unit. seen: [M] bool, whether a view shows the texel.
        nearest: [U] for each of the others the nearest texel in space that one does, whose values it has.
        added: [M, C] values in [0, 1] of surface properties with a texture of their own.
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
        """Values [M, C] with those of unseen texels replaced."""
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
"""Numbers of values of a texel. ``surface.SurfaceProperty`` rows with a texture follow."""
CONSTANTS = {"roughness": 1.0, "metalness": 0.0, "strength": 0.0}
"""Of recipes that learn nothing of the kind: a matte dielectric."""


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
    """Look up what views show at places on the surface.

    Args:
        run: of Gaussians. views: that count. places, normals: [M, 3] in the scene, normals unit.
        color: the layer, or the photographs. voxel: side of those that the surface was fused in.
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
            for begin in range(0, len(points), _TOGETHER):
                part = slice(begin, begin + _TOGETHER)
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
    """Pictures [H, W, C] of the channels, in their order, of the surface alone: blended values over alpha."""
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
    """Depth [H, W] of the surface; 0 where a pixel is translucent, on the outline of something, or, of photographs,
    invalid."""
    depth = result.depth
    far = max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
    near = -max_pool2d(-depth[None, None], 3, 1, 1)[0, 0]
    # Further apart than the surface picture is thick, to both sides: a pixel between them mixes two surfaces.
    solid = (result.alpha > OPAQUE) & (far - near < 2 * WIDTH * depth)
    if view is not None:
        solid &= ~view.invalid.cpu()
    return torch.where(solid, depth, 0.0)


def _visible(
    points: Tensor, normals: Tensor, camera: Camera, depth: Tensor, voxel: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows [K] of the points that a view shows, their weights [K], and where, [K, 2] in [-1, 1] as PyTorch counts."""
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
    # Half a pixel beside it, an inclined surface has another depth, too.
    tolerance = (NEAR * voxel + 0.5 * z / camera.fx) / cosine.clamp(min=0.3)
    visible = (surface > 0) & ((surface - z).abs() < tolerance)
    places = torch.stack((2 * column / camera.width - 1, 2 * row / camera.height - 1), dim=-1)
    return rows[visible], cosine[visible].square(), places[visible]


def _nearest_seen(places: NDArray[np.float32], visible: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For each texel that no view shows the nearest that one does, about; itself where none is."""
    known = visible.nonzero()[0]
    unseen = (~visible).nonzero()[0]
    if not len(known) or not len(unseen):
        return unseen
    known = known[:: -(-len(known) // _FILLED_FROM)]
    return np.asarray(known[cKDTree(places[known]).query(places[unseen])[1]])
