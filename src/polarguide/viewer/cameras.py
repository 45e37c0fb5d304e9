"""Cameras in a browser's window: free cameras, poses of photographs, keyframes, and clickable frusta."""

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

from polarguide.capture import Scene, View
from polarguide.capture.presentation import Crop
from polarguide.geometry.camera import Camera, quaternion
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.geometry.trajectory import camera_record, interpolated
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture


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
