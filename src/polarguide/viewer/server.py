"""Web server of the viewer for a run or a training. One thread renders for all sessions."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import io
import platform
import shlex
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import msgspec

from polarguide.capture import Scene
from polarguide.capture.presentation import (
    PRESENTATION_FILE,
    UNCHANGED,
    Presentation,
    read_presentation,
    write_presentation,
)
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.options import LOOPBACK, VisitorOptions
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import network_address
from polarguide.geometry.scene_frame import scene_frame
from polarguide.runs.model import layers_of
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import Ends, Look
from polarguide.shading.model import ShadingModel, radiance_cubemap
from polarguide.training.loop import TrainingLoop
from polarguide.viewer.guard import Accepts, Gate, checked_message, guarded
from polarguide.viewer.scenery import (
    Photograph,
    Scenery,
    photographs,
    run_scenery,
    training_scenery,
)
from polarguide.viewer.session import PanelOptions, Session

REFRESH = 1.0  # least time in seconds between two pictures of a training
SHARE = 10.0  # least time in units of the duration of the last picture
TICK = 0.02
REACH = 1e4  # largest distance of a camera in units of the cameras' distance


EVERYWHERE = ("0.0.0.0", "::")
"""Hosts that mean all addresses of the machine."""


def viewing_address(host: str, port: int) -> str:
    """Return the URL of the viewer for a browser on the same machine."""
    name = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}.get(host, host)
    return f"http://{name}:{port}"


class Viewer:
    """Web viewer of a scene.

    Only ``serve`` renders, in the thread that calls it, so that a training and its viewer take turns.

    Args:
        current: function that returns the current scenery.
        photographs: photographs of the scene by name, at least one; sessions start at the first one.
        shading: model of the recipe.
        trains: whether the panel can pause a training.
        host, port: address of the server. If the port is in use, the next free port is taken.
        visitors: further hosts and origins that may connect.
        presentation: the saved presentation.
        save: function that writes a presentation to the run and returns a message in plain text. With None, browsers
            download the presentation. Browsers on other machines can never save.
        title: title of the page, plain text.
        warn: callback that receives the reason why a connection was closed.
        beside: another run, which wipes show.

    Raises:
        PolarguideError: viser is not installed or has another version, or the server cannot listen at the address.
    """

    def __init__(
        self,
        current: Callable[[], Scenery],
        photographs: Mapping[str, Photograph],
        *,
        shading: ShadingModel,
        trains: bool = False,
        host: str = LOOPBACK[0],
        port: int = 8080,
        visitors: VisitorOptions = VisitorOptions(),
        presentation: Presentation = UNCHANGED,
        save: Callable[[Presentation], str] | None = None,
        title: str = "polarguide",
        warn: Callable[[str], None] = lambda text: None,
        beside: Scenery | None = None,
    ) -> None:
        viser = optional_import("viser", "the viewer")
        # viser warns about pictures for a browser that has just disconnected.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self._current = current
        self._photographs = photographs
        self._beside = beside
        self._scene_frame = scene_frame([photograph.view.camera for photograph in photographs.values()])
        turns = radiance_cubemap(shading) is not None
        others = visitors.allow_host or visitors.allow_origin
        self._save = save if host in LOOPBACK and not others else None
        saves = self._save is not None
        self._options = PanelOptions(
            layers_of(shading), turns, tuple(photographs), trains, presentation, saves
        )
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._refreshed = time.monotonic()
        self._cost = 0.0
        self._warn = warn
        self._warned = set[str]()
        around = self._scene_frame
        reach = float(around.center.abs().max()) + REACH * around.distance
        gate = Gate(host, visitors.allow_host, visitors.allow_origin)
        with contextlib.ExitStack() as stack:
            with guarded(gate, lambda raw: checked_message(raw, self._control, reach)):
                self._server = _listening(viser, host, port, title)
                stack.callback(self.close)
            stack.pop_all()
        self._server.scene.set_up_direction(tuple(presentation.upright(around).up.tolist()))
        self._server.scene.world_axes.visible = False
        self.port: int = self._server.get_port()
        self.address = viewing_address(host, self.port)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    @property
    def paused(self) -> bool:
        """True if at least one session pauses the training."""
        with self._lock:
            return any(session.paused for session in self._sessions.values())

    def _connected(self, client: Any) -> None:
        def drop(error: Exception) -> None:
            self._drop(client.client_id, error)

        try:
            session = Session(
                client,
                self._photographs,
                self._scene_frame,
                self._options,
                self._wake.set,
                save=None if self._save is None else self._saved,
                drop=drop,
                beside=self._beside,
            )
            session.go(next(iter(self._photographs)))
        except Exception as error:
            drop(error)
            return
        with self._lock:
            self._sessions[client.client_id] = session
        self._wake.set()

    def _saved(self, presentation: Presentation) -> str:
        """Save a presentation, and use it as the initial presentation of new sessions."""
        assert self._save is not None
        try:
            text = self._save(presentation)
        except PolarguideError as error:
            self._warn(str(error))
            return f"Not saved: found {error.found}"
        with self._lock:
            self._options = replace(self._options, presentation=presentation)
        return text

    def _control(self, name: str) -> Accepts | None:
        """Return the function that validates a control of any session, by its name in viser."""
        with self._lock:
            tables = [session.panel.accepts for session in self._sessions.values()]
        return next((table[name] for table in tables if name in table), None)

    def _drop(self, client_id: int, error: Exception) -> None:
        """Close the connection of a browser, while the server and the training continue."""
        with self._lock:
            removed = self._sessions.pop(client_id, None) is not None
        text = f"the viewer disconnected a browser: {type(error).__name__}: {error}"
        if removed and text not in self._warned:
            self._warned.add(text)
            self._warn(text)
        connection = self._server._websock_server._live_connections.get(client_id)
        if connection is not None:
            asyncio.run_coroutine_threadsafe(connection.close(1011), self._server.get_event_loop())

    def _disconnected(self, client: Any) -> None:
        with self._lock:
            self._sessions.pop(client.client_id, None)

    def serve(self, timeout: float = 0.0) -> bool:
        """Render the picture that has waited longest.

        Args:
            timeout: longest time to wait until a picture is due, in seconds.

        Returns:
            True if a picture was rendered.
        """
        deadline = time.monotonic() + timeout
        while True:
            self._wake.clear()
            if self._draw_next():
                return True
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            # No event announces that a sharp picture or a picture of an animation is due.
            self._wake.wait(min(left, TICK if self._sessions else 1.0))

    def _draw_next(self) -> bool:
        """Render the picture that has waited longest. Return False if no picture is due."""
        with self._lock:
            sessions = sorted(self._sessions.values(), key=lambda session: session.pacing.last_frame)
        for session in sessions:
            began = time.monotonic()
            try:
                kind = session.due()
                if kind is None:
                    continue
                session.draw(self._current(), kind)
            except Exception as error:  # caused by a request of one browser
                self._drop(session.client_id, error)
            self._cost = time.monotonic() - began
            return True
        return False

    def refresh(self) -> None:
        """Request new pictures of a changed scene. The rate is limited, so that a training is not slowed down."""
        now = time.monotonic()
        if now - self._refreshed < max(REFRESH, SHARE * self._cost):
            return
        self._refreshed = now
        with self._lock:
            for session in self._sessions.values():
                session.pacing.mark_outdated()

    def close(self) -> None:
        """Stop the server and close all sessions."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def _listening(viser: Any, host: str, port: int, title: str) -> Any:
    if not 0 < port < 65536:
        raise PolarguideError(
            "the port", expected="a port from 1 to 65535", found=str(port), remedy="Choose another port."
        )
    try:  # viser would wait forever
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listener:
            listener.bind(address)
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that no network can have
        raise PolarguideError(
            f"the viewer's host {host!r}",
            expected="an address of this machine",
            found=getattr(error, "strerror", None) or str(error),
            remedy="Choose 127.0.0.1, or another address of this machine.",
        ) from None
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label=title, verbose=False)


PATIENCE = 0.2  # interval in seconds at which a paused training checks if it must end


def view_run(
    run: OpenedRun,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    visitors: VisitorOptions = VisitorOptions(),
    reporter: Reporter = SILENT,
    beside: OpenedRun | None = None,
) -> None:
    """Serve a run to browsers, which show its layers from any side, until KeyboardInterrupt.

    Args:
        run: the run; its scene is read.
        host: address of the server.
        port: port of the server. If it is in use, the next free port is taken.
        visitors: further hosts and origins that may connect.
        reporter: receives the address.
        beside: another run of the same scene, which a wipe shows on the left.

    Raises:
        PolarguideError: the server cannot listen at the address, or the other run has another scene.
    """
    if beside is not None and beside.configuration.scene_digest != run.configuration.scene_digest:
        raise PolarguideError(
            beside.folder,
            expected=f"a run of {run.configuration.scene}",
            found=f"a run of {beside.configuration.scene}",
            remedy="Choose a run of this scene, or train a run on it.",
        )
    scenery = run_scenery(run)
    with _opened(
        lambda: scenery,
        run.scene,
        reporter,
        host,
        name=run.folder.resolve().name,
        shading=run.model.shading,
        port=port,
        visitors=visitors,
        presentation=run.presentation,
        save=functools.partial(save_to_run, run),
        beside=None if beside is None else run_scenery(beside),
    ) as viewer:
        while True:
            viewer.serve(1.0)


def save_to_run(run: OpenedRun, chosen: Presentation) -> str:
    """Write exposure and crop box to the run's ``presentation.json``, and return a message in plain text.

    A value that equals the value of the scene is not written, so that the run still inherits it. Other values of the
    run are not changed.
    """
    own = read_presentation(run.folder)
    above = read_presentation(run.scene_folder)
    fields = {}
    unchanged = []
    for name in ("exposure", "crop"):
        value = getattr(chosen, name)
        inherited = getattr(above, name)
        fields[name] = None if value == inherited else value
        if value is None and inherited is not None:
            unchanged.append(name)
    fields["whole"] = own.whole and chosen.crop is None
    write_presentation(run.folder, msgspec.structs.replace(own, **fields))
    if unchanged:
        return f"Saved; the scene's own {', '.join(unchanged)} still counts"
    return f"Saved to {PRESENTATION_FILE}"


@contextmanager
def watched(
    loop: TrainingLoop,
    host: str,
    port: int,
    visitors: VisitorOptions = VisitorOptions(),
    reporter: Reporter = SILENT,
) -> Iterator[Look]:
    """Open a viewer for a training. The context yields the function that the training calls between steps.

    Raises:
        PolarguideError: the server cannot listen at the address.
    """
    scene = loop.context.scene

    def look(ends: Ends) -> None:
        viewer.refresh()
        viewer.serve()
        while viewer.paused and not ends():
            viewer.serve(PATIENCE)

    with _opened(
        functools.partial(training_scenery, loop),
        scene,
        reporter,
        host,
        name=scene.name,
        shading=loop.context.shading,
        port=port,
        visitors=visitors,
        presentation=read_presentation(scene.root),
        trains=True,
    ) as viewer:
        yield look


@contextmanager
def _opened(
    current: Callable[[], Scenery], scene: Scene, reporter: Reporter, host: str, *, name: str, **options: Any
) -> Iterator[Viewer]:
    """Open a viewer, report its address, and warn if other machines can connect.

    Args:
        current, scene, reporter, host, name: the scene, its name, and the address.
        options: further arguments of ``Viewer``.
    """
    viewer = Viewer(
        current, photographs(scene), host=host, title=f"polarguide {name}", warn=reporter.warn, **options
    )
    with closing(viewer):
        if host not in LOOPBACK:
            reporter.warn(
                f"every user with network access to {host} can open the viewer: there is no password"
            )
            for line in from_elsewhere(host, viewer.port):
                reporter.say(line)
        reporter.say(f"viewer: {viewer.address}")
        yield viewer


def from_elsewhere(host: str, port: int) -> list[str]:
    """Return lines with the address for other machines, and with the command for a private tunnel."""
    here = network_address() if host in EVERYWHERE else host
    lines = [] if here is None else [f"from other machines: {viewing_address(here, port)}"]
    tunnel = shlex.join(["ssh", "-L", f"{port}:127.0.0.1:{port}", here or platform.node()])
    return [*lines, f"for you alone, without --host: {tunnel}   and there http://127.0.0.1:{port}"]
