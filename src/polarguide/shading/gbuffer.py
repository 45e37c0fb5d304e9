"""From Gaussians to a picture: one splat of the G-buffer, then the shading model per pixel."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.native import fits
from polarguide.raster.interface import Rasterize, ScreenStatistic
from polarguide.raster.surface import surface_picture
from polarguide.shading.layout import NORMAL_CHANNELS, Layout
from polarguide.shading.model import PLAIN, GBuffer, Light, Parameters, ShadingModel
from polarguide.shading.native import split_native
from polarguide.shading.result import RenderResult
from polarguide.shading.splatting import splatting

NO_LIGHT: Light = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """What is wanted of a rendering.

    Attributes:
        sh_degree: SH degree of the base color, 0 to 3.
        normals: the blended normal, also for a shading model that does not need it.
        depth: the camera depth.
        layers_detached: the layers once more, without a gradient on the normals (of a shading model with layers).
        normal_rotation_only: the blended normal once more, with a gradient that rotates Gaussians, but neither moves
            them nor changes their opacity.
        at_median_depth: normal and depth are those of the surface at each pixel's median depth, without gradients. The
            layers are shaded with the blended normal all the same.
        statistic: see ``ScreenStatistic``; the color channels come first.
    """

    sh_degree: int = 3
    normals: bool = True
    depth: bool = False
    layers_detached: bool = False
    normal_rotation_only: bool = False
    at_median_depth: bool = False
    statistic: ScreenStatistic | None = None


def render(
    gaussians: Parameters,
    camera: Camera,
    rasterize: Rasterize,
    request: RenderRequest = RenderRequest(),
    *,
    shading: ShadingModel = PLAIN,
    light: Light = NO_LIGHT,
) -> RenderResult:
    """Render one view.

    Args:
        gaussians: the Gaussians, with the parameters of the shading model; with ``outward`` where normals are turned
            to the side from which they are seen, not to the camera.
        request: what the result holds.
        shading: what is splatted, and how it makes the picture. light: its learned light, by name.
    """
    normals, depth = request.normals or shading.needs_normals, request.depth
    given, layout = splatting(
        gaussians, camera, shading, sh_degree=request.sh_degree, normals=normals, depth=depth
    )
    rotated = NORMAL_CHANNELS if request.normal_rotation_only and normals else ()
    picture = rasterize(given, camera, statistic=request.statistic, still=rotated)
    features, normal, camera_depth = split(picture.features, picture.alpha, layout)
    splatted = GBuffer(features, picture.alpha, layout)
    if request.layers_detached and normals:
        layers, detached = shading.shade_detached(splatted, light, camera)
    else:
        layers, detached = shading.shade(splatted, light, camera), None
    blended = None
    if request.at_median_depth and (normals or depth):
        directions = (
            given.features[:, layout.channels("normal")] if normals else torch.zeros_like(given.means)
        )
        found = surface_picture(given._replace(features=directions), camera)
        camera_depth = found.depth if depth else None
        if normals:
            normal, blended = picture.alpha[..., None] * found.directions, normal
    return RenderResult(
        final=layers["final"],
        base=splatted["color"],
        **{name: layers.get(name) for name in ("specular", "diffuse", "reflection", "strength", "metalness")},
        normal=normal,
        depth=camera_depth,
        alpha=picture.alpha,
        radii=picture.radii,
        detached_layers=detached,
        rotation_only_normal=picture.still,
        metal=layers.get("metal"),
        index=layers.get("index"),
        blended_normal=blended,
    )


Split = tuple[Tensor, Tensor | None, Tensor | None]


def split(features: Tensor, alpha: Tensor, layout: Layout) -> Split:
    """What a result holds of its G-buffer: ``split_reference``, on the CPU in float32 with one native gradient pass.

    Without a gradient and a depth there is nothing to do natively: the normal is a part of the features.
    """
    depth, further = "depth" in layout, features.shape[-1] > 6
    if "normal" in layout and further and fits(features) and (depth or features.requires_grad):
        return split_native(features, alpha, depth=depth)
    return split_reference(features, alpha, layout)


def split_reference(features: Tensor, alpha: Tensor, layout: Layout) -> Split:
    """Features for the shading model, blended normal [H, W, 3] and camera depth [H, W]; any dtype and device.

    Args:
        features: [H, W, D] blended; the depth is times alpha. alpha: [H, W]. layout: of the features.
    """
    normal = features[..., layout.channels("normal")] if "normal" in layout else None
    if "depth" not in layout:
        return features, normal, None
    return features, normal, features[..., layout.first("depth")] / alpha.clamp(min=1e-6)
