"""Measure the loss of an exported PLY: its display colors in other viewers against our final picture.

    python benchmarks/accuracy/baked_splats.py RUN... > benchmarks/records/baked-splats.md

Prints a Markdown table with means over the test views in dB, for display pictures of the PLY of the training, which is
equal to the exported one, and of the diffuse layer alone.
"""

from __future__ import annotations

import sys
from statistics import fmean

import torch

from polarguide import Run, open_run
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.gaussians.ply import read_ply
from polarguide.optics.color import srgb_encode
from polarguide.raster import Splats
from polarguide.runs.folder import PLY


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the PSNR of two pictures in [0, 1] in dB."""
    return float(-10 * torch.log10(((a - b) ** 2).mean().clamp(min=1e-10)))


def scores(run: Run) -> tuple[float, float]:
    """Return the mean PSNR of the file and of the diffuse layer over the test views."""
    file = read_ply(run.folder / PLY)
    baked, diffuse = [], []
    for view in run.scene.test_views:
        result = run.result(view.camera).to("cpu")
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
        drawn = run.model.backend.rasterize(splats, view.camera).features.clamp(0, 1)
        layer = result.base if result.diffuse is None else result.diffuse
        final = srgb_encode(result.final.clamp(0, 1))
        baked.append(psnr(drawn, final))
        diffuse.append(psnr(srgb_encode(layer.clamp(0, 1)), final))
    return fmean(baked), fmean(diffuse)


def main() -> None:
    print("| run | exported splats | diffuse layer alone |\n|---|---:|---:|")
    for folder in sys.argv[1:]:
        run = open_run(folder)
        baked, diffuse = scores(run)
        print(
            f"| `{run.scene.root.name}`, {run.steps:,} steps | {baked:.1f} dB | {diffuse:.1f} dB |",
            flush=True,
        )


if __name__ == "__main__":
    main()
