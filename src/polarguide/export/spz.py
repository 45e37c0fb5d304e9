"""Splats in SPZ, Niantic's compressed format, from the PLY of a run."""

from __future__ import annotations

from pathlib import Path

import torch

from polarguide.errors import PolarguideError, optional_import
from polarguide.files import write_whole
from polarguide.gaussians.ply import read_ply, write_ply

# Signs of the harmonics of degree 1 to 3, in the order of a PLY, after half a turn about x: y and z change theirs.
_HALF_TURN_HARMONICS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)


def write_spz(path: Path, ply: Path, version: int = 3) -> None:
    """Convert a PLY of Gaussians; our own fields in it are left out, as the format has no place for them.

    SPZ is in its own axes (right, up, back), so half a turn about x from ours; readers turn it back. Positions in it
    are multiples of 1/4096 of the world's unit; colors and scales keep 8 bits, harmonics 5 or 4.

    Args:
        path: the file to write. ply: as ``write_run_ply`` writes it. version: 3, or 4 (zstd in place of gzip).

    Raises:
        PolarguideError: the converter is not installed, or refuses.
    """
    converter = optional_import("gaussforge", "--format spz").GaussForge()
    converted = converter.convert(_half_turned(ply).read_bytes(), "ply", "spz", spz_version=version)
    if "error" in converted:
        raise PolarguideError(
            ply,
            expected="Gaussians that spz can hold",
            found=str(converted["error"]),
            remedy="Export them as ply.",
        )
    write_whole(path, bytes(converted["data"]))


def _half_turned(ply: Path) -> Path:
    """The same Gaussians beside the file, half a turn about the world's x further."""
    gaussians = read_ply(ply)
    gaussians.pop("extra")
    gaussians["means"] = gaussians["means"] * torch.tensor([1.0, -1.0, -1.0])
    # Half a turn of the world and of each Gaussian's own axes, which does not change its shape.
    gaussians["quaternions"] = gaussians["quaternions"] * torch.tensor([1.0, 1.0, -1.0, -1.0])
    gaussians["sh_rest"] = gaussians["sh_rest"] * torch.tensor(_HALF_TURN_HARMONICS)[None, :, None]
    turned = ply.with_name("turned.ply")
    write_ply(turned, **gaussians)
    return turned
