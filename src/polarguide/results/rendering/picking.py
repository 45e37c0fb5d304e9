"""Surface or color at a pixel that the user specifies, and white balance from such a color."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.presentation import Vector
from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera, unit
from polarguide.shading.result import RenderResult

LEAST_ALPHA = 0.5  # minimum alpha of a surface
LEAST_GAIN = 0.02
MOST_GAIN = 50.0
# Limits of a color that is picked for the white balance.
DARKEST = 2e-3
BRIGHTEST = 0.98
PATCH = 2  # radius in pixels over which a picked color is averaged


@dataclass(frozen=True, eq=False)
class SurfacePoint:
    """Surface point at a specified pixel.

    Attributes:
        point: [3] float64 in the world.
        normal: [3] float64 unit vector toward the camera, or None if unknown.
    """

    point: Tensor
    normal: Tensor | None


def surface_at(result: RenderResult, camera: Camera, x: float, y: float) -> SurfacePoint | None:
    """Return the surface at a position in a rendering with depth.

    Return None if the position lies outside the picture or shows no surface.

    Args:
        result: the rendering, with the size of the camera.
        camera: its camera.
        x, y: pixels from the top left corner; the center of the first pixel is (0.5, 0.5).
    """
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        return None
    column = int(x)
    row = int(y)
    depth = float(result.depth[row, column])
    if float(result.alpha[row, column]) < LEAST_ALPHA or depth <= 0:
        return None
    local = torch.tensor([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0], dtype=torch.float64)
    ray = camera.rotation.T @ local
    normal: Tensor | None = None
    if "normal" in result.layers:
        blended = _patch(result.normal, row, column).double().mean(dim=(0, 1))
        if float(blended.norm()) > 0.1:
            normal = unit(blended, 1e-9)
            normal = -normal if float(normal @ ray) > 0 else normal
    return SurfacePoint(camera.center + depth * ray, normal)


def photograph_color(view: View, x: float, y: float) -> Tensor:
    """Return the mean color [3] of the valid pixels of a photograph around a position; see ``surface_at``.

    Raises:
        PolarguideError: the position lies outside the photograph, or no pixel around it is valid.
    """
    camera = view.camera
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise PolarguideError(
            "white_balance",
            expected=f"a place in {view.name}, which is {camera.width} x {camera.height}",
            found=f"{x:g},{y:g}",
            remedy="Count pixels from the top left corner.",
        )
    row = int(y)
    column = int(x)
    valid = ~_patch(view.invalid | view.saturated, row, column)
    if not bool(valid.any()):
        raise PolarguideError(
            "white_balance",
            expected="pixels that are not saturated or invalid",
            found=f"none around {x:g},{y:g} of {view.name}",
            remedy="Pick a gray or white place that is not too bright.",
        )
    return _patch(view.photograph(), row, column)[valid].mean(dim=0)


def _patch(picture: Tensor, row: int, column: int) -> Tensor:
    top = max(0, row - PATCH)
    left = max(0, column - PATCH)
    return picture[top : row + PATCH + 1, left : column + PATCH + 1]


def white_balance_gains(color: Tensor) -> Vector:
    """Return the gains [3] of a white balance that makes a linear color [3] gray. The gain of green is 1.

    Raises:
        PolarguideError: the color is too dark, clips, or is not gray under any usual light.
    """
    values = [float(value) for value in color]
    if not (min(values) > 0 and max(values) >= DARKEST and max(values) <= BRIGHTEST):
        listed = ", ".join(f"{value:.3g}" for value in values)
        raise PolarguideError(
            "white_balance",
            expected=f"a color of {DARKEST:g} to {BRIGHTEST:g} of full scale in its brightest channel, without zeros",
            found=f"R, G, B {listed}",
            remedy="Pick a gray or white place that is not dark or clipped.",
        )
    gains = [values[1] / value for value in values]
    if not all(LEAST_GAIN <= gain <= MOST_GAIN for gain in gains):
        raise PolarguideError(
            "white_balance",
            expected=f"gains of {LEAST_GAIN:g} to {MOST_GAIN:g}",
            found=", ".join(f"{gain:.3g}" for gain in gains),
            remedy="Pick a gray or white place.",
        )
    return gains[0], 1.0, gains[2]


def gray_world_gains(views: Iterable[View]) -> Vector:
    """Return gains [3] that make the mean of all valid pixels gray (Buchsbaum 1980). The gain of green is 1.

    Raises:
        PolarguideError: there are no valid pixels, or all are black.
    """
    total = torch.zeros(3, dtype=torch.float64)
    count = 0
    for view in views:
        valid = ~(view.invalid | view.saturated)
        total += view.photograph()[valid].double().sum(dim=0)
        count += int(valid.sum())
    mean = total / max(count, 1)
    # The gains do not depend on brightness, so black pixels around an object have no effect.
    return white_balance_gains(0.5 * mean / max(float(mean.max()), 1e-12))
