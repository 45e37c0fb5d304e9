"""The small JSON files beside the pictures: ``split.json`` and ``scene.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec

from polarguide.capture.view import unknown_view
from polarguide.errors import PolarguideError
from polarguide.records import decode

TEST_EVERY = 8
"""Without ``split.json`` every 8th view is held out, starting with the first."""
Index = Annotated[float, msgspec.Meta(gt=1.0, lt=10.0)]


class _Split(msgspec.Struct):
    """``split.json``; what else it says is passed over."""

    test: list[str]


class _Scene(msgspec.Struct):
    """What is read of ``scene.json``: other programs write files of this name, too."""

    refractive_index: Index | None = None
    objects: Any = None


def held_out(path: Path, data: bytes | None, names: list[str]) -> tuple[str, ...]:
    """The names of the test views, sorted.

    Args:
        path: ``split.json``, for messages.
        data: its content, or None if there is no such file; then every 8th view is held out.
        names: all view names of the capture, sorted.

    Raises:
        PolarguideError: the split has another form, names an unknown view, or leaves nothing to train on.
    """
    if data is None:
        test = names[::TEST_EVERY]
    else:
        remedy = 'List the names of the test views, {"test": ["<view>", ...]}, or remove the file.'
        test = decode(data, _Split, path, remedy=remedy).test
        for name in test:
            if name not in names:
                raise unknown_view(f"{path} (test)", name, names)
    if len(set(test)) >= len(names):
        raise PolarguideError(
            path,
            expected="at least one view to train on",
            found=f"all {len(names)} views in the test set",
            remedy="Name fewer test views in split.json, or add views.",
        )
    return tuple(sorted(set(test)))


def refractive_index_of(path: Path, data: bytes | None) -> float | None:
    """The one index in ``scene.json``, or None: ``refractive_index``, else the ``ior`` its objects agree on.

    Args:
        path: ``scene.json``, for messages. data: its content, or None if there is no such file.

    Raises:
        PolarguideError: the index is not a number from 1 to 10.
    """
    if data is None:
        return None
    remedy = "Correct it, or remove it to use the default."
    scene = decode(data, _Scene, path, remedy=remedy)
    if scene.refractive_index is not None:
        return scene.refractive_index
    objects = scene.objects if isinstance(scene.objects, list) else []
    materials = [item.get("material") for item in objects if isinstance(item, dict)]
    found = [item["ior"] for item in materials if isinstance(item, dict) and item.get("ior") is not None]
    if not found or any(index != found[0] for index in found):
        return None
    return decode(found[0], Index, f"{path} (ior)", remedy=remedy)
