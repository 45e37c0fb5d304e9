"""Print the tables of a bench's records: losses, means over scenes, gain by polarization, scenes and objects.

The losses against recipes without polarization are first. The tables of polarguide compare and polarguide tables
contain every metric. These tables contain the metrics of the documentation. A column without any value is left out.

    python benchmarks/accuracy/bench_tables.py benchmarks/results/final/bench/*.json > tables.md
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench_records import (
    BY_KEY,
    Rows,
    Scenes,
    Value,
    by_scene,
    code_versions,
    objects_of,
    of_material,
    of_object,
    of_run,
    read_scenes,
    values,
)
from losses import LAYERS, METALS, NORMALS, bad_views, gain_table, loss_tables, without_polarization
from scipy import stats

from polarguide.core.errors import PolarguideError, require
from polarguide.results.evaluation.table import OBJECT_METRICS

COLUMNS = {
    "psnr": "PSNR",
    "psnr_seen": "PSNR of seen pixels",
    "psnr_foreground": "foreground",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "flip": "FLIP",
    "normal_mae_deg": "normal error (deg)",
    "specular_psnr": "specular PSNR",
    "diffuse_psnr": "diffuse PSNR",
    "specular_psnr_dielectric": "specular PSNR without metals",
    "diffuse_psnr_dielectric": "diffuse PSNR without metals",
    "stokes_error": "Stokes error",
    "depth_error_median_percent": "depth error (%)",
    "depth_beyond": "depth beyond (%)",
    "mesh_fscore_1": "mesh F-score 1 % (%)",
    "fps": "frames per second",
    "train_seconds": "training (s)",
}
"""Heading of each metric in the tables of scenes and means."""
RECIPE = "polarguide-stokes"
BASELINE = "3dgs-dr"
FALSE_METAL = 1.0
"""Share of a dielectric that is metal, in percent, above which it is listed."""
CONTROLS = (f"{RECIPE}:unpolarized", f"{RECIPE}:unpolarized-without-consistency")


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
    columns = shown_columns({"": rows})
    yield f"| recipe | {' | '.join(columns.values())} | seeds |"
    yield f"|---|{'---:|' * (len(columns) + 1)}"
    for name, seeds in rows.items():
        cells = (number(key, list(values(seeds, of_run(key)).values())) for key in columns)
        yield f"| `{name}` | {' | '.join(cells)} | {len(seeds)} |"


def mean_table(scenes: Scenes) -> Iterator[str]:
    """Yield a table of all recipes over all scenes with equal weights. Each column has the scenes of all recipes."""
    names = dict.fromkeys(name for rows in scenes.values() for name in rows)
    columns = shown_columns(scenes)
    yield f"| recipe | {' | '.join(columns.values())} |"
    yield f"|---|{'---:|' * len(columns)}"
    for name in names:
        cells = []
        for key in columns:
            of_scene = [list(values(rows.get(name, {}), of_run(key)).values()) for rows in scenes.values()]
            known = all(of_scene)
            cells.append(number(key, [statistics.fmean(map(statistics.fmean, of_scene))] if known else []))
        yield f"| `{name}` | {' | '.join(cells)} |"


def control_table(scenes: Scenes) -> Iterator[str]:
    """Yield a table of the gain by polarization on each scene."""
    columns = {key: heading for key, heading in shown_columns(scenes).items() if not BY_KEY[key].timed}
    yield f"| scene | {' | '.join(columns.values())} |"
    yield f"|---|{'---|' * len(columns)}"
    for scene, rows in scenes.items():
        if RECIPE in rows:
            yield f"| `{scene}` | {' | '.join(gain(key, rows) for key in columns)} |"


def material_table(scenes: Scenes) -> Iterator[str]:
    """Yield a table of the materials: means over scenes of the baseline, the first control, and the recipe."""
    keys = (*NORMALS, *LAYERS)
    parts = [part for rows in scenes.values() if RECIPE in rows for part in objects_of(rows, RECIPE).values()]
    yield f"| material | {' | '.join(COLUMNS[key] for key in keys)} |"
    yield f"|---|{'---|' * len(keys)}"
    for material in dict.fromkeys(part["material"] for part in parts):
        cells = []
        for key in keys:
            value = of_material(material, key)
            means = [by_scene(scenes, recipe, value).values() for recipe in (BASELINE, CONTROLS[0], RECIPE)]
            cells.append(" / ".join(number(key, [statistics.fmean(of)] if of else []) for of in means))
        yield f"| {material} | {' | '.join(cells)} |"


def object_table(rows: Rows) -> Iterator[str]:
    """Yield a table of the objects of a scene: the baseline, the better of the controls, and the recipe."""
    yield f"| object | material | {' | '.join(BY_KEY[key].heading for key in OBJECT_METRICS)} |"
    yield f"|---|---|{'---|' * len(OBJECT_METRICS)}"
    for name, part in objects_of(rows, RECIPE).items():
        cells = []
        for key in OBJECT_METRICS:
            value = of_object(name, key)
            three = (BASELINE, better_control(key, rows, value), RECIPE)
            found = [list(values(rows.get(row or "", {}), value).values()) for row in three]
            digits = BY_KEY[key].digits
            cells.append(" / ".join(f"{statistics.fmean(v):.{digits}f}" if v else "n/a" for v in found))
        yield f"| {name} | {part['material']} | {' | '.join(cells)} |"


def metal_table(scenes: Scenes) -> Iterator[str]:
    """Yield a table of the metals of each scene, and of dielectrics of which at least ``FALSE_METAL`` is metal.

    Shares of pixels have one value per seed. Layers are means over the seeds of the first control and the recipe.
    """
    yield "| scene | object | material | metal (%) | undecided (%) | specular (dB) | diffuse (dB) |"
    yield "|---|---|---|---|---|---|---|"
    for scene, rows in scenes.items():
        for name, part in objects_of(rows, RECIPE).items():
            found = shares(rows, name, "metal_share")
            if not found or (part["material"] not in METALS and max(found) < FALSE_METAL):
                continue
            cells = [", ".join(f"{share:.0f}" for share in found)]
            cells.append(", ".join(f"{share:.0f}" for share in shares(rows, name, "undecided_share")))
            for key in LAYERS:
                pair = [
                    values(rows.get(of, {}), of_object(name, key)).values() for of in (CONTROLS[0], RECIPE)
                ]
                cells.append(" / ".join(f"{statistics.fmean(v):.1f}" if v else "n/a" for v in pair))
            yield f"| `{scene}` | {name} | {part['material']} | {' | '.join(cells)} |"
        falsely = [
            f"{100 * share:.1f}" for share in map(false_metal, rows[RECIPE].values()) if share is not None
        ]
        if falsely:
            yield f"| `{scene}` | all dielectrics | | {', '.join(falsely)} | | | |"


def shares(rows: Rows, name: str, key: str) -> list[float]:
    """Return a share of the pixels of an object in percent, by seed."""
    return [100 * share for share in values(rows[RECIPE], of_object(name, key)).values()]


def false_metal(run: Any) -> float | None:
    """Return the share of the pixels of all dielectrics of a run that are metal; None without dielectrics."""
    parts = [part for material, part in (run["materials"] or {}).items() if material not in METALS]
    known = [part for part in parts if part["metrics"].get("metal_share") is not None]
    pixels = sum(part["pixels"] for part in known)
    return sum(part["pixels"] * part["metrics"]["metal_share"] for part in known) / pixels if pixels else None


def shown_columns(scenes: Scenes) -> dict[str, str]:
    """Return the columns in which any run has a value."""
    runs = [run for rows in scenes.values() for seeds in rows.values() for run in seeds.values()]
    return {
        key: heading for key, heading in COLUMNS.items() if any(of_run(key)(run) is not None for run in runs)
    }


def tables(scenes: Scenes, others: Sequence[str]) -> Iterator[str]:
    """Yield all tables. Losses are counted against the recipes ``others``, which have no polarization.

    Scenes without runs of the default recipe have only tables of means.
    """
    ours = {scene: rows for scene, rows in scenes.items() if RECIPE in rows}
    if ours:
        yield from ("## Losses\n", *loss_tables(ours, RECIPE, others))
        yield from ("\n## Mean gains\n", *gain_table(ours, RECIPE, others))
        yield from ("\n## By material\n", *material_table(ours))
        yield from ("\n## Gain by polarization\n", *control_table(ours))
        yield from ("\n## Metals\n", *metal_table(ours))
    yield from ("\n## Mean over scenes\n", *mean_table(scenes))
    for scene, rows in scenes.items():
        yield from (f"\n## {scene}\n", *scene_table(rows), "")
        if scene in ours:
            yield from object_table(rows)
            yield from ("", *(f"- {line}" for line in bad_views(scene, rows, RECIPE, others)))


def check_recipes(scenes: Scenes, names: Sequence[str]) -> None:
    """Check that the records contain all named recipes.

    Raises:
        PolarguideError: a recipe occurs in no scene.
    """
    recorded = {name for rows in scenes.values() for name in rows}
    absent = [name for name in names if name not in recorded]
    require(
        not absent,
        "--against",
        expected=f"recipes of the records: {', '.join(sorted(recorded))}",
        found=", ".join(absent),
        remedy="Correct the names.",
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, nargs="+", help="results.json of polarguide bench or compare")
    parser.add_argument(
        "--against", nargs="+", help="recipes without polarization; the default is all of them in the records"
    )
    options = parser.parse_args()
    try:
        scenes = read_scenes(options.records)
        versions = code_versions(options.records)
        check_recipes(scenes, options.against or ())
    except PolarguideError as error:
        parser.error(str(error))
    comparable = "" if len(versions) == 1 else " Values of different versions are not comparable."
    print(f"Version of the code: {', '.join(versions)}.{comparable}\n")
    print(*tables(scenes, options.against or without_polarization(RECIPE)), sep="\n")


if __name__ == "__main__":
    main()
