"""Layers of a rendering and their ground truth as 8-bit pictures."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.capture.presentation import colored
from polarguide.geometry.camera import Camera
from polarguide.shading.result import POLARIZED, RenderResult
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

RADIANCE = frozenset(("final", "base", "reflection", "specular", "diffuse"))
"""Layers that are linear radiance."""


DOLP_HIGH = 0.5
"""DoLP of full brightness. Dielectrics exceed it near Brewster's angle only."""
AOLP_FULL_DOLP = 0.1
"""DoLP above which the AoLP has full brightness. Below it, noise dominates the angle."""
STOKES_HIGH = 0.5
"""S1 / S0 and S2 / S0 of full color."""
_SHARES = ("strength", "roughness", "metalness", "alpha")
Depths = tuple[float, float]
"""Nearest and farthest depth of a color scale."""


def layer_picture(
    result: RenderResult,
    name: str,
    camera: Camera,
    depths: Depths | None = None,
    *,
    exposed: bool = False,
    color: Tensor | None = None,
) -> Picture | None:
    """Return a layer as an 8-bit picture, or None if the recipe lacks it.

    Args:
        result, camera: the rendering.
        name: name of the layer.
        depths: range of the colors of depth.
        exposed: darken radiance so that at most 1 % of the pixels clip.
        color: color matrix of the presentation, [3, 3], for layers of radiance.
    """
    if name in POLARIZED:
        return polarization_picture(name, result.layers["stokes"]) if "stokes" in result.layers else None
    values = result.layers.get(name)
    if values is None:
        return None
    if name in RADIANCE:
        values = colored(values, color)
    if exposed:
        values = values * clipping_exposure(values)
    if name == "depth":
        there = result.alpha > 0.5
        return depth_picture(torch.where(there, values, 0.0), depths or depth_range(values, there))
    if name == "normal":
        return figures.normal_to_rgb(values, camera)
    return figures.scalar_to_rgb(values, 0.0, 1.0) if name in _SHARES else figures.radiance_to_rgb(values)


def polarization_picture(name: str, stokes: Tensor) -> Picture:
    """Return Stokes vectors [3, H, W, C], predicted or measured, as one of ``POLARIZED``, by their luminance.

    ``stokes``: S1 / S0 in red and S2 / S0 in green, mid gray at 0.
    """
    gray = optics.luminance(stokes)
    degree = optics.dolp(gray)
    if name == "dolp":
        return figures.dolp_to_rgb(degree, DOLP_HIGH)
    if name == "aolp":
        return figures.aolp_to_rgb(optics.aolp(gray), degree / AOLP_FULL_DOLP)
    shares = gray[1:] / gray[0].clamp(min=1e-6)
    red, green = (0.5 + shares / (2 * STOKES_HIGH)).unbind(0)
    return figures.shares_to_rgb(torch.stack((red, green, torch.full_like(red, 0.5)), dim=-1))


def depth_picture(depth: Tensor, depths: Depths) -> Picture:
    """Return depths [H, W] in colors on a logarithmic scale; black without a depth."""
    near, far = (math.log(end) for end in depths)
    logs = torch.where(depth > 0, depth.double().clamp(min=1e-12).log(), math.nan)
    return figures.scalar_to_rgb(logs, near, far)


def layer_scale(name: str, depths: Depths | None = None) -> Picture | None:
    """Return the legend of a layer, 256 pixels wide, or None for radiance, and for depth without a range."""
    name = name.partition(",")[0]
    if name in _SHARES:
        return figures.scale_bar(0.0, 1.0, "viridis")
    if name == "depth" and depths is not None:
        near, far = (float(f"{end:.3g}") for end in depths)
        return figures.scale_bar(near, far, "viridis", "units", middle=f"{math.sqrt(near * far):.3g}")
    if name == "dolp":
        return figures.scale_bar(0.0, DOLP_HIGH, "inferno")
    if name == "stokes":
        return figures.color_patch(128, f"0; red S1, green S2, to {STOKES_HIGH:g} S0")
    if name == "aolp":
        return figures.angle_wheel()
    return figures.normal_ball() if name == "normal" else None


def clipping_exposure(values: Tensor) -> float:
    """Return the factor, at most 1, with which under 1 % of the pixels of radiance [H, W, 3] exceed 1."""
    brightest = values.detach().nan_to_num(0.0, 0.0, 0.0).amax(dim=-1).flatten().sort().values
    limit = float(brightest[max(0, brightest.numel() - 1 - brightest.numel() // 128)])
    return min(1.0, 1.0 / limit) if limit > 0 else 1.0


_SAMPLES = 1_000_000
"""Largest number of depths to sort. PyTorch accepts at most 16 million."""


def depth_range(depth: Tensor, mask: Tensor) -> Depths:
    """Return the range of depths where ``mask``, of one shape, without 2 % on either side."""
    values = depth[mask & (depth > 0)]
    if values.numel() == 0:
        return 1.0, 2.0
    values = values[:: max(1, values.numel() // _SAMPLES)]
    near = max(float(values.quantile(0.02)), 1e-6)
    return near, max(float(values.quantile(0.98)), 1.001 * near)


def true_depths(view: View) -> Tensor | None:
    """Return the true depths of a view's surfaces, 0 without a surface; None: unknown."""
    truth = view.ground_truth
    return None if truth is None or truth.depth is None else truth.depth


def true_name(name: str) -> str:
    """Return the name of a layer's ground truth: the photograph for the final layer."""
    return "photograph" if name == "final" else f"{name}, true"


def reference_pictures(
    view: View, color: Tensor | None = None, depths: Depths | None = None
) -> dict[str, Picture]:
    """Return reference pictures of a view's layers, 8-bit.

    They are the ``photograph``, the ground truth of other layers as ``NAME, true``, and the measured
    polarization as ``NAME, measured``.

    Args:
        color, depths: see ``layer_picture``.
    """
    pictures = {
        true_name(name): picture for name, picture in ground_truth_pictures(view, color, depths).items()
    }
    if view.is_determined:
        stokes = view.stokes()
        pictures |= {f"{name}, measured": polarization_picture(name, stokes) for name in POLARIZED}
    return pictures


def ground_truth_pictures(
    view: View, color: Tensor | None = None, depths: Depths | None = None
) -> dict[str, Picture]:
    """Return the photograph as ``final`` and the ground truth of other layers as 8-bit pictures.

    Depth needs ``depths``.
    """
    pictures = {"final": figures.radiance_to_rgb(colored(view.photograph(), color))}
    ground_truth = view.ground_truth
    if ground_truth is None:
        return pictures
    if ground_truth.normal is not None:
        pictures["normal"] = figures.normal_to_rgb(ground_truth.normal, view.camera)
    for name, layer in (("specular", ground_truth.specular), ("diffuse", ground_truth.diffuse)):
        if layer is not None:
            pictures[name] = figures.radiance_to_rgb(colored(layer / 2, color))
    if ground_truth.depth is not None and depths is not None:
        pictures["depth"] = depth_picture(ground_truth.depth, depths)
    return pictures
