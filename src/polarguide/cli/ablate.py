"""``polarguide ablate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.common import Transfer
from polarguide.cli.compare import compare
from polarguide.errors import PolarguideError
from polarguide.raster import DeviceName
from polarguide.recipes import ABLATIONS


def ablate(
    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE ...")],
    /,
    *,
    out: Path,
    base: str = "polarguide",
    only: tuple[str, ...] = (),
    reference: tuple[str, ...] = (),
    steps: int = 5000,
    seeds: int = 1,
    downscale: int = 1,
    transfer: Transfer = "linear",
    refractive_index: float = 1.5,
    jobs: int = 0,
    threads: int = 1,
    speed: bool = False,
    report_views: int = 3,
    device: DeviceName = "auto",
) -> None:
    """Compare a recipe with its ablations: the same with one thing changed, each.

    It is compare with the recipe and its ablations as rows, and shares runs with a comparison in the same --out.

    Args:
        scenes: Scene folders, as for train.
        out: Folder to write, as for compare.
        base: The recipe whose ablations to train.
        only: Names of the ablations to take, such as without-normals; all if none is given.
        reference: Recipes to add as first rows, such as 3dgs-dr.
        steps: Optimizer steps of each run.
        seeds: How many seeds: 3 trains with the seeds 0, 1 and 2, and shows mean and spread.
        downscale: Average the pictures over boxes of this many pixels first.
        transfer: How the files encode radiance; srgb undoes the display curve of JPEGs.
        refractive_index: Of the surfaces: 1.5 for glass, plastic and glaze, 1.33 for water.
        jobs: Runs at a time; 0 takes as many as there are cores for their threads. Times are measured only with 1.
        threads: Threads of each run.
        speed: With --speed at the end time pictures, one run after the other, where that was not done alone before.
        report_views: Test views of each scene in the report; 0 leaves the pictures out.
        device: What to compute on.
    """
    compare(
        scenes,
        recipes=(*reference, *ablated(base, only)),
        out=out,
        steps=steps,
        seeds=seeds,
        downscale=downscale,
        transfer=transfer,
        refractive_index=refractive_index,
        jobs=jobs,
        threads=threads,
        speed=speed,
        report_views=report_views,
        device=device,
    )


def ablated(base: str, only: tuple[str, ...] = ()) -> tuple[str, ...]:
    """The names of a recipe and of its ablations, or of those of them that are in ``only``.

    Args:
        base: a recipe.
        only: ablations with or without ``base:`` before the name; all if empty.

    Raises:
        PolarguideError: a recipe without ablations, or an ablation that it does not have.
    """
    if base not in ABLATIONS:
        raise PolarguideError(
            "--base",
            expected="a recipe with ablations: " + ", ".join(ABLATIONS),
            found=base,
            remedy="Take one of these, or use compare.",
        )
    names = [recipe.name for recipe in ABLATIONS[base]]
    wanted = [name if name.startswith(f"{base}:") else f"{base}:{name}" for name in only]
    for name, full in zip(only, wanted, strict=True):
        if full not in names:
            raise PolarguideError(
                "--only",
                expected="one of " + ", ".join(n.partition(":")[2] for n in names),
                found=name,
                remedy="Correct the name.",
            )
    return (base, *(name for name in names if not only or name in wanted))
