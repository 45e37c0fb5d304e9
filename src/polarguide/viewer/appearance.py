"""How a visitor wants to see a scene, and the pictures that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.inspection.layers import AOLP_FULL_DOLP, DOLP_HIGH
from polarguide.optics import aolp, dolp, luminance
from polarguide.presentation import Crop, Presentation, Vector, balanced
from polarguide.rendering.picking import SurfacePoint, surface_at
from polarguide.scene_frame import SceneFrame
from polarguide.shading.result import RenderResult
from polarguide.viewer.shown import Scenery
from polarguide.viewer.viewport import letterbox
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture
from polarguide.visualization.layers import RADIANCE, depth_range, layer_picture

MEASURED = ("photograph", "DoLP", "AoLP", "error")
"""Layers that only a photograph's pose has."""
POLARIZED = ("DoLP", "AoLP")
"""Those of them that need pictures which determine the polarization."""


@dataclass(frozen=True)
class Appearance:
    """What a visitor has chosen.

    Attributes:
        layer: a name in ``LAYERS`` or ``MEASURED``.
        exposure: stops by which radiance is brightened.
        strength: factor on the specular layer.
        turn: degrees of the far environment, counter-clockwise seen from above.
        crop: what is shown of the scene; None: all.
        white_balance: gains of R, G and B on radiance. up_axis: the axis of turning; None: as the cameras say.
    """

    layer: str = "final"
    exposure: float = 0.0
    strength: float = 1.0
    turn: float = 0.0
    crop: Crop | None = None
    white_balance: Vector | None = None
    up_axis: Vector | None = None


class Painter:
    """Draws a scene as a visitor wants it.

    Args:
        around: the frame of the scene's cameras.
    """

    def __init__(self, around: SceneFrame) -> None:
        self.around = around
        self._depths: tuple[float, float] | None = None

    def paint(
        self,
        shown: Scenery,
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
        if layer in MEASURED and (view is None or (layer in POLARIZED and not view.is_determined)):
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

    def point(
        self,
        shown: Scenery,
        camera: Camera,
        appearance: Appearance,
        view: View | None,
        place: tuple[float, float],
    ) -> SurfacePoint | None:
        """What is seen at a place of the picture that ``paint`` draws, in shares of its width and height."""
        if view is not None:
            camera = letterbox(view.camera, (camera.width, camera.height)).camera(view.camera)
        plain = Appearance(layer="depth", crop=appearance.crop)
        result = self._result(shown, camera, plain)
        return surface_at(result, camera, place[0] * camera.width, place[1] * camera.height)

    def _result(self, shown: Scenery, camera: Camera, appearance: Appearance) -> RenderResult:
        crop, turn = appearance.crop, None
        kept = None if crop is None else lambda means: crop.inside(means, self.around)
        if appearance.turn % 360:
            presented = Presentation(up_axis=appearance.up_axis)
            turn = presented.upright(self.around).turn(appearance.turn)
        surface = appearance.layer in ("normal", "depth")
        result = shown.render(
            camera, depth=appearance.layer == "depth", surface=surface, kept=kept, turn=turn
        )
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
            return figures.radiance_to_rgb(_shown(values, appearance))
        if layer == "depth" and (settled or self._depths is None):
            self._depths = depth_range(values, result.alpha > 0.5)
        return layer_picture(result, layer, camera, self._depths)

    def _measured(self, shown: Scenery, view: View, appearance: Appearance) -> Picture:
        """A picture of the photograph's size."""
        brighter = 2.0**appearance.exposure
        if appearance.layer == "photograph":
            return figures.radiance_to_rgb(_shown(view.photograph(), appearance))
        if appearance.layer == "error":
            final = self._result(shown, view.camera, appearance).final
            return figures.error_to_rgb(final * brighter, view.photograph() * brighter)
        gray = luminance(view.stokes())
        if appearance.layer == "DoLP":
            return figures.dolp_to_rgb(dolp(gray), DOLP_HIGH)
        return figures.aolp_to_rgb(aolp(gray), dolp(gray) / AOLP_FULL_DOLP)


def _shown(radiance: Tensor, appearance: Appearance) -> Tensor:
    """Radiance [H, W, 3] as bright and as white as wanted, linear."""
    gains = Presentation(white_balance=appearance.white_balance).gains
    return balanced(radiance, gains) * 2.0**appearance.exposure
