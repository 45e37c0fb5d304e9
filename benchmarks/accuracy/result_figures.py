"""Draw the figures docs/figures/results-*.svg from the records in benchmarks/results.

    python benchmarks/accuracy/result_figures.py

The figures show quality by recipe, by material, by number of views and by polarizer angles of each view. Each point is
one scene, the mean of its seeds. No record varies the noise of the pictures.
"""

from __future__ import annotations

import json
import statistics
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from bench_records import BY_KEY, Scenes, by_scene, of_material, of_run, read_scenes
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
RECORDS, FIGURES = ROOT / "benchmarks" / "results", ROOT / "docs" / "figures"
BENCH = sorted((RECORDS / "final" / "bench").glob("*.json"))
"""The eleven scenes of the bench."""
BASELINE = "3dgs-dr"
RECIPES = (
    "3dgs",
    "3dgs-dr:consistent",
    "ref-gs",
    "polgs",
    "polarguide-paper",
    "polarguide-paper:kind",
    "polarguide-stokes:unpolarized-without-consistency",
    "polarguide-stokes:unpolarized",
    "polarguide-stokes",
)
THREE = (BASELINE, "polarguide-stokes:unpolarized", "polarguide-stokes")
MATERIALS = ("dielectric", "rough dielectric", "metal", "rough metal")
ANGLES = ("four", "two", "one", "unknown", "none")
PICTURE = ("psnr", "psnr_foreground")
NORMALS, LAYERS = ("normal_mae_deg",), ("specular_psnr", "diffuse_psnr")
DIELECTRIC = ("specular_psnr_dielectric", "diffuse_psnr_dielectric")
COLORS = ("#777777", "#e69f00", "#0072b2", "#009e73")
"""Colors of Okabe and Ito, distinguishable with color blindness and in gray."""
TITLE_WIDTH = 16
"""Characters in a line of a panel's title."""
STYLE = {
    "svg.fonttype": "none",  # text stays text: small, searchable files
    "svg.hashsalt": "polarguide",  # reproducible files
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
}


def panels(keys: Sequence[str], height: float, **options: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure with the width of a page's text, with a titled panel for each metric."""
    figure, axes = pyplot.subplots(1, len(keys), figsize=(9.6, height), layout="constrained", **options)
    for axis, key in zip(axes, keys, strict=True):
        axis.set_title(textwrap.fill(BY_KEY[key].heading, TITLE_WIDTH), fontsize=9)
    return figure, list(axes)


def save(figure: Figure, name: str) -> None:
    """Write a figure to docs/figures."""
    figure.savefig(FIGURES / f"results-{name}.svg", metadata={"Date": None})
    pyplot.close(figure)


def draw_recipes(scenes: Scenes) -> None:
    """Draw the gain of each recipe over the baseline: a dot for each scene, a bar for the mean."""
    keys = (*PICTURE, *NORMALS, *DIELECTRIC)
    figure, axes = panels(keys, 3.6, sharey=True)
    for axis, key in zip(axes, keys, strict=True):
        base = by_scene(scenes, BASELINE, of_run(key))
        for row, recipe in enumerate(RECIPES):
            own = by_scene(scenes, recipe, of_run(key))
            gains = [own[scene] - base[scene] for scene in own if scene in base]
            if gains:
                color = COLORS[2] if recipe == RECIPES[-1] else COLORS[0]
                axis.plot(gains, [row] * len(gains), "o", color=color, alpha=0.45, markersize=4, mew=0)
                axis.plot(statistics.fmean(gains), row, "|", color=color, markersize=18, markeredgewidth=2.5)
        axis.axvline(0, color="#222222", linewidth=0.8)
    labels = [recipe.replace("-without", "\n-without") for recipe in RECIPES]
    axes[0].set_yticks(range(len(RECIPES)), labels)
    axes[0].invert_yaxis()
    figure.supxlabel(f"difference to {BASELINE}; dots are scenes, bars their mean", fontsize=9)
    save(figure, "recipes")


def draw_materials(scenes: Scenes) -> None:
    """Draw normals and layers over the pixels of each material, for three recipes."""
    keys = (*NORMALS, *LAYERS)
    figure, axes = panels(keys, 2.9)
    for axis, key in zip(axes, keys, strict=True):
        for index, recipe in enumerate(THREE):
            label = recipe
            for place, material in enumerate(MATERIALS):
                known = list(by_scene(scenes, recipe, of_material(material, key)).values())
                at = place + 0.24 * (index - 1)
                axis.plot([at] * len(known), known, "o", color=COLORS[index], alpha=0.4, markersize=4, mew=0)
                axis.plot(
                    at, statistics.fmean(known), "_", color=COLORS[index], markersize=12, mew=3, label=label
                )
                label = "_"  # one entry of the legend for each recipe
        axis.set_xticks(range(len(MATERIALS)), [name.replace(" ", "\n") for name in MATERIALS])
        axis.grid(visible=False, axis="x")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    save(figure, "materials")


def draw_views(scenes: Scenes, recipes: Sequence[str]) -> None:
    """Draw the quality over the number of training views."""
    keys = ("psnr_foreground", *NORMALS, "specular_psnr")
    figure, axes = panels(keys, 2.9)
    counts = [int(scene.removeprefix("views-")) for scene in scenes]
    for axis, key in zip(axes, keys, strict=True):
        for color, recipe in zip((COLORS[1], COLORS[0], COLORS[3], COLORS[2]), recipes, strict=True):
            known = list(by_scene(scenes, recipe, of_run(key)).values())
            if known:
                axis.plot(counts, known, "o-", color=color, label=recipe, markersize=4)
        axis.set_xscale("log", base=2)
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.set_xlabel("training views")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    save(figure, "views")


def draw_angles(scenes: Scenes) -> None:
    """Draw the quality over the polarizer angles of each training view: a line for each scene, and their mean."""
    keys = ("psnr_foreground", *NORMALS, *LAYERS)
    figure, axes = panels(keys, 2.8)
    for axis, key in zip(axes, keys, strict=True):
        known = {words: by_scene(scenes, words, of_run(key)) for words in ANGLES}
        for scene in scenes:
            axis.plot(
                [known[words][scene] for words in ANGLES], "o-", color=COLORS[0], alpha=0.45, markersize=3
            )
        means = [statistics.fmean(known[words].values()) for words in ANGLES]
        axis.plot(means, "o-", color=COLORS[2], linewidth=2.2, markersize=5)
        axis.set_xticks(range(len(ANGLES)), ANGLES, rotation=35)
    figure.supxlabel(
        "angles of each training view; thin lines are scenes, the thick one their mean", fontsize=9
    )
    save(figure, "angles")


METALS = {
    "metals-a": {"jug": ("jug", "jug_handle"), "pot": ("pot",)},
    "kit": {"lid": ("lid_blue",), "ruler": ("ruler",)},
    "frame": {"frame": ("frame",)},
    "metals-b": {"gold cup": ("cup",), "iron kettle": ("kettle",)},
    "alloys": {
        "polished alloys": (
            "gold_ball",
            "copper_cup",
            "brass_candlestick",
            "steel_can",
            "chrome_ring",
            "aluminum_egg",
        ),
        "rough alloys": ("rough_gold_bell", "rough_copper_stone", "rough_steel_ball", "rough_aluminum_block"),
    },
}
"""Metals by scene. Objects with one label are drawn as their mean."""


def draw_constants(scenes: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """Draw the recall of each metal, and the dielectric with most false metal pixels, over the constants of metals."""
    settings = list(next(iter(scenes.values())))
    figure, axes = pyplot.subplots(figsize=(7, 2.8), layout="constrained")
    dielectrics = {}
    for scene, labels in METALS.items():
        for label, names in labels.items():
            shares = [
                statistics.fmean(scenes[scene][setting][name] for name in names) for setting in settings
            ]
            axes.plot(settings, shares, "o", markersize=5, label=label, alpha=0.8)
        metals = {name for names in labels.values() for name in names}
        dielectrics[scene] = scenes[scene]["as is"].keys() - metals
    wrong = [
        max(scenes[scene][setting][name] for scene, names in dielectrics.items() for name in names)
        for setting in settings
    ]
    axes.plot(settings, wrong, "x", color=COLORS[0], label="most of a dielectric")
    axes.set_ylabel("taken for metal (%)")
    axes.tick_params(axis="x", rotation=30)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    save(figure, "metals")


def main() -> None:
    bench = read_scenes(BENCH)
    angles = read_scenes([RECORDS / "exposures.json"])
    views = read_scenes([RECORDS / "cup-views.json"])
    mpl.use("svg")
    mpl.rcParams.update(STYLE)
    draw_recipes(bench)
    draw_materials(bench)
    draw_views(views, list(next(iter(views.values()))))
    draw_angles(angles)
    draw_constants(json.loads((RECORDS.parent / "records" / "metal-constants.json").read_text())["scenes"])


if __name__ == "__main__":
    main()
