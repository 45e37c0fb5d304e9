"""One browser that looks at a scene: its controls, its cameras, and the pictures that it is sent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from polarguide.camera import Camera
from polarguide.scene_frame import SceneFrame
from polarguide.viewer.appearance import Painter
from polarguide.viewer.frusta import Frusta
from polarguide.viewer.keys import FRAMES_PER_SECOND, Keys
from polarguide.viewer.lens import free_camera
from polarguide.viewer.pace import Pace
from polarguide.viewer.panel import NOWHERE, Offer, Panel
from polarguide.viewer.photographs import Photograph
from polarguide.viewer.place import Place, stand
from polarguide.viewer.shown import Shown
from polarguide.visualization.figures import Picture, png_bytes

PATH_FILE, PICTURE_FILE = "camera_path.json", "polarguide.png"
JPEG_QUALITY = 75
NO_LAYER = "Nothing to show: go to a photograph, or choose another layer"


class Visitor:
    """A connected browser. Its callbacks only note what changed; ``draw`` is called by the thread that renders.

    Args:
        client: viser's handle. photographs: by name, to go to. around: the scene's surroundings.
        offer: for the panel. wake: called when there may be something to draw.
    """

    def __init__(
        self,
        client: Any,
        photographs: Mapping[str, Photograph],
        around: SceneFrame,
        offer: Offer,
        wake: Callable[[], None],
    ) -> None:
        self._client, self._photographs, self._around, self._wake = client, photographs, around, wake
        self._lock = threading.Lock()
        self._painter = Painter(around)
        self.pace = Pace()
        self._place: Place | None = None
        self._screenshot = False
        self._playing: tuple[float, list[Camera]] | None = None
        first = next(iter(photographs.values())).view.camera
        self._size = first.width, first.height
        self._keys = Keys(self._size)
        self.panel = Panel(client.gui, offer, self._changed)
        self._frusta = Frusta(client.scene, list(photographs.values()), around, self.go)
        self._connect()

    @property
    def paused(self) -> bool:
        """Whether the visitor wants the training to wait."""
        return bool(self.panel.pause.value)

    def _connect(self) -> None:
        panel = self.panel
        self._client.camera.on_update(lambda _: self._moved())
        panel.view.on_update(lambda _: self._chose(panel.view.value))
        panel.step.on_click(lambda _: self._step(1 if panel.step.value == "next" else -1))
        panel.frusta.on_update(lambda _: self._frusta.show(panel.frusta.value))
        panel.box.on_update(lambda _: self._changed())
        panel.pause.on_update(lambda _: self._wake())
        panel.screenshot.on_click(lambda _: self._ask_for_file())
        panel.add_key.on_click(lambda _: self._add_key())
        panel.remove_key.on_click(lambda _: self._remove_key())
        panel.seconds.on_update(lambda _: self._count_keys())
        panel.play.on_click(lambda _: self._play())
        panel.save_path.on_click(lambda _: self._save_path())

    def _changed(self) -> None:
        with self._lock:
            self.pace.change(time.monotonic())
        self._frusta.box(self.panel.crop if self.panel.box.value else None)
        self._wake()

    def _moved(self) -> None:
        """The browser tells where its camera is."""
        camera = self._client.camera
        with self._lock:
            now = time.monotonic()
            self.pace.change(now)
            if self._place is not None and not self._place.holds(camera, now, self._around.distance):
                self._place = None
                self.panel.view.value = NOWHERE
        self._wake()

    def go(self, name: str) -> None:
        """Stand where a photograph was taken."""
        with self._lock:
            self._playing = None
            view = self._photographs[name].view
            self._place = stand(self._client, view, self._around, time.monotonic())
            self.pace.change(time.monotonic())
        self.panel.view.value = name
        self._wake()

    def _chose(self, name: str) -> None:
        if name in self._photographs and (self._place is None or self._place.view.name != name):
            self.go(name)

    def _step(self, by: int) -> None:
        names = list(self._photographs)
        at = names.index(self._place.view.name) if self._place else (-1 if by > 0 else 0)
        self.go(names[(at + by) % len(names)])

    def _ask_for_file(self) -> None:
        self._screenshot = True
        self._wake()

    def _add_key(self) -> None:
        camera = self._place.view.camera if self._place else self._camera(self._size)
        self._keys.add(camera)
        self._count_keys()

    def _remove_key(self) -> None:
        del self._keys.cameras[-1:]
        self._count_keys()

    def _count_keys(self) -> None:
        count = len(self._keys.cameras)
        seconds = max(0, count - 1) * float(self.panel.seconds.value)
        self.panel.keys.value = f"{count}" + (f", {seconds:g} s" if count > 1 else "")

    def _save_path(self) -> None:
        if self._keys.cameras:
            text = self._keys.file(float(self.panel.seconds.value))
            self._client.send_file_download(PATH_FILE, text.encode(), save_immediately=True)

    def _play(self) -> None:
        path = self._keys.path(float(self.panel.seconds.value))
        if len(path) > 1:
            with self._lock:
                self._place, self._playing = None, (time.monotonic(), path)
            self.panel.view.value = NOWHERE
            self._wake()

    def _camera(self, size: tuple[int, int]) -> Camera:
        camera = self._client.camera
        return free_camera(camera.wxyz, camera.position, camera.fov, size)

    def _follow_path(self) -> None:
        """Put the browser's camera where the path is by now."""
        if self._playing is None:
            return
        began, path = self._playing
        frame = int((time.monotonic() - began) * FRAMES_PER_SECOND)
        if frame >= len(path):
            self._playing = None
            return
        camera, lens = self._client.camera, path[frame]
        ahead = float(np.linalg.norm(camera.look_at - camera.position))
        with self._client.atomic():
            camera.position = lens.center.numpy()
            camera.up_direction = (-lens.rotation[1]).numpy()
            camera.look_at = (lens.center + ahead * lens.rotation[2]).numpy()
        self.pace.change(time.monotonic())

    def wants(self) -> str | None:
        """Which picture is due: coarse, sharp, or none."""
        with self._lock:
            self._follow_path()
            return "sharp" if self._screenshot else self.pace.wants(time.monotonic())

    def draw(self, shown: Shown, kind: str) -> None:
        """Render a picture and send it."""
        began = time.monotonic()
        with self._lock:
            version, place = self.pace.begin(), self._place
            screenshot, self._screenshot = self._screenshot, False
            camera = self._client.camera
            size = self.pace.size((camera.image_width, camera.image_height), kind)
            lens = self._camera(size)
        view = None if place is None else place.view
        sharp = kind == "sharp"
        appearance = self.panel.appearance
        picture = self._painter.paint(shown, lens, appearance, view, settled=sharp)
        self._send(picture, size, sharp=sharp)
        self._frusta.seen_from(None if view else lens.center.numpy())
        if screenshot and picture is not None:
            self._client.send_file_download(PICTURE_FILE, png_bytes(picture), save_immediately=True)
        now = time.monotonic()
        with self._lock:
            self.pace.end(version, kind, now - began, now)
        note = f"{size[0]} x {size[1]} in {1000 * (now - began):.0f} ms"
        self.panel.tell(shown.status, NO_LAYER if picture is None else note)

    def _send(self, picture: Picture | None, size: tuple[int, int], *, sharp: bool) -> None:
        if picture is None:
            picture = np.full((size[1], size[0], 3), 64, dtype=np.uint8)
        if sharp:
            self._client.scene.set_background_image(picture, format="png")
        else:
            self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG_QUALITY)
