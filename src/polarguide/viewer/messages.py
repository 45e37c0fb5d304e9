"""The messages that a browser may send: checked and clamped before viser reads them; no others reach it.

What viser accepts besides, such as uploads, or the wish to open a tunnel to the world, is of no use to this viewer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

LARGEST = 1 << 16  # bytes of a message
FIELD_OF_VIEW = (0.01, 3.0)  # radians
LARGEST_WINDOW = 8192  # pixels each way

Accepts = Callable[[Any], Any]
"""What a control takes: gives the value, within its range; raises ``Refused`` for what no browser of ours sends."""


class Refused(Exception):
    """A message that no browser of ours sends."""


class _Kind(msgspec.Struct):
    type: str


class _Update(msgspec.Struct):
    uuid: str
    updates: dict[str, Any]


class _Camera(msgspec.Struct):
    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: tuple[float, float, float]
    up_direction: tuple[float, float, float]


class _Click(msgspec.Struct):
    name: str


class _Pointer(msgspec.Struct):
    event_type: str
    screen_pos: list[tuple[float, float]]


def checked(raw: bytes | str, control: Callable[[str], Accepts | None], reach: float) -> bytes | None:
    """A message as viser may read it, or None where it is to be passed over.

    Args:
        raw: MessagePack. control: what the control of a name takes, or None where there is no such control.
        reach: the largest coordinate of a camera.

    Raises:
        Refused: no browser of ours sends it.
    """
    if not isinstance(raw, bytes) or len(raw) > LARGEST:
        raise Refused("not a message")
    try:
        kind = msgspec.msgpack.decode(raw, type=_Kind).type
        if kind == "ViewerCameraMessage":
            return _encoded(kind, _camera(msgspec.msgpack.decode(raw, type=_Camera), reach))
        if kind == "GuiUpdateMessage":
            update = msgspec.msgpack.decode(raw, type=_Update)
            accepts = control(update.uuid)
            if accepts is None or "value" not in update.updates:
                return None
            value = accepts(update.updates["value"])
            return _encoded(kind, {"uuid": update.uuid, "updates": {"value": value}})
        if kind == "SceneNodeClickMessage":
            name = msgspec.msgpack.decode(raw, type=_Click).name
            nowhere = {"ray_origin": (0.0,) * 3, "ray_direction": (0.0, 0.0, 1.0), "screen_pos": (0.0, 0.0)}
            owner = msgspec.msgpack.decode(raw, type=dict[str, Any]).get("owner", "")
            node = {"name": name, "instance_index": None, "modifier": None, "owner": str(owner)[:100]}
            return _encoded(kind, {**node, **nowhere})
        if kind == "ScenePointerMessage":
            pointer = msgspec.msgpack.decode(raw, type=_Pointer)
            return _encoded(kind, _clicked(pointer)) if pointer.event_type == "click" else None
    except (ValueError, RecursionError, OverflowError) as error:  # msgspec's are ValueErrors
        raise Refused("not a message") from error
    return None


def number(low: float, high: float) -> Accepts:
    """A number in a range."""
    return lambda value: min(max(_finite(value), low), high)


def pair(low: float, high: float) -> Accepts:
    """Two numbers in a range, the smaller one first."""

    def accepts(value: Any) -> list[float]:
        if not isinstance(value, list) or len(value) != 2:
            raise Refused("not two numbers")
        return sorted(min(max(_finite(item), low), high) for item in value)

    return accepts


def choice(options: Sequence[str]) -> Accepts:
    """One of some texts."""

    def accepts(value: Any) -> str:
        if not isinstance(value, str) or value not in options:
            raise Refused("not one of the choices")
        return value

    return accepts


def flag(value: Any) -> bool:
    """On or off; see ``Accepts``."""
    if not isinstance(value, bool):
        raise Refused("neither on nor off")
    return value


def push(_: Any) -> bool:
    """A button that is pressed, whatever comes with it; see ``Accepts``."""
    return True


def _camera(camera: _Camera, reach: float) -> dict[str, Any]:
    def placed(vector: Sequence[float]) -> tuple[float, ...]:
        return tuple(min(max(_finite(value), -reach), reach) for value in vector)

    def pixels(value: float) -> int:
        return int(min(max(_finite(value), 1), LARGEST_WINDOW))

    position = placed(camera.position)
    look_at = placed(camera.look_at)
    if position == look_at:  # viser would ask for the direction
        raise Refused("a camera that looks at itself")
    return {
        "wxyz": _unit(camera.wxyz),
        "position": position,
        "look_at": look_at,
        "up_direction": _unit(camera.up_direction),
        "fov": min(max(_finite(camera.fov), FIELD_OF_VIEW[0]), FIELD_OF_VIEW[1]),
        "near": min(max(_finite(camera.near), 1e-9), 1e9),
        "far": min(max(_finite(camera.far), 1e-9), 1e12),
        "image_height": pixels(camera.image_height),
        "image_width": pixels(camera.image_width),
    }


def _clicked(pointer: _Pointer) -> dict[str, Any]:
    """A click by its place in the window; the ray, which a session knows better, is left out."""
    if len(pointer.screen_pos) != 1:
        raise Refused("not one place")
    place = tuple(min(max(_finite(value), 0.0), 1.0) for value in pointer.screen_pos[0])
    ray = {"ray_origin": (0.0,) * 3, "ray_direction": (0.0, 0.0, 1.0)}
    return {"event_type": "click", **ray, "screen_pos": (place,), "modifier": None}


def _unit(vector: Sequence[float]) -> tuple[float, ...]:
    length = math.hypot(*(_finite(value) for value in vector))
    if not 1e-6 < length < 1e6:
        raise Refused("a direction without a length")
    return tuple(value / length for value in vector)


def _finite(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Refused("not a finite number")
    return float(value)


def _encoded(kind: str, fields: dict[str, Any]) -> bytes:
    return msgspec.msgpack.encode({"type": kind, **fields})
