"""The container of glTF 2.0 in one binary file: a tree of JSON, and arrays that it names by number."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.core.files import write_whole

ARRAY = 34962
"""Target of a buffer view with values at vertices."""
ELEMENTS = 34963
"""Target of a buffer view with numbers of vertices."""
_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Binary:
    """Arrays and files of one GLB, in the order in which they are added."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes; returns the number of their buffer view."""
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._views.append(view if target is None else {**view, "target": target})
        self._data += data
        return len(self._views) - 1

    def array(self, values: NDArray[Any], target: int = ARRAY, *, bounds: bool = False) -> int:
        """Add values [N] or [N, C], single precision or uint32; returns the number of their accessor.

        Args:
            values: the array. target: what it is for. bounds: whether to tell the smallest and the largest value, as
                positions have to.
        """
        table = values.reshape(len(values), -1)
        accessor = {
            "bufferView": self.view(np.ascontiguousarray(values).tobytes(), target),
            "componentType": _COMPONENTS[values.dtype],
            "count": len(table),
            "type": _TYPES[table.shape[1]],
        }
        if bounds:
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def write(
        self, path: Path, asset: dict[str, Any], primitive: dict[str, Any], more: dict[str, Any]
    ) -> None:
        """Write the file of one primitive.

        Args:
            path: the file. asset: whom and what made it, without the version. primitive: primitive of the only mesh.
            more: further fields of the tree.

        Raises:
            PolarguideError: the file cannot be written.
        """
        self._data += bytes(-len(self._data) % 4)
        tree = {
            "asset": {"version": "2.0", **asset},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "model"}],
            "meshes": [{"primitives": [primitive]}],
            **more,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._data)}],
        }
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(self._data))
        chunks = [
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(self._data), b"BIN\0"),
        ]
        write_whole(path, b"".join([head, *chunks, self._data]))
