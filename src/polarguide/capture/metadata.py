"""The small JSON files beside the pictures: ``split.json`` and ``scene.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from polarguide.capture.view import unknown_view
from polarguide.errors import PolarguideError

TEST_EVERY = 8
"""Without ``split.json`` every 8th view is held out, starting with the first."""


def held_out(path: Path, split: dict[str, Any] | None, names: list[str]) -> tuple[str, ...]:
    """The names of the test views, sorted.

    Args:
        path: ``split.json``, for messages.
        split: its content, or None if there is no such file; then every 8th view is held out.
        names: all view names of the capture, sorted.

    Raises:
        PolarguideError: the split has another form, names an unknown view, or leaves nothing to train on.
    """
    if split is None:
        test = names[::TEST_EVERY]
    else:
        test = split.get("test", [])
        if "test" not in split or not isinstance(test, list) or not all(isinstance(n, str) for n in test):
            raise PolarguideError(
                path,
                expected='{"test": ["<view>", ...]}',
                found=f"the keys {', '.join(sorted(split)) or '(none)'}"
                if "test" not in split
                else f"{test!r}",
                remedy="List the names of the test views under 'test', or remove the file.",
            )
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


def refractive_index_of(path: Path, scene: dict[str, Any] | None) -> float | None:
    """The one index in ``scene.json``, or None: ``refractive_index``, else the ``ior`` its objects agree on.

    Raises:
        PolarguideError: the index is not a number above 1.
    """
    if scene is None:
        return None
    index = scene.get("refractive_index")
    if index is None:
        objects = scene.get("objects")
        materials = [item.get("material") for item in objects or () if isinstance(item, dict)]
        found = {material.get("ior") for material in materials if isinstance(material, dict)} - {None}
        if len(found) != 1:
            return None
        index = found.pop()
    if isinstance(index, bool) or not isinstance(index, int | float) or not 1.0 < index < 10.0:
        raise PolarguideError(
            f"{path} (refractive_index)",
            expected="a number above 1, such as 1.5",
            found=repr(index),
            remedy="Correct it, or remove it to use the default.",
        )
    return float(index)
