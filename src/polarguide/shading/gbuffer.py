"""Rendering: features of the Gaussians, one splat of the G-buffer, then the shading model per pixel.

On the CPU in float32 one native pass in each direction computes the features of Gaussians from ``Channels``; other
tensors use plain torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import applied, fits
from polarguide.gaussians.gaussians import CORE_SHAPES
from polarguide.gaussians.geometry import GRAZING, shortest_axis_normals
from polarguide.geometry.camera import Camera
from polarguide.raster.interface import Rasterize, ScreenStatistic, Splats
from polarguide.raster.magnification import as_trained
from polarguide.raster.surface import surface_picture
from polarguide.shading.model import PLAIN, GBuffer, Light, Parameters, ShadingModel
from polarguide.shading.native import DETACHED, split_native
from polarguide.shading.result import NORMAL_CHANNELS, ChannelSlices, RenderResult, channel_slices


def splats(gaussians: Parameters, features: Tensor | None = None) -> Splats:
    """Return the input of a rasterizer, with features [N, D]; by default one feature that is zero."""
    means = gaussians["means"]
    return Splats(
        means,
        gaussians["quaternions"],
        gaussians["log_scales"].exp(),
        torch.sigmoid(gaussians["opacity_logits"]),
        means.new_zeros(len(means), 1) if features is None else features,
    )


def splatting(
    gaussians: Parameters,
    camera: Camera,
    shading: ShadingModel,
    *,
    sh_degree: int,
    normals: bool,
    depth: bool,
    native: bool = True,
) -> tuple[Splats, ChannelSlices]:
    """Return the input of a rasterizer for a shading model, and the features by name.

    Features are the color [N, 3], with ``normals`` unit normals (``shortest_axis_normals``) in world axes [N, 3],
    further channels of the model, and with ``depth`` the camera depth [N, 1].

    Args:
        gaussians: Gaussians with the parameters of the shading model; with ``outward`` if normals point to the side of
            the cameras that see them.
        camera: the view. shading: the shading model.
        sh_degree: degree of the base color's harmonics, 0 to 3. normals, depth: whether to splat these features.
        native: False: the reference implementation in plain torch, any dtype and device.

    Returns:
        Differentiable in the Gaussians. The number of threads does not change a bit.

    Raises:
        ValueError: the degree or a shape does not fit.
    """
    core = [gaussians[name] for name in CORE_SHAPES]
    means, quaternions, log_scales = core[:3]
    pose = camera.pose(means.dtype, means.device)
    outward = gaussians.get("outward") if normals else None
    own = shading.channels(gaussians, pose.center, sh_degree)
    widths = {"color": 3} | ({"normal": 3} if normals else {}) | own.widths | ({"depth": 1} if depth else {})
    layout = channel_slices(widths)
    if native and own.color is None and fits(*core, outward, *own[:-1], *own.further.values()):
        forward = pose.rotation[2].contiguous() if depth else None
        settings = {"degree": sh_degree, "center": pose.center.contiguous(), "forward": forward}
        settings |= {"normals": normals, "grazing": GRAZING}
        further = torch.cat([*own.further.values()], dim=1) if own.further else None
        tensors = applied(_Splatting, settings, *core, outward, *own[1:-1], further)
        return Splats(*tensors), layout
    axes = means.new_empty(len(means), 0)
    if normals:
        axes = shortest_axis_normals(means, quaternions, log_scales, pose.center, outward)
    values = own.values(gaussians, axes, pose.center, sh_degree)
    values |= {"normal": axes, "depth": ((means - pose.center) @ pose.rotation[2])[:, None]}
    return splats(gaussians, torch.cat([values[name] for name in widths], dim=1)), layout


_INPUTS = (
    "means",
    "quaternions",
    "log_scales",
    "opacity_logits",
    "dc",
    "rest",
    "outward",
    "strength",
    "light_dc",
    "light_rest",
    "metalness",
    "further",
)
"""Tensors of the native pass by the names of its arguments, in the order of ``_Splatting``."""
_UNTRAINED = ("outward", "metalness")
"""Tensors of the native pass without a gradient."""


class _Splatting(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: dict[str, Any], *tensors: Tensor | None) -> tuple[Tensor, ...]:
        inputs: dict[str, Any] = dict(zip(_INPUTS, tensors, strict=True))
        means = inputs["means"]
        quaternions = inputs["quaternions"]
        inputs = {name: None if t is None else t.detach().contiguous() for name, t in inputs.items()}
        kernel = _native.Splatting(**inputs, **settings)
        outputs = {
            "scales": torch.empty_like(inputs["log_scales"]),
            "opacities": torch.empty_like(inputs["opacity_logits"]),
            "features": means.new_empty(len(means), kernel.channels),
        }
        learns = any(ctx.needs_input_grad)
        mirrored = torch.empty_like(inputs["means"]) if learns and inputs["light_dc"] is not None else None
        kernel.forward(**outputs, mirrored=mirrored)
        if learns:
            ctx.settings = settings
            ctx.save_for_backward(*inputs.values(), *outputs.values(), mirrored)
        return means.view_as(means), quaternions.view_as(quaternions), *outputs.values()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs: dict[str, Any] = dict(zip(_INPUTS, saved, strict=False))
        results = ("scales", "opacities", "features", "mirrored")
        outputs = dict(zip(results, saved[len(_INPUTS) :], strict=True))
        names = ("grad_means", "grad_quaternions", "grad_scales", "grad_opacities", "grad_features")
        by = {name: grad.contiguous() for name, grad in zip(names, grads, strict=True)}
        to: dict[str, Any] = {
            name: None if inputs[name] is None else torch.empty_like(inputs[name])
            for name in _INPUTS
            if name not in _UNTRAINED
        }
        kernel = _native.Splatting(**inputs, **ctx.settings)
        kernel.backward(**outputs, **by, **{f"to_{name}": gradient for name, gradient in to.items()})
        return None, *(to.get(name) for name in _INPUTS)


NO_LIGHT: Light = MappingProxyType({})
"""Light of a model without parameters of the light."""


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """Layers requested from a rendering.

    Attributes:
        sh_degree: SH degree of the base color, 0 to 3.
        normals: the blended normal; a shading model that reflects always has it.
        depth: the camera depth.
        layers_detached: a second copy of the layers, without a gradient on the normals.
        normal_rotation_only: a second copy of the blended normal. Its gradient rotates Gaussians and leaves
            their position and opacity unchanged.
        at_median_depth: normal and depth describe the surface at each pixel's median depth, without gradients. Shading
            still uses the blended normal.
        statistic: see ``ScreenStatistic``.
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
    footprints: Tensor | None = None,
) -> RenderResult:
    """Render one view.

    Args:
        gaussians: Gaussians with the parameters of the shading model; with ``outward`` if normals point to the side of
            the cameras that see them instead of the camera of the view.
        camera: the view. rasterize: rasterizer of the backend.
        request: requested layers.
        shading: the shading model. light: its learned light by name.
        footprints: [N] pixel sizes of the training, which keep larger pictures smooth, see ``raster.magnification``;
            None: Gaussians are drawn without additional blur, as in a training.
    """
    normals = request.normals or shading.reflects
    depth = request.depth
    gaussian_splats, layout = splatting(
        gaussians, camera, shading, sh_degree=request.sh_degree, normals=normals, depth=depth
    )
    if footprints is not None:
        gaussian_splats = as_trained(gaussian_splats, camera, footprints)
    rotated = NORMAL_CHANNELS if request.normal_rotation_only and normals else ()
    picture = rasterize(gaussian_splats, camera, statistic=request.statistic, still=rotated)
    features, normal, camera_depth = split(picture.features, picture.alpha, layout)
    splatted = GBuffer(features, picture.alpha, layout, detached=request.layers_detached and normals)
    layers = shaded(shading, splatted, light, camera)
    metal = layers.pop("metal", None)
    training = {"radii": picture.radii}
    training |= {name: layers.pop(name) for name in DETACHED if name in layers}
    layers |= {"base": splatted["color"], "alpha": picture.alpha}
    if request.at_median_depth and (normals or depth):
        directions = (
            gaussian_splats.features[:, layout["normal"]]
            if normals
            else torch.zeros_like(gaussian_splats.means)
        )
        surface = surface_picture(gaussian_splats._replace(features=directions), camera)
        camera_depth = surface.depth
        if normal is not None:
            layers["shaded_normal"] = normal
            normal = picture.alpha[..., None] * surface.directions
    if normal is not None:
        layers["normal"] = normal
    if depth and camera_depth is not None:
        layers["depth"] = camera_depth
    if picture.still is not None:
        training["rotation_only_normal"] = picture.still
    return RenderResult(layers, metal, training)


def shaded(
    shading: ShadingModel, splatted: GBuffer, light: Light, camera: Camera, *, native: bool = True
) -> dict[str, Any]:
    """Return the layers of a shading model, and the ``DETACHED`` ones if the G-buffer requests them.

    If the model does not return these or ``native`` is False, it shades a second time with detached normals. Metals
    keep their gradient on the normals.
    """
    layers = {**shading.shade(replace(splatted, detached=splatted.detached and native), light, camera)}
    if not splatted.detached or "specular" not in layers or DETACHED[0] in layers:
        return layers
    parts = [splatted[name].detach() if name == "normal" else splatted[name] for name in splatted.layout]
    features = torch.cat(parts, dim=-1)
    again = shading.shade(replace(splatted, features=features, metal=layers.get("metal")), light, camera)
    return layers | {name: again[name.removeprefix("detached_")] for name in DETACHED}


Split = tuple[Tensor, Tensor | None, Tensor | None]


def split(features: Tensor, alpha: Tensor, layout: ChannelSlices) -> Split:
    """Split normal and depth from a G-buffer; ``split_reference`` or, on the CPU in float32, a native pass.

    Without a gradient and a depth a slice of the features suffices.
    """
    depth = "depth" in layout
    further = features.shape[-1] > 6
    if "normal" in layout and further and fits(features) and (depth or features.requires_grad):
        return split_native(features, alpha, depth=depth)
    return split_reference(features, alpha, layout)


def split_reference(features: Tensor, alpha: Tensor, layout: ChannelSlices) -> Split:
    """Return features for the shading model, blended normal [H, W, 3] and camera depth [H, W]; any dtype and device.

    Args:
        features: [H, W, D] blended; the depth is multiplied by alpha. alpha: [H, W]. layout: features by name.
    """
    normal = features[..., layout["normal"]] if "normal" in layout else None
    if "depth" not in layout:
        return features, normal, None
    return features, normal, features[..., layout["depth"].start] / alpha.clamp(min=1e-6)


class _RayCamera(Camera):
    """Camera whose picture is one column of pixels with given rays."""

    def __init__(self, rays: Tensor) -> None:
        rotation = torch.eye(3, dtype=torch.float64)
        super().__init__(1, len(rays), 1.0, 1.0, 0.0, 0.0, rotation, torch.zeros(3, dtype=torch.float64))
        self.__dict__["_rays"] = rays[:, None]

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Return the rays [N, 1, 3]."""
        rays: Tensor = self.__dict__["_rays"]
        return rays.to(device, dtype)


def _values_along(
    gaussians: Parameters, shading: ShadingModel, rays: Tensor, normals: Tensor
) -> dict[str, Tensor]:
    """Return the channels of Gaussians by name, each seen along its own ray: from the origin, with its ray as mean."""
    names = (*CORE_SHAPES, *shading.parameters)
    tensors = {name: values for name in names if (values := gaussians.get(name)) is not None}
    tensors["means"] = rays
    origin = rays.new_zeros(3)
    return {**shading.channels(tensors, origin, 3).values(tensors, normals, origin, 3), "normal": normals}


def single_colors(
    gaussians: Parameters, light: Light, shading: ShadingModel, rays: Tensor, normals: Tensor
) -> Tensor:
    """Shade Gaussians one by one.

    Args:
        gaussians, light, shading: the Gaussians, the light and the shading model.
        rays: [N, 3] unit. normals: [N, 3] unit, facing the rays.

    Returns:
        [N, 3] linear colors.
    """
    values = _values_along(gaussians, shading, rays, normals)
    order = ("color", "normal", *(name for name in values if name not in ("color", "normal")))
    features = torch.cat([values[name] for name in order], dim=1)[:, None]
    layout = channel_slices({name: values[name].shape[1] for name in order})
    splatted = GBuffer(features, torch.ones_like(features[..., 0]), layout)
    final: Tensor = shading.shade(splatted, light, _RayCamera(rays))["final"]
    return final[:, 0]


def diffuse_colors(gaussians: Parameters, shading: ShadingModel, rays: Tensor) -> Tensor:
    """Return linear colors [N, 3] of Gaussians without reflections, along unit rays [N, 3]."""
    return _values_along(gaussians, shading, rays, -rays)["color"]
