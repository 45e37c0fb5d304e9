"""Export of a textured mesh as a binary glTF 2.0 file."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from polarguide.core.files import write_whole
from polarguide.optics.color import srgb_encode_array
from polarguide.shading.surface import GltfTexture

ARRAY = 34962
"""Value of ``target`` for a buffer view with vertex attributes."""
ELEMENTS = 34963
"""Value of ``target`` for a buffer view with vertex indices."""
_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("u1"): 5121}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Binary:
    """Builder of one GLB file from arrays and embedded files."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes to the file, and return the index of their buffer view."""
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._views.append(view if target is None else {**view, "target": target})
        self._data += data
        return len(self._views) - 1

    def array(self, values: NDArray[Any], target: int = ARRAY, *, bounds: bool = False) -> int:
        """Add values [N] or [N, C] (float32, uint32 or normalized uint8), and return the index of their accessor.

        Args:
            values: the array.
            target: target of the buffer view.
            bounds: record minimum and maximum, as glTF requires for positions.
        """
        table = values.reshape(len(values), -1)
        accessor: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
            "componentType": _COMPONENTS[values.dtype],
            "normalized": values.dtype == np.uint8,
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
            path: the file.
            asset: asset record of glTF without the version.
            primitive: primitive of the only mesh in the file.
            more: additional fields at the top level of the glTF record.

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


QUALITY = 92
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
"""Sampler with mip maps, clamped to the edge."""
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Textured:
    """Mesh with textures, in the axes and units of an exported file.

    Attributes:
        vertices, normals: [V, 3].
        uv: [V, 2] texture coordinates. v points down from the first row of the texture.
        faces: [F, 3].
        base_color: [T, T, 3] sRGB.
        surface: [T, T, 3] texture with roughness in green and metalness in blue, or None for an unlit mesh.
        specular: [T, T] factor on the reflection of dielectrics. None means 1 everywhere.
        index: refractive index.
        added: [T, T, 3] textures of additional surface properties. Only GLB files contain them.
    """

    vertices: NDArray[np.float64]
    normals: NDArray[np.float64]
    uv: NDArray[np.float64]
    faces: NDArray[np.int64]
    base_color: Pixels
    surface: Pixels | None
    specular: Pixels | None
    index: float
    added: Sequence[tuple[GltfTexture, Pixels]] = ()


def color_pixels(linear: NDArray[np.float32]) -> Pixels:
    """Encode linear colors as sRGB bytes, as glTF requires for base color."""
    return np.asarray(np.rint(255 * srgb_encode_array(np.clip(linear, 0, 1))), np.uint8)


def linear_pixels(values: NDArray[np.float32]) -> Pixels:
    """Encode values in [0, 1] as linear bytes, as glTF requires for roughness, metalness and factors."""
    return np.asarray(np.rint(255 * np.clip(values, 0, 1)), np.uint8)


def encoded(pixels: Pixels, *, jpeg: bool) -> tuple[str, bytes]:
    """Encode a picture [H, W, 3 or 4], and return its media type and the bytes of the file.

    A picture with transparency is encoded as PNG even if ``jpeg`` is set.
    """
    kind = "jpeg" if jpeg else "png"
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, quality=QUALITY)
    return f"image/{kind}", file.getvalue()


def write_glb(path: Path, model: Textured, asset: dict[str, Any], *, jpeg: bool) -> None:
    """Write a textured mesh.

    Args:
        path: the file.
        model: the mesh.
        asset: glTF asset record without the version.
        jpeg: encode base color, roughness and metalness as JPEG instead of PNG.

    Raises:
        PolarguideError: the file cannot be written.
    """
    images, material, extensions = _material(model, jpeg=jpeg)
    binary = Binary()
    attributes = {
        "POSITION": binary.array(model.vertices.astype("<f4"), bounds=True),
        "NORMAL": binary.array(model.normals.astype("<f4")),
        "TEXCOORD_0": binary.array(model.uv.astype("<f4")),
    }
    faces = binary.array(model.faces.reshape(-1).astype("<u4"), ELEMENTS)
    tree = {
        **({"extensionsUsed": extensions} if extensions else {}),
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [_SAMPLER],
        "images": [{"bufferView": binary.view(data), "mimeType": kind} for kind, data in images],
    }
    binary.write(path, asset, {"attributes": attributes, "indices": faces, "material": 0}, tree)


def _material(model: Textured, *, jpeg: bool) -> tuple[list[tuple[str, bytes]], dict[str, Any], list[str]]:
    """Return the images of a mesh, the material that references them by index, and the extensions that it uses."""
    images = [encoded(model.base_color, jpeg=jpeg)]
    shading: dict[str, Any] = {"baseColorTexture": {"index": 0}}
    material: dict[str, Any] = {"name": "surface", "pbrMetallicRoughness": shading}
    extensions: dict[str, Any] = {}
    if model.surface is None:
        # Programs that do not support the extension draw no highlight.
        shading |= {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        extensions["KHR_materials_unlit"] = {}
    else:
        shading["metallicRoughnessTexture"] = {"index": len(images)}
        images.append(encoded(model.surface, jpeg=jpeg))
        extensions["KHR_materials_ior"] = {"ior": model.index}
    if model.specular is not None:
        extensions["KHR_materials_specular"] = {"specularTexture": {"index": len(images)}}
        white = np.full_like(model.base_color, 255)
        images.append(encoded(np.concatenate([white, model.specular[..., None]], axis=2), jpeg=False))
    for place, pixels in model.added:
        extension = extensions.setdefault(place.extension, {})
        extension |= {**place.constants, place.texture: {"index": len(images)}}
        images.append(encoded(pixels, jpeg=False))
    return images, {**material, "extensions": extensions}, [*extensions]
