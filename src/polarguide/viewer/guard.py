"""Access control of the viewer, because viser has no authentication and trusts every message.

Web pages of other sites that are open in the same browser must not connect to the viewer. viser has no hook for this.
Therefore ``websockets``' function ``serve`` is wrapped while viser starts to listen. The version of viser is pinned,
and the viewer does not start if viser did not call the wrapper.

viser receives only messages that were checked and clamped here. Other messages that viser accepts, such as uploads or
requests for a public tunnel, are ignored.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import math
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any
from urllib.parse import urlsplit

import msgspec

from polarguide.core.errors import PolarguideError, install_package, optional_import

LARGEST = 1 << 16
"""Largest size of a message in bytes."""
LARGEST_WINDOW = 8192
"""Largest width and height of a browser's window in pixels."""
CAMERA_LIMITS = {
    "fov": (0.01, 3.0), "near": (1e-9, 1e9), "far": (1e-9, 1e12),
    "image_height": (1, LARGEST_WINDOW), "image_width": (1, LARGEST_WINDOW),
}  # fmt: skip
"""Valid range of each number of a camera. The field of view is in radians."""
NO_RAY = {"ray_origin": (0.0,) * 3, "ray_direction": (0.0, 0.0, 1.0)}
"""Placeholder for the ray of a click on a camera, which the viewer does not use."""

Accepts = Callable[[Any], Any]
"""Function that clamps the value of a control to its range, and raises ``Refused`` for a value of another type."""


class Refused(Exception):
    """Error for a message that the viewer's page never sends."""


def checked_message(raw: bytes | str, control: Callable[[str], Accepts | None], reach: float) -> bytes | None:
    """Check a message, and return it with clamped values, or return None if viser must not receive it.

    Args:
        raw: message in the format MessagePack.
        control: returns the function that validates a control by its name in viser, or None for an unknown name.
        reach: largest coordinate of a camera.

    Raises:
        Refused: the viewer's page never sends such a message.
    """
    if not isinstance(raw, bytes) or len(raw) > LARGEST:
        raise Refused("not a message")
    try:
        message = msgspec.msgpack.decode(raw, type=dict[str, Any])
        kind = message["type"]
        if kind == "ViewerCameraMessage":
            fields = _camera(message, reach)
        elif kind == "GuiUpdateMessage":
            accepts = control(message["uuid"])
            if accepts is None or "value" not in message["updates"]:
                return None
            fields = {"uuid": message["uuid"], "updates": {"value": accepts(message["updates"]["value"])}}
        elif kind == "SceneNodeClickMessage":
            names = {"name": str(message["name"]), "owner": str(message.get("owner", ""))[:100]}
            fields = {**names, **NO_RAY, "instance_index": None, "modifier": None, "screen_pos": (0.0, 0.0)}
        else:
            return None
    except (LookupError, TypeError, ValueError, RecursionError, OverflowError) as error:
        raise Refused("not a message") from error
    return msgspec.msgpack.encode({"type": kind, **fields})


def number(low: float, high: float) -> Accepts:
    """Return a check that accepts a number and clamps it to a range."""
    return lambda value: _clamped(value, low, high)


def pair(low: float, high: float) -> Accepts:
    """Return a check that accepts two numbers, clamps them to a range, and sorts them."""
    return lambda value: sorted(_clamped(item, low, high) for item in _numbers(value, 2))


def choice(options: Sequence[str]) -> Accepts:
    """Return a check that accepts one of the texts in ``options``."""

    def accepts(value: Any) -> str:
        if not isinstance(value, str) or value not in options:
            raise Refused("not one of the choices")
        return value

    return accepts


def flag(value: Any) -> bool:
    """Accept True or False."""
    if not isinstance(value, bool):
        raise Refused("a value other than on or off")
    return value


def push(_: Any) -> bool:
    """Accept any value, because the value of a button has no meaning."""
    return True


def _camera(message: dict[str, Any], reach: float) -> dict[str, Any]:
    """Return the fields of a camera in a message, with clamped numbers and normalized directions."""
    fields: dict[str, Any] = {
        name: _clamped(message[name], *limits) for name, limits in CAMERA_LIMITS.items()
    }
    for name in ("image_height", "image_width"):
        fields[name] = int(fields[name])
    for name in ("position", "look_at"):
        fields[name] = [_clamped(value, -reach, reach) for value in _numbers(message[name], 3)]
    for name, count in (("wxyz", 4), ("up_direction", 3)):
        vector = _numbers(message[name], count)
        length = math.hypot(*vector)
        if not 1e-6 < length < 1e6:
            raise Refused("a direction without a length")
        fields[name] = [value / length for value in vector]
    if fields["position"] == fields["look_at"]:  # viser computes the direction between them
        raise Refused("a camera that looks at itself")
    return fields


def _numbers(values: Any, count: int) -> list[float]:
    """Return a list of finite numbers.

    Raises:
        Refused: the value is not a list of ``count`` finite numbers.
    """
    if not isinstance(values, list) or len(values) != count:
        raise Refused(f"not {count} numbers")
    return [_clamped(value, -math.inf, math.inf) for value in values]


def _clamped(value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Refused("not a finite number")
    return min(max(float(value), low), high)


WEB = ("http", "https")
_PLACE = re.compile(r"(\[[^\[\]]*\]|[^\[\]:@]*)(:[0-9]*)?")
"""Host in a URL: NAME or [ADDRESS], with an optional port."""
_NAME = re.compile(r"[\w-]+(\.[\w-]+)*")
"""Host name without wildcards."""


class Gate:
    """Rules that accept or refuse requests by their host and origin. Ports are ignored, because tunnels change them.

    Args:
        listening: host of the server, which requests may name.
        hosts: further host names under which the viewer may be opened.
        origins: sites whose pages may connect, in addition to the viewer's own pages. A site is ``https://NAME`` or
            ``NAME``.

    Raises:
        PolarguideError: a name is not a host name or an address.
    """

    def __init__(self, listening: str, hosts: Iterable[str] = (), origins: Iterable[str] = ()) -> None:
        self._hosts = {"localhost", listening.lower(), *(_given("allow_host", name) for name in hosts)}
        self._origins = {_given("allow_origin", name) for name in origins}

    def refusal(self, headers: Any) -> str | None:
        """Return the reason for refusing a request, with a remedy. Return None for a valid request.

        An unknown name may belong to a stranger and point to this machine (DNS rebinding). The origin is the page
        that sends the request; programs other than browsers send none.

        Args:
            headers: ``websockets.Headers`` of the request.
        """
        named = headers.get_all("Host")
        asking = headers.get_all("Origin")
        if len(named) != 1 or len(asking) > 1:
            return "One Host and at most one Origin are expected."
        host = host_of(f"//{named[0]}")
        if host is None or not (host in self._hosts or _is_address(host)):
            return (
                "This viewer is not known under this name. If it is yours, start it with --allow-host NAME."
            )
        if not asking:
            return None
        origin = host_of(asking[0], schemes=WEB)
        if origin is None or origin not in {host, *self._origins}:
            return "Pages of others may not look here. If it is yours, start the viewer with --allow-origin NAME."
        return None


def host_of(url: str, schemes: tuple[str, ...] = ("",)) -> str | None:
    """Return the host of SCHEME://HOST[:PORT] in lower case; return None for other texts."""
    try:
        parts = urlsplit(url)
        host = parts.hostname
        _ = parts.port
    except ValueError:
        return None
    if _PLACE.fullmatch(parts.netloc) is None:  # urlsplit ignores text after the bracket of an address
        return None
    more = parts.path.strip("/") or parts.query or parts.fragment or "@" in parts.netloc
    return host.rstrip(".") if host and parts.scheme in schemes and not more else None


def _given(option: str, name: str) -> str:
    """Return the host in the value of an option, which is a host name or a URL."""
    host = host_of(name if "://" in name else f"//{name}", schemes=("", *WEB))
    if host is None or not (_is_address(host) or _NAME.fullmatch(host)):
        raise PolarguideError(
            option, expected="a name such as viewer.example.org", found=name, remedy="Omit all but the name."
        )
    return host


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


MOST_BROWSERS = 32
SENDING_SECONDS = 30.0  # timeout of a browser that receives nothing
# viser's page connects to any server that its URL names (?websocket=, ?playbackPath=) and trusts this server. The
# policy restricts connections to the page's own origin. Not every browser applies 'self' to sockets.
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
"""Function that returns a valid message, returns None for a message to ignore, or raises ``Refused``."""

_WRAPPING = threading.Lock()
_QUIET = logging.getLogger("polarguide.viewer.connections")  # broken requests of strangers are not logged
_QUIET.propagate = False
_QUIET.addHandler(logging.NullHandler())


@contextlib.contextmanager
def guarded(gate: Gate, check: Check) -> Iterator[None]:
    """Install the access control in this context, in which viser must start to listen.

    Raises:
        PolarguideError: viser did not use the wrapped function. Then the caller must stop viser.
    """
    sockets = optional_import("websockets.asyncio.server", "the viewer")
    listen = sockets.serve
    opened = []

    def serve(handler: Any, *arguments: Any, **options: Any) -> Any:
        # Another server may start at the same time.
        if not str(getattr(handler, "__module__", "")).startswith("viser."):
            return listen(handler, *arguments, **options)
        opened.append(True)
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
    if not opened:
        raise PolarguideError(
            "the viewer",
            expected="a version of viser whose connections polarguide can check",
            found="a version that accepts connections in another way",
            remedy=f"Install the tested version ({install_package('viser')}) and repeat the command.",
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
            # The gate accepts a Host only if it is an address or a known name, with an optional port.
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
        except Exception:  # the server continues
            _QUIET.debug("a connection failed", exc_info=True)
            await connection.close(1011)
        finally:
            browsers -= 1

    return handle


class _Connection:
    """Connection of a browser that validates messages and has a timeout."""

    def __init__(self, connection: Any, check: Check) -> None:
        self._connection = connection
        self._check = check

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """Return the next valid message."""
        refused = False
        while True:
            raw = await self._connection.recv()
            if refused:  # messages that were already sent; then recv raises ConnectionClosed
                continue
            try:
                message = self._check(raw)
            except Refused as error:
                refused = True
                await self._connection.close(1008, str(error))
                continue
            if message is not None:
                return message

    async def send(self, data: bytes) -> None:
        """Send data, or abort the connection if the browser does not receive the data in time."""
        try:
            await asyncio.wait_for(self._connection.send(data), SENDING_SECONDS)
        except asyncio.TimeoutError:
            self._connection.transport.abort()
