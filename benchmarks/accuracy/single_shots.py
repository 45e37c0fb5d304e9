"""Measure burnt pixels of trainings on single shots through a filter: brightness and accuracy, view by view.

``polarguide synth SCENE --sensor filter`` writes both the single shots (``raw``, for ``prepare``) and the scene with
four exact angles, which is the ground truth here. For each scene and each kind of knowledge about the angles:

    polarguide synth cup --out TRUTH --sensor filter --noise 1 --size 320x240 --samples 8 --views 32

    polarguide prepare TRUTH/raw --out SHOTS --poses TRUTH

    polarguide train SHOTS --out RUN --downscale 2 --steps 2500 --threads 1 --seed 0
    polarguide train TRUTH --out FOUR --downscale 2 --steps 2500 --threads 1 --seed 0
    python benchmarks/accuracy/single_shots.py RUN=TRUTH FOUR=TRUTH ... --json single-shots.json

For unknown angles the files are copied without the angle in their names, and prepared with ``--angles unknown``.

A pixel burns if its light is more than twice the brightest unclipped value in any training view, and another training
view measures the same place unclipped. Shares are of the pixels of a view: of ``final`` (S0/2), and of the predicted
intensity behind the analyzer of the view.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

import polarguide as pg
from polarguide.capture import Scene, View
from polarguide.capture.exposures import analyzers
from polarguide.results.evaluation.metrics import psnr
from polarguide.runs.opened import OpenedRun
from polarguide.training.photometric import behind_analyzer

SAME_PLACE = 0.02
"""Largest relative difference of two depths of one place."""
HIGHLIGHT = 2.0
"""True S0/2 above which a place is a highlight, in units of full scale."""


class Burning:
    """Observer of the views of a run.

    Args:
        run: a run on single shots or on four angles.
        truth: the scene with four exact angles, at the run's size.
    """

    def __init__(self, run: OpenedRun, truth: Scene) -> None:
        self.run, self.truth = run, {view.name: view for view in truth.views}
        views = run.scene.train_views
        self.limit = 2 * max(brightest_unclipped(view) for view in views)
        self.clear = {view.name: ~(view.saturated | view.invalid) for view in views}
        self.depth = {view.name: run.model.render(view.camera, depth=True).depth for view in views}

    def look(self, view: View) -> dict[str, Any]:
        """Measure a view: shares of burnt pixels, PSNR against the ground truth, and values of highlights."""
        result = self.run.model.render(view.camera, depth=True)
        assert result.depth is not None
        found: dict[str, Any] = {"final": self.burns(view, result.final, result.depth)}
        stokes = self.run.model.stokes(result, view.camera)
        polarized = [exposure for exposure in view.exposures if exposure.angle is not None]
        if stokes is not None and len(view.exposures) < 4 and polarized:
            (analyzer,) = analyzers(polarized, view.camera.rays(), view.mount)
            behind = result.final + behind_analyzer(stokes, analyzer)
            found["behind"] = self.burns(view, behind, result.depth)
        true = self.truth[view.name]
        found["psnr"] = psnr(result.final, true.photograph(), ~(true.invalid | true.saturated))
        if true.ground_truth is not None and true.ground_truth.specular is not None:
            exact = (true.ground_truth.specular + true.ground_truth.diffuse) / 2
            bright = exact.mean(dim=-1) > HIGHLIGHT
            found["highlight pixels"] = int(bright.sum())
            if bool(bright.any()):
                found["highlights kept"] = float(result.final[bright].mean() / exact[bright].mean())
        return found

    def burns(self, view: View, light: Tensor, depth: Tensor) -> float:
        """Return the share of burnt pixels."""
        rows, columns = torch.nonzero(light.amax(dim=-1) > self.limit, as_tuple=True)
        if not len(rows):
            return 0.0
        camera = view.camera
        rays = camera.rays(dtype=torch.float64)[rows, columns]
        inside = rays / rays[:, 2:] * depth[rows, columns, None].double()
        points = inside @ camera.rotation + camera.center
        seen = torch.zeros(len(points), dtype=torch.bool)
        for other in self.run.scene.train_views:
            if other.name != view.name:
                seen |= self._sees_unclipped(other, points)
        return float(seen.sum()) / light[..., 0].numel()

    def _sees_unclipped(self, view: View, points: Tensor) -> Tensor:
        camera = view.camera
        local = points @ camera.rotation.T + camera.translation
        front = local[:, 2] > 1e-6
        depth = local[:, 2].clamp(min=1e-6)
        column = (local[:, 0] / depth * camera.fx + camera.cx).floor().long()
        row = (local[:, 1] / depth * camera.fy + camera.cy).floor().long()
        inside = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
        rendered = self.depth[view.name]
        assert rendered is not None
        near = (rendered[row, column] / depth - 1).abs() < SAME_PLACE
        return inside & near & self.clear[view.name][row, column]


def brightest_unclipped(view: View) -> float:
    """Return the largest intensity of the unclipped pixels of a view."""
    clear = ~(view.saturated | view.invalid)
    return float(view.intensities()[:, clear].max()) if bool(clear.any()) else 0.0


@torch.no_grad()
def examine(folder: Path, truth: Path) -> dict[str, Any]:
    """Return the record of one run."""
    run = OpenedRun.open(folder)
    scene = pg.load_scene(truth, downscale=run.configuration.downscale)
    burning = Burning(run, scene)
    train = {view.name: burning.look(view) for view in run.scene.train_views}
    test = {view.name: burning.look(view) for view in run.scene.test_views}
    scores = {name: found["psnr"] for name, found in test.items()}
    kept = [found["highlights kept"] for found in test.values() if "highlights kept" in found]
    return {
        "limit": burning.limit,
        "burning, training": max(found["final"] for found in train.values()),
        "burning, held out": max(found["final"] for found in test.values()),
        "burning behind, training": max(found.get("behind", 0.0) for found in train.values()),
        "burning behind, held out": max(found.get("behind", 0.0) for found in test.values()),
        "psnr": sum(scores.values()) / len(scores),
        "median": median(scores.values()),
        "worst": min(scores.values()),
        "worst view": min(scores, key=lambda name: scores[name]),
        "worst training view": min(found["psnr"] for found in train.values()),
        "highlights kept": sum(kept) / len(kept) if kept else None,
        "views": scores,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "pairs", nargs="+", help="RUN=TRUTH: a run folder, and the scene with four exact angles"
    )
    parser.add_argument("--json", type=Path, help="where to write the record")
    arguments = parser.parse_args()
    records = {}
    print(
        f"{'run':28} burn train  held out   behind: train  held out   PSNR median  worst  train worst  highlights"
    )
    for pair in arguments.pairs:
        run, truth = pair.split("=")
        record = records[Path(run).name] = examine(Path(run), Path(truth))
        shares = [
            f"{100 * record[f'burning{of}']:8.2f} %"
            for of in (", training", ", held out", " behind, training", " behind, held out")
        ]
        levels = [f"{record[name]:7.2f}" for name in ("psnr", "median", "worst", "worst training view")]
        kept = record["highlights kept"]
        print(
            f"{Path(run).name:28}",
            *shares,
            *levels,
            "n/a" if kept is None else f"{kept:.3f}",
            record["worst view"],
            flush=True,
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
