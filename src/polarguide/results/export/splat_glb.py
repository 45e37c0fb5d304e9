"""Export of splats as glTF with the extension ``KHR_gaussian_splatting`` (kernel ``ellipse``), from the PLY of a run.

The extension stores linear scales, opacities in [0, 1], quaternions (x, y, z, w) and the harmonics of 3DGS.
Its ``colorSpace`` states the encoding of colors, but readers ignore it. So there is one file for each kind of
reader.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch

from polarguide.gaussians.ply import read_ply
from polarguide.results.export.glb import Binary

EXTENSION = "KHR_gaussian_splatting"
"""Name of the glTF extension."""
Encoding = Literal["srgb", "linear"]
COLOR_SPACES: dict[Encoding, str] = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
"""Value of ``colorSpace`` by encoding.

Babylon and PlayCanvas blend encoded colors; three.js blends linear colors.
"""


def write_splat_glb(path: Path, ply: Path, asset: dict[str, Any], encoding: Encoding) -> None:
    """Convert a PLY of Gaussians (+y up) without our own fields.

    Args:
        path: the file to write. ply: file from ``write_run_ply``. asset: glTF asset record.
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
