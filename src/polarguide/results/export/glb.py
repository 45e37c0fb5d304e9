"""Binary container of glTF 2.0: a JSON tree and arrays that it references by index."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.core.files import write_whole

ARRAY = 34962
"""Target of a buffer view with vertex attributes."""
ELEMENTS = 34963
"""Target of a buffer view with vertex indices."""
_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Binary:
    """Arrays and files of one GLB, in the order of their addition."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes and return the index of their buffer view."""
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._views.append(view if target is None else {**view, "target": target})
        self._data += data
        return len(self._views) - 1

    def array(self, values: NDArray[Any], target: int = ARRAY, *, bounds: bool = False) -> int:
        """Add values [N] or [N, C], float32 or uint32, and return the index of their accessor.

        Args:
            values: the array. target: target of the buffer view.
            bounds: record the minimum and the maximum, which positions require.
        """
        table = values.reshape(len(values), -1)
        accessor: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
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
        """Write a file with one primitive.

        Args:
            path: the file. asset: glTF asset record without the version. primitive: primitive of the only
                mesh.
            more: additional fields of the tree.

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
        length = 12 + 8 + len(text) + 8 + len(self._data)
        head = struct.pack("<4sIII4s", b"glTF", 2, length, len(text), b"JSON")
        write_whole(path, head + text + struct.pack("<I4s", len(self._data), b"BIN\0") + self._data)
