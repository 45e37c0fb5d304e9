"""Tune baselines by changing one value at a time, on the development scenes.

Baselines need the same search as our recipes. Each setting is trained at half size with seed 0. Finished trainings are
not repeated. Each recipe has a table: PSNR / foreground / normal error / specular / diffuse. It also contains the gain
in the picture over the unchanged recipe (mean over scenes, PSNR and foreground, in dB).

    python benchmarks/accuracy/tune_baselines.py SCENE... --out FOLDER [--recipes 3dgs ...] [--last N] [--steps 1500]
        [--jobs 2]
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

import polarguide as pg
from polarguide.methods import recipe_named
from polarguide.methods.baselines import RESET
from polarguide.results.evaluation.evaluate import read_metrics
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.directional import DirectionalShading
from polarguide.training.recipe import Recipe, Stage, Weights

SHOWN = ("psnr", "psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
AS_IT_IS = "as it is"


def rates(recipe: Recipe, **factors: float) -> Recipe:
    """Multiply some learning rates by factors."""
    changed = {name: recipe.rates[name] * factor for name, factor in factors.items()}
    return replace(recipe, rates={**recipe.rates, **changed})


def densify(recipe: Recipe, **values: Any) -> Recipe:
    return replace(recipe, densification=replace(recipe.densification, **values))


def shaded(recipe: Recipe, **values: Any) -> Recipe:
    shading = recipe.shading
    assert isinstance(shading, (DeferredShading, DirectionalShading))
    return replace(recipe, shading=replace(shading, **values))


def propagated(recipe: Recipe, **values: Any) -> Recipe:
    return replace(recipe, propagation=replace(recipe.propagation, **values))


def priors(recipe: Recipe, **values: Any) -> Recipe:
    return replace(recipe, priors=replace(recipe.priors, **values))


def staged(recipe: Recipe, **values: Any) -> Recipe:
    return replace(recipe, stages=tuple(replace(stage, **values) for stage in recipe.stages))


def resets(recipe: Recipe) -> Recipe:
    """Reset the opacity together with the density control."""
    stages = (replace(stage, repeats=(RESET,)) if stage.densify else stage for stage in recipe.stages)
    return replace(recipe, stages=tuple(stages))


def weighted(recipe: Recipe, **values: Any) -> Recipe:
    """Change the weights of the active terms."""

    def changed(stage: Stage) -> Stage:
        weights = {name: value for name, value in values.items() if getattr(stage.weights, name) > 0}
        return replace(stage, weights=replace(stage.weights, **weights))

    return replace(recipe, stages=tuple(map(changed, recipe.stages)))


def with_geometry(recipe: Recipe, *, flatness: float, consistency: float) -> Recipe:
    """Enable terms without polarization in the guided stages."""

    def changed(stage: Stage) -> Stage:
        if stage.weights == Weights():
            return stage
        return replace(stage, weights=replace(stage.weights, flatness=flatness, consistency=consistency))

    return replace(recipe, stages=tuple(map(changed, recipe.stages)))


def lengths(recipe: Recipe, **fractions: float) -> Recipe:
    """Change the shares of the stages at the expense of the last but one."""
    stages = [replace(stage, fraction=fractions.get(stage.name, stage.fraction)) for stage in recipe.stages]
    at = max(k for k, stage in enumerate(stages) if stage.name not in fractions)
    rest = 1 - sum(stage.fraction for k, stage in enumerate(stages) if k != at)
    stages[at] = replace(stages[at], fraction=rest)
    return replace(recipe, stages=tuple(stages))


def settings_of(name: str, last: int = 0) -> Mapping[str, Recipe]:
    """Return the settings of a recipe by their change, or only the last of them, with the unchanged recipe."""
    base = recipe_named(name)
    assert isinstance(base, Recipe)
    return {AS_IT_IS: base, **dict([*SETTINGS[name](base).items()][-last:])}


def _of_3dgs(base: Recipe) -> dict[str, Recipe]:
    return {
        "means learn twice as fast": rates(base, means=2),
        "half as fast": rates(base, means=0.5),
        "scales twice as fast": rates(base, log_scales=2),
        "half as fast ": rates(base, log_scales=0.5),
        "rotations three times as fast": rates(base, quaternions=3),
        "ten times as fast": rates(base, quaternions=10),
        "opacities half as fast": rates(base, opacity_logits=0.5),
        "colors twice as fast": rates(base, sh_dc=2, sh_rest=2),
        "harmonics three times as fast": rates(base, sh_rest=3),
        "harmonics from the start": replace(base, sh_fractions=(0.0, 0.01, 0.02)),
        "means decay to a tenth": replace(base, means_decay=0.1),
        "SSIM 0.1": replace(base, ssim_weight=0.1),
        "SSIM 0.4": replace(base, ssim_weight=0.4),
        "density control at half the gradient": densify(base, gradient=1e-4),
        "at twice the gradient": densify(base, gradient=4e-4),
        "for 70 % of the steps": lengths(base, densify=0.7),
        "for 30 %": lengths(base, densify=0.3),
        "no resets": staged(base, repeats=()),
        "SSIM 0.3": replace(base, ssim_weight=0.3),
        "opacities twice as fast": rates(base, opacity_logits=2),
        "base colors twice as fast": rates(base, sh_dc=2),
        "harmonics ten times as fast": rates(base, sh_rest=10),
        "means decay to three tenths": replace(base, means_decay=0.3),
        "half the gradient, for 70 %": lengths(densify(base, gradient=1e-4), densify=0.7),
    }


def _of_3dgs_dr(base: Recipe) -> dict[str, Recipe]:
    propagate = tuple(
        replace(s, rounds=replace(s.rounds, actions=("propagate_normals",))) if s.rounds else s
        for s in base.stages
    )
    return {
        "strength learns twice as fast": shaded(base, strength_rate=1.2e-2),
        "half as fast": shaded(base, strength_rate=3e-3),
        "environment learns twice as fast": shaded(base, environment_rate=0.02),
        "half as fast ": shaded(base, environment_rate=0.005),
        "environment of 16 texels": shaded(base, environment_resolution=16),
        "first strength 0.02": shaded(base, first_strength=0.02),
        "propagated opacity 0.6": propagated(base, opacity=0.6),
        "widened by 1.2": propagated(base, widen=1.2),
        "color noise 0.1": propagated(base, color_noise=0.1),
        "harmonics as 3dgs has them": replace(base, sh_fractions=Recipe.sh_fractions),
        "propagations without resets between them": replace(base, stages=propagate),
        "density control at half the gradient": densify(base, gradient=1e-4),
        "at twice the gradient": densify(base, gradient=4e-4),
        "half the gradient, first strength 0.02": shaded(densify(base, gradient=1e-4), first_strength=0.02),
        "environment of 64 texels": shaded(base, environment_resolution=64),
    }


def _of_ref_gs(base: Recipe) -> dict[str, Recipe]:
    return {
        "MLP of width 128": shaded(base, width=128),
        "of width 32": shaded(base, width=32),
        "MLP learns three times as fast": shaded(base, mlp_rate=4.5e-3),
        "MLP a third as fast": shaded(base, mlp_rate=5e-4),
        "albedo three times as fast": shaded(base, albedo_rate=9e-3),
        "albedo a third as fast": shaded(base, albedo_rate=1e-3),
        "features three times as fast": shaded(base, feature_rate=1.8e-2),
        "features a third as fast": shaded(base, feature_rate=2e-3),
        "grid of 64 texels": shaded(base, environment_resolution=64),
        "of 16 texels": shaded(base, environment_resolution=16),
        "consistency 0.1, flatness 0.3": staged(base, weights=Weights(consistency=0.1, flatness=0.3)),
        "resets as 3dgs has them": resets(base),
        "density control at half the gradient": densify(base, gradient=1e-4),
        "density control for 70 % of the steps": lengths(base, densify=0.7),
        "consistency 0.02, flatness 0.05": staged(base, weights=Weights(consistency=0.02, flatness=0.05)),
        "grid learns three times as fast": shaded(base, environment_rate=3e-2),
    }


def _of_paper_kind(base: Recipe) -> dict[str, Recipe]:
    return {
        "specular 0.3": weighted(base, specular=0.3),
        "specular 0.03": weighted(base, specular=0.03),
        "diffuse 0.15": weighted(base, diffuse=0.15),
        "diffuse 0.02": weighted(base, diffuse=0.02),
        "normal 0.06": weighted(base, normal=0.06),
        "normal 0.2": weighted(base, normal=0.2),
        "normal 0.005": weighted(base, normal=0.005),
        "DoLP over 0.05": priors(base, threshold=0.05),
        "DoLP over 0.2": priors(base, threshold=0.2),
        "full weight at a DoLP of 0.3": priors(base, full_dolp=0.3),
        "final stage 5 %": lengths(base, final=0.05),
        "final stage 30 %": lengths(base, final=0.3),
        "flatness 0.1": with_geometry(base, flatness=0.1, consistency=0.0),
        "flatness 0.1, consistency 0.05": with_geometry(base, flatness=0.1, consistency=0.05),
        "first strength 0.5": shaded(base, first_strength=0.5),
        "strength learns twice as fast": shaded(base, strength_rate=1.2e-2),
        "environment of 16 texels": shaded(base, environment_resolution=16),
        "density control at half the gradient": densify(base, gradient=1e-4),
        "first strength 0.02": shaded(base, first_strength=0.02),
        "first strength 0.1": shaded(base, first_strength=0.1),
        "strength half as fast": shaded(base, strength_rate=3e-3),
        "normal 0.002": weighted(base, normal=0.002),
        "first strength 0.02, normal 0.002": shaded(weighted(base, normal=0.002), first_strength=0.02),
        "normal 0.005, DoLP over 0.05, 16 texels": shaded(
            priors(weighted(base, normal=0.005), threshold=0.05), environment_resolution=16
        ),
    }


SETTINGS = {
    "3dgs": _of_3dgs,
    "3dgs-dr": _of_3dgs_dr,
    "ref-gs": _of_ref_gs,
    "polarguide-paper:kind": _of_paper_kind,
}


def folder_of(out: Path, scene: Path, name: str, setting: str) -> Path:
    words = [scene.name, name, setting]
    return out.joinpath(*(re.sub(r"[^\w.]+", "-", word) for word in words))


def train(job: tuple[Path, Path, str, str, int, int]) -> None:
    """Train and score one setting on one scene."""
    out, scene, name, setting, steps, downscale = job
    torch.set_num_threads(1)
    folder = folder_of(out, scene, name, setting)
    recipe = settings_of(name)[setting]
    if not (folder / "metrics.json").exists():
        loaded = pg.load_scene(scene, downscale=downscale)
        options = pg.TrainSettings(steps=steps, seed=0)
        pg.train(loaded, folder, recipe=recipe, settings=options, resume=folder.exists()).evaluate()
    print(f"{scene.name}, {name}, {setting}", file=sys.stderr, flush=True)


def table(out: Path, scenes: list[Path], name: str, last: int) -> str:
    """Return a table of the settings of a recipe and their scores on each scene."""
    scores = {
        setting: [read_metrics(folder_of(out, scene, name, setting)) for scene in scenes]
        for setting in settings_of(name, last)
    }
    lines = [
        f"| `{name}` | {' | '.join(s.name for s in scenes)} | gain |",
        f"|---|{'---|' * len(scenes)}---|",
    ]

    def picture(record: Mapping[str, Any]) -> float:
        return (record["psnr"] + record["psnr_foreground"]) / 2

    def shown(record: Mapping[str, Any]) -> str:
        return " / ".join("n/a" if record[key] is None else f"{record[key]:.1f}" for key in SHOWN)

    for setting, records in scores.items():
        gains = [picture(r) - picture(b) for r, b in zip(records, scores[AS_IT_IS], strict=True)]
        gain = f"{sum(gains) / len(gains):+.2f}"
        lines.append(f"| {setting.strip()} | {' | '.join(map(shown, records))} | {gain} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recipes", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--last", type=int, default=0, help="this many of each recipe's settings alone; 0: all"
    )
    options = parser.parse_args()
    jobs = [
        (options.out, scene, name, setting, options.steps, options.downscale)
        for name in options.recipes
        for setting in settings_of(name, options.last)
        for scene in options.scenes
    ]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for _ in pool.imap_unordered(train, jobs):
            pass
    for name in options.recipes:
        print(table(options.out, options.scenes, name, options.last) + "\n")


if __name__ == "__main__":
    main()
