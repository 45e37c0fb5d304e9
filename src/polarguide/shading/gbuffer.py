"""From Gaussians to a picture: one splat of the G-buffer, then the shading model per pixel."""

from __future__ import annotations

from types import MappingProxyType

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.native import fits
from polarguide.raster.interface import Rasterize, ScreenStatistic
from polarguide.raster.surface import surface_picture
from polarguide.shading.model import PLAIN, GBuffer, Light, Parameters, ShadingModel
from polarguide.shading.native import split_native
from polarguide.shading.result import RenderResult
from polarguide.shading.splatting import splatting

COLOR_CHANNELS = (0, 1, 2)
NORMAL_CHANNELS = (3, 4, 5)
NO_LIGHT: Light = MappingProxyType({})


def render(
    gaussians: Parameters,
    camera: Camera,
    rasterize: Rasterize,
    *,
    sh_degree: int = 3,
    shading: ShadingModel = PLAIN,
    light: Light = NO_LIGHT,
    normals: bool = True,
    depth: bool = False,
    held: bool = False,
    still: bool = False,
    surface: bool = False,
    statistic: ScreenStatistic | None = None,
) -> RenderResult:
    """Render one view.

    Args:
        gaussians: the Gaussians, with the parameters of the shading model; with ``outward`` where normals are turned
            to the side from which they are seen, not to the camera.
        sh_degree: SH degree of the base color, 0 to 3.
        shading: what is splatted, and how it makes the picture. light: its learned light, by name.
        normals: also splat normals where the shading model does not need them.
        depth: also splat camera depth.
        held: also give the layers without a gradient on the normals, of a shading model that has them.
        still: also give the blended normal with a gradient that turns Gaussians and neither moves nor fades them.
        surface: normals and depth are those around the median depth, without gradients; the layers are shaded as ever.
        statistic: see ``ScreenStatistic``; the color channels come first.
    """
    normals = normals or shading.needs_normals
    given = splatting(gaussians, camera, shading, sh_degree=sh_degree, normals=normals, depth=depth)
    picture = rasterize(
        given,
        camera,
        statistic=statistic,
        still=NORMAL_CHANNELS if still and normals else (),
    )
    features, normal, camera_depth = split(picture.features, picture.alpha, normals=normals, depth=depth)
    splatted = GBuffer(features, picture.alpha, depth=depth)
    if held and normals:
        layers, again = shading.shade_held(splatted, light, camera)
    else:
        layers, again = shading.shade(splatted, light, camera), None
    blended = None
    if surface and (normals or depth):
        directions = given.features[:, 3:6] if normals else torch.zeros_like(given.means)
        found = surface_picture(given._replace(features=directions), camera)
        camera_depth = found.depth if depth else None
        if normals:
            normal, blended = picture.alpha[..., None] * found.directions, normal
    return RenderResult(
        final=layers["final"],
        base=features[..., :3],
        **{name: layers.get(name) for name in ("specular", "diffuse", "reflection", "strength", "metalness")},
        normal=normal,
        depth=camera_depth,
        alpha=picture.alpha,
        radii=picture.radii,
        held=again,
        still_normal=picture.still,
        metal=layers.get("metal"),
        index=layers.get("index"),
        blended_normal=blended,
    )


Split = tuple[Tensor, Tensor | None, Tensor | None]


def split(features: Tensor, alpha: Tensor, *, normals: bool, depth: bool) -> Split:
    """What a result holds of its G-buffer: ``split_reference``, on the CPU in float32 with one native gradient pass.

    Without a gradient and a depth there is nothing to do natively: the normal is a part of the features.
    """
    if normals and features.shape[-1] > 6 and fits(features) and (depth or features.requires_grad):
        return split_native(features, alpha, depth=depth)
    return split_reference(features, alpha, normals=normals, depth=depth)


def split_reference(features: Tensor, alpha: Tensor, *, normals: bool, depth: bool) -> Split:
    """Features for the shading model, blended normal [H, W, 3] and camera depth [H, W]; any dtype and device.

    Args:
        features: [H, W, D] blended color, with ``normals`` the normal, and with ``depth`` depth times alpha at last.
        alpha: [H, W].
    """
    normal = features[..., 3:6] if normals else None
    return features, normal, features[..., -1] / alpha.clamp(min=1e-6) if depth else None
