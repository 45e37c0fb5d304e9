"""Scene that a viewer shows, painter of its pictures, and cameras in the browser's window.

Cameras are free, poses of photographs, or keyframes. Clickable frusta show the photographs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.presentation import UNCHANGED, Crop, Presentation
from polarguide.gaussians.gaussians import Gaussians
from polarguide.geometry.camera import Camera, quaternion
from polarguide.geometry.camera_path import camera_record, interpolated
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.raster.interface import Rasterize
from polarguide.results.rendering.relight import RELIT_RESOLUTION, turned_cubemap
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import PLAIN, Light, Parameters, ShadingModel, radiance_cubemap
from polarguide.shading.result import POLARIZED, RenderResult, polarized_layers
from polarguide.training.loop import TrainingLoop
from polarguide.visualization import figures
from polarguide.visualization.figures import (
    Picture,
    depth_range,
    layer_picture,
    layer_scale,
    polarization_picture,
)


def free_camera(
    wxyz: Sequence[float], position: Sequence[float], fov: float, frame_size: tuple[int, int]
) -> Camera:
    """Return a camera with square pixels and a centered principal point.

    Args:
        wxyz: quaternion of the camera-to-world rotation. The camera has OpenCV axes.
        position: camera center in the world.
        fov: vertical field of view in radians.
        frame_size: width and height in pixels.
    """
    width, height = frame_size
    w, x, y, z = (float(v) for v in wxyz)
    rotation = torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix().T.copy())
    center = torch.tensor([float(v) for v in position], dtype=torch.float64)
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, -rotation @ center)


def letterboxed(photograph: Picture, frame_size: tuple[int, int]) -> Picture:
    """Fit a photograph into a window of another aspect ratio. It is centered on gray and as large as possible.

    Args:
        photograph: uint8 [h, w, 3].
        frame_size: width and height of the window in pixels.
    """
    height, width = photograph.shape[:2]
    scale = min(frame_size[0] / width, frame_size[1] / height)
    left = 0.5 * (frame_size[0] - scale * width)
    top = 0.5 * (frame_size[1] - scale * height)
    # The origin of warpAffine is the center of the corner pixel; the origin of our cameras is its corner.
    matrix = np.array([[scale, 0, left + 0.5 * scale - 0.5], [0, scale, top + 0.5 * scale - 0.5]])
    blend = cv2.INTER_LINEAR if scale >= 1 else cv2.INTER_AREA
    placed = cv2.warpAffine(photograph, matrix, frame_size, flags=blend, borderValue=(64, 64, 64))
    return np.ascontiguousarray(placed, dtype=np.uint8)


def drawn_camera(camera: Camera, view: View | None) -> Camera:
    """Return the camera with which a window's picture is rendered.

    It is the free camera or, if ``view`` is set, the pose of this view with the size of the window.
    """
    if view is None:
        return camera
    return view.camera.extended(camera.width, camera.height)


ARRIVAL = 5.0  # seconds within which a browser must report a pose
# Tolerances of rounding: 1 - |cos| of half the angle, and distance in units of the cameras' distance.
TURNED = 1e-6
MOVED = 1e-4


@dataclass(eq=False)
class ViewPose:
    """View to whose pose the camera of a session was moved.

    Attributes:
        view: view of the scene.
        wxyz, position: the pose that was sent to the browser.
        since: time at which the pose was sent.
        written: time stamp with which viser recorded this change of the camera.
        reached: True if the browser has reported this pose. Before that, it may still report earlier poses.
    """

    view: View
    wxyz: np.ndarray
    position: np.ndarray
    since: float
    written: float
    reached: bool = False

    def is_kept(self, camera: Any, now: float, distance: float) -> bool:
        """Return True if a browser's camera has this pose, or may still be moving to it.

        Args:
            camera: viser's camera.
            now: time in seconds.
            distance: distance of the cameras from the scene's center.
        """
        turned = 1 - abs(float(np.dot(self.wxyz, camera.wxyz)))
        moved = float(np.linalg.norm(self.position - camera.position)) / distance
        here = turned < TURNED and moved < MOVED
        # The callback of an earlier report may run after the pose was written, and then reads the written pose.
        self.reached |= here and camera.update_timestamp != self.written
        return here or (not self.reached and now - self.since < ARRIVAL)


def move_to_view(client: Any, view: View, scene_frame: SceneFrame, now: float) -> ViewPose:
    """Move a browser's camera to the pose of a view. Its field of view then contains the whole photograph."""
    camera = client.camera
    target = view.camera
    center = view.camera.center
    # The orbit center lies on the optical axis, at the distance of the scene's center.
    ahead = target.rotation[2]
    distance = max(float((scene_frame.center - center) @ ahead), 0.1 * scene_frame.distance)
    high = 0.5 * target.height / target.fy
    wide = 0.5 * target.width / target.fx
    with client.atomic():
        camera.fov = 2 * math.atan(max(high, wide / camera.aspect))
        camera.up_direction = (-target.rotation[1]).numpy()
        camera.position = center.numpy()
        camera.look_at = (center + distance * ahead).numpy()
    # viser's stored pose may already be replaced by a message of the browser.
    pose = np.array(quaternion(target.rotation.T)), center.numpy()
    return ViewPose(view, *pose, since=now, written=camera.update_timestamp)


FRAMES_PER_SECOND = 30
MOST_KEYFRAMES = 50


def keyframe(camera: Camera, frame_size: tuple[int, int]) -> Camera:
    """Return a camera with another picture size (width, height) and the same vertical field of view."""
    width, height = frame_size
    focal = camera.fy * height / camera.height
    return replace(camera, width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)


def keyframe_path(keyframes: list[Camera], seconds: float) -> list[Camera]:
    """Return a smooth camera path that takes ``seconds`` from one keyframe to the next.

    Fewer than two keyframes are returned unchanged.
    """
    if len(keyframes) < 2:
        return keyframes
    return interpolated(keyframes, 1 + round((len(keyframes) - 1) * seconds * FRAMES_PER_SECOND))


def path_json(path: list[Camera]) -> str:
    """Return a path as JSON for ``polarguide render --path``."""
    records = [camera_record(camera) for camera in path]
    return json.dumps({"frames_per_second": FRAMES_PER_SECOND, "cameras": records})


THUMBNAIL = 96  # pixels of the longer side
# In units of the cameras' distance: size of a frustum, and distance within which it is hidden.
SIZE = 0.05
NEAR = 0.4
COLOR = (60, 90, 160)
HELD_OUT_COLOR = (200, 120, 30)
BOX_COLOR = (240, 200, 40)
# The twelve edges of a box. Its eight corners are ordered with the last axis fastest.
EDGES = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]


@dataclass(frozen=True, eq=False)
class Photograph:
    """Photograph with its thumbnail (uint8 RGB [h, w, 3]), marked if it is held out from training."""

    view: View
    thumbnail: Picture
    held_out: bool


def photographs(scene: Scene) -> dict[str, Photograph]:
    """Return all photographs of a scene by view name."""
    tests = set(scene.test_names)
    found = {}
    for view in scene.views:
        picture = view.photograph().numpy()
        scale = min(1.0, THUMBNAIL / max(picture.shape[:2]))
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        thumbnail = figures.radiance_to_rgb(torch.from_numpy(small))
        found[view.name] = Photograph(view, thumbnail, view.name in tests)
    return found


class Frusta:
    """Clickable camera frusta with their photographs.

    Args:
        scene: viser's scene handle of one session.
        photographs: photographs to show.
        scene_frame: frame of the scene.
        go: callback that receives the name of a view when its frustum is clicked.
    """

    def __init__(
        self,
        scene: Any,
        photographs: Sequence[Photograph],
        scene_frame: SceneFrame,
        go: Callable[[str], None],
    ) -> None:
        self._scene = scene
        self._scene_frame = scene_frame
        self._visible = True
        self._far = np.ones(len(photographs), dtype=bool)
        self._centers = np.array([p.view.camera.center.numpy() for p in photographs]).reshape(-1, 3)
        self._reach = NEAR * scene_frame.distance
        self._handles: list[Any] = []
        for number, photograph in enumerate(photographs):
            camera = photograph.view.camera
            name = photograph.view.name
            handle = scene.add_camera_frustum(
                f"/cameras/{number}",
                fov=2 * math.atan(0.5 * camera.height / camera.fy),
                aspect=camera.width / camera.height,
                scale=SIZE * scene_frame.distance,
                thickness=0.02 * SIZE * scene_frame.distance,
                color=HELD_OUT_COLOR if photograph.held_out else COLOR,
                image=photograph.thumbnail,
                jpeg_quality=80,
                wxyz=quaternion(camera.rotation.T),
                position=camera.center.numpy(),
                cast_shadow=False,
                receive_shadow=False,
            )
            handle.on_click(lambda _, name=name: go(name))
            self._handles.append(handle)
        self._box: Any = None

    def show(self, visible: bool) -> None:
        """Show or hide all frusta."""
        self._visible = visible
        self._update()

    def hide_near(self, position: np.ndarray | None) -> None:
        """Hide the frusta near a camera position [3], which would cover the picture. None hides all frusta."""
        near = True if position is None else np.linalg.norm(self._centers - position, axis=1) < self._reach
        self._far = ~np.broadcast_to(near, len(self._handles))
        self._update()

    def _update(self) -> None:
        for handle, far in zip(self._handles, self._far, strict=True):
            visible = self._visible and bool(far)
            if handle.visible != visible:
                handle.visible = visible

    def show_box(self, crop: Crop | None) -> None:
        """Draw a crop box. None removes the drawn box."""
        if self._box is not None:
            self._box.remove()
            self._box = None
        if crop is not None:
            corners = crop.corners(self._scene_frame).numpy()
            points = np.array([[corners[a], corners[b]] for a, b in EDGES], dtype=np.float32)
            width = 0.0015 * self._scene_frame.distance
            self._box = self._scene.add_line_segments("/crop", points, BOX_COLOR, thickness=width)


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


@dataclass(frozen=True)
class Appearance:
    """Settings of a picture that a visitor chooses.

    Attributes:
        layer: a name in ``LAYERS``, ``POLARIZED`` or ``MEASURED``.
        strength: factor on the specular layer. It has no effect on predicted polarization.
        turn: rotation of the far environment in degrees, counter-clockwise seen from above.
        wipe: share of the picture's width, from the left, that shows the other run. Without another run, this part
            shows the measured layer (``BESIDE``) at the pose of a photograph.
        presentation: color, exposure, tone curve, up axis and crop box. Without a crop box, the whole scene is shown.
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
        if layer == "depth" and (settled or self._depths is None):
            self._depths = depth_range(values, result.alpha > 0.5)
        return layer_picture(result, layer, camera, self._depths, presentation=appearance.presentation)

    def _measured(
        self, scenery: Scenery, view: View | None, appearance: Appearance, frame_size: tuple[int, int]
    ) -> Picture | None:
        """Draw a measured layer at the pose of a photograph. Return None if the layer is unknown."""
        layer = appearance.layer
        if view is None or (layer in OF_POLARIZATION and not view.is_determined):
            return None
        if layer == "photograph":
            picture = figures.radiance_to_rgb(appearance.presentation.displayed(view.photograph()))
        elif layer == "error":
            brighter = 2.0 ** (appearance.presentation.exposure or 0.0)
            final = self._result(scenery, view.camera, appearance).final
            picture = figures.error_to_rgb(final * brighter, view.photograph() * brighter)
        else:
            picture = polarization_picture(OF_POLARIZATION[layer], view.stokes())
        return letterboxed(picture, frame_size)
