"""Check that polarization never hurts: compare a recipe of a bench's records with the best row without polarization.

Each metric of a scene is compared with the best row without polarization in that metric: the baselines of --against and
the recipe's controls. The comparison is of means over seeds, with a benefit of doubt of twice the standard error over
common seeds. That benefit is at most 0.1 dB or 0.2 degrees, and has this size for fewer than two common seeds. A
difference is a loss below -0.15 dB (picture, foreground), below -0.2 dB (layers), or above +0.3 degrees.

Scenes with metals are compared by object, and metals only by picture and normals. For comparison, the losses of each
row without polarization are counted by the same rule against the best of the others. Further tables show the gains
over all scenes, views with haze or fog, and views that show more from behind the true surface than the best other row.

    python benchmarks/accuracy/never_hurts.py benchmarks/results/bench/*.json

The exit status is 1 after a loss.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.results.evaluation.table import METRICS
from polarguide_bench.results import read_results

PICTURE = {"psnr": 0.15, "psnr_foreground": 0.15}
LAYERS = {"specular_psnr": 0.2, "diffuse_psnr": 0.2}
NORMALS = {"normal_mae_deg": 0.3}
ALLOWED = {**PICTURE, **NORMALS, **LAYERS}
"""Tolerated losses against the best row without polarization: dB, degrees."""
LARGEST_ERROR = {"dB": 0.1, "deg": 0.2}
MOST_HAZE = 0.02
MOST_OUTSIDE = 0.01
MORE_BEYOND = 0.03
VIEW_LOSS = 2.0
METALS = ("metal", "rough metal")
BY_KEY = {metric.key: metric for metric in METRICS}
Runs = Mapping[str, Mapping[int, Any]]


@dataclass(frozen=True)
class Judged:
    """A metric of a scene or an object: our value, the best row without polarization, and the difference."""

    where: str
    key: str
    ours: float
    best: str
    theirs: float
    gain: float
    error: float

    @property
    def lost(self) -> bool:
        """Return True for a loss beyond the tolerance."""
        return self.gain + self.error < -ALLOWED[self.key]

    def line(self) -> str:
        """Format a row of a table."""
        metric = BY_KEY[self.key]
        cells = [self.where, metric.label, f"{self.ours:.2f}", f"{self.theirs:.2f} `{self.best}`"]
        sign = self.gain if metric.better == "higher" else -self.gain
        return f"| {' | '.join([*cells, f'{sign:+.2f} {metric.unit}', 'worse' if self.lost else ''])} |"


def judge(where: str, key: str, rows: Runs, recipe: str, others: Sequence[str], value: Any) -> Judged | None:
    """Compare a metric with the best of the other rows; None without a value.

    Args:
        rows: runs by recipe and seed.
        value: returns the value of a run or None.
    """
    values = {
        name: {seed: found for seed, run in rows[name].items() if (found := value(run)) is not None}
        for name in (recipe, *others)
        if name in rows
    }
    if not values.get(recipe):
        return None
    up = 1.0 if BY_KEY[key].better == "higher" else -1.0
    ours = statistics.fmean(values[recipe].values())
    means = {name: statistics.fmean(v.values()) for name, v in values.items() if name != recipe and v}
    if not means:
        return None
    best = max(means, key=lambda name: up * means[name])
    common = sorted(set(values[recipe]) & set(values[best]))
    differences = [values[recipe][seed] - values[best][seed] for seed in common]
    most = LARGEST_ERROR[BY_KEY[key].unit]
    error = most
    if len(common) > 1:
        error = min(most, 2 * statistics.stdev(differences) / math.sqrt(len(common)))
    return Judged(where, key, ours, best, means[best], up * (ours - means[best]), error)


def scene_runs(record: Mapping[str, Any], scene: str) -> dict[str, dict[int, Any]]:
    """Return the finished runs of a scene by recipe and seed."""
    found: dict[str, dict[int, Any]] = {}
    for run in record["runs"]:
        if run["scene"] == scene and run["state"] == "done":
            found.setdefault(run["recipe"], {})[run["seed"]] = run
    return found


def judged_scene(scene: str, rows: Runs, recipe: str, others: Sequence[str]) -> Iterator[Judged]:
    """Return all comparisons of a scene. A scene with metals is compared by object and as a whole picture."""
    parts = next(iter(rows[recipe].values()))["objects"]
    metals = any(part["material"] in METALS for part in parts.values())
    for key in PICTURE if metals else ALLOWED:
        found = judge(scene, key, rows, recipe, others, lambda run, key=key: run["metrics"][key])
        if found is not None:
            yield found
    for name, part in parts.items() if metals else ():
        keys = ("psnr", *NORMALS) if part["material"] in METALS else ("psnr", *NORMALS, *LAYERS)
        for key in keys:

            def of_part(run: Any, name: str = name, key: str = key) -> float | None:
                return run["objects"].get(name, {"metrics": {}})["metrics"].get(key)

            found = judge(f"{scene}, {name}", key, rows, recipe, others, of_part)
            if found is not None:
                yield found


def all_judged(scenes: Mapping[str, Runs], recipe: str, others: Sequence[str]) -> list[Judged]:
    """Return all comparisons of all scenes with runs of the recipe."""
    return [
        found
        for scene, rows in scenes.items()
        if recipe in rows
        for found in judged_scene(scene, rows, recipe, others)
    ]


def mean_gains(scenes: Mapping[str, Runs], recipe: str, other: str) -> str:
    """Format the mean gain of the recipe: geometric mean of normals, layers without the pixels of metals."""

    def mean(key: str, combine: Callable[[float, float], float]) -> float:
        gains = []
        for rows in scenes.values():
            if recipe in rows and other in rows:
                ours, theirs = (
                    [v for run in rows[name].values() if (v := run["metrics"][key]) is not None]
                    for name in (recipe, other)
                )
                if ours and theirs:
                    gains.append(combine(statistics.fmean(ours), statistics.fmean(theirs)))
        return statistics.fmean(gains) if gains else math.nan

    def less(a: float, b: float) -> float:
        return a - b

    def layer(name: str) -> float:
        whole = mean(f"{name}_psnr_dielectric", less)
        return mean(f"{name}_psnr", less) if math.isnan(whole) else whole

    normals = math.exp(mean("normal_mae_deg", lambda a, b: math.log(a / b)))
    cells = [f"{mean('psnr', less):+.2f}", f"{mean('psnr_foreground', less):+.2f}", f"x {normals:.2f}"]
    return f"| {' | '.join([f'`{other}`', *cells, *(f'{layer(n):+.2f}' for n in ('specular', 'diffuse'))])} |"


def bad_views(scene: str, rows: Runs, recipe: str) -> Iterator[str]:
    """Yield a line for each view with haze, with fog outside the mask, or far worse than plain splatting."""
    for seed, run in rows[recipe].items():
        for view, scores in run["views"].items():
            for key, most in (("haze_free", MOST_HAZE), ("alpha_outside", MOST_OUTSIDE)):
                if (scores.get(key) or 0.0) > most:
                    yield f"{scene}, seed {seed}, {view}: {BY_KEY[key].label} {100 * scores[key]:.1f} %"
            peers = [
                rows[name][0]["views"][view]["psnr"]
                for name in ("3dgs", "3dgs-dr")
                if 0 in rows.get(name, {})
            ]
            if seed == 0 and peers and scores["psnr"] < max(peers) - VIEW_LOSS:
                yield f"{scene}, {view}: {scores['psnr']:.1f} dB where plain splatting has {max(peers):.1f}"


def drawn_through(scene: str, rows: Runs, recipe: str, others: Sequence[str]) -> Iterator[str]:
    """Yield views that show more from behind the true surface than the best other row, in means over seeds."""

    def beyond(name: str, view: str) -> float | None:
        known = [run["views"][view].get("depth_beyond") for run in rows.get(name, {}).values()]
        return statistics.fmean(known) if known and None not in known else None

    for view in next(iter(rows[recipe].values()))["views"]:
        ours = beyond(recipe, view)
        theirs = {name: share for name in others if (share := beyond(name, view)) is not None}
        if ours is None or not theirs:
            continue
        best = min(theirs, key=lambda name: theirs[name])
        if ours > theirs[best] + MORE_BEYOND:
            yield f"{scene}, {view}: depth beyond {100 * ours:.1f} % for {100 * theirs[best]:.1f} % of `{best}`"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, nargs="+", help="results.json of polarguide bench or compare")
    parser.add_argument("--recipe", default="polarguide-stokes")
    parser.add_argument("--against", nargs="+", default=["3dgs-dr", "3dgs-dr:consistent"])
    parser.add_argument("--all", action="store_true", help="every comparison, not the losses alone")
    options = parser.parse_args()
    recipe = options.recipe
    controls = [f"{recipe}:unpolarized", f"{recipe}:unpolarized-without-consistency"]
    scenes: dict[str, Runs] = {}
    for path in options.records:
        try:
            record = msgspec.to_builtins(read_results(path))
        except PolarguideError as error:
            parser.error(str(error))
        for name in (known["name"] for known in record["scenes"]):
            runs = scene_runs(record, name)
            if recipe in runs:
                scenes[name] = runs
    rows_without = [*options.against, *controls]
    judged = all_judged(scenes, recipe, rows_without)
    losses = [found for found in judged if found.lost]
    print(
        "| where | metric | value | best without polarization | difference | |\n|---|---|---:|---:|---:|---|"
    )
    for found in judged if options.all else losses:
        print(found.line())
    print(f"\n{len(losses)} of {len(judged)} comparisons on {len(scenes)} scenes are losses.\n")
    print("| row without polarization | losses | pictures | normals | layers |\n|---|---:|---:|---:|---:|")
    for name in (recipe, *rows_without):
        lost = [f for f in all_judged(scenes, name, [r for r in rows_without if r != name]) if f.lost]
        kinds = [sum(found.key in kind for found in lost) for kind in (PICTURE, NORMALS, LAYERS)]
        print(f"| `{name}` | {' | '.join(map(str, (len(lost), *kinds)))} |")
    print()
    print("| over | PSNR (dB) | foreground (dB) | normals | specular (dB) | diffuse (dB) |")
    print("|---|---:|---:|---:|---:|---:|")
    for other in rows_without:
        if any(other in rows for rows in scenes.values()):
            print(mean_gains(scenes, recipe, other))
    print()
    for scene, rows in scenes.items():
        for line in (
            *bad_views(scene, rows, recipe),
            *drawn_through(scene, rows, recipe, rows_without),
        ):
            print(line)
    sys.exit(1 if losses else 0)


if __name__ == "__main__":
    main()
