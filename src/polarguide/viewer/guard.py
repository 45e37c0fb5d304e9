"""What stands between viser and the network: viser itself asks nobody who they are, and believes what it is told.

viser has no hook for this, so the function that it listens with is wrapped while it starts. That is why its version is
pinned, and why the viewer does not start where the wrap did not take.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from polarguide.errors import PolarguideError, optional_import
from polarguide.installation import install_package
from polarguide.viewer.gate import Gate
from polarguide.viewer.messages import LARGEST, Refused

MOST_BROWSERS = 32
MESSAGES_PER_SECOND = 200.0
BURST = 400.0  # messages
SENDING_SECONDS = 30.0  # a browser that takes nothing for so long is let go
# viser's page goes to whatever server the address names (?websocket=, ?playbackPath=), and does what that one says, in
# the name of this one: it may talk to nobody but where it came from. Not every browser takes 'self' for sockets, too.
POLICY = (
    "frame-ancestors 'self'; connect-src 'self' ws://{host} wss://{host} blob: data:; object-src 'none'; "
    "base-uri 'none'; form-action 'none'"
)
HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Frame-Options": "SAMEORIGIN",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
Check = Callable[[bytes | str], bytes | None]
"""Gives a message as it may be read, None to pass it over, or raises ``Refused``."""

_WRAPPING = threading.Lock()
_QUIET = logging.getLogger("polarguide.viewer.connections")  # strangers' broken requests are no news
_QUIET.propagate = False
_QUIET.addHandler(logging.NullHandler())


@contextlib.contextmanager
def guarded(gate: Gate, check: Check) -> Iterator[None]:
    """A context in which viser starts to listen behind a gate.

    Raises:
        PolarguideError: it has not listened with what was wrapped; whoever started it has to end it.
    """
    sockets = optional_import("websockets.asyncio.server", "the viewer")
    listen, taken = sockets.serve, []

    def serve(handler: Any, *arguments: Any, **options: Any) -> Any:
        if not str(getattr(handler, "__module__", "")).startswith("viser."):  # somebody else's, meanwhile
            return listen(handler, *arguments, **options)
        taken.append(True)
        options |= {
            "max_size": LARGEST,
            "logger": _QUIET,
            "process_request": _gated(options.get("process_request"), gate),
        }
        return listen(_handled(handler, check), *arguments, **options)

    with _WRAPPING:
        sockets.serve = serve
        try:
            yield
        finally:
            sockets.serve = listen
    if not taken:
        raise PolarguideError(
            "the viewer",
            expected="a viser whose connections can be checked",
            found="one that listens in another way",
            remedy=f"Install the version that was tested with {install_package('viser')} and repeat the command.",
        )


def _gated(process: Any, gate: Gate) -> Callable[[Any, Any], Any]:
    def answer(connection: Any, request: Any) -> Any:
        refusal = gate.refusal(request.headers)
        if refusal is not None:
            return connection.respond(403, refusal + "\n")
        response = None if process is None else process(connection, request)
        if response is not None:
            for name, value in HEADERS.items():
                response.headers[name] = value
            # The gate lets no Host pass but an address or a known name, and its port.
            response.headers["Content-Security-Policy"] = POLICY.format(host=request.headers["Host"])
        return response

    return answer


def _handled(handler: Any, check: Check) -> Callable[[Any], Any]:
    browsers = 0

    async def handle(connection: Any) -> None:
        nonlocal browsers
        if browsers >= MOST_BROWSERS:
            await connection.close(1013, "too many browsers")
            return
        browsers += 1
        try:
            await handler(_Connection(connection, check))
        except Exception:  # one browser's; the server goes on
            _QUIET.debug("a connection failed", exc_info=True)
            await connection.close(1011)
        finally:
            browsers -= 1

    return handle


class _Connection:
    """A browser's connection: gives checked messages only, not too many at a time, and does not wait forever."""

    def __init__(self, connection: Any, check: Check) -> None:
        self._connection, self._check = connection, check
        self._left, self._since = BURST, time.monotonic()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """The next message that may be read."""
        refused = False
        while True:
            raw = await self._connection.recv()
            if refused:  # what was on its way already; then the connection says that it is closed
                continue
            await self._pace()
            try:
                message = self._check(raw)
            except Refused as error:
                refused = True
                await self._connection.close(1008, str(error))
                continue
            if message is not None:
                return message

    async def send(self, data: bytes) -> None:
        """Send, or let the browser go if it takes nothing."""
        try:
            await asyncio.wait_for(self._connection.send(data), SENDING_SECONDS)
        except asyncio.TimeoutError:
            self._connection.transport.abort()

    async def _pace(self) -> None:
        """Read no faster than a hand can move; the rest waits at its sender's."""
        now = time.monotonic()
        self._left = min(BURST, self._left + (now - self._since) * MESSAGES_PER_SECOND) - 1
        self._since = now
        if self._left < 0:
            await asyncio.sleep(-self._left / MESSAGES_PER_SECOND)
