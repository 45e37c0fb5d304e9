"""``polarguide ablate``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polarguide
from polarguide.cli.compare import Options, Scenes, Settings, print_results
from polarguide.cli.console import JobReporter, use_threads


def ablate(
    scenes: Scenes,
    /,
    *,
    out: Path,
    steps: int | None = None,
    settings: Settings,
    options: Options,
    base: str = "polarguide-stokes",
    only: tuple[str, ...] = (),
    reference: tuple[str, ...] = (),
) -> None:
    """Compare a recipe with its ablations: the same with one thing changed, each.

    It is compare with the recipe and its ablations as rows, and shares runs with a comparison in the same --out.

    Args:
        scenes: Scene folders, as for train.
        out: Folder to write, as for compare.
        steps: Optimizer steps of every run, without it 5,000.
        base: The recipe whose ablations to train.
        only: Names of the ablations to take, such as without-normals; all if none is given.
        reference: Recipes to add as first rows, such as 3dgs-dr.
    """
    use_threads(options.threads)
    results = polarguide.ablate(
        scenes,
        base,
        out,
        only=only,
        reference=reference,
        settings=replace(settings, steps=steps),
        options=options,
        reporter=JobReporter(),
    )
    print_results(results, out)
