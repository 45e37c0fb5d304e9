"""Layers of a rendering and their ground truth as 8-bit pictures."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from polarguide.capture import View
from polarguide.capture.presentation import balanced
from polarguide.geometry.camera import Camera
from polarguide.shading.result import RenderResult
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

RADIANCE = frozenset(("final", "base", "reflection", "specular", "diffuse"))
"""Layers that are linear radiance."""


def layer_picture(
    result: RenderResult,
    name: str,
    camera: Camera,
    depths: tuple[float, float] | None = None,
    *,
    exposed: bool = False,
    gains: Tensor | None = None,
) -> Picture | None:
    """One layer as an 8-bit picture, or None where the recipe has no such layer.

    Args:
        result, camera: the rendering. name: of the layer. depths: nearest and farthest, for depth's colors.
        exposed: show radiance darker where more than 1 % of the pixels would clip.
        gains: [3] of a white balance, of layers of radiance.
    """
    values: Tensor | None = getattr(result, name)
    if values is None:
        return None
    if name in RADIANCE:
        values = balanced(values, gains)
    if exposed:
        values = values * clipping_exposure(values)
    near, far = depths or (0.0, 1.0)
    if name == "depth" and depths is None:
        near, far = depth_range(values, result.alpha > 0.5)
    draw: dict[str, Callable[[Tensor], Picture]] = {
        "normal": lambda v: figures.normal_to_rgb(v, camera),
        "depth": lambda v: figures.scalar_to_rgb(v, near, far),
        "strength": lambda v: figures.scalar_to_rgb(v, 0.0, 1.0),
        "roughness": lambda v: figures.scalar_to_rgb(v, 0.0, 1.0),
        "metalness": lambda v: figures.scalar_to_rgb(v, 0.0, 1.0),
        "alpha": lambda v: figures.scalar_to_rgb(v, 0.0, 1.0),
    }
    return draw.get(name, figures.radiance_to_rgb)(values)


def clipping_exposure(values: Tensor) -> float:
    """The factor, 1 or less, with which under 1 % of the pixels of radiance [H, W, 3] exceed 1 in some channel."""
    brightest = values.detach().nan_to_num(0.0, 0.0, 0.0).amax(dim=-1).flatten().sort().values
    limit = float(brightest[max(0, brightest.numel() - 1 - brightest.numel() // 128)])
    return min(1.0, 1.0 / limit) if limit > 0 else 1.0


def depth_range(depth: Tensor, mask: Tensor) -> tuple[float, float]:
    """Nearest and farthest depth [H, W] worth a color where ``mask`` [H, W]."""
    values = depth[mask]
    if values.numel() == 0:
        return 0.0, 1.0
    near, far = float(values.quantile(0.02)), float(values.quantile(0.9))
    return near, max(far, near + 1e-6)


def true_depth_range(view: View) -> tuple[float, float] | None:
    """The range of the true depths, so that rendered and true pictures share their colors; None if it is unknown."""
    ground_truth = view.ground_truth
    if ground_truth is None or ground_truth.depth is None or ground_truth.mask is None:
        return None
    return depth_range(ground_truth.depth, ground_truth.mask)


def ground_truth_pictures(view: View, gains: Tensor | None = None) -> dict[str, Picture]:
    """The photograph as ``final``, and the ground truth of the other layers, as 8-bit pictures; ``gains`` as above."""
    pictures = {"final": figures.radiance_to_rgb(balanced(view.photograph(), gains))}
    ground_truth = view.ground_truth
    if ground_truth is None:
        return pictures
    if ground_truth.normal is not None:
        pictures["normal"] = figures.normal_to_rgb(ground_truth.normal, view.camera)
    for name, layer in (("specular", ground_truth.specular), ("diffuse", ground_truth.diffuse)):
        if layer is not None:
            pictures[name] = figures.radiance_to_rgb(balanced(layer / 2, gains))
    depths = true_depth_range(view)
    if ground_truth.depth is not None and depths is not None:
        pictures["depth"] = figures.scalar_to_rgb(ground_truth.depth, *depths)
    return pictures
