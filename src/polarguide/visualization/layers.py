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
"""DoLP that is brightest: dielectrics at Brewster's angle have more, most of what is seen has less."""
AOLP_FULL_DOLP = 0.1
"""DoLP from which the AoLP is shown at full brightness; below it, noise turns the angle."""
STOKES_HIGH = 0.5
"""S1 and S2, as shares of S0, at which the picture of Stokes vectors is fully colored."""
_SHARES = ("strength", "roughness", "metalness", "alpha")
Depths = tuple[float, float]
"""Nearest and farthest depth of a scale of colors."""


def layer_picture(
    result: RenderResult,
    name: str,
    camera: Camera,
    depths: Depths | None = None,
    *,
    exposed: bool = False,
    color: Tensor | None = None,
) -> Picture | None:
    """One layer as an 8-bit picture, or None where the recipe has no such layer.

    Args:
        result, camera: the rendering. name: name of the layer. depths: nearest and farthest, for depth's colors.
        exposed: show radiance darker where more than 1 % of the pixels would clip.
        color: color of the presentation, [3, 3], of layers of radiance.
    """
    if name in POLARIZED:
        return None if result.predicted is None else polarization_picture(name, result.predicted)
    values: Tensor | None = getattr(result, name)
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
    """Stokes vectors [3, H, W, C], predicted or measured, as one of ``POLARIZED``; of their luminance.

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
    """Depths [H, W] in colors, even steps of which are equal ratios: what is near and what is far has both detail.
    Black where there is none.
    """
    near, far = (math.log(end) for end in depths)
    logs = torch.where(depth > 0, depth.double().clamp(min=1e-12).log(), math.nan)
    return figures.scalar_to_rgb(logs, near, far)


def layer_scale(name: str, depths: Depths | None = None) -> Picture | None:
    """The color scale of a layer, 256 pixels wide; None for radiance, and for depth without a range."""
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
    """The factor, 1 or less, with which under 1 % of the pixels of radiance [H, W, 3] exceed 1 in some channel."""
    brightest = values.detach().nan_to_num(0.0, 0.0, 0.0).amax(dim=-1).flatten().sort().values
    limit = float(brightest[max(0, brightest.numel() - 1 - brightest.numel() // 128)])
    return min(1.0, 1.0 / limit) if limit > 0 else 1.0


_SAMPLES = 1_000_000
"""Depths that are sorted; PyTorch takes no more than 16 millions."""


def depth_range(depth: Tensor, mask: Tensor) -> Depths:
    """Nearest and farthest depth worth a color where ``mask``, of one shape: those of all but 2 % on either side."""
    values = depth[mask & (depth > 0)]
    if values.numel() == 0:
        return 1.0, 2.0
    values = values[:: max(1, values.numel() // _SAMPLES)]
    near = max(float(values.quantile(0.02)), 1e-6)
    return near, max(float(values.quantile(0.98)), 1.001 * near)


def true_depths(view: View) -> Tensor | None:
    """The true depths of a view's surfaces, 0 where there is none; None if they are unknown."""
    truth = view.ground_truth
    return None if truth is None or truth.depth is None else truth.depth


def true_name(name: str) -> str:
    """What the truth of a layer is called: that of the picture is the photograph."""
    return "photograph" if name == "final" else f"{name}, true"


def reference_pictures(
    view: View, color: Tensor | None = None, depths: Depths | None = None
) -> dict[str, Picture]:
    """Reference pictures of a view's layers, 8-bit: the ``photograph``, the ground truth of others as ``NAME, true``,
    and the polarization that its pictures measure as ``NAME, measured``.

    Args:
        color, depths: as for ``layer_picture``.
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
    """The photograph as ``final``, and the ground truth of the other layers, as 8-bit pictures; of the depth where
    ``depths`` are given.
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
