"""Conversion of a PLY file of Gaussians to other formats of splats: Niantic's SPZ and glTF.

glTF uses the extension ``KHR_gaussian_splatting`` (kernel ``ellipse``). It stores linear scales, opacities in [0, 1],
quaternions (x, y, z, w) and the harmonics of 3DGS. Its ``colorSpace`` states the encoding of colors, but programs
ignore it. So one file is written for programs that blend linear colors, and one for programs that blend encoded colors.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from plyfile import PlyData

from polarguide.core.errors import PolarguideError, PolarguideWarning, optional_import
from polarguide.core.files import write_whole
from polarguide.gaussians.ply import read_ply
from polarguide.results.export.model.gltf import Binary

SPZ_RANGE = 2047.0
"""Largest absolute coordinate in SPZ. It has 24 bits with 12 fractional bits, and larger values wrap around."""


def write_spz(path: Path, ply: Path, version: int = 3) -> None:
    """Convert a PLY file of Gaussians to SPZ, without the fields that only this program uses.

    Gaussians outside the range of SPZ are moved toward the origin with a warning. Their size shrinks in proportion, so
    that they look the same from the origin.

    The axes of SPZ are right, up and back. Positions are rounded to 1/4096 of a unit. Colors and scales have 8 bits,
    harmonics 5 or 4 bits by degree.

    Args:
        path: file to write.
        ply: file from ``write_run_ply`` in the axes of SPZ.
        version: version of the format: 3 (gzip) or 4 (zstd).

    Raises:
        PolarguideError: the converter is not installed or cannot convert the file.
    """
    converter = optional_import("gaussforge", "--format spz").GaussForge()
    content = PlyData.read(ply)
    vertices = content["vertex"].data
    positions = np.stack([vertices[axis] for axis in "xyz"])
    shrink = np.minimum(1, SPZ_RANGE / np.abs(positions).max(axis=0).clip(min=1e-9))
    moved = np.count_nonzero(shrink < 1)
    if moved:
        warnings.warn(
            f"{path}: SPZ has no positions beyond {SPZ_RANGE:g} units. {moved:,} of {len(vertices):,} Gaussians are "
            "moved toward the origin and made smaller, so that they look the same from there.",
            PolarguideWarning,
            stacklevel=2,
        )
        for axis in "xyz":
            vertices[axis] *= shrink
        for name in ("scale_0", "scale_1", "scale_2"):
            vertices[name] += np.log(shrink)
    data = io.BytesIO()
    content.write(data)
    converted = converter.convert(data.getvalue(), "ply", "spz", spz_version=version)
    if "error" in converted:
        raise PolarguideError(
            ply,
            expected="Gaussians that SPZ can represent",
            found=str(converted["error"]),
            remedy="Export to ply instead.",
        )
    write_whole(path, bytes(converted["data"]))


EXTENSION = "KHR_gaussian_splatting"
Encoding = Literal["srgb", "linear"]
COLOR_SPACES: dict[Encoding, str] = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
"""Value of ``colorSpace`` by encoding.

Babylon and PlayCanvas blend encoded colors; three.js blends linear colors.
"""


def write_splat_glb(path: Path, ply: Path, asset: dict[str, Any], encoding: Encoding) -> None:
    """Convert a PLY file of Gaussians (+y up) to GLB, without the fields that only this program uses.

    Args:
        path: the file to write.
        ply: file from ``write_run_ply``.
        asset: glTF asset record.
        encoding: encoding of the colors in the PLY.

    Raises:
        PolarguideError: the file cannot be written.
    """
    gaussians = read_ply(ply)
    fields = {
        "ROTATION": torch.nn.functional.normalize(gaussians["quaternions"], dim=1)[:, [1, 2, 3, 0]],
        "SCALE": gaussians["log_scales"].exp(),
        "OPACITY": torch.sigmoid(gaussians["opacity_logits"]),
    }
    harmonics = torch.cat((gaussians["sh_dc"], gaussians["sh_rest"]), dim=1)
    for degree in range(4):
        for k in range(2 * degree + 1):
            fields[f"SH_DEGREE_{degree}_COEF_{k}"] = harmonics[:, degree * degree + k]
    binary = Binary()
    attributes = {"POSITION": binary.array(gaussians["means"].numpy(), bounds=True)}
    attributes |= {f"{EXTENSION}:{name}": binary.array(values.numpy()) for name, values in fields.items()}
    about = {
        "kernel": "ellipse",
        "colorSpace": COLOR_SPACES[encoding],
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: about}}
    binary.write(path, asset, primitive, {"extensionsUsed": [EXTENSION]})
