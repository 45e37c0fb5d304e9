"""Count the losses of a recipe against the recipes without polarization, by scene and by object.

Each metric is compared with the recipe without polarization that is best in this metric. The values are means over
seeds. A difference counts as a loss if it exceeds the tolerance of the metric by more than its uncertainty. The
uncertainty is twice the standard error over common seeds. It is at most 0.1 dB or 0.2 degrees, and has this size for
fewer than two common seeds. The pixels of metals do not count in the layers of a scene. The layers of an object of
metal are not compared.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bench_records import BY_KEY, Rows, Scenes, Value, objects_of, of_object, of_run, values

PICTURE = {"psnr": 0.15, "psnr_foreground": 0.15}
NORMALS = {"normal_mae_deg": 0.3}
LAYERS = {"specular_psnr": 0.2, "diffuse_psnr": 0.2}
TOLERANCES = {**PICTURE, **NORMALS, **LAYERS}
"""Differences that do not count as a loss, in dB and degrees."""
LARGEST_ERROR = {"dB": 0.1, "deg": 0.2}
"""Largest uncertainty of a difference by unit."""
MOST_HAZE = 0.02
"""Share of haze above which a view is listed."""
MOST_OUTSIDE = 0.01
"""Opacity outside the mask above which a view is listed."""
MORE_BEYOND = 0.03
"""Additional share of depth beyond the true surface above which a view is listed."""
VIEW_LOSS = 2.0
"""Difference in dB to plain splatting above which a view is listed."""
METALS = ("metal", "rough metal")
BASELINES = ("3dgs", "3dgs-dr", "3dgs-dr:consistent", "ref-gs")
"""Recipes without polarization, apart from the controls of a recipe."""


def without_polarization(recipe: str) -> tuple[str, ...]:
    """Return the names of the recipes without polarization with which a recipe is compared."""
    return (*BASELINES, f"{recipe}:unpolarized", f"{recipe}:unpolarized-without-consistency")


@dataclass(frozen=True)
class Judged:
    """Metric of a scene or an object, compared with the best recipe without polarization.

    Attributes:
        scene: name of the scene.
        part: name of the object; empty for the scene.
        key: key of the metric.
        ours: value of the judged recipe.
        best: recipe without polarization that is best.
        theirs: value of this recipe.
        gain: difference; positive if the judged recipe is better.
        error: uncertainty of the difference.
    """

    scene: str
    part: str
    key: str
    ours: float
    best: str
    theirs: float
    gain: float
    error: float

    @property
    def lost(self) -> bool:
        """True for a loss beyond tolerance and uncertainty."""
        return self.gain + self.error < -TOLERANCES[self.key]

    def line(self) -> str:
        """Format a row of a table."""
        metric = BY_KEY[self.key]
        sign = self.gain if metric.better == "higher" else -self.gain
        cells = (
            *(self.scene, self.part, metric.label, f"{self.ours:.2f}"),
            *(f"{self.theirs:.2f} `{self.best}`", f"{sign:+.2f} {metric.unit}"),
        )
        return f"| {' | '.join(cells)} |"


def judge(
    scene: str, part: str, key: str, rows: Rows, recipe: str, others: Sequence[str], value: Value
) -> Judged | None:
    """Compare a metric of a recipe with the best of other recipes. Return None if a value is missing."""
    numbers = {name: values(rows.get(name, {}), value) for name in (recipe, *others)}
    up = 1.0 if BY_KEY[key].better == "higher" else -1.0
    means = {name: statistics.fmean(of.values()) for name, of in numbers.items() if of}
    rivals = [name for name in others if name in means]
    if recipe not in means or not rivals:
        return None
    best = max(rivals, key=lambda name: up * means[name])
    common = sorted(set(numbers[recipe]) & set(numbers[best]))
    differences = [numbers[recipe][seed] - numbers[best][seed] for seed in common]
    error = LARGEST_ERROR[BY_KEY[key].unit]
    if len(common) > 1:
        error = min(error, 2 * statistics.stdev(differences) / math.sqrt(len(common)))
    gain = up * (means[recipe] - means[best])
    return Judged(scene, part, key, means[recipe], best, means[best], gain, error)


def of_scene(rows: Rows, recipe: str, key: str) -> Value:
    """Return a function that reads a metric of a run. Layers leave out the pixels of metals if possible."""
    without_metals = of_run(f"{key}_dielectric")
    return without_metals if values(rows[recipe], without_metals) else of_run(key)


def judged_scene(scene: str, rows: Rows, recipe: str, others: Sequence[str]) -> Iterator[Judged]:
    """Yield all comparisons of a scene and of its objects."""
    compared = [("", key, of_scene(rows, recipe, key)) for key in TOLERANCES]
    for name, part in objects_of(rows, recipe).items():
        keys = ("psnr", *NORMALS, *(() if part["material"] in METALS else LAYERS))
        compared += [(name, key, of_object(name, key)) for key in keys]
    for part, key, value in compared:
        judged = judge(scene, part, key, rows, recipe, others, value)
        if judged is not None:
            yield judged


def judged_scenes(scenes: Scenes, recipe: str, others: Sequence[str]) -> list[Judged]:
    """Return all comparisons of all scenes with runs of the recipe."""
    return [
        judged
        for scene, rows in scenes.items()
        if recipe in rows
        for judged in judged_scene(scene, rows, recipe, others)
    ]


def count(judged: Sequence[Judged]) -> str:
    """Format the number of losses and of comparisons."""
    return f"{sum(one.lost for one in judged)} of {len(judged)}"


def loss_tables(scenes: Scenes, recipe: str, others: Sequence[str]) -> Iterator[str]:
    """Yield the losses by scene and by object, those of each recipe, and a list of all losses."""
    judged = judged_scenes(scenes, recipe, others)
    whole = [one for one in judged if not one.part]
    parts = [one for one in judged if one.part]
    yield f"`{recipe}` loses {count(whole)} comparisons by scene and {count(parts)} by object."
    yield ""
    yield "| scene | losses by scene | losses by object |"
    yield "|---|---:|---:|"
    for scene in dict.fromkeys(one.scene for one in judged):
        counts = [count([one for one in of if one.scene == scene]) for of in (whole, parts)]
        yield f"| `{scene}` | {' | '.join(counts)} |"
    yield ""
    yield "| recipe | losses | by scene | by object | pictures | normals | layers |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    for name in (recipe, *others):
        of_name = judged_scenes(scenes, name, [other for other in others if other != name])
        lost = [one for one in of_name if one.lost]
        by_part = [sum(bool(one.part) is part for one in lost) for part in (False, True)]
        kinds = [sum(one.key in kind for one in lost) for kind in (PICTURE, NORMALS, LAYERS)]
        if of_name:
            yield f"| `{name}` | {count(of_name)} | {' | '.join(map(str, (*by_part, *kinds)))} |"
    yield ""
    yield "| scene | object | metric | value | best without polarization | difference |"
    yield "|---|---|---|---:|---:|---:|"
    yield from (one.line() for one in judged if one.lost)


def mean_gain(scenes: Scenes, recipe: str, other: str, key: str) -> str:
    """Format the mean gain over another recipe. The gain of normals is the geometric mean of the ratios of errors."""
    gains = []
    for rows in scenes.values():
        if recipe in rows and other in rows:
            value = of_scene(rows, recipe, key)
            ours, theirs = (list(values(rows[name], value).values()) for name in (recipe, other))
            if ours and theirs:
                gains.append((statistics.fmean(ours), statistics.fmean(theirs)))
    if not gains:
        return "n/a"
    if key in NORMALS:
        return f"{statistics.geometric_mean(mine / theirs for mine, theirs in gains):.2f}"
    return f"{statistics.fmean(mine - theirs for mine, theirs in gains):+.2f}"


def gain_table(scenes: Scenes, recipe: str, others: Sequence[str]) -> Iterator[str]:
    """Yield the mean gain of a recipe over each other recipe."""
    yield "| compared with | PSNR (dB) | foreground (dB) | normal error, factor | specular (dB) | diffuse (dB) |"
    yield "|---|---:|---:|---:|---:|---:|"
    for other in others:
        if any(other in rows for rows in scenes.values()):
            cells = (mean_gain(scenes, recipe, other, key) for key in TOLERANCES)
            yield f"| `{other}` | {' | '.join(cells)} |"


def bad_views(scene: str, rows: Rows, recipe: str, others: Sequence[str]) -> Iterator[str]:
    """Yield a line for each held-out view with haze, with fog outside the mask, or far worse than plain splatting."""
    for seed, run in rows[recipe].items():
        for view, scores in run["views"].items():
            for key, most in (("haze_free", MOST_HAZE), ("alpha_outside", MOST_OUTSIDE)):
                if (scores.get(key) or 0.0) > most:
                    yield f"{scene}, seed {seed}, {view}: {BY_KEY[key].label} {100 * scores[key]:.1f} %"
            peers = [
                rows[name][seed]["views"][view]["psnr"]
                for name in ("3dgs", "3dgs-dr")
                if seed in rows.get(name, {})
            ]
            if peers and scores["psnr"] < max(peers) - VIEW_LOSS:
                yield f"{scene}, seed {seed}, {view}: {scores['psnr']:.1f} dB; plain splatting {max(peers):.1f}"
    yield from _views_from_behind(scene, rows, recipe, others)


def _views_from_behind(scene: str, rows: Rows, recipe: str, others: Sequence[str]) -> Iterator[str]:
    """Yield views that show more from behind the true surface than the best other recipe, in means over seeds."""
    for view in next(iter(rows[recipe].values()))["views"]:

        def beyond(name: str, view: str = view) -> list[float]:
            of_view = values(rows.get(name, {}), lambda run: run["views"][view].get("depth_beyond"))
            return list(of_view.values())

        ours = beyond(recipe)
        theirs = {name: statistics.fmean(shares) for name in others if (shares := beyond(name))}
        best = min(theirs, key=lambda name: theirs[name], default=None)
        if ours and best is not None and statistics.fmean(ours) > theirs[best] + MORE_BEYOND:
            shares = f"{100 * statistics.fmean(ours):.1f} %; `{best}` {100 * theirs[best]:.1f} %"
            yield f"{scene}, {view}: depth beyond {shares}"
