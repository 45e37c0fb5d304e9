"""Scene that a viewer shows, and painter of its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.presentation import Presentation, colored
from polarguide.gaussians.gaussians import Gaussians
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.raster.interface import Rasterize
from polarguide.results.rendering.relight import RELIT_RESOLUTION, turned_cubemap
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import PLAIN, Light, Parameters, ShadingModel, radiance_cubemap
from polarguide.shading.result import POLARIZED, RenderResult, polarized_layers
from polarguide.training.loop import TrainingLoop
from polarguide.viewer.cameras import drawn_camera, letterboxed
from polarguide.visualization import figures
from polarguide.visualization.figures import (
    RADIANCE,
    Picture,
    depth_range,
    layer_picture,
    layer_scale,
    polarization_picture,
)


@dataclass(frozen=True, eq=False)
class Scenery:
    """Gaussians and all other data from which a viewer renders pictures.

    Attributes:
        gaussians: the Gaussians.
        light: learned light by name.
        shading: shading of the current stage.
        rasterize: rasterizer of the backend.
        sh_degree: degree of the base color's harmonics.
        status: line of text that describes the run or the state of the training.
        footprints: [N] size of a training pixel at each Gaussian of a finished training, see ``raster.magnification``.
    """

    gaussians: Gaussians
    light: Light
    shading: ShadingModel
    rasterize: Rasterize
    sh_degree: int
    status: str
    footprints: Tensor | None = None

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        *,
        depth: bool,
        surface: bool = False,
        within: Callable[[Tensor], Tensor] | None = None,
        turn: Tensor | None = None,
    ) -> RenderResult:
        """Render all layers, and return them on the CPU.

        Args:
            camera: the camera, with the size of the picture.
            depth: render depth.
            surface: return normals and depth of the surface at the median depth of each pixel.
            within: function that maps points [N, 3] to a mask [N] of points to show. None shows all points.
            turn: rotation [3, 3] of a radiance environment. None renders the environment as learned.
        """
        gaussians: Parameters = self.gaussians
        footprints = self.footprints
        if within is not None:
            inside = within(self.gaussians["means"].detach())
            gaussians = self.gaussians.only(inside)
            footprints = None if footprints is None else footprints[inside]
        return render(
            gaussians,
            camera,
            self.rasterize,
            RenderRequest(self.sh_degree, depth=depth, at_median_depth=surface),
            shading=self.shading,
            light=self.light if turn is None else self._turned(turn),
            footprints=footprints,
        ).to("cpu")

    def stokes(self, result: RenderResult, camera: Camera) -> Tensor | None:
        """Predict Stokes vectors. Return None if the normal or one of the two radiance layers is missing."""
        if not result.is_polarized:
            return None
        return self.shading.predicted_stokes(result, camera)

    def _turned(self, turn: Tensor) -> Light:
        cubemap = radiance_cubemap(self.shading)
        if cubemap is None:
            return self.light
        turned = turned_cubemap(self.light[cubemap.name].detach(), turn, RELIT_RESOLUTION)
        return {**self.light, cubemap.name: turned}


def run_scenery(run: OpenedRun) -> Scenery:
    """Return the scenery of a trained run."""
    model = run.model
    status = f"{run.recipe.name}, {run.steps:,} steps; {model.size}"
    return Scenery(
        model.state.gaussians,
        model.light,
        model.shading,
        model.backend.rasterize,
        3,
        status,
        model.state.footprints,
    )


def training_scenery(loop: TrainingLoop) -> Scenery:
    """Return the scenery of a training between two steps. Its shading is the shading of the current stage."""
    steps = loop.settings.steps
    state = loop.state
    stage = loop.schedule.at(min(state.step, steps - 1)).stage
    progress = f"step {state.step:,} of {steps:,} ({stage.name})"
    status = f"{loop.context.recipe.name}, {progress}; {len(state.gaussians):,} Gaussians"
    return Scenery(
        state.gaussians,
        state.light,
        loop.current.shading if stage.reflection else PLAIN,
        loop.context.backend.rasterize,
        loop.schedule.sh_degree(min(state.step, steps - 1)),
        status,
    )


OF_POLARIZATION = {f"{name}, measured": name for name in POLARIZED}
"""Predicted layer for each measured layer. Measured layers need pictures that determine the polarization."""
BESIDE = {
    **dict.fromkeys(("final", "base"), "photograph"),
    **{of: name for name, of in OF_POLARIZATION.items()},
}
"""Measured layer for each rendered layer. A wipe compares the two."""
MEASURED = ("photograph", *OF_POLARIZATION, "error")
"""Layers that exist only at the pose of a photograph."""
LEGEND = 0.25, 128, 512
"""Width of the legend: share of the picture's width, minimum in pixels, maximum in pixels."""


UNCHANGED = Presentation()
"""Presentation with default values, which changes nothing."""


@dataclass(frozen=True)
class Appearance:
    """Settings of a picture that a visitor chooses.

    Attributes:
        layer: a name in ``LAYERS``, ``POLARIZED`` or ``MEASURED``.
        strength: factor on the specular layer. It has no effect on predicted polarization.
        turn: rotation of the far environment in degrees, counter-clockwise seen from above.
        wipe: share of the picture's width, from the left, that shows the other run. Without another run, this part
            shows the measured layer (``BESIDE``) at the pose of a photograph.
        presentation: color, exposure, up axis and crop box. Without a crop box, the whole scene is shown.
    """

    layer: str = "final"
    strength: float = 1.0
    turn: float = 0.0
    wipe: float = 0.0
    presentation: Presentation = UNCHANGED


class Painter:
    """Painter of a scene's pictures.

    Args:
        around: frame of the scene's cameras.
        beside: another run of the scene, which wipes show. With None, wipes show measured layers.
    """

    def __init__(self, around: SceneFrame, beside: Scenery | None = None) -> None:
        self.around = around
        self._beside = beside
        self._depths: tuple[float, float] | None = None

    def paint(
        self,
        scenery: Scenery,
        camera: Camera,
        appearance: Appearance,
        view: View | None = None,
        *,
        settled: bool = True,
    ) -> Picture | None:
        """Draw a picture.

        Args:
            scenery: the scene.
            camera: camera with the size of the window. If there is a view, only the size is used.
            appearance: choice of the picture.
            view: photograph at whose pose the camera is, or None for a free camera.
            settled: True if the camera does not move. The range of the depth colors is updated only then.

        Returns:
            uint8 [H, W, 3] of the camera's size; None if the layer does not exist.
        """
        if appearance.layer in MEASURED:
            picture = self._measured(scenery, view, appearance, (camera.width, camera.height))
        else:
            camera = drawn_camera(camera, view)
            picture = self._modeled(scenery, camera, appearance, settled=settled)
            if picture is not None and appearance.wipe > 0:
                picture = self._wiped(picture, scenery, camera, view, appearance)
        return None if picture is None else self._with_scale(picture, appearance.layer)

    def _modeled(
        self, scenery: Scenery, camera: Camera, appearance: Appearance, *, settled: bool
    ) -> Picture | None:
        """Draw a rendered layer, or return None if the layer does not exist."""
        result = self._result(scenery, camera, appearance)
        if appearance.layer in POLARIZED and (stokes := scenery.stokes(result, camera)) is not None:
            result = result.with_layers(**polarized_layers(stokes))
        return self._layer(result, camera, appearance, settled=settled)

    def _wiped(
        self, picture: Picture, scenery: Scenery, camera: Camera, view: View | None, appearance: Appearance
    ) -> Picture:
        """Draw the other run or the measured layer over the left part of a picture.

        Return the picture unchanged if there is neither another run nor a measured layer.
        """
        other = BESIDE.get(appearance.layer)
        left = None
        if self._beside is not None:
            left = self._modeled(self._beside, camera, appearance, settled=False)
        elif other is not None:
            measured = replace(appearance, layer=other)
            left = self._measured(scenery, view, measured, (camera.width, camera.height))
        if left is None:
            return picture
        column = round(min(appearance.wipe, 1.0) * picture.shape[1])
        wiped = picture.copy()
        wiped[:, :column] = left[:, :column]
        wiped[:, max(0, column - 1) : column + 1] = 255
        return wiped

    def _with_scale(self, picture: Picture, layer: str) -> Picture:
        """Draw the legend of a layer's colors over the lower left corner of a picture."""
        scale = (
            figures.scale_bar(0.0, figures.LARGE_ERROR, "inferno", middle="difference, sRGB")
            if layer == "error"
            else layer_scale(layer, self._depths)
        )
        share, least, most = LEGEND
        width = min(max(round(share * picture.shape[1]), least), most)
        if scale is None or picture.shape[1] < 2 * least:
            return picture  # the legend would hide the picture
        return figures.with_key(picture, scale, width)

    def _result(self, scenery: Scenery, camera: Camera, appearance: Appearance) -> RenderResult:
        crop = appearance.presentation.crop
        turn = None
        strength = 1.0 if appearance.layer in POLARIZED else appearance.strength
        within = None if crop is None else lambda means: crop.inside(means, self.around)
        if appearance.turn % 360:
            turn = appearance.presentation.upright(self.around).turn(appearance.turn)
        result = scenery.render(
            camera,
            depth=appearance.layer == "depth",
            surface=appearance.layer in ("normal", "depth"),
            within=within,
            turn=turn,
        )
        if not {"specular", "diffuse"} <= result.layers.keys() or strength == 1.0:
            return result
        specular = strength * result.layers["specular"]
        return result.with_layers(specular=specular, final=result.layers["diffuse"] + specular)

    def _layer(
        self, result: RenderResult, camera: Camera, appearance: Appearance, *, settled: bool
    ) -> Picture | None:
        layer = appearance.layer
        values = result.layers.get(layer)
        if values is None:
            return None
        if layer in RADIANCE:
            return figures.radiance_to_rgb(colored(values, appearance.presentation.color))
        if layer == "depth" and (settled or self._depths is None):
            self._depths = depth_range(values, result.alpha > 0.5)
        return layer_picture(result, layer, camera, self._depths)

    def _measured(
        self, scenery: Scenery, view: View | None, appearance: Appearance, frame_size: tuple[int, int]
    ) -> Picture | None:
        """Draw a measured layer at the pose of a photograph. Return None if the layer is unknown."""
        layer = appearance.layer
        if view is None or (layer in OF_POLARIZATION and not view.is_determined):
            return None
        if layer == "photograph":
            picture = figures.radiance_to_rgb(colored(view.photograph(), appearance.presentation.color))
        elif layer == "error":
            brighter = 2.0 ** (appearance.presentation.exposure or 0.0)
            final = self._result(scenery, view.camera, appearance).final
            picture = figures.error_to_rgb(final * brighter, view.photograph() * brighter)
        else:
            picture = polarization_picture(OF_POLARIZATION[layer], view.stokes())
        return letterboxed(picture, frame_size)
