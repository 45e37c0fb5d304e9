"""Measure how the constants of the search for metals change its last decision.

Usage: python benchmarks/accuracy/metal_constants.py RUN... [--out benchmarks/records/metal-constants.json]

Each RUN is a finished training of a scene with ground truth of objects. The decision is repeated on the trained
Gaussians with each constant of ``metal_rules`` as it is, halved and doubled. The record contains, for each scene and
setting, the share of the pixels of each object that becomes metal, in percent, over the held-out views.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import torch

import polarguide
from polarguide.core.files import write_text
from polarguide.results.evaluation.evaluate import code_digest
from polarguide.runs.opened import OpenedRun
from polarguide.training.context import TrainingContext
from polarguide.training.metals.observations import blended
from polarguide.training.metals.search import MetalSearch, decide, evidence
from polarguide.training.recipe import MetalRules

RECORD = Path(__file__).resolve().parents[1] / "records" / "metal-constants.json"
ABOUT = (
    "share of each object's pixels (percent, held-out views) that the last decision makes metal, with the constants of "
    "metal_rules as they are, halved and doubled one by one; trainings of 2,500 steps, 128 x 96 pixels, seed 0"
)


def variants(rules: MetalRules) -> dict[str, MetalRules]:
    """Return the rules by setting: as they are, and with each constant halved and doubled."""
    changed = {"as is": rules}
    for field in fields(rules):
        for factor in (0.5, 2.0):
            value = factor * getattr(rules, field.name)
            changed[f"{field.name} {factor:g}"] = replace(rules, **{field.name: value})
    return changed


@torch.no_grad()
def shares_of(run: OpenedRun, rules: MetalRules) -> dict[str, float]:
    """Return the share of each object's pixels that becomes metal with the given rules, in percent."""
    recipe = replace(run.recipe, metal_rules=rules)
    context = TrainingContext(run.scene, recipe, run.configuration.settings, run.model.backend)
    state = run.model.state
    rasterize = run.model.backend.rasterize
    measured = evidence(
        state.gaussians,
        context.views,
        rasterize,
        context.settings.refractive_index,
        rules,
        recipe.metal_views,
    )
    metal = decide(measured, state.gaussians, MetalSearch(context).allowed(state), rules)
    pixels: Counter[str] = Counter()
    found: Counter[str] = Counter()
    for view in run.scene.test_views:
        truth = view.ground_truth
        if truth is None or truth.object_ids is None:
            raise SystemExit(f"{run.folder}: its scene has no ground truth of objects (gt/).")
        share = blended(state.gaussians, metal, view.camera, rasterize)
        for item in run.scene.objects:
            mask = (truth.object_ids == item.id) & ~view.invalid
            pixels[item.name] += int(mask.sum())
            found[item.name] += int((share[mask] > 0.5).sum())
    return {name: round(100 * found[name] / count, 1) for name, count in pixels.items() if count}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=RECORD)
    options = parser.parse_args()
    scenes = {}
    for folder in options.runs:
        run = polarguide.open_run(folder)
        shares = {}
        for setting, rules in variants(run.recipe.metal_rules).items():
            shares[setting] = shares_of(run, rules)
            print(run.scene_folder.name, setting, shares[setting], flush=True)
        scenes[run.scene_folder.name] = shares
    record = {"what": ABOUT, "sources": code_digest(), "scenes": scenes}
    write_text(options.out, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
