"""Splats in the compressed formats that today's viewers read: SPZ and SOG, from the PLY of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from polarguide.errors import PolarguideError
from polarguide.export.extras import needed
from polarguide.training.run import atomic

Compressed = Literal["spz", "sog"]


def write_compressed(path: Path, ply: Path, kind: Compressed) -> None:
    """Convert a PLY of Gaussians; our own fields in it are left out, as neither format has a place for them.

    Positions in SPZ are multiples of 1/4096 of the world's unit; both keep 8 bits or fewer of colours and harmonics.

    Args:
        path: the file to write. ply: as ``write_run_ply`` writes it. kind: the format.

    Raises:
        PolarguideError: the converter is not installed, or refuses.
    """
    converter = needed("gaussforge", f"--format {kind}").GaussForge()
    converted = converter.convert(ply.read_bytes(), "ply", kind)
    if "error" in converted:
        raise PolarguideError(
            ply,
            expected=f"Gaussians that {kind} can hold",
            found=str(converted["error"]),
            remedy="Export them as ply.",
        )
    with atomic(path) as temporary:
        temporary.write_bytes(bytes(converted["data"]))
