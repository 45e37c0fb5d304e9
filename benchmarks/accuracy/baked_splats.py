"""Measure the loss of an exported PLY: its display colors in other viewers against our final picture.

    python benchmarks/accuracy/baked_splats.py RUN [RUN/export/splats.ply]

Prints means over the test views in dB, for display pictures of the file and of the diffuse layer alone. The default
file is the PLY of the training, which is equal to the exported one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from polarguide import open_run
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.gaussians.ply import read_ply
from polarguide.optics.color import srgb_encode
from polarguide.raster import Splats
from polarguide.runs.folder import PLY


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the PSNR of two pictures in [0, 1] in dB."""
    return float(-10 * torch.log10(((a - b) ** 2).mean().clamp(min=1e-10)))


def main() -> None:
    """Print the two means."""
    run = Path(sys.argv[1])
    opened, file = open_run(run), read_ply(sys.argv[2] if len(sys.argv) > 2 else run / PLY)
    scores = []
    for view in opened.scene.test_views:
        result = opened.result(view.camera).to("cpu")
        colors = evaluate_sh(
            file["means"], view.camera.center, file["sh_dc"][:, 0].contiguous(), file["sh_rest"], 3
        )
        splats = Splats(
            file["means"],
            file["quaternions"],
            file["log_scales"].exp(),
            torch.sigmoid(file["opacity_logits"]),
            (colors + 0.5).clamp(min=0),
        )
        baked = opened.model.backend.rasterize(splats, view.camera).features.clamp(0, 1)
        diffuse = result.base if result.diffuse is None else result.diffuse
        final = srgb_encode(result.final.clamp(0, 1))
        scores.append((psnr(baked, final), psnr(srgb_encode(diffuse.clamp(0, 1)), final)))
    mean = torch.tensor(scores).mean(dim=0)
    print(f"baked file {mean[0]:.2f} dB, diffuse layer alone {mean[1]:.2f} dB")


if __name__ == "__main__":
    main()
