"""The server: browsers connect to it, and one thread of ours draws for them."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from polarguide.errors import PolarguideError, optional_import
from polarguide.scene_frame import scene_frame
from polarguide.shading.deferred import Shading
from polarguide.viewer.panel import Offer
from polarguide.viewer.photographs import Photograph
from polarguide.viewer.shown import Shown
from polarguide.viewer.visitor import Visitor

LOOPBACK = ("127.0.0.1", "localhost", "::1")
REFRESH = 1.0  # seconds between pictures of a training at least,
SHARE = 10.0  # and at least this many times as long as the last one took
TICK = 0.02


def viewing_address(host: str, port: int) -> str:
    """What to type into a browser on the same machine."""
    name = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}.get(host, host)
    return f"http://{name}:{port}"


class Viewer:
    """A web viewer.

    Pictures are drawn in ``serve`` alone, by the thread that calls it, so that a training and its viewer take turns.

    Args:
        look: gives the scene as it is now.
        photographs: of the scene by name, at least one; the first one is where visitors begin.
        lit: whether the recipe learns light. trains: whether ``paused`` is looked at.
        host, port: where to listen; another port is taken if this one is in use.
        title: plain text.

    Raises:
        PolarguideError: viser is not installed, or the address cannot be listened at.
    """

    def __init__(
        self,
        look: Callable[[], Shown],
        photographs: Mapping[str, Photograph],
        *,
        lit: bool,
        trains: bool = False,
        host: str = LOOPBACK[0],
        port: int = 8080,
        title: str = "polarguide",
    ) -> None:
        viser = optional_import("viser", "the viewer", install="'viser>=1.1'")
        # Of pictures for a browser that has just left.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self._look, self._photographs = look, photographs
        self._around = scene_frame([photograph.view.camera for photograph in photographs.values()])
        turns = lit and isinstance(look().shading, Shading)
        self._offer = Offer(lit, turns, tuple(photographs), trains)
        self._visitors: dict[int, Visitor] = {}
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._refreshed = time.monotonic()
        self._cost = 0.0
        self._server = _listening(viser, host, port, title)
        self._server.scene.set_up_direction(tuple(self._around.up.tolist()))
        self._server.scene.world_axes.visible = False
        self.address = viewing_address(host, self._server.get_port())
        self._server.on_client_connect(self._arrive)
        self._server.on_client_disconnect(self._leave)

    @property
    def paused(self) -> bool:
        """Whether a visitor wants the training to wait."""
        with self._lock:
            return any(visitor.paused for visitor in self._visitors.values())

    def _arrive(self, client: Any) -> None:
        visitor = Visitor(client, self._photographs, self._around, self._offer, self._wake.set)
        visitor.go(next(iter(self._photographs)))
        with self._lock:
            self._visitors[client.client_id] = visitor
        self._wake.set()

    def _leave(self, client: Any) -> None:
        with self._lock:
            self._visitors.pop(client.client_id, None)

    def serve(self, patience: float = 0.0) -> bool:
        """Draw the picture that has been due for longest, if one is.

        Args:
            patience: seconds to wait for one.

        Returns:
            Whether one was drawn.
        """
        deadline = time.monotonic() + patience
        while True:
            self._wake.clear()
            due = self._due()
            if due is not None:
                visitor, kind = due
                began = time.monotonic()
                visitor.draw(self._look(), kind)
                self._cost = time.monotonic() - began
                return True
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            # Rests, and paths that are played, are noticed by looking.
            self._wake.wait(min(left, TICK if self._visitors else 1.0))

    def _due(self) -> tuple[Visitor, str] | None:
        with self._lock:
            visitors = sorted(self._visitors.values(), key=lambda visitor: visitor.pace.last)
        for visitor in visitors:
            kind = visitor.wants()
            if kind is not None:
                return visitor, kind
        return None

    def refresh(self) -> None:
        """The scene has changed: draw it anew, though not so often that a training would feel it."""
        now = time.monotonic()
        if now - self._refreshed < max(REFRESH, SHARE * self._cost):
            return
        self._refreshed = now
        with self._lock:
            for visitor in self._visitors.values():
                visitor.pace.stale()

    def close(self) -> None:
        """Send the visitors away."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def _listening(viser: Any, host: str, port: int, title: str) -> Any:
    if not 0 < port < 65536:
        raise PolarguideError(
            "the port", expected="1 to 65535", found=str(port), remedy="Choose such a port."
        )
    try:  # viser itself would wait for ever
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listener:
            listener.bind(address)
    except OSError as error:
        raise PolarguideError(
            host,
            expected="an address of this machine to listen at",
            found=error.strerror or str(error),
            remedy="Choose 127.0.0.1, or one that this machine has.",
        ) from None
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label=title, verbose=False)
