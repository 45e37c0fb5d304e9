"""Validation of the messages that a browser sends. viser receives only messages that were checked and clamped here.

Other messages that viser accepts, such as uploads or requests for a public tunnel, are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

LARGEST = 1 << 16
"""Largest size of a message in bytes."""
LARGEST_WINDOW = 8192
"""Largest width and height of a browser's window in pixels."""
CAMERA_LIMITS = {
    "fov": (0.01, 3.0), "near": (1e-9, 1e9), "far": (1e-9, 1e12),
    "image_height": (1, LARGEST_WINDOW), "image_width": (1, LARGEST_WINDOW),
}  # fmt: skip
"""Ranges of a camera's numbers; the field of view is in radians."""
NO_RAY = {"ray_origin": (0.0,) * 3, "ray_direction": (0.0, 0.0, 1.0)}
"""Placeholder for the ray of a click. A session computes it from the place in the window."""

Accepts = Callable[[Any], Any]
"""Function that returns the value of a control within its range, and raises ``Refused`` for other types."""


class Refused(Exception):
    """A message that the viewer's page never sends."""


def checked_message(raw: bytes | str, control: Callable[[str], Accepts | None], reach: float) -> bytes | None:
    """Return a valid message for viser, or None for a message to ignore.

    Args:
        raw: MessagePack.
        control: returns the validation of a control by viser's name, None for an unknown name.
        reach: the largest coordinate of a camera.

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
        elif kind == "ScenePointerMessage" and message["event_type"] == "click":
            (place,) = message["screen_pos"]
            clicked = (tuple(_clamped(value, 0.0, 1.0) for value in _numbers(place, 2)),)
            fields = {**NO_RAY, "event_type": "click", "screen_pos": clicked, "modifier": None}
        else:
            return None
    except (LookupError, TypeError, ValueError, RecursionError, OverflowError) as error:
        raise Refused("not a message") from error
    return msgspec.msgpack.encode({"type": kind, **fields})


def number(low: float, high: float) -> Accepts:
    """Accept a number, clamped to a range."""
    return lambda value: _clamped(value, low, high)


def pair(low: float, high: float) -> Accepts:
    """Accept two numbers, clamped to a range and sorted."""
    return lambda value: sorted(_clamped(item, low, high) for item in _numbers(value, 2))


def choice(options: Sequence[str]) -> Accepts:
    """Accept one of some texts."""

    def accepts(value: Any) -> str:
        if not isinstance(value, str) or value not in options:
            raise Refused("not one of the choices")
        return value

    return accepts


def flag(value: Any) -> bool:
    """Accept true or false."""
    if not isinstance(value, bool):
        raise Refused("a value other than on or off")
    return value


def push(_: Any) -> bool:
    """Accept any value, for a button."""
    return True


def _camera(message: dict[str, Any], reach: float) -> dict[str, Any]:
    """Return the clamped fields of a camera, with unit vectors as directions."""
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
