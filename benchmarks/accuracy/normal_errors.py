"""Locate the normal errors of runs on scenes with ground truth: ``python benchmarks/accuracy/normal_errors.py RUN...``.

Foreground pixels of the held-out views are divided into edges and the rest, and by degree of polarization. Edges are
within two pixels of the foreground's border or of a jump of the true normals (neighbors more than 26 degrees apart).
Each part has its share of the pixels, its mean error in degrees, and its share of the total error.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from polarguide import open_run, optics
from polarguide.results.evaluation.metrics import normal_angles_deg

NEAR = np.ones((5, 5), dtype=np.uint8)
JUMP = 0.9  # cosine between neighbors
FAINT = 0.02


def near_edges(normals: Tensor, mask: Tensor) -> Tensor:
    """Return the mask of pixels near the border of ``mask`` [H, W] or a jump of ``normals`` [H, W, 3]: two pixels."""
    n = normals.numpy()
    jumps = np.zeros(mask.shape, dtype=np.uint8)
    jumps[:, 1:] |= (n[:, 1:] * n[:, :-1]).sum(axis=-1) < JUMP
    jumps[1:] |= (n[1:] * n[:-1]).sum(axis=-1) < JUMP
    border = cv2.erode(mask.numpy().astype(np.uint8), NEAR) == 0
    return torch.from_numpy(border | (cv2.dilate(jumps, NEAR) > 0))


def main() -> None:
    """Print a table."""
    print("| run | mean | median | near edges | DoLP under 0.02 | the rest |")
    print("|---|---|---|---|---|---|")
    for run in map(Path, sys.argv[1:]):
        opened = open_run(run)
        errors, edges, faint = [], [], []
        for view in opened.scene.test_views:
            ground_truth = view.ground_truth
            assert ground_truth is not None
            assert ground_truth.normal is not None
            assert ground_truth.mask is not None
            rendered = opened.result(view.camera).to("cpu").normal
            assert rendered is not None
            angles = normal_angles_deg(rendered, ground_truth.normal)
            dolp = optics.dolp(optics.luminance(optics.stokes(view.intensities())))
            errors.append(angles[ground_truth.mask])
            edges.append(near_edges(ground_truth.normal, ground_truth.mask)[ground_truth.mask])
            faint.append((dolp < FAINT)[ground_truth.mask])
        error, edge, dark = torch.cat(errors), torch.cat(edges), torch.cat(faint)
        parts = []
        for part in (edge, ~edge & dark, ~edge & ~dark):
            share = 100 * float(part.float().mean()), 100 * float(error[part].sum() / error.sum())
            parts.append(f"{share[0]:.0f} %, {float(error[part].mean()):.1f}, {share[1]:.0f} %")
        overall = f"{float(error.mean()):.1f} | {float(error.median()):.1f}"
        print(f"| {opened.scene.name}, `{opened.recipe.name}` | {overall} | {' | '.join(parts)} |")


if __name__ == "__main__":
    main()
