"""From Gaussians to a picture: features of the Gaussians, one splat of the G-buffer, then the shading model per pixel.

On the CPU in float32 one native pass each way does what a shading model describes with ``ChannelParameters``;
``splatting_reference`` asks it for its ``channels``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import applied, fits
from polarguide.gaussians.geometry import GRAZING, shortest_axis_normals
from polarguide.geometry.camera import Camera
from polarguide.raster.interface import Rasterize, ScreenStatistic, Splats
from polarguide.raster.magnification import as_trained
from polarguide.raster.surface import surface_picture
from polarguide.shading.model import PLAIN, GBuffer, Light, Parameters, ShadingModel
from polarguide.shading.native import DETACHED, split_native
from polarguide.shading.result import NORMAL_CHANNELS, Layout, RenderResult


def splats(gaussians: Parameters, features: Tensor | None = None) -> Splats:
    """Gaussians as a rasterizer takes them, with features [N, D]; none: one that is zero."""
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
) -> tuple[Splats, Layout]:
    """Gaussians as a rasterizer takes them, with what a shading model splats, and which feature is what.

    Features are its color [N, 3], with ``normals`` unit normals (``shortest_axis_normals``) in world axes [N, 3], its
    further channels, and with ``depth`` the camera depth [N, 1] at last.

    Args:
        gaussians: with the parameters of the shading model; with ``outward`` where normals are turned to the side from
            which they are seen. sh_degree: degree of the base color's harmonics, 0 to 3.

    Returns:
        Differentiable in the Gaussians; the same bits for any number of threads.

    Raises:
        ValueError: the degree, or a shape, is not as above.
    """
    described = shading.channel_parameters(gaussians)
    core = [gaussians[name] for name in _CORE]
    outward = gaussians.get("outward") if normals else None
    if described is None or not fits(*core, outward, *described[:-1], *described.further.values()):
        return splatting_reference(
            gaussians, camera, shading, sh_degree=sh_degree, normals=normals, depth=depth
        )
    pose = camera.pose(torch.float32, core[0].device)
    forward = pose.rotation[2].contiguous() if depth else None
    settings = SplattingSettings(sh_degree, pose.center.contiguous(), forward, normals)
    further = torch.cat([*described.further.values()], dim=1) if described.further else None
    tensors = applied(_Splatting, settings, *core, outward, *described[:-1], further)
    return Splats(*tensors), Layout(_widths(described.widths, normals=normals, depth=depth))


def splatting_reference(
    gaussians: Parameters,
    camera: Camera,
    shading: ShadingModel,
    *,
    sh_degree: int,
    normals: bool,
    depth: bool,
) -> tuple[Splats, Layout]:
    """The reference implementation of ``splatting``: plain torch around the model's channels, any dtype and device."""
    means = gaussians["means"]
    pose = camera.pose(means.dtype, means.device)
    if normals:
        shape = means, gaussians["quaternions"], gaussians["log_scales"]
        axes = shortest_axis_normals(*shape, pose.center, gaussians.get("outward"))
    else:
        axes = means.new_empty(len(means), 0)
    own = shading.channels(gaussians, axes, pose.center, sh_degree)
    widths = _widths({name: t.shape[1] for name, t in own.items()}, normals=normals, depth=depth)
    own |= {"normal": axes, "depth": ((means - pose.center) @ pose.rotation[2])[:, None]}
    return splats(gaussians, torch.cat([own[name] for name in widths], dim=1)), Layout(widths)


def _widths(own: Mapping[str, int], *, normals: bool, depth: bool) -> dict[str, int]:
    """Numbers of all channels, given those of the shading model, which begin with the color."""
    first = {"color": 3, **({"normal": 3} if normals else {})}
    last = {"depth": 1} if depth else {}
    return {**first, **{name: width for name, width in own.items() if name != "color"}, **last}


_CORE = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
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


class SplattingSettings(NamedTuple):
    """Arguments of the native pass that are no parameters of Gaussians.

    Attributes:
        degree: degree of the base color's harmonics. center: [3] of the camera.
        forward: [3] direction of the camera depth; None: no depth. normals: whether to splat normals.
    """

    degree: int
    center: Tensor
    forward: Tensor | None
    normals: bool


class _Splatting(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: SplattingSettings, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        inputs: dict[str, Any] = dict(zip(_INPUTS, tensors, strict=True))
        means = inputs["means"]
        quaternions = inputs["quaternions"]
        inputs = {name: None if t is None else t.detach().contiguous() for name, t in inputs.items()}
        kernel = _native.Splatting(**inputs, **settings._asdict(), grazing=GRAZING)
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
        kernel = _native.Splatting(**inputs, **ctx.settings._asdict(), grazing=GRAZING)
        kernel.backward(**outputs, **by, **{f"to_{name}": gradient for name, gradient in to.items()})
        return None, *(to.get(name) for name in _INPUTS)


NO_LIGHT: Light = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """The layers that a rendering has to have.

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
    footprints: Tensor | None = None,
) -> RenderResult:
    """Render one view.

    Args:
        gaussians: the Gaussians, with the parameters of the shading model; with ``outward`` where normals are turned
            to the side from which they are seen, not to the camera.
        request: what the result holds.
        shading: what is splatted, and how it makes the picture. light: its learned light, by name.
        footprints: [N] of the training, with which larger pictures are as smooth as it was, see
            ``raster.magnification``; None: drawn as they are, which is how training draws.
    """
    normals = request.normals or shading.needs_normals
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
            gaussian_splats.features[:, layout.channels("normal")]
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

    Where the model does not return these, or not ``native``, it shades a second time with detached normals. Metals keep
    their gradient on the normals.
    """
    layers = {**shading.shade(replace(splatted, detached=splatted.detached and native), light, camera)}
    if not splatted.detached or "specular" not in layers or DETACHED[0] in layers:
        return layers
    parts = [splatted[name].detach() if name == "normal" else splatted[name] for name in splatted.layout]
    features = torch.cat(parts, dim=-1)
    again = shading.shade(replace(splatted, features=features, metal=layers.get("metal")), light, camera)
    return layers | {name: again[name.removeprefix("detached_")] for name in DETACHED}


Split = tuple[Tensor, Tensor | None, Tensor | None]


def split(features: Tensor, alpha: Tensor, layout: Layout) -> Split:
    """The layers of a G-buffer: ``split_reference``, on the CPU in float32 with one native gradient pass.

    Without a gradient and a depth there is nothing to do natively: the normal is a part of the features.
    """
    depth = "depth" in layout
    further = features.shape[-1] > 6
    if "normal" in layout and further and fits(features) and (depth or features.requires_grad):
        return split_native(features, alpha, depth=depth)
    return split_reference(features, alpha, layout)


def split_reference(features: Tensor, alpha: Tensor, layout: Layout) -> Split:
    """Features for the shading model, blended normal [H, W, 3] and camera depth [H, W]; any dtype and device.

    Args:
        features: [H, W, D] blended; the depth is times alpha. alpha: [H, W]. layout: layout of the features.
    """
    normal = features[..., layout.channels("normal")] if "normal" in layout else None
    if "depth" not in layout:
        return features, normal, None
    return features, normal, features[..., layout.first("depth")] / alpha.clamp(min=1e-6)
