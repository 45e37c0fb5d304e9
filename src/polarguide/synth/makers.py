"""Make what the data of a scene name by its type: ``{"type": "wood", ...}``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from polarguide.errors import PolarguideError

T = TypeVar("T")
REMEDY = "docs/reference/scene-files.md describes them."


def make(makers: Mapping[str, Callable[..., T]], data: Mapping[str, Any], where: str, expected: str) -> T:
    """Call the function that the type names with the other fields.

    Args:
        makers: functions by type. data: the type and the fields.
        where: what is made, for messages. expected: what messages ask for if the type is unknown.

    Raises:
        PolarguideError: the type or a field is unknown, or a value makes no sense.
    """
    fields = dict(data)
    kind = fields.pop("type", None)
    maker = makers.get(kind) if isinstance(kind, str) else None
    if maker is None:
        raise PolarguideError(where, expected=expected, found=f"the type {kind!r}", remedy=REMEDY)
    try:
        return maker(**fields)
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise PolarguideError(
            where, expected=f"the fields of a {kind}", found=str(error), remedy=REMEDY
        ) from error
