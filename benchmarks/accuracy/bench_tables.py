"""Write short Markdown tables of a bench's records: rows by scene, gain by polarization, and errors by object.

The tables of polarguide bench and polarguide tables contain every metric. These tables contain the nine metrics of the
documentation. The records have the same code and options, with one or more scenes each.

    python benchmarks/accuracy/bench_tables.py benchmarks/results/bench/*.json > tables.md
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from scipy import stats

from polarguide.core.errors import PolarguideError
from polarguide.results.evaluation.table import METRICS, OBJECT_METRICS
from polarguide_bench.results import read_results

BY_KEY = {metric.key: metric for metric in METRICS}
COLUMNS = {
    "psnr": "PSNR",
    "psnr_foreground": "foreground",
    "normal_mae_deg": "normal error (deg)",
    "specular_psnr": "specular PSNR",
    "diffuse_psnr": "diffuse PSNR",
    "stokes_error": "Stokes error",
    "depth_error_median_percent": "depth error (%)",
    "depth_beyond": "depth beyond (%)",
    "mesh_fscore_1": "mesh F-score 1 % (%)",
}
WITHOUT_METALS = {
    "specular_psnr_dielectric": "specular PSNR without metals",
    "diffuse_psnr_dielectric": "diffuse PSNR without metals",
}
RECIPE, BASELINE = "polarguide-stokes", "3dgs-dr"
CONTROLS = (f"{RECIPE}:unpolarized", f"{RECIPE}:unpolarized-without-consistency")
Value = Callable[[Any], float | None]
Seeds = Mapping[int, Any]
Rows = Mapping[str, Seeds]


def values(seeds: Seeds, value: Value) -> dict[int, float]:
    """Return the values of a metric by seed, for seeds with a value."""
    return {seed: found for seed, run in seeds.items() if (found := value(run)) is not None}


def of_run(key: str) -> Value:
    """Return a function that reads a metric of a run."""
    return lambda run: run["metrics"].get(key)


def of_object(name: str, key: str) -> Value:
    """Return a function that reads a metric of an object of a run."""
    return lambda run: run["objects"].get(name, {"metrics": {}})["metrics"].get(key)


def number(key: str, known: list[float]) -> str:
    """Format a mean, with the standard deviation of several values."""
    metric = BY_KEY[key]
    if not known:
        return "n/a"
    mean = f"{metric.factor * statistics.fmean(known):.{metric.digits}f}"
    return mean if len(known) < 2 else f"{mean} ± {metric.factor * statistics.stdev(known):.{metric.digits}f}"


def better_control(key: str, rows: Rows, value: Value) -> str | None:
    """Return the control that is better in a metric; None without a value."""
    means = {
        name: statistics.fmean(v) for name in CONTROLS if (v := values(rows.get(name, {}), value).values())
    }
    pick = max if BY_KEY[key].better == "higher" else min
    return pick(means, key=lambda name: means[name]) if means else None


def gain(key: str, rows: Rows) -> str:
    """Format the difference of the recipe to the better of its controls, with the 95 % interval over common seeds."""
    value = of_run(key)
    control = better_control(key, rows, value)
    if control is None:
        return ""
    ours, theirs = values(rows[RECIPE], value), values(rows[control], value)
    differences = [
        BY_KEY[key].factor * (ours[seed] - theirs[seed]) for seed in sorted(set(ours) & set(theirs))
    ]
    if not differences:
        return ""
    digits, mean = BY_KEY[key].digits, statistics.fmean(differences)
    if len(differences) < 2:
        return f"{mean:+.{digits}f}"
    count = len(differences)
    half = float(stats.t.ppf(0.975, count - 1)) * statistics.stdev(differences) / math.sqrt(count)
    return f"{mean:+.{digits}f} ({mean - half:.{digits}f} to {mean + half:.{digits}f})"


def scene_table(rows: Rows) -> Iterator[str]:
    """Yield a table of all recipes of a scene."""
    shown = [key for key in COLUMNS if any(values(seeds, of_run(key)) for seeds in rows.values())]
    yield f"| recipe | {' | '.join(COLUMNS[key] for key in shown)} | seeds |"
    yield f"|---|{'---:|' * (len(shown) + 1)}"
    for name, seeds in rows.items():
        cells = (number(key, list(values(seeds, of_run(key)).values())) for key in shown)
        yield f"| `{name}` | {' | '.join(cells)} | {len(seeds)} |"


def mean_table(scenes: Mapping[str, Rows]) -> Iterator[str]:
    """Yield a table of all recipes over all scenes with equal weights. Each column has the scenes of all recipes."""
    names = dict.fromkeys(name for rows in scenes.values() for name in rows)
    yield f"| recipe | {' | '.join(COLUMNS.values())} |"
    yield f"|---|{'---:|' * len(COLUMNS)}"
    for name in names:
        cells = []
        for key in COLUMNS:
            of_scene = [list(values(rows.get(name, {}), of_run(key)).values()) for rows in scenes.values()]
            known = all(of_scene)
            cells.append(number(key, [statistics.fmean(map(statistics.fmean, of_scene))] if known else []))
        yield f"| `{name}` | {' | '.join(cells)} |"


def gain_table(scenes: Mapping[str, Rows]) -> Iterator[str]:
    """Yield a table of the gain by polarization on each scene."""
    columns = {**COLUMNS, **WITHOUT_METALS}
    yield f"| scene | {' | '.join(columns.values())} |"
    yield f"|---|{'---|' * len(columns)}"
    for scene, rows in scenes.items():
        if RECIPE in rows:
            yield f"| `{scene}` | {' | '.join(gain(key, rows) for key in columns)} |"


def object_table(rows: Rows) -> Iterator[str]:
    """Yield a table of the objects of a scene: the baseline, the better of the controls, and the recipe."""
    yield f"| object | material | {' | '.join(BY_KEY[key].heading for key in OBJECT_METRICS)} |"
    yield f"|---|---|{'---|' * len(OBJECT_METRICS)}"
    for name, part in next(iter(rows[RECIPE].values()))["objects"].items():
        cells = []
        for key in OBJECT_METRICS:
            value = of_object(name, key)
            three = (BASELINE, better_control(key, rows, value), RECIPE)
            found = [list(values(rows.get(row or "", {}), value).values()) for row in three]
            digits = BY_KEY[key].digits
            cells.append(" / ".join(f"{statistics.fmean(v):.{digits}f}" if v else "n/a" for v in found))
        yield f"| {name} | {part['material']} | {' | '.join(cells)} |"


def read_scenes(paths: list[Path]) -> dict[str, dict[str, dict[int, Any]]]:
    """Return the finished runs of all records by scene, recipe and seed, in the order of the records.

    Raises:
        PolarguideError: a file is not a record.
    """
    scenes: dict[str, dict[str, dict[int, Any]]] = {}
    for path in paths:
        record = msgspec.to_builtins(read_results(path))
        for recipe in record["recipes"]:
            for run in record["runs"]:
                if run["recipe"] == recipe["name"] and run["state"] == "done":
                    rows = scenes.setdefault(run["scene"], {})
                    rows.setdefault(run["recipe"], {})[run["seed"]] = run
    return scenes


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, nargs="+", help="results.json of polarguide bench or compare")
    options = parser.parse_args()
    try:
        scenes = read_scenes(options.records)
    except PolarguideError as error:
        parser.error(str(error))
    print("## Mean over scenes\n", *mean_table(scenes), sep="\n", end="\n\n")
    print("## Gain by polarization\n", *gain_table(scenes), sep="\n", end="\n\n")
    for scene, rows in scenes.items():
        print(f"## {scene}\n", *scene_table(rows), sep="\n", end="\n\n")
        if RECIPE in rows:
            print(*object_table(rows), sep="\n", end="\n\n")


if __name__ == "__main__":
    main()
