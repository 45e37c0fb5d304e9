"""Session of the viewer: one connected browser with its control panel, camera and pictures."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec
import numpy as np

from polarguide.capture.presentation import PRESENTATION_FILE, STOPS, UNCHANGED, Crop, Presentation
from polarguide.core.records import to_json
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.viewer.guard import Accepts, choice, flag, number, pair, push
from polarguide.viewer.scenery import (
    MEASURED,
    MOST_KEYFRAMES,
    Appearance,
    Frusta,
    Painter,
    Photograph,
    Scenery,
    ViewPose,
    free_camera,
    keyframe,
    keyframe_path,
    move_to_view,
    path_json,
)
from polarguide.visualization.figures import png_bytes

FREE_VIEW = "(free)"
STEPS = ("previous", "next")
# Ranges of the controls.
SIDES = {"left_right": "Left, right", "down_up": "Down, up", "front_back": "Front, back"}
"""Label of each slider of the crop box."""
EXPOSURE = (-STOPS, STOPS)
STRENGTH = (0.0, 2.0)
TURN = (-180, 180)
SECONDS = (0.5, 10.0)
CROP = (-150, 150)
WIPE = (0, 100)


@dataclass(frozen=True)
class PanelOptions:
    """Options of a panel.

    Attributes:
        layers: layers of the shading model.
        turns: True if the environment can be rotated.
        views: names of the photographs.
        trains: True if the panel can pause a training.
        presentation: the saved presentation.
        saves: True if the presentation is saved to the run. Otherwise the browser downloads it.
    """

    layers: Sequence[str]
    turns: bool
    views: Sequence[str]
    trains: bool
    presentation: Presentation = UNCHANGED
    saves: bool = False


class Control(NamedTuple):
    """Description of a control.

    Attributes:
        kind: kind of control: the name of viser's method without ``add_``.
        label: text next to the control.
        arguments: further positional arguments of the method.
        accepts: function that validates a value from a browser, or None if the control is read-only.
        options: keyword arguments of the method.
    """

    kind: str
    label: str
    arguments: tuple[Any, ...] = ()
    accepts: Accepts | None = push
    options: Mapping[str, Any] = {}


def controls_of(options: PanelOptions) -> dict[str, dict[str, Control]]:
    """Return the controls of a panel by folder and name. An empty folder label stands for the panel itself."""
    presentation = options.presentation
    layers = (*options.layers, *MEASURED)
    views = (FREE_VIEW, *options.views)
    return {
        "": {
            "pause": Control("checkbox", "Pause training", (False,), flag, {"visible": options.trains}),
            "layer": Control("dropdown", "Layer", (layers,), choice(layers), {
                "hint": f"From {MEASURED[0]} on, a photograph's pose is needed; stokes, dolp and aolp are predicted"}),
            "exposure": Control("slider", "Exposure", (*EXPOSURE, 0.1, presentation.exposure or 0.0),
                                number(*EXPOSURE), {"hint": "In stops"}),
            "strength": Control("slider", "Reflection", (*STRENGTH, 0.05, 1.0), number(*STRENGTH), {
                "visible": "specular" in layers}),
            "turn": Control("slider", "Environment", (*TURN, 1, 0), number(*TURN), {
                "hint": "Rotates the environment light, in degrees; the scene stays", "visible": options.turns}),
        },
        "Photographs": {
            "view": Control("dropdown", "Go to", (views,), choice(views)),
            "step": Control("button_group", "", (STEPS,), choice(STEPS)),
            "frusta": Control("checkbox", "Show cameras", (True,), flag),
            "wipe": Control("slider", "Wipe", (*WIPE, 1, 0), number(*WIPE), {
                "hint": "In percent of the width, from the left: the run beside, else what was measured at this pose"}),
        },
        "Crop": {
            "crop": Control("checkbox", "Crop", (presentation.crop is not None,), flag),
            "box": Control("checkbox", "Show box", (False,), flag),
            **{
                name: Control("multi_slider", SIDES[name], (*CROP, 1, sides), pair(*CROP), {"min_range": 1})
                for name, sides in zip(SIDES, _percent(presentation.crop), strict=True)
            },
            "save": Control("button", "Save to the run" if options.saves else "Download", options={
                "hint": "Crop and exposure, for pages, exports and renderings"}),
        },
        "Picture and camera path": {
            "screenshot": Control("button", "Save picture"),
            "keyframes": Control("text", "Keyframes", ("0",), None, {"disabled": True}),
            "add_keyframe": Control("button", "Add keyframe"),
            "remove_keyframe": Control("button", "Remove last keyframe"),
            "seconds": Control("slider", "Seconds per segment", (*SECONDS, 0.5, 2.0), number(*SECONDS)),
            "save_path": Control("button", "Save path"),
        },
    }  # fmt: skip


class Panel:
    """Controls of one session. A control is accessed by its name, such as ``panel["layer"].value``.

    Names of views come from files. They are shown as plain text, because Markdown in the browser may run code.

    Attributes:
        accepts: functions that validate values from a browser, by the name of the control in viser.
        changed: callback after every change of the picture.

    Args:
        gui: viser's handle of the session's controls.
        options: options of the panel.
        changed: callback after every change of the picture.
        drop: callback that receives the exception of another callback.
        folded: True to place the controls in a closed folder. On a phone, viser's panel is open at first and covers
            half of the picture, and the server cannot close it.
    """

    def __init__(
        self,
        gui: Any,
        options: PanelOptions,
        changed: Callable[[], None],
        drop: Callable[[Exception], None],
        *,
        folded: bool = False,
    ) -> None:
        self.accepts: dict[str, Accepts] = {}
        self.changed = changed
        self._drop = drop
        self._controls: dict[str, Any] = {}
        self._saved = options.presentation
        # The saved box has more exact sides than the sliders' steps. It applies until a slider moves.
        self._saved_crop = options.presentation.crop
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._status = gui.add_markdown("")
        self._lines = tuple[str, ...]()
        self._note = ""
        with gui.add_folder("Controls", expand_by_default=False) if folded else nullcontext():
            for folder, controls in controls_of(options).items():
                unfolded = folder == "Photographs"
                with (
                    gui.add_folder(folder, expand_by_default=unfolded)
                    if folder and controls
                    else nullcontext()
                ):
                    for name, control in controls.items():
                        self._add(gui, name, control)
        for name in SIDES:
            self.listen(name, self._forget_saved_crop)
        for name in ("layer", "exposure", "strength", "turn", "wipe", "crop", "box", *SIDES):
            self.listen(name, changed)

    def __getitem__(self, name: str) -> Any:
        return self._controls[name]

    def _add(self, gui: Any, name: str, control: Control) -> None:
        handle = getattr(gui, f"add_{control.kind}")(control.label, *control.arguments, **control.options)
        self._controls[name] = handle
        if control.accepts is not None:
            self.accepts[handle._impl.uuid] = control.accepts

    def listen(self, name: str, act: Callable[[], None]) -> None:
        """Call a function when a visitor changes a control or presses a button."""
        control = self._controls[name]
        subscribe = control.on_click if hasattr(control, "on_click") else control.on_update
        subscribe(self.caught(act))

    def caught(self, act: Callable[[], None]) -> Callable[[Any], None]:
        """Wrap a function as a callback whose errors close only the connection of this browser."""

        def called(_: Any) -> None:
            try:
                act()
            except Exception as error:
                self._drop(error)

        return called

    def _forget_saved_crop(self) -> None:
        self._saved_crop = None

    def show_note(self, note: str) -> None:
        """Show a note below the status. The note must not contain names from files."""
        self._note = note
        self.show_status(*self._lines)

    def show_status(self, *lines: str) -> None:
        """Show status lines. The lines must not contain names from files."""
        self._lines = lines
        text = "  \n".join((*lines, f"**{self._note}**") if self._note else lines)
        if self._status.content != text:
            self._status.content = text

    def crop(self) -> Crop | None:
        """Return the crop box, or None without cropping. Its up axis is the up axis of the saved presentation."""
        if not self["crop"].value:
            return None
        if self._saved_crop is not None:
            return self._saved_crop
        left_right, down_up, front_back = (self[name].value for name in SIDES)
        low = (left_right[0] / 100, down_up[0] / 100, front_back[0] / 100)
        # A message may make both ends equal.
        high = tuple(max(side[1], side[0] + 1) / 100 for side in (left_right, down_up, front_back))
        return Crop(low, (high[0], high[1], high[2]), self._saved.up_axis)

    def presentation(self) -> Presentation:
        """Return the saved presentation with exposure and crop box from the panel."""
        crop = self.crop()
        exposure = float(self["exposure"].value) or None
        whole = self._saved.whole and crop is None
        return msgspec.structs.replace(self._saved, exposure=exposure, crop=crop, whole=whole)

    def appearance(self) -> Appearance:
        """Return the appearance of the picture, from the controls of the panel and the saved presentation."""
        return Appearance(
            layer=self["layer"].value,
            strength=float(self["strength"].value),
            turn=float(self["turn"].value),
            wipe=float(self["wipe"].value) / 100,
            presentation=self.presentation(),
        )


def _percent(crop: Crop | None) -> list[tuple[int, int]]:
    """Convert a crop box to the positions of its sliders."""
    if crop is None:
        return [(-40, 40)] * 3
    percents = []
    for low, high in zip(crop.low, crop.high, strict=True):
        first = min(max(round(100 * low), CROP[0]), CROP[1] - 1)
        percents.append((first, max(first + 1, min(round(100 * high), CROP[1]))))
    return percents


REST = 0.25  # seconds without a change before a sharp picture
BUDGET = 0.1  # seconds per picture while the camera moves
FIRST_HEIGHT = 360
LEAST_HEIGHT = 90
GREATEST_HEIGHT = 1080
GREATEST_WIDTH = 3840


class FramePacing:
    """Schedule of a session's pictures.

    While the camera or a control changes, pictures are coarse. Afterwards one sharp picture is due.

    The height of coarse pictures adapts to their rendering time. Times are seconds of one monotonic clock.

    Attributes:
        version: number of changes so far. The next picture shows all of them.
    """

    def __init__(self) -> None:
        self._changed = 0.0
        self.version = 1
        self._drawn = self._sharp = 0
        self.last_frame = 0.0
        self._height = float(FIRST_HEIGHT)

    def mark_changed(self, now: float) -> None:
        """Record a change of the camera or of a control at the time ``now``."""
        self._changed = now
        self.version += 1

    def mark_outdated(self) -> None:
        """Record a change of the scene. A sharp picture is then due, without coarse pictures before it."""
        self.version += 1

    def due(self, now: float) -> str | None:
        """Return the kind of picture that is due: "coarse", "sharp", or None if the last picture is up to date."""
        if now - self._changed >= REST:
            return None if self._sharp == self.version else "sharp"
        return None if self._drawn == self.version else "coarse"

    def frame_size(self, window: tuple[int, int], kind: str) -> tuple[int, int]:
        """Return the width and height in pixels of the next picture of a kind in a window of a given size."""
        limit = GREATEST_HEIGHT if kind == "sharp" else round(self._height)
        height = max(1, min(window[1], limit))
        width = max(1, round(window[0] * height / max(1, window[1])))
        if width > GREATEST_WIDTH:
            height = max(1, round(height * GREATEST_WIDTH / width))
        return min(width, GREATEST_WIDTH), height

    def end_frame(self, version: int, kind: str, seconds: float, now: float) -> None:
        """Record the duration of a rendered picture."""
        self._drawn = version
        self.last_frame = now
        if kind == "sharp":
            self._sharp = version
            return
        # The time is at most proportional to the number of pixels. Shrink at once, grow step by step.
        factor = (BUDGET / max(seconds, 1e-4)) ** 0.5
        self._height *= max(0.25, factor) if factor < 1 else min(1.1, factor)
        self._height = min(float(GREATEST_HEIGHT), max(float(LEAST_HEIGHT), self._height))


PATH_FILE = "camera_path.json"
PICTURE_FILE = "polarguide.png"
JPEG_QUALITY = 75
BETWEEN_FILES = 0.5  # least seconds between two files of a kind, or two animations
NO_LAYER = "This layer is not available here: go to a photograph, or choose another layer"


def _raise(error: Exception) -> None:
    raise error


class Session:
    """Connected browser with its controls, camera and pictures.

    Callbacks only record changes. The rendering thread calls ``draw``.

    Args:
        client: viser's handle.
        photographs: photographs by name.
        scene_frame: frame of the scene.
        options: options of the panel.
        wake: callback that is called when a picture may be due.
        save: function that writes a presentation to the run and returns a message. With None, the browser downloads the
            presentation.
        drop: callback that receives the exception of another callback and closes the connection.
        beside: another run, which wipes show.
    """

    def __init__(
        self,
        client: Any,
        photographs: Mapping[str, Photograph],
        scene_frame: SceneFrame,
        options: PanelOptions,
        wake: Callable[[], None],
        *,
        save: Callable[[Presentation], str] | None = None,
        drop: Callable[[Exception], None] = _raise,
        beside: Scenery | None = None,
    ) -> None:
        self._client = client
        self._photographs = photographs
        self._scene_frame = scene_frame
        self._wake = wake
        self._lock = threading.Lock()
        self._painter = Painter(scene_frame, beside)
        self.pacing = FramePacing()
        self._view_pose: ViewPose | None = None
        self._last_pose: ViewPose | None = (
            None  # pose of the last requested view, even if the camera has left it
        )
        self._screenshot = False
        self._written_at = dict[str, float]()
        first = next(iter(photographs.values())).view.camera
        self._size = first.width, first.height
        self._keyframes: list[Camera] = []
        upright = client.camera.image_width < client.camera.image_height  # as on a phone
        self.panel = panel = Panel(client.gui, options, self._changed, drop, folded=upright)
        self._save = save
        self._up_axis = options.presentation.up_axis
        self._frusta = Frusta(
            client.scene,
            list(photographs.values()),
            scene_frame,
            lambda name: panel.caught(lambda: self.go(name))(None),
        )
        client.camera.on_update(panel.caught(self._moved))
        callbacks = {
            "view": lambda: self._selected(panel["view"].value),
            "step": lambda: self._step(1 if panel["step"].value == "next" else -1),
            "frusta": lambda: self._frusta.show(panel["frusta"].value),
            "pause": self._wake,
            "screenshot": self._request_screenshot,
            "add_keyframe": self._add_keyframe,
            "remove_keyframe": self._remove_keyframe,
            "seconds": self._show_count,
            "save_path": self._save_path,
            "save": lambda: panel.show_note(self._save_presentation()),
        }
        for name, act in callbacks.items():
            panel.listen(name, act)
        panel.caught(self._changed)(None)  # show the saved box

    @property
    def client_id(self) -> int:
        """Number by which viser identifies the browser."""
        return int(self._client.client_id)

    @property
    def paused(self) -> bool:
        """True if this session pauses the training."""
        return bool(self.panel["pause"].value)

    def _soon_again(self, what: str) -> bool:
        """Return True if a request came less than ``BETWEEN_FILES`` after the last one of its kind; else record it."""
        now = time.monotonic()
        with self._lock:
            soon = now - self._written_at.get(what, -BETWEEN_FILES) < BETWEEN_FILES
            if not soon:
                self._written_at[what] = now
        return soon

    def _changed(self) -> None:
        with self._lock:
            self.pacing.mark_changed(time.monotonic())
        crop = self.panel.crop()
        self._frusta.show_box(crop if self.panel["box"].value else None)
        self._wake()

    def _save_presentation(self) -> str:
        if self._soon_again("presentation"):
            return "Saved just now"
        chosen = self.panel.presentation()
        if self._save is not None:
            return self._save(chosen)
        content = to_json(chosen.to_record())
        self._client.send_file_download(PRESENTATION_FILE, content, save_immediately=True)
        return "Put it into the run's folder"

    def _moved(self) -> None:
        """Handle a new camera pose from the browser."""
        camera = self._client.camera
        with self._lock:
            now = time.monotonic()
            self.pacing.mark_changed(now)
            pose = self._last_pose
            if pose is None or not pose.is_kept(camera, now, self._scene_frame.distance):
                pose = None
            if pose is not self._view_pose:
                self._view_pose = pose
                self.panel["view"].value = FREE_VIEW if pose is None else pose.view.name
                if pose is None and self._up_axis is not None:
                    self._client.camera.up_direction = np.array(self._up_axis)
        self._wake()

    def go(self, name: str) -> None:
        """Move the camera to the pose of a photograph."""
        with self._lock:
            view = self._photographs[name].view
            pose = move_to_view(self._client, view, self._scene_frame, time.monotonic())
            self._view_pose = self._last_pose = pose
            self.pacing.mark_changed(time.monotonic())
        self.panel["view"].value = name
        self._wake()

    def _selected(self, name: str) -> None:
        if name in self._photographs and (self._view_pose is None or self._view_pose.view.name != name):
            self.go(name)

    def _step(self, by: int) -> None:
        names = list(self._photographs)
        at = names.index(self._view_pose.view.name) if self._view_pose else (-1 if by > 0 else 0)
        self.go(names[(at + by) % len(names)])

    def _request_screenshot(self) -> None:
        if not self._soon_again("picture"):
            self._screenshot = True
            self._wake()

    def _add_keyframe(self) -> None:
        camera = self._view_pose.view.camera if self._view_pose else self._camera(self._size)
        if len(self._keyframes) < MOST_KEYFRAMES:
            self._keyframes.append(keyframe(camera, self._size))
        self._show_count()

    def _remove_keyframe(self) -> None:
        del self._keyframes[-1:]
        self._show_count()

    def _show_count(self) -> None:
        count = len(self._keyframes)
        seconds = max(0, count - 1) * float(self.panel["seconds"].value)
        self.panel["keyframes"].value = f"{count}" + (f", {seconds:g} s" if count > 1 else "")

    def _path(self) -> list[Camera]:
        return keyframe_path(self._keyframes, float(self.panel["seconds"].value))

    def _save_path(self) -> None:
        if self._keyframes and not self._soon_again("path"):
            text = path_json(self._path())
            self._client.send_file_download(PATH_FILE, text.encode(), save_immediately=True)

    def _camera(self, frame_size: tuple[int, int]) -> Camera:
        camera = self._client.camera
        return free_camera(camera.wxyz, camera.position, camera.fov, frame_size)

    def due(self) -> str | None:
        """Return the kind of picture that is due: "coarse", "sharp", or None."""
        with self._lock:
            return "sharp" if self._screenshot else self.pacing.due(time.monotonic())

    def draw(self, scenery: Scenery, kind: str) -> None:
        """Render a picture and send it to the browser."""
        began = time.monotonic()
        with self._lock:
            version = self.pacing.version
            view_pose = self._view_pose
            screenshot = self._screenshot
            self._screenshot = False
            camera = self._client.camera
            frame_size = self.pacing.frame_size((camera.image_width, camera.image_height), kind)
            viewpoint = self._camera(frame_size)
        view = None if view_pose is None else view_pose.view
        sharp = kind == "sharp"
        appearance = self.panel.appearance()
        picture = self._painter.paint(scenery, viewpoint, appearance, view, settled=sharp)
        image = picture
        if image is None:
            image = np.full((frame_size[1], frame_size[0], 3), 64, dtype=np.uint8)
        coding: dict[str, Any] = (
            {"format": "png"} if sharp else {"format": "jpeg", "jpeg_quality": JPEG_QUALITY}
        )
        self._client.scene.set_background_image(image, **coding)
        self._frusta.hide_near(None if view else viewpoint.center.numpy())
        if screenshot and picture is not None:
            self._client.send_file_download(PICTURE_FILE, png_bytes(picture), save_immediately=True)
        now = time.monotonic()
        with self._lock:
            self.pacing.end_frame(version, kind, now - began, now)
        note = f"{frame_size[0]} x {frame_size[1]} in {1000 * (now - began):.0f} ms"
        self.panel.show_status(scenery.status, NO_LAYER if picture is None else note)
