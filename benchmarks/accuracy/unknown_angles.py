"""Measure the search for unknown polarizer angles on a capture with known angles.

One picture of each training view remains, at 0, 45, 90 and 135 degrees in turn. ``--choices`` are starting points of
the turn. Then all angles are withheld, or those of one fold of the views at a time (every ``--folds``-th view). With
folds, each angle is withheld once while the others are known. The search is that of ``polarguide train``. Later steps
of the training do not change the angles, so they are left out.

    python benchmarks/accuracy/unknown_angles.py CAPTURE --record FILE [--downscale 2] [--steps 1200]
    python benchmarks/accuracy/unknown_angles.py --record FILE

Each search is recorded at its end, and the same command resumes with the missing ones. Without a capture, the tables of
the record are printed. With an odd number of folds, each fold has pictures at all four angles.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import polarguide
from polarguide.capture import Scene
from polarguide.capture.exposures import FOUR, Exposure
from polarguide.capture.view import View
from polarguide.methods import recipe_named
from polarguide.raster import choose_backend
from polarguide.runs.folder import resolve
from polarguide.training.angles.polarizers import Judgment, gaussian_training
from polarguide.training.context import TrainingContext
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings

RIGHT, ACROSS = 15.0, 45.0
"""Largest error in degrees of a correct angle, and error in degrees beyond which the perpendicular angle is nearer."""


def one_each(scene: Scene, first: int, withheld: Sequence[bool]) -> Scene:
    """Keep one picture of each training view, the first at ``FOUR[first]``, and remove the angles of some."""
    changed = {}
    for k, view in enumerate(scene.train_views):
        place = (k + first) % len(FOUR)
        exposure = Exposure() if withheld[k] else FOUR[place]
        changed[view.name] = replace(view, pictures=view.codes[place : place + 1], exposures=(exposure,))
    views: list[View] = [changed.get(view.name, view) for view in scene.views]
    return replace(scene, views=tuple(views))


def searched(scene: Scene, steps: int) -> list[Judgment]:
    """Search for the angles in a training of ``steps`` steps."""
    recipe = recipe_named("polarguide-stokes")
    assert isinstance(recipe, Recipe)
    settings = resolve(TrainSettings(steps=steps), scene, recipe)
    loop, fits = gaussian_training(TrainingContext(scene, recipe, settings, choose_backend("cpu")))
    while not fits.polarizers.settled:
        loop.step()
    return fits.polarizers.judgments()


def search(scene: Scene, steps: int, first: int, folds: int, fold: int) -> dict[str, Any]:
    """Withhold the angles of a fold and search for them. A single fold has all views. Return a row per picture."""
    withheld = [k % folds == fold for k in range(len(scene.train_views))]
    began = time.perf_counter()
    found = searched(one_each(scene, first, withheld), steps)
    true = {v.name: FOUR[(k + first) % len(FOUR)].angle for k, v in enumerate(scene.train_views)}
    rows = [
        [j.view, true[j.view], round(j.angle, 1), round(j.spread, 1), j.doubtful]
        for j in found
        if not j.specified.known
    ]
    return {"first": first, "folds": folds, "fold": fold, "seconds": round(time.perf_counter() - began),
            "pictures": rows}  # fmt: skip


def summary(searches: Sequence[dict[str, Any]]) -> list[str]:
    """Return cells of a table: pictures, median error, shares, doubtful pictures, and the same of the others."""
    rows = [row for each in searches for row in each["pictures"]]
    errors = np.array([abs((found - true + 90) % 180 - 90) for _, true, found, *_ in rows])
    doubtful = np.array([row[-1] for row in rows], bool)

    def cells(of: np.ndarray) -> list[str]:
        if not len(of):
            return ["-"] * 3
        return [
            f"{np.median(of):.0f}",
            f"{100 * np.mean(of < RIGHT):.0f} %",
            f"{100 * np.mean(of > ACROSS):.0f} %",
        ]

    return [
        str(len(rows)),
        *cells(errors),
        f"{100 * doubtful.mean():.0f} %",
        *cells(errors[~doubtful]),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--record", type=Path, required=True)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--choices", type=int, default=3)
    parser.add_argument("--most", type=int, default=10_000, help="searches to make before it ends")
    options = parser.parse_args()
    record = {"capture": "", "downscale": options.downscale, "steps": options.steps, "searches": []}
    if options.record.exists():
        record = json.loads(options.record.read_text(encoding="utf-8"))
    if options.capture is not None:
        scene = polarguide.load_scene(options.capture, downscale=options.downscale)
        record["capture"] = options.capture.name
        done = {(each["first"], each["folds"], each["fold"]) for each in record["searches"]}
        plan = [(first, 1, 0) for first in range(options.choices)]
        plan += [
            (first, options.folds, fold) for first in range(options.choices) for fold in range(options.folds)
        ]
        for key in [key for key in plan if key not in done][: options.most]:
            record["searches"].append(search(scene, options.steps, *key))
            options.record.write_text(json.dumps(record, separators=(",", ":")) + "\n", encoding="utf-8")
    for name, chosen in (
        ("all angles unknown", [each for each in record["searches"] if each["folds"] == 1]),
        ("the others known", [each for each in record["searches"] if each["folds"] > 1]),
    ):
        for each in chosen if name.startswith("all") else []:
            print(f"| {name}, choice {each['first'] + 1} | {' | '.join(summary([each]))} |")
        if chosen:
            print(f"| {name} | {' | '.join(summary(chosen))} |")


if __name__ == "__main__":
    main()
