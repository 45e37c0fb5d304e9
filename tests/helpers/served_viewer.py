"""A viewer that is served by a thread, as a training does, and a client that speaks to it."""

import threading
import time
from typing import Any

import msgspec
import viser
from viewer_scenes import photographs, shown
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from polarguide.viewer import Viewer

PATIENCE = 30.0
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, -4], "fov": 0.8, "near": 0.01,
    "far": 1000, "image_height": 48, "image_width": 64, "look_at": [0, 0, 0], "up_direction": [0, -1, 0],
}  # fmt: skip


class Served:
    """A viewer over random Gaussians, served by a thread as a training would."""

    def __init__(self, port: int = 18180) -> None:
        self.seen = shown()
        self.warned: list[str] = []
        self.viewer = Viewer(
            lambda: self.seen, photographs(self.seen), shading=self.seen.shading, trains=True, port=port,
            warn=self.warned.append,
        )  # fmt: skip
        self.ends, self.failed = threading.Event(), None
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self) -> None:
        while not self.ends.is_set():
            self.viewer.serve(0.05)

    def close(self) -> None:
        self.ends.set()
        self.thread.join()
        self.viewer.close()

    def browser(self, **headers: str) -> ClientConnection:
        address = self.viewer.address.replace("http", "ws")
        return connect(
            address,
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            additional_headers=headers,
            max_size=None,
        )

    def picture(self, browser: ClientConnection) -> None:
        """Read what a browser is sent up to a picture."""
        while b"BackgroundImageMessage" not in _unpacked(browser.recv(PATIENCE)):
            pass

    def is_well(self) -> bool:
        """Whether a browser that behaves is sent a picture."""
        with self.browser() as browser:
            browser.send(msgspec.msgpack.encode(CAMERA))
            self.picture(browser)
        return self.thread.is_alive()

    def controls(self) -> list[str]:
        """The names of the controls that browsers have; waits until there are some."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            with self.viewer._lock:
                names = [name for s in self.viewer._sessions.values() for name in s.panel.accepts]
            if names:
                return names
            time.sleep(0.005)
        raise TimeoutError("no browser has controls")


def drain(browser: ClientConnection) -> None:
    while True:
        browser.recv(PATIENCE)


def _unpacked(data: Any) -> bytes:
    import zstandard

    size = int.from_bytes(data[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
