"""A fake of viser's client: what the viewer uses of it, kept in memory."""

from collections.abc import Callable
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
from viser.transforms import SO3


class Control:
    """A handle with a value, that calls back when a user changes it."""

    def __init__(self, value: Any = None) -> None:
        self._value, self.visible, self._callbacks = value, True, []
        self._impl = SimpleNamespace(uuid=str(id(self)))

    @property
    def value(self) -> Any:
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        self._value = value
        self._call()

    content = value

    def on_update(self, callback: Callable[[Any], None]) -> None:
        self._callbacks.append(callback)

    on_click = on_update

    def _call(self) -> None:
        for callback in self._callbacks:
            callback(None)

    def click(self) -> None:
        self._call()

    def remove(self) -> None:
        self.visible = False


class Gui:
    """Remembers its controls by label."""

    def __init__(self) -> None:
        self.controls: dict[str, Control] = {}
        self.folders: dict[str, bool] = {}  # whether each is open

    def configure_theme(self, **_: Any) -> None:
        pass

    @contextmanager
    def add_folder(self, label: str, expand_by_default: bool = True):
        self.folders[label] = expand_by_default
        yield

    def _add(self, label: str, value: Any) -> Control:
        return self.controls.setdefault(label, Control(value))

    def add_text(self, label: str, value: str, **_: Any) -> Control:
        return self._add(label, value)

    def add_markdown(self, content: str) -> Control:
        return self._add("status", content)

    def add_checkbox(self, label: str, value: bool, **_: Any) -> Control:
        return self._add(label, value)

    def add_dropdown(
        self, label: str, options: tuple[str, ...], initial_value: str | None = None, **_: Any
    ) -> Control:
        return self._add(label, initial_value or options[0])

    def add_slider(self, label: str, low: float, high: float, step: float, value: float, **_: Any) -> Control:
        return self._add(label, value)

    def add_multi_slider(
        self, label: str, low: int, high: int, step: int, value: tuple[int, int], **_: Any
    ) -> Control:
        return self._add(label, value)

    def add_button(self, label: str, **_: Any) -> Control:
        return self._add(label, False)

    def add_button_group(self, label: str, options: tuple[str, ...], **_: Any) -> Control:
        return self._add(label, options[0])


class SceneTree:
    """What is drawn over the picture, and the pictures that were sent."""

    def __init__(self) -> None:
        self.pictures: list[tuple[np.ndarray, str]] = []
        self.frusta: list[Control] = []
        self.boxes: list[np.ndarray] = []

    def set_background_image(self, image: np.ndarray, format: str, jpeg_quality: int = 0) -> None:
        self.pictures.append((image, format))

    def add_camera_frustum(self, name: str, **_: Any) -> Control:
        self.frusta.append(Control())
        return self.frusta[-1]

    def add_line_segments(self, name: str, points: np.ndarray, color: Any, thickness: float) -> Control:
        self.boxes.append(points)
        return Control()


class FakeCamera:
    """The browser's camera: turned by looking at a point, as viser's is."""

    def __init__(self) -> None:
        self.position, self.look_at = np.array([0.0, 0.0, -5.0]), np.zeros(3)
        self.up_direction, self.fov = np.array([0.0, -1.0, 0.0]), 0.8
        self.image_width, self.image_height = 128, 96
        self.update_timestamp = 0.0
        self.callbacks: list[Callable[[Any], None]] = []

    @property
    def aspect(self) -> float:
        return self.image_width / self.image_height

    @property
    def wxyz(self) -> np.ndarray:
        ahead = self.look_at - self.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, self.up_direction)
        right = right / np.linalg.norm(right)
        return SO3.from_matrix(np.stack((right, np.cross(ahead, right), ahead), axis=1)).wxyz

    def on_update(self, callback: Callable[[Any], None]) -> None:
        self.callbacks.append(callback)

    def drag(self, to: tuple[float, float, float]) -> None:
        """What a user does with a mouse."""
        self.position = np.array(to)
        self.report()

    def report(self) -> None:
        self.update_timestamp += 1.0
        self.call_back()

    def call_back(self) -> None:
        """What viser does in a thread, some time after a report has arrived."""
        for callback in self.callbacks:
            callback(self)


class FakeClient(SimpleNamespace):
    """The client."""

    def __init__(self) -> None:
        super().__init__(gui=Gui(), scene=SceneTree(), camera=FakeCamera(), files={}, client_id=1)

    @contextmanager
    def atomic(self):
        yield

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        self.files[name] = content

    def control(self, label: str) -> Control:
        return self.gui.controls[label]
