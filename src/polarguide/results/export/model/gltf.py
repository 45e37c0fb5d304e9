"""A textured mesh as one binary glTF 2.0 file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.optics.color import srgb_encode_array
from polarguide.results.export.glb import ELEMENTS, Binary
from polarguide.shading.surface import GltfTexture

QUALITY = 92
"""Of JPEG textures."""
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
        added: [T, T, 3] textures of added surface properties, which GLB files alone have.
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
    for place, pixels in model.added:
        extension = extensions.setdefault(place.extension, {})
        extension |= {**place.constants, place.texture: {"index": len(images)}}
        images.append(encoded(pixels, jpeg=False))
    return images, {**material, "extensions": extensions}, [*extensions]
