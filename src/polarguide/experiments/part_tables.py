"""Scores by object of every scene, and by material over scenes: where the error is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from polarguide.evaluation.table import PART_METRICS, Metric
from polarguide.experiments.aggregate import PartScores
from polarguide.experiments.controls import controlled
from polarguide.experiments.difference_tables import difference_text
from polarguide.experiments.differences import judged, pair
from polarguide.experiments.intervals import Samples, mean, seed_means
from polarguide.experiments.results import Results
from polarguide.experiments.shown import MINUS, Block, Label, Row, Section, ShownCell, formatted
from polarguide.experiments.tables import leaders

ByRecipe = dict[str, dict[int, dict[str, float]]]
_HOW = (
    "Scores on the pixels of a part, means over seeds. Bold: as above, but no scatter is known of parts, so that with "
    "fewer than two paired seeds only the best is bold.",
)


def object_section(results: Results) -> Section | None:
    """A block for every metric, a row for every object of every scene; None where no scene has objects."""
    parts: dict[tuple[str, ...], dict[str, list[tuple[str, int, PartScores]]]] = {}
    for run in results["runs"]:
        for name, scores in run["objects"].items():
            place = (run["scene"], name, scores["material"] or "")
            found = parts.setdefault(place, {}).setdefault(run["scene"], [])
            found.append((run["recipe"], run["seed"], scores))
    scenes = [scene["name"] for scene in results["scenes"]]
    ordered = dict(sorted(parts.items(), key=lambda item: scenes.index(item[0][0])))
    return _section(results, "objects", "By object", ("scene", "object", "material"), ordered)


def material_section(results: Results) -> Section | None:
    """A block for every metric, a row for every class of material; None where no scene has any."""
    by_class: dict[str, dict[str, list[tuple[str, int, PartScores]]]] = {}
    for run in results["runs"]:
        for name, scores in run["materials"].items():
            found = by_class.setdefault(name, {}).setdefault(run["scene"], [])
            found.append((run["recipe"], run["seed"], scores))
    order = [scene["name"] for scene in results["scenes"]]
    rows: dict[tuple[str, ...], dict[str, list[tuple[str, int, PartScores]]]] = {}
    for name, scenes in by_class.items():
        rows[name, ", ".join(sorted(scenes, key=order.index))] = scenes
    return _section(results, "materials", "By material", ("material", "scenes"), rows)


def _section(
    results: Results,
    key: str,
    title: str,
    labels: tuple[str, ...],
    parts: Mapping[tuple[str, ...], Mapping[str, Sequence[tuple[str, int, PartScores]]]],
) -> Section | None:
    recipes = [recipe["name"] for recipe in results["recipes"]]
    with_controls = controlled(recipes)
    blocks = []
    for column in (metric for metric in PART_METRICS if metric.shown == "tables"):
        rows = []
        for place, scenes in parts.items():
            data = {scene: _samples(scores, column) for scene, scores in scenes.items()}
            data = {scene: by_recipe for scene, by_recipe in data.items() if by_recipe}
            if data:
                cells = [*_values(data, recipes, column), *_gains(data, with_controls, column)]
                rows.append(Row(tuple(map(Label, place)), tuple(cells)))
        if rows:
            blocks.append(Block(column.heading, tuple(rows)))
    if not blocks:
        return None
    notes = list(_HOW)
    if with_controls:
        notes.append(
            "The last columns: what polarization buys, the difference to the better control; bold and ≈ as above."
        )
    if key == "materials":
        notes.append("Means over the scenes that have the material, with one weight each.")
    headings = (*recipes, *(f"{recipe} {MINUS} control" for recipe in with_controls))
    return Section(key, title, labels, headings, tuple(blocks), tuple(notes))


def _samples(scores: Sequence[tuple[str, int, PartScores]], column: Metric) -> ByRecipe:
    found: ByRecipe = {}
    for recipe, seed, part in scores:
        value = part["metrics"].get(column.key)
        if value is not None:
            found.setdefault(recipe, {})[seed] = {"": value}
    return found


def _values(data: Mapping[str, ByRecipe], recipes: Sequence[str], column: Metric) -> Iterator[ShownCell]:
    """A cell for every recipe; empty where it lacks a scene that another has."""
    values = {
        index: {scene: seed_means(by_recipe[recipe]) for scene, by_recipe in data.items()}
        for index, recipe in enumerate(recipes)
        if all(recipe in by_recipe for by_recipe in data.values())
    }
    means = {index: mean(mean(by.values()) for by in scenes.values()) for index, scenes in values.items()}
    bold = leaders(means, values, column, {}) if len(means) > 1 else set()
    for index in range(len(recipes)):
        yield ShownCell(formatted(means[index], column), "", index in bold) if index in means else ShownCell()


def _gains(
    data: Mapping[str, Mapping[str, Samples]], recipes: Mapping[str, Sequence[str]], column: Metric
) -> Iterator[ShownCell]:
    for recipe, controls in recipes.items():
        found = pair(data, recipe, controls, column) if column.better is not None else None
        if found is None:
            yield ShownCell()
            continue
        estimate, noise = judged(found.by_scene, {})
        better = (estimate.mean > 0) == (column.better == "higher")
        yield ShownCell(difference_text(estimate.mean, noise, column), "", noise is False and better)
