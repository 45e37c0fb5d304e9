"""Which runs a comparison consists of, where each lives, what is still to be done for it, and how many run at a time.

A run's folder carries a digest of everything that its result depends on: the same command finds finished runs again,
and whatever changes gets a folder of its own.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open

from polarguide import __version__
from polarguide.capture import View
from polarguide.capture.layout import SHARE
from polarguide.capture.variants import black_pixels, mask_background
from polarguide.core.errors import PolarguideError
from polarguide.core.options import DeviceName, Exposures, SceneOptions, index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import free_memory
from polarguide.raster import Backend
from polarguide.results.evaluation.record import PACKAGE, _digest, code_digest, read_metrics
from polarguide.results.evaluation.target import SceneFacts
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION, PLY, RunConfiguration, most_gaussians
from polarguide.runs.memory_plan import pixels_of, plan_memory
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.training.recipe import Recipe
from polarguide.training.settings import STEPS, TrainSettings
from polarguide_bench.gnerp.runs import FieldRun, open_field, plan_field_memory
from polarguide_bench.options import ClusterOptions, CompareOptions
from polarguide_bench.recipes import AnyRecipe, ablations_of, recipe_named

State = Literal["new", "begun", "trained", "done"]
RUNS = "runs"


@dataclass(frozen=True)
class TableRow:
    """A row of the tables: a recipe, and the pictures that it trains on.

    Attributes:
        name: as the tables and the run folders call it. steps: where that is not the others' number.
    """

    name: str
    recipe: AnyRecipe
    exposures: Exposures = "captured"
    steps: int | None = None

    @property
    def about(self) -> str:
        """In one line."""
        named = self.name == self.recipe.name
        about = self.recipe.about if named else f"{self.recipe.name}, {self.exposures}"
        return about if self.steps is None else f"{about.removesuffix('.')}; {self.steps:,} steps."


@dataclass(frozen=True)
class Comparison:
    """A requested comparison.

    Attributes:
        scenes: folders. recipes: the methods, in the order of the tables.
        settings: settings of each training, as specified; the first seed, from which others count up.
        options: how runs are trained, timed and shown.
        out: folder to write.
        seeds_of: by the name of a recipe, how many seeds where that is not ``options.seeds``.
        steps_of: by the name of a recipe, how many steps where that is not ``settings.steps``.
        command_line: for the record, if not ``polarguide compare``.
    """

    scenes: tuple[Path, ...]
    recipes: tuple[AnyRecipe, ...]
    settings: TrainSettings
    options: CompareOptions
    out: Path
    seeds_of: Mapping[str, int] = field(default_factory=dict)
    steps_of: Mapping[str, int] = field(default_factory=dict)
    command_line: str = ""

    @property
    def steps(self) -> int:
        """Of every run whose recipe has no number of its own. They do not follow from the size: scenes are compared."""
        return compared_steps(self.settings.steps)

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """The rows of the tables, in their order."""
        rows = []
        for recipe in self.recipes:
            steps = self.steps_of.get(recipe.name)
            if not self.options.exposures:
                rows.append(TableRow(recipe.name, recipe, self.settings.exposures, steps))
            for word in self.options.exposures:
                name = word if len(self.recipes) == 1 else f"{recipe.name} {word}"
                # Without any polarization in the pictures, the recipe without its terms, if there is one.
                controls = {r.name: r for r in ablations_of(recipe.name) if word == "none"}
                rows.append(TableRow(name, controls.get(f"{recipe.name}:unpolarized", recipe), word, steps))
        return tuple(rows)

    def seeds(self, recipe: AnyRecipe) -> range:
        """The seeds of a recipe."""
        first = self.settings.seed
        return range(first, first + self.seeds_of.get(recipe.name, self.options.seeds))

    def index_of(self, scene: SceneEntry) -> float:
        """The refractive index of a scene's runs: the specified one, or the scene's own."""
        return index_of(self.settings.refractive_index, scene.refractive_index)

    @property
    def command(self) -> str:
        """A command line that asks for the same."""
        settings = self.settings
        options = self.options
        arguments: dict[str, Sequence[object]] = {
            "--recipes": [recipe.name for recipe in self.recipes],
            "--steps": [self.steps, *(f"{name}={n}" for name, n in self.steps_of.items())],
            "--seeds": [options.seeds],
            "--out": [self.out],
            "--downscale": [options.downscale],
            "--transfer": [options.transfer],
            "--refractive-index": [settings.refractive_index]
            if settings.refractive_index is not None
            else [],
            "--background": [settings.background],
            "--split": [options.split],
            "--materials": [settings.materials] if settings.materials != "auto" else [],
            "--exposures": options.exposures,
        }
        line = [word for option, values in arguments.items() if values for word in (option, *values)]
        return self.command_line or shlex.join(map(str, ["polarguide", "compare", *self.scenes, *line]))


@dataclass(frozen=True)
class SceneEntry:
    """A scene as far as the record needs it.

    Attributes:
        warnings: what its scores do not mean because something of the ground truth is missing, a sentence each.
    """

    path: Path
    name: str
    digest: str
    views: int
    test_views: tuple[str, ...]
    black_share: float | None = None
    warnings: tuple[str, ...] = ()
    refractive_index: float | None = None


@dataclass(frozen=True)
class PlannedRun:
    """One training: a scene, a row of the tables with its recipe, and a seed.

    Attributes:
        steps: steps of the training. settings: what it is asked for; what they leave open, ``train`` resolves.
    """

    scene: SceneEntry
    row: TableRow
    steps: int
    settings: TrainSettings
    reading: SceneOptions
    folder: Path

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"{self.scene.name}, {self.row.name}, seed {self.settings.seed}"

    @property
    def recipe(self) -> AnyRecipe:
        """The method."""
        return self.row.recipe

    def state(self) -> State:
        """How far it is, by what its folder holds."""
        if not (self.folder / CONFIGURATION).exists():
            return "new"
        try:
            configuration = RunConfiguration.load(self.folder)
        except PolarguideError:
            return "begun"  # going on with it will say what does not match
        same = (
            configuration.scene_digest == self.scene.digest
            and configuration.recipe_data == self.recipe.data()
            and configuration.settings.fit(self.settings)
            and (
                configuration.recipe,
                configuration.downscale,
                configuration.transfer,
                configuration.test_views,
            )
            == (self.recipe.name, self.reading.downscale, self.reading.transfer, self.scene.test_views)
        )
        if not same:
            return "begun"
        if self.metrics() is not None:
            return "done"
        # Scoring looks for the scene where the training found it: going on with the training takes up a moved one.
        moved = configuration.scene != str(self.scene.path.resolve())
        leaves = PLY if isinstance(self.recipe, Recipe) else CHECKPOINT
        finished = (self.folder / leaves).exists() and trained_steps(self.folder) == self.steps
        return "trained" if finished and not moved else "begun"

    def metrics(self) -> dict[str, Any] | None:
        """The record of its scores, or None where there is no valid one by this version."""
        try:
            record = read_metrics(self.folder)
        except (OSError, PolarguideError):
            return None
        whole = record["steps"] == self.steps
        return record if whole and record["provenance"].get("sources") == code_digest() else None


def scene_entries(comparison: Comparison, reporter: Reporter = SILENT) -> list[SceneEntry]:
    """Read every scene once: its digest and its test views; warns where scores are not comparable.

    Raises:
        PolarguideError: a scene that cannot be read, has no test views, or is called like another.
    """
    entries: list[SceneEntry] = []
    for path in comparison.scenes:
        scene = read_scene(path, comparison.options, reporter)
        if comparison.settings.background == "masked":
            scene = mask_background(scene)
        if scene.name in [entry.name for entry in entries]:
            raise PolarguideError(
                path,
                expected="scenes with names of their own",
                found=f"{scene.name} twice",
                remedy="Rename a folder.",
            )
        if not scene.test_names:
            raise PolarguideError(
                path, expected="test views", found="none", remedy="Name some in split.json to score on."
            )
        if comparison.settings.refractive_index is None and scene.refractive_index is not None:
            reporter.say(f"{scene.name}: refractive index {scene.refractive_index:g}, as scene.json says")
        warnings = SceneFacts.of(scene).warnings
        for warning in warnings:
            reporter.warn(f"{scene.name}: {warning}")
        entries.append(
            SceneEntry(
                path,
                scene.name,
                scene.digest,
                len(scene.views),
                scene.test_names,
                black_share(scene.test_views[0]),
                warnings,
                scene.refractive_index,
            )
        )
    return entries


def black_share(view: View) -> float:
    """The share of a view's pixels that are black."""
    return float(black_pixels(view).float().mean())


def plan_runs(comparison: Comparison, scenes: Sequence[SceneEntry]) -> list[PlannedRun]:
    """All runs, scene by scene; within a scene seed by seed, so that first results compare all recipes."""
    every = {row.name: comparison.seeds(row.recipe) for row in comparison.rows}
    return [
        _planned(comparison, scene, row, seed)
        for scene in scenes
        for seed in sorted(set().union(*every.values()))
        for row in comparison.rows
        if seed in every[row.name]
    ]


def _planned(comparison: Comparison, scene: SceneEntry, row: TableRow, seed: int) -> PlannedRun:
    recipe = row.recipe
    options = comparison.options
    steps = compared_steps(row.steps, comparison.settings.steps)
    settings = replace(
        comparison.settings,
        steps=steps,
        seed=seed,
        exposures=row.exposures,
        refractive_index=comparison.index_of(scene),
    )
    reading = SceneOptions(options.downscale, options.transfer, split=options.split)
    plugin = model_digest(type(recipe.shading)) if isinstance(recipe, Recipe) else ""
    code = f"{__version__} {code_digest(training=True)}{plugin}"
    key = run_key(scene.digest, recipe.data(), settings, reading, code=code)
    name = row.name.replace(":", "__").replace(" ", "-")
    folder = comparison.out / RUNS / scene.name / name / f"{seed}-{key}"
    return PlannedRun(scene, row, steps, settings, reading, folder)


def run_key(
    scene_digest: str, recipe: Mapping[str, Any], settings: TrainSettings, reading: SceneOptions, *, code: str
) -> str:
    """A short digest of everything that a training's result depends on.

    Args:
        scene_digest: SHA-256 of the scene's files.
        recipe: all values of the recipe.
        settings: settings of the training.
        reading: how the pictures are read.
        code: which version of the program trains.

    Returns:
        Ten hexadecimal digits.
    """
    parts = [scene_digest, recipe, asdict(settings), asdict(reading), code]
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def most_memory(runs: Sequence[PlannedRun]) -> int:
    """Bytes that the process of any of the trainings takes at most, as far as headers tell.

    Raises:
        PolarguideError: a scene has gone, or its ``--memory`` is too small.
    """
    pixels = {run.scene.path: run.reading.downscale for run in runs}
    counts = {path: pixels_of(path, downscale) for path, downscale in pixels.items()}
    kinds = {(run.scene.path, run.row.name): run for run in runs}.values()  # seeds take the same
    return max((_expected_memory(run, counts[run.scene.path]) for run in kinds), default=0)


def _expected_memory(run: PlannedRun, pixels: Sequence[int]) -> int:
    if isinstance(run.recipe, Recipe):
        gaussians = most_gaussians(sum(pixels), run.recipe, run.settings, None)
        return plan_memory(pixels, run.recipe, gaussians, limit=run.reading.memory).peak
    return plan_field_memory(pixels, run.recipe, limit=run.reading.memory).peak


def own_gpus(backend: Backend) -> tuple[str, ...]:
    """The GPUs of this machine, as CUDA_VISIBLE_DEVICES calls them; none where the CPU computes."""
    if backend.device.type != "cuda":
        return ()
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return tuple(visible or map(str, range(torch.cuda.device_count())))


def jobs_at_a_time(options: ClusterOptions, count: int, memory: int, gpus: Sequence[str]) -> int:
    """How many jobs work at a time: at least one, and no more than there are.

    Args:
        options: where, and how many if that was specified.
        count: how many there are to do.
        memory: bytes that each takes at most. gpus: GPUs of this machine, each for one job.
    """
    if options.jobs or not options.local:
        return max(1, min(options.jobs or count, count))
    room = len(gpus) or (os.cpu_count() or 1) // options.threads
    if memory:
        room = min(room, int(SHARE * free_memory()) // memory)
    return max(1, min(room, count))


def trained_steps(run: Path) -> int | None:
    """Number of training steps completed at a run's checkpoint.

    None if the run has no checkpoint, or if the checkpoint does not record the number.
    """
    try:
        with safe_open(run / CHECKPOINT, framework="pt") as file:
            record = (file.metadata() or {}).get("polarguide", "")
        return int(record.rpartition(" ")[2])
    except (SafetensorError, OSError, ValueError):
        return None


def compared_steps(*specified: int | None) -> int:
    """Steps of a run of a comparison: the first number that was specified, else ``STEPS``.

    They do not follow from the size of the pictures: scenes are compared.
    """
    return next((steps for steps in specified if steps is not None), STEPS)


def model_digest(kind: type) -> str:
    """Digest of the file that defines a plug-in's shading model; empty for models of this package."""
    file = Path(inspect.getfile(kind))
    return "" if PACKAGE in file.parents else _digest(file.parent, [file])


def open_compared(folder: str | Path, device: DeviceName = "auto") -> OpenedRun | FieldRun:
    """Open a run of a comparison.

    Raises:
        PolarguideError: the folder is no run, is damaged, or belongs to another version.
    """
    recipe = recipe_named(RunConfiguration.load(Path(folder)).recipe)
    if isinstance(recipe, Recipe):
        return OpenedRun.open(folder, recipe=recipe, device=device)
    return open_field(folder, recipe, device=device)
