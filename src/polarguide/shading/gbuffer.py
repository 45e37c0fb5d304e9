"""Rendering in three steps: features of the Gaussians, splatting to a G-buffer, and shading per pixel.

In float32 on the CPU, a native pass computes the features of Gaussians from ``Channels``, and another pass their
gradients. Other tensors use plain torch.
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
    """Return the input of a rasterizer, with features [N, D]. By default, there is one feature that is zero."""
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
    """Return the input of a rasterizer for a shading model, and the places of its features by name.

    The features of a Gaussian are the color (3), the unit normal in world axes (3), channels of the model, and the
    camera depth (1). Normal and depth are optional.

    Args:
        gaussians: Gaussians with the parameters of the shading model. If they have the tensor ``outward``, normals
            point to the side from which training views see them.
        camera: the view.
        shading: the shading model.
        sh_degree: degree of the base color's harmonics, 0 to 3.
        normals, depth: True to splat these features.
        native: False to use the reference implementation in plain torch, for any dtype and device.

    Returns:
        A tuple of the input and the slices of the features by name. The input is differentiable in the Gaussians and
        does not depend on the number of threads.

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
"""Names of the tensors that the native pass reads, in the order of the arguments of ``_Splatting``."""
_UNTRAINED = ("outward", "metalness")
"""Names of the tensors without a gradient in the native pass."""


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
"""Light of a shading model that learns no light."""


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """Layers that are requested from a rendering.

    Attributes:
        sh_degree: SH degree of the base color, 0 to 3.
        normals: True to render the blended normal. Shading models that reflect always render it.
        depth: True to render the camera depth.
        layers_detached: True to also return a copy of the layers without a gradient on the normals.
        normal_rotation_only: True to also return a copy of the blended normal whose gradient only rotates Gaussians.
            Their positions and opacities do not change.
        at_median_depth: True if normal and depth describe the surface at each pixel's median depth, without gradients.
            Shading still uses the blended normal.
        statistic: object in which the backward pass stores the gradient of the projected means.
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
        gaussians: Gaussians with the parameters of the shading model. If they have the tensor ``outward``, normals
            point to the side from which training views see them. Otherwise they point to the camera of the view.
        camera: the view.
        rasterize: rasterizer of the backend.
        request: requested layers.
        shading: the shading model.
        light: learned light of the shading model by name.
        footprints: [N] pixel sizes of the training, which keep magnified pictures smooth, see ``raster.magnification``.
            With None, Gaussians are drawn without additional blur, as in a training.
    """
    normals = request.normals or "specular" in shading.layers
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
    """Return the layers of a shading model, with the layers in ``DETACHED`` if the G-buffer requests them.

    If the model does not return the detached layers, or if ``native`` is False, it shades a second time with detached
    normals. Light from metals keeps its gradient on the normals.
    """
    layers = {**shading.shade(replace(splatted, detached=splatted.detached and native), light, camera)}
    if not splatted.detached or "specular" not in layers or DETACHED[0] in layers:
        return layers
    parts = [splatted[name].detach() if name == "normal" else splatted[name] for name in splatted.layout]
    features = torch.cat(parts, dim=-1)
    again = shading.shade(replace(splatted, features=features, metal=layers.get("metal")), light, camera)
    return layers | {name: again[name.removeprefix("detached_")] for name in DETACHED}


def split(
    features: Tensor, alpha: Tensor, layout: ChannelSlices
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Extract the normal and the depth from a G-buffer.

    In float32 on the CPU this is a native pass, and otherwise ``split_reference``. If there is no gradient and no
    depth, a slice of the features suffices.
    """
    depth = "depth" in layout
    further = features.shape[-1] > 6
    if "normal" in layout and further and fits(features) and (depth or features.requires_grad):
        return split_native(features, alpha, depth=depth)
    return split_reference(features, alpha, layout)


def split_reference(
    features: Tensor, alpha: Tensor, layout: ChannelSlices
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Extract the normal and the depth from a G-buffer, for any dtype and device.

    Args:
        features: [H, W, D] blended features. The blended depth is multiplied by alpha.
        alpha: [H, W] blended opacity.
        layout: slices of the features by name.

    Returns:
        A tuple of the features for the shading model, the blended normal [H, W, 3], and the camera depth [H, W].
    """
    normal = features[..., layout["normal"]] if "normal" in layout else None
    if "depth" not in layout:
        return features, normal, None
    return features, normal, features[..., layout["depth"].start] / alpha.clamp(min=1e-6)


class _RayCamera(Camera):
    """Camera with given rays, whose picture is a single column of pixels."""

    def __init__(self, rays: Tensor) -> None:
        rotation = torch.eye(3, dtype=torch.float64)
        super().__init__(1, len(rays), 1.0, 1.0, 0.0, 0.0, rotation, torch.zeros(3, dtype=torch.float64))
        self.__dict__["_rays"] = rays[:, None]

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Return the rays [N, 1, 3]."""
        rays: Tensor = self.__dict__["_rays"]
        return rays.to(device, dtype)


def single_colors(
    gaussians: Parameters, light: Light, shading: ShadingModel, rays: Tensor, normals: Tensor
) -> Tensor:
    """Shade each Gaussian alone, without blending.

    Args:
        gaussians, light, shading: the Gaussians, the light and the shading model.
        rays: [N, 3] unit direction from the camera to each Gaussian.
        normals: [N, 3] unit normals that face the camera.

    Returns:
        Linear colors [N, 3].
    """
    names = (*CORE_SHAPES, *shading.parameters)
    tensors = {name: own for name in names if (own := gaussians.get(name)) is not None}
    # The camera is at the origin, and each Gaussian lies at the end of its own ray.
    tensors["means"] = rays
    origin = rays.new_zeros(3)
    values = shading.channels(tensors, origin, 3).values(tensors, normals, origin, 3) | {"normal": normals}
    order = ("color", "normal", *(name for name in values if name not in ("color", "normal")))
    features = torch.cat([values[name] for name in order], dim=1)[:, None]
    layout = channel_slices({name: values[name].shape[1] for name in order})
    splatted = GBuffer(features, torch.ones_like(features[..., 0]), layout)
    final: Tensor = shading.shade(splatted, light, _RayCamera(rays))["final"]
    return final[:, 0]
