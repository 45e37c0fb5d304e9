"""Measure the gain of one setting by object: runs with it minus runs without it, paired by scene and seed.

    python benchmarks/accuracy/paired_runs.py --runs RUN... --less RUN... [--record FILE]
    python benchmarks/accuracy/paired_runs.py --record FILE

The runs must have scores (``polarguide eval``). The first table has a line for each scene. For each scene and each of
its objects, the next tables contain means of the differences with twice their standard error over seeds, and the scores
of the layers. They also contain the share of the object's pixels that each run classifies as metal. ``--record`` writes
the scores, or reads them without runs.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polarguide_bench.tables import MINUS

METRICS = ("psnr", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
WHOLE = "all"
DIELECTRICS = "layers without metals"
ONE_PERCENT = 1.0
FOUND_SHARE = 0.5
"""Share of an object's pixels that a run must classify as metal, for the object to count as a found metal."""
Scores = dict[str, dict[str, float | None]]
"""Scores by object, and of the whole scene."""


def scores_of(run: Path) -> tuple[str, str, Scores]:
    """Return scene and seed of a run, and its scores."""
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    configuration = json.loads((run / "run.json").read_text(encoding="utf-8"))
    keys = (*METRICS, "metal_share")
    layers = {key: metrics.get(f"{key}_dielectric") for key in METRICS[2:]}
    parts = {WHOLE: metrics, DIELECTRICS: layers, **metrics["objects"]}
    scores = {name: {key: part.get(key) for key in keys} for name, part in parts.items()}
    return Path(configuration["scene"]).name, str(configuration["settings"]["seed"]), scores


def collected(runs: Sequence[Path]) -> dict[str, dict[str, Scores]]:
    """Return scores by scene and seed."""
    found: dict[str, dict[str, Scores]] = {}
    for run in runs:
        scene, seed, scores = scores_of(run)
        found.setdefault(scene, {})[seed] = scores
    return found


def code_digests(runs: Sequence[Path]) -> list[str]:
    """Return the digests of the code that scored the runs."""
    metrics = (json.loads((run / "metrics.json").read_text(encoding="utf-8")) for run in runs)
    return sorted({each["provenance"]["sources"] for each in metrics})


def difference(having: Sequence[Any], lacking: Sequence[Any]) -> str:
    """Format the mean of the paired differences, and twice their standard error for two or more."""
    if None in (*having, *lacking):
        return ""
    apart = np.subtract(having, lacking)
    error = f" ± {2 * apart.std(ddof=1) / len(apart) ** 0.5:.1f}" if len(apart) > 1 else ""
    return f"{round(float(apart.mean()), 1) + 0.0:+.1f}{error}".replace("-", MINUS)


def table(having: dict[str, Scores], lacking: dict[str, Scores]) -> list[str]:
    """Return the lines of one scene's table, for seeds that both have."""
    seeds = sorted(having.keys() & lacking.keys())
    lines = [
        "| | PSNR | normals | specular | diffuse | specular / diffuse | called metal (%) |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name in having[seeds[0]] if seeds else ():
        a, b = ([by[seed][name] for seed in seeds] for by in (having, lacking))
        cells = [difference([s[key] for s in a], [s[key] for s in b]) for key in METRICS]
        layers = [[s[key] for s in a] for key in METRICS[2:]]
        shown = "" if any(None in of for of in layers) else " / ".join(f"{np.mean(of):.1f}" for of in layers)
        shares = [100 * s["metal_share"] for s in a if s["metal_share"] is not None]
        metal = ", ".join(f"{share:.0f}" if share >= ONE_PERCENT else f"{share:.1f}" for share in shares)
        lines.append(f"| {' | '.join((name, *cells, shown, metal))} |")
    return [f"{len(seeds)} seeds", "", *lines] if seeds else ["no seed that both have"]


def summary(record: dict[str, Any]) -> Iterator[str]:
    """Yield a table by scene: gains of the layers of found metals and of dielectrics, and of the other objects' PSNR.

    Several metals are summarized by their smallest and largest gain. The PSNR is a mean over objects.
    """
    yield (
        "| scene | found metals | specular | diffuse | dielectrics, specular | dielectrics, diffuse "
        "| other objects, PSNR |"
    )
    yield "|---|---|---|---|---|---|---|"
    for scene, runs in record["runs"].items():
        seeds = sorted(runs.keys() & record["less"].get(scene, {}).keys())
        having, lacking = ([record[side][scene][seed] for seed in seeds] for side in ("runs", "less"))
        metals = [
            name
            for name in (having[0] if seeds else ())
            if max(scores[name]["metal_share"] or 0.0 for scores in having) >= FOUND_SHARE
        ]
        if not metals:
            continue
        cells = [str(len(metals))]
        for key in METRICS[2:]:
            gains = sorted(
                float(np.mean([a[name][key] - b[name][key] for a, b in zip(having, lacking, strict=True)]))
                for name in metals
            )
            cells.append(" to ".join(dict.fromkeys(f"{gain:+.1f}" for gain in (gains[0], gains[-1]))))
        for key in METRICS[2:]:
            values = ([scores[DIELECTRICS][key] for scores in side] for side in (having, lacking))
            cells.append(difference(*values))
        others = having[0].keys() - {*metals, WHOLE, DIELECTRICS}
        pictures = (
            [np.mean([scores[name][METRICS[0]] for name in others]) for scores in side]
            for side in (having, lacking)
        )
        cells.append(difference(*pictures))
        yield f"| `{scene}` | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", nargs="+", type=Path, default=[])
    parser.add_argument("--less", nargs="+", type=Path, default=[])
    parser.add_argument("--record", type=Path, default=None)
    options = parser.parse_args()
    if options.runs and options.less:
        record = {
            "runs": collected(options.runs),
            "less": collected(options.less),
            "sources": code_digests([*options.runs, *options.less]),
        }
        if options.record is not None:
            options.record.write_text(json.dumps(record, separators=(",", ":")) + "\n", encoding="utf-8")
    elif options.record is not None and not options.runs and not options.less:
        record = json.loads(options.record.read_text(encoding="utf-8"))
    else:
        parser.error("give both --runs and --less, or a --record alone")
    print(f"Digest of the code: {', '.join(record.get('sources', ['unknown']))}\n")
    print("\n".join(summary(record)))
    for scene, having in record["runs"].items():
        print(f"\n{scene}: " + "\n".join(table(having, record["less"].get(scene, {}))))


if __name__ == "__main__":
    main()
