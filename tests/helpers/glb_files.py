"""Content of GLB files, read by their layout alone."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

TYPES = {5121: "u1", 5126: "<f4"}
"""NumPy types by the component types of glTF."""


def read_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The tree, and the values of the only primitive by attribute."""
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    values = {}
    for name, number in tree["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values[name] = np.frombuffer(part, TYPES[accessor["componentType"]]).reshape(
            accessor["count"], columns[accessor["type"]]
        )
    return tree, values
