"""How a visitor wants to see a scene, and the pictures that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.inspection.layers import AOLP_FULL_DOLP, DOLP_HIGH
from polarguide.optics import aolp, dolp, luminance, stokes
from polarguide.scene_frame import SceneFrame
from polarguide.shading.result import RenderResult
from polarguide.viewer.shown import Shown
from polarguide.viewer.viewport import letterbox
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture
from polarguide.visualization.layers import depth_range, layer_picture

MEASURED = ("photograph", "DoLP", "AoLP", "error")
"""Layers that only a photograph's pose has."""

RADIANCE = {"final", "diffuse", "specular", "base", "reflection"}


@dataclass(frozen=True)
class Crop:
    """A box about the scene's center along the cameras' common right, up and back.

    Attributes:
        low, high: corners in shares of the cameras' distance.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def corners(self, around: SceneFrame) -> Tensor:
        """Its eight corners in the world, [8, 3] float64, the last axis fastest."""
        sides = torch.tensor([self.low, self.high], dtype=torch.float64)
        local = torch.cartesian_prod(*sides.T) * around.distance
        return around.center + local @ around.panorama_axes().T

    def inside(self, means: Tensor, around: SceneFrame) -> Tensor:
        """Which means [N, 3] lie in it, [N] bool."""
        axes, center = (t.to(means) for t in (around.panorama_axes(), around.center))
        local = (means - center) @ axes / around.distance
        low, high = (
            torch.tensor(side, dtype=local.dtype, device=local.device) for side in (self.low, self.high)
        )
        return ((local >= low) & (local <= high)).all(dim=1)


@dataclass(frozen=True)
class Appearance:
    """What a visitor has chosen.

    Attributes:
        layer: a name in ``LAYERS`` or ``MEASURED``.
        exposure: stops by which radiance is brightened.
        strength: factor on the specular layer.
        turn: degrees of the far environment, counter-clockwise seen from above.
        crop: what is shown of the scene; None: all.
    """

    layer: str = "final"
    exposure: float = 0.0
    strength: float = 1.0
    turn: float = 0.0
    crop: Crop | None = None


class Painter:
    """Draws a scene as a visitor wants it.

    Args:
        around: the scene's surroundings.
    """

    def __init__(self, around: SceneFrame) -> None:
        self.around = around
        self._depths: tuple[float, float] | None = None

    def paint(
        self,
        shown: Shown,
        camera: Camera,
        appearance: Appearance,
        view: View | None = None,
        *,
        settled: bool = True,
    ) -> Picture | None:
        """A picture.

        Args:
            shown: the scene. camera: with the window's size; of the pose alone, where there is a view.
            appearance: what to draw.
            view: the photograph at whose pose it is drawn.
            settled: whether the camera rests; the colors of depths follow the picture only then.

        Returns:
            uint8 [H, W, 3] of the camera's size; None where there is no such layer.
        """
        layer = appearance.layer
        if layer in MEASURED and view is None:
            return None
        size = camera.width, camera.height
        if view is None:
            result = self._result(shown, camera, appearance)
            return self._layer(result, camera, appearance, settled=settled)
        place = letterbox(view.camera, size)
        if layer in MEASURED:
            return place.apply(self._measured(shown, view, appearance))
        camera = place.camera(view.camera)
        return self._layer(self._result(shown, camera, appearance), camera, appearance, settled=settled)

    def _result(self, shown: Shown, camera: Camera, appearance: Appearance) -> RenderResult:
        crop, turn = appearance.crop, None
        kept = None if crop is None else lambda means: crop.inside(means, self.around)
        if appearance.turn % 360:
            turn = self.around.turn(appearance.turn)
        result = shown.render(camera, depth=appearance.layer == "depth", kept=kept, turn=turn)
        if result.specular is None or result.diffuse is None or appearance.strength == 1.0:
            return result
        specular = appearance.strength * result.specular
        return replace(result, specular=specular, final=result.diffuse + specular)

    def _layer(
        self, result: RenderResult, camera: Camera, appearance: Appearance, *, settled: bool
    ) -> Picture | None:
        layer = appearance.layer
        values: Tensor | None = getattr(result, layer)
        if values is None:
            return None
        if layer in RADIANCE:
            return figures.radiance_to_rgb(values * 2.0**appearance.exposure)
        if layer == "depth" and (settled or self._depths is None):
            self._depths = depth_range(values, result.alpha > 0.5)
        return layer_picture(result, layer, camera, self._depths)

    def _measured(self, shown: Shown, view: View, appearance: Appearance) -> Picture:
        """A picture of the photograph's size."""
        brighter = 2.0**appearance.exposure
        if appearance.layer == "photograph":
            return figures.radiance_to_rgb(view.photograph() * brighter)
        if appearance.layer == "error":
            final = self._result(shown, view.camera, appearance).final
            return figures.error_to_rgb(final * brighter, view.photograph() * brighter)
        gray = luminance(stokes(view.intensities()))
        if appearance.layer == "DoLP":
            return figures.dolp_to_rgb(dolp(gray), DOLP_HIGH)
        return figures.aolp_to_rgb(aolp(gray), dolp(gray) / AOLP_FULL_DOLP)
