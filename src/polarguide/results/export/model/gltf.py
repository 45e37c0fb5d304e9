"""A textured mesh as one binary glTF 2.0 file."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.core.files import write_whole
from polarguide.optics.color import srgb_encode_array

QUALITY = 92
"""Of JPEG textures."""
_ARRAY, _ELEMENTS = 34962, 34963
_FLOAT, _UNSIGNED = 5126, 5125
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
"""Linear with mip maps; clamped to the edge."""
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Textured:
    """A mesh with its textures, in the axes and units of the file.

    Attributes:
        vertices, normals: [V, 3]. uv: [V, 2], v down from the first row. faces: [F, 3].
        base_color: [T, T, 3] sRGB. surface: [T, T, 3] roughness in green, metalness in blue; None: unlit.
        specular: [T, T] factor on a dielectric's reflection; None: 1. index: refractive index.
    """

    vertices: NDArray[np.float64]
    normals: NDArray[np.float64]
    uv: NDArray[np.float64]
    faces: NDArray[np.int64]
    base_color: Pixels
    surface: Pixels | None
    specular: Pixels | None
    index: float


def color_pixels(linear: NDArray[np.float32]) -> Pixels:
    """Linear colors as sRGB bytes: how glTF has base color."""
    return np.asarray(np.rint(255 * srgb_encode_array(np.clip(linear, 0, 1))), np.uint8)


def linear_pixels(values: NDArray[np.float32]) -> Pixels:
    """Values in [0, 1] as bytes: how glTF has roughness, metalness and factors."""
    return np.asarray(np.rint(255 * np.clip(values, 0, 1)), np.uint8)


def encoded(pixels: Pixels, *, jpeg: bool) -> tuple[str, bytes]:
    """The media type and the file of a picture [H, W, 3 or 4]; transparency only as PNG."""
    order = [2, 1, 0, 3][: pixels.shape[2]]
    flags = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if jpeg else []
    done, data = cv2.imencode(".jpg" if jpeg else ".png", np.ascontiguousarray(pixels[..., order]), flags)
    assert done
    return ("image/jpeg" if jpeg else "image/png"), data.tobytes()


def write_glb(path: Path, model: Textured, asset: dict[str, Any], *, jpeg: bool) -> None:
    """Write the file.

    Args:
        path: the file. model: the mesh. asset: glTF's record of whom and what made it, without the version.
        jpeg: whether base color, roughness and metalness are JPEG; else PNG.

    Raises:
        PolarguideError: it cannot be written.
    """
    images, material, extensions = _material(model, jpeg=jpeg)
    arrays = [
        *(np.ascontiguousarray(values, "<f4") for values in (model.vertices, model.normals, model.uv)),
        np.ascontiguousarray(model.faces, "<u4"),
    ]
    blob, views = bytearray(), []
    targets = [_ARRAY, _ARRAY, _ARRAY, _ELEMENTS]
    for data, target in [
        *zip((array.tobytes() for array in arrays), targets, strict=True),
        *((data, None) for _, data in images),
    ]:
        blob += bytes(-len(blob) % 4)
        view = {"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)}
        views.append(view if target is None else {**view, "target": target})
        blob += data
    blob += bytes(-len(blob) % 4)
    places = arrays[0]
    tree = {
        "asset": {"version": "2.0", **asset},
        **({"extensionsUsed": extensions} if extensions else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "model"}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [_SAMPLER],
        "images": [{"bufferView": len(arrays) + k, "mimeType": kind} for k, (kind, _) in enumerate(images)],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(places), "type": "VEC3",
             "min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()},
            {"bufferView": 1, "componentType": _FLOAT, "count": len(places), "type": "VEC3"},
            {"bufferView": 2, "componentType": _FLOAT, "count": len(places), "type": "VEC2"},
            {"bufferView": 3, "componentType": _UNSIGNED, "count": arrays[3].size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(blob))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    write_whole(path, head + chunks)


def _material(model: Textured, *, jpeg: bool) -> tuple[list[tuple[str, bytes]], dict[str, Any], list[str]]:
    """The images, the material that names them by number, and the extensions that it uses."""
    images = [encoded(model.base_color, jpeg=jpeg)]
    shading: dict[str, Any] = {"baseColorTexture": {"index": 0}}
    material: dict[str, Any] = {"name": "surface", "pbrMetallicRoughness": shading}
    extensions: dict[str, Any] = {}
    if model.surface is None:
        # What readers without the extension draw instead: no highlight.
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
    return images, {**material, "extensions": extensions}, [*extensions]
