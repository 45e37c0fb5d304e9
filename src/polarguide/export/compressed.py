"""Splats in the compressed formats that today's viewers read: SPZ and SOG, from the PLY of a run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Literal

import torch

from polarguide.errors import PolarguideError
from polarguide.export.extras import needed
from polarguide.gaussians.ply import read_ply, write_ply
from polarguide.training.run import atomic

Compressed = Literal["spz", "sog"]

# Signs of the harmonics of degree 1 to 3, in the order of a PLY, after half a turn about x: y and z change theirs.
_HALF_TURN_HARMONICS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)


def write_compressed(path: Path, ply: Path, kind: Compressed) -> None:
    """Convert a PLY of Gaussians; our own fields in it are left out, as neither format has a place for them.

    SPZ is in its own axes (right, up, back), so half a turn about x from ours; readers turn it back. Positions in it
    are multiples of 1/4096 of the world's unit; both formats keep 8 bits or fewer of colours and harmonics. SOG
    clusters harmonics, which takes minutes for 100,000 Gaussians.

    Args:
        path: the file to write. ply: as ``write_run_ply`` writes it. kind: the format.

    Raises:
        PolarguideError: the converter is not installed, or refuses.
    """
    needed("gaussforge", f"--format {kind}")
    if kind == "spz":
        ply = _half_turned(ply)
    with atomic(path) as temporary:
        command = [sys.executable, "-m", "polarguide.export.converter", str(ply), kind, str(temporary)]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode != 0:
            raise PolarguideError(
                ply,
                expected=f"Gaussians that {kind} can hold",
                found=(done.stderr.strip().splitlines() or ["a converter that failed"])[-1],
                remedy="Export them as ply.",
            )


def _half_turned(ply: Path) -> Path:
    """The same Gaussians beside the file, half a turn about the world's x further."""
    rows = read_ply(ply)
    rows.pop("extra")
    rows["means"] = rows["means"] * torch.tensor([1.0, -1.0, -1.0])
    # Half a turn of the world and of each Gaussian's own axes, which does not change its shape.
    rows["quaternions"] = rows["quaternions"] * torch.tensor([1.0, 1.0, -1.0, -1.0])
    rows["sh_rest"] = rows["sh_rest"] * torch.tensor(_HALF_TURN_HARMONICS)[None, :, None]
    turned = ply.with_name("turned.ply")
    write_ply(turned, **rows)
    return turned
