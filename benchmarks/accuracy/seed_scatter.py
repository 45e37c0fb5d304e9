"""Print how much differences between two recipes vary with the seed, and how much of it pairing removes.

    python benchmarks/accuracy/seed_scatter.py benchmarks/results/final/*/*.json

A pair consists of a recipe and one of its controls, which have at least three common seeds on a scene. The tables are
in docs/explanation/statistics.md, which explains them, and KNOWN_SCATTER of polarguide_bench has the values.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from bench_records import BY_KEY, Scenes, Seeds, of_run, read_scenes, values

from polarguide.core.errors import PolarguideError, require
from polarguide_bench.results import KNOWN_SCATTER, LEAST_UNITS, NORMAL_QUANTILE, controlled

PAIRED = ("psnr", "psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
"""Metrics of the table of pairing."""
Pair = tuple[str, Seeds, Seeds]
"""Scene, runs of a recipe, and runs of its control."""


def pairs_of(scenes: Scenes) -> list[Pair]:
    """Return all pairs with enough common seeds."""
    return [
        (scene, rows[recipe], rows[control])
        for scene, rows in scenes.items()
        for recipe, controls in controlled(list(rows)).items()
        for control in controls
        if recipe in rows and len(rows[recipe].keys() & rows[control].keys()) >= LEAST_UNITS
    ]


def pairs_of_records(paths: Iterable[Path]) -> list[Pair]:
    """Return the pairs of all records. Two records may have different scenes with the same name.

    Raises:
        PolarguideError: a file is not a record.
    """
    return [pair for path in paths for pair in pairs_of(read_scenes([path]))]


def differences(pair: Pair, key: str) -> list[float]:
    """Return the differences of a metric at common seeds."""
    _, of, other = pair
    ours, theirs = values(of, of_run(key)), values(other, of_run(key))
    return [ours[seed] - theirs[seed] for seed in sorted(ours.keys() & theirs.keys())]


def scatters(pairs: Iterable[Pair], key: str) -> list[float]:
    """Return the standard deviation over seeds of the differences, for each pair that has the metric."""
    found = (differences(pair, key) for pair in pairs)
    return [statistics.stdev(d) for d in found if len(d) >= LEAST_UNITS]


def typical_scatter(pairs: Iterable[Pair], key: str) -> float:
    """Return the scatter of a metric: the root of the mean variance over all pairs."""
    return math.sqrt(statistics.fmean(scatter**2 for scatter in scatters(pairs, key)))


def beyond(pairs: Iterable[Pair], key: str, scatter: float) -> float:
    """Return the share of single differences that a test with this scatter would wrongly mark.

    These are farther from the mean of their pair than ``NORMAL_QUANTILE`` scatters. Deviations from a mean of few
    values are smaller than those from the true mean. They are enlarged accordingly.
    """
    found = [d for pair in pairs if len(d := differences(pair, key)) >= LEAST_UNITS]
    deviations = [
        (value - statistics.fmean(d)) * math.sqrt(len(d) / (len(d) - 1)) for d in found for value in d
    ]
    return statistics.fmean(abs(deviation) > NORMAL_QUANTILE * scatter for deviation in deviations)


def left_by_views(pair: Pair, key: str) -> Iterator[float]:
    """Yield the share of the variance over views that pairing leaves, for each common seed with values by view."""
    _, of, other = pair
    for seed in sorted(of.keys() & other.keys()):
        ours, theirs = by_view(of[seed], key), by_view(other[seed], key)
        views = sorted(ours.keys() & theirs.keys())
        if len(views) >= LEAST_UNITS:
            alone = statistics.variance(ours[view] for view in views)
            alone += statistics.variance(theirs[view] for view in views)
            yield statistics.variance(ours[view] - theirs[view] for view in views) / alone


def by_view(run: Mapping[str, Any], key: str) -> dict[str, float]:
    """Return the values of a metric by view."""
    return {view: of[key] for view, of in (run["views"] or {}).items() if of.get(key) is not None}


def left_by_seeds(pairs: Iterable[Pair], key: str) -> float:
    """Return the share of the variance over seeds that pairing leaves, from the sums of variances of all pairs."""
    paired, alone = 0.0, 0.0
    for pair in pairs:
        found = differences(pair, key)
        if len(found) >= LEAST_UNITS:
            paired += statistics.variance(found)
            alone += sum(statistics.variance(values(seeds, of_run(key)).values()) for seeds in pair[1:])
    return paired / alone


def rounded(value: float) -> float:
    """Return a number with two significant digits."""
    return float(f"{value:.2g}")


def scatter_table(pairs: Sequence[Pair]) -> Iterator[str]:
    """Yield a table of the scatter of each metric, of its range over pairs, and of the differences beyond it."""
    yield "| metric | unit | scatter | smallest | largest | wrongly marked (%) |"
    yield "|---|---|---:|---:|---:|---:|"
    for key in KNOWN_SCATTER:
        scatter = rounded(typical_scatter(pairs, key))
        found = scatters(pairs, key)
        cells = (f"{value:g}" for value in (scatter, rounded(min(found)), rounded(max(found))))
        unit = BY_KEY[key].unit if BY_KEY[key].factor == 1 else "share"
        yield f"| `{key}` | {unit} | {' | '.join(cells)} | {100 * beyond(pairs, key, scatter):.0f} |"


def pairing_table(pairs: Sequence[Pair]) -> Iterator[str]:
    """Yield a table of the variance that pairing leaves, in percent of the variance of two independent runs."""
    yield f"| remaining variance (%) | {' | '.join(BY_KEY[key].label for key in PAIRED)} |"
    yield f"|---|{'---:|' * len(PAIRED)}"
    views = (
        statistics.median(chain.from_iterable(left_by_views(pair, key) for pair in pairs)) for key in PAIRED
    )
    yield f"| by view | {' | '.join(f'{100 * value:.0f}' for value in views)} |"
    yield f"| by seed | {' | '.join(f'{100 * left_by_seeds(pairs, key):.0f}' for key in PAIRED)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, nargs="+", help="results.json of polarguide compare")
    options = parser.parse_args()
    try:
        pairs = pairs_of_records(options.records)
        require(
            pairs,
            "records",
            expected=f"a recipe and its control with {LEAST_UNITS} common seeds",
            found="none",
            remedy="Run polarguide compare with --seeds 3.",
        )
    except PolarguideError as error:
        parser.error(str(error))
    named = dict.fromkeys(scene for scene, *_ in pairs)
    print(f"{len(pairs)} pairs of these scenes: {', '.join(named)}.\n")
    print(*scatter_table(pairs), "", *pairing_table(pairs), sep="\n")


if __name__ == "__main__":
    main()
