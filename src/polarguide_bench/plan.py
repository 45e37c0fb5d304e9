"""Plan of a comparison, which determines its runs, their folders, and the number of simultaneous runs.

The name of a run folder contains a digest of all inputs that determine the result. So the same command finds finished
runs, and changed inputs lead to a new folder.
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
from polarguide.capture.layout import SHARE
from polarguide.capture.variants import mask_background
from polarguide.core.errors import PolarguideError, require
from polarguide.core.options import DeviceName, Exposures, SceneOptions, index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import free_memory
from polarguide.raster import Backend
from polarguide.results.evaluation.evaluate import PACKAGE, _digest, code_digest, read_metrics
from polarguide.results.evaluation.table import registered_digests
from polarguide.results.evaluation.target import SceneFacts
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION, PLY, RunConfiguration, most_gaussians
from polarguide.runs.memory_plan import pixels_of, plan_memory
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.training.recipe import Recipe
from polarguide.training.settings import STEPS, TrainSettings
from polarguide_bench.gnerp.runs import FieldRun, open_field, plan_field_memory
from polarguide_bench.objects import recipe_digest
from polarguide_bench.options import ClusterOptions, CompareOptions
from polarguide_bench.recipes import AnyRecipe, ablations_of, recipe_named

State = Literal["new", "begun", "trained", "done"]


@dataclass(frozen=True)
class TableRow:
    """Row of the tables: a recipe, and the kind of pictures on which it is trained.

    Attributes:
        name: name in tables and in the names of run folders.
        recipe: the recipe.
        exposures: kind of pictures on which the recipe is trained.
        steps: number of steps of this row, or None for the number of the comparison.
    """

    name: str
    recipe: AnyRecipe
    exposures: Exposures = "captured"
    steps: int | None = None

    @property
    def about(self) -> str:
        """Description of the row in one line."""
        named = self.name == self.recipe.name
        about = self.recipe.about if named else f"{self.recipe.name}, {self.exposures}"
        return about if self.steps is None else f"{about.removesuffix('.')}; {self.steps:,} steps."


@dataclass(frozen=True)
class Comparison:
    """Request for a comparison.

    Attributes:
        scenes: scene folders.
        recipes: recipes in the order of the tables.
        settings: settings of each training. Their seed is the first of the seeds.
        options: options for training, timing and presentation.
        out: output folder.
        seeds_of: number of seeds of each recipe for which it differs from ``options.seeds``.
        steps_of: number of steps of each recipe for which it differs from ``settings.steps``.
        command_line: command line to record if it differs from ``polarguide compare``.
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
    def rows(self) -> tuple[TableRow, ...]:
        """Rows of the tables in their order."""
        rows = []
        for recipe in self.recipes:
            steps = self.steps_of.get(recipe.name)
            if not self.options.exposures:
                rows.append(TableRow(recipe.name, recipe, self.settings.exposures, steps))
            for exposures in self.options.exposures:
                name = exposures if len(self.recipes) == 1 else f"{recipe.name} {exposures}"
                # For pictures without polarization, the variant without polarization terms is trained, if it exists.
                controls = {r.name: r for r in ablations_of(recipe.name) if exposures == "none"}
                control = controls.get(f"{recipe.name}:unpolarized", recipe)
                rows.append(TableRow(name, control, exposures, steps))
        return tuple(rows)

    @property
    def command(self) -> str:
        """Command line that repeats this comparison."""
        settings = self.settings
        options = self.options
        arguments: dict[str, Sequence[object]] = {
            "--recipes": [recipe.name for recipe in self.recipes],
            "--steps": [
                compared_steps(settings.steps),
                *(f"{name}={n}" for name, n in self.steps_of.items()),
            ],
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
    """Facts about a scene, for the record of the comparison.

    Attributes:
        path: scene folder.
        name: name of the scene.
        digest: SHA-256 of the files of the scene.
        views: number of views.
        test_views: names of the test views.
        warnings: sentences about scores that are limited because ground truth is missing.
        refractive_index: refractive index in ``scene.json``, or None if it contains none.
    """

    path: Path
    name: str
    digest: str
    views: int
    test_views: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    refractive_index: float | None = None


@dataclass(frozen=True)
class PlannedRun:
    """Training of a comparison: a recipe on a scene with a seed.

    Attributes:
        scene: the scene.
        row: row of the tables, which defines the recipe.
        steps: number of steps of the training.
        settings: requested settings. ``train`` chooses the settings that are not specified.
        reading: options for reading the scene.
        folder: run folder.
    """

    scene: SceneEntry
    row: TableRow
    steps: int
    settings: TrainSettings
    reading: SceneOptions
    folder: Path

    @property
    def label(self) -> str:
        """Name of the run in messages."""
        return f"{self.scene.name}, {self.row.name}, seed {self.settings.seed}"

    def state(self) -> State:
        """Return the state of the run, read from its folder."""
        if not (self.folder / CONFIGURATION).exists():
            return "new"
        try:
            run = RunConfiguration.load(self.folder)
        except PolarguideError:
            return "begun"  # the resumed training reports the mismatch
        recipe = self.row.recipe
        recorded = (
            run.scene_digest,
            run.recipe,
            run.recipe_data,
            run.downscale,
            run.transfer,
            run.test_views,
        )
        requested = (
            self.scene.digest,
            recipe.name,
            recipe.data(),
            self.reading.downscale,
            self.reading.transfer,
            self.scene.test_views,
        )
        if recorded != requested or not run.settings.fit(self.settings):
            return "begun"
        if self.metrics() is not None:
            return "done"
        # Scoring reads the scene from the path of the training. A resumed training updates the path of a moved scene.
        moved = run.scene != str(self.scene.path.resolve())
        result = PLY if isinstance(recipe, Recipe) else CHECKPOINT
        finished = (self.folder / result).exists() and trained_steps(self.folder) == self.steps
        return "trained" if finished and not moved else "begun"

    def metrics(self) -> dict[str, Any] | None:
        """Read the scores of the run. Return None if there is no valid record of this version."""
        try:
            record = read_metrics(self.folder)
        except (OSError, PolarguideError):
            return None
        provenance = record["provenance"]
        scored = registered_digests().items() <= provenance.get("metrics", {}).items()
        current = provenance.get("sources") == code_digest() and scored
        return record if record["steps"] == self.steps and current else None


def scene_entries(comparison: Comparison, reporter: Reporter = SILENT) -> list[SceneEntry]:
    """Read the facts about each scene, and warn about scores that are not comparable.

    Raises:
        PolarguideError: a scene is invalid, has no test views, or has the same name as another scene.
    """
    entries: list[SceneEntry] = []
    for path in comparison.scenes:
        scene = read_scene(path, comparison.options, reporter)
        if comparison.settings.background == "masked":
            scene = mask_background(scene)
        require(
            scene.name not in [entry.name for entry in entries],
            path,
            expected="scenes with different names",
            found=f"{scene.name} twice",
            remedy="Rename one of the folders.",
        )
        require(
            scene.test_names,
            path,
            expected="test views",
            found="none",
            remedy="List test views in split.json.",
        )
        if comparison.settings.refractive_index is None and scene.refractive_index is not None:
            reporter.say(f"{scene.name}: refractive index {scene.refractive_index:g} of scene.json")
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
                warnings,
                scene.refractive_index,
            )
        )
    return entries


def plan_runs(comparison: Comparison, scenes: Sequence[SceneEntry]) -> list[PlannedRun]:
    """Return all runs, sorted by scene and then by seed, so that the first finished runs compare all recipes."""
    counts = {
        row.name: comparison.seeds_of.get(row.recipe.name, comparison.options.seeds)
        for row in comparison.rows
    }
    return [
        _planned(comparison, scene, row, comparison.settings.seed + number)
        for scene in scenes
        for number in range(max(counts.values()))
        for row in comparison.rows
        if number < counts[row.name]
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
        refractive_index=index_of(comparison.settings.refractive_index, scene.refractive_index),
    )
    reading = SceneOptions(options.downscale, options.transfer, split=options.split)
    plugin = recipe_digest(recipe)
    if isinstance(recipe, Recipe) and not plugin:
        plugin = model_digest(type(recipe.shading))
    code = f"{__version__} {code_digest(training=True)}{plugin}"
    key = run_key(scene.digest, recipe.data(), settings, reading, code=code)
    folder = comparison.out / "runs" / scene.name / folder_of_recipe(row.name) / f"{seed}-{key}"
    return PlannedRun(scene, row, steps, settings, reading, folder)


def folder_of_recipe(name: str) -> str:
    """Return the name of the folder for a recipe or for a row of the tables."""
    return name.replace(":", "__").replace(" ", "-")


def run_key(
    scene_digest: str, recipe: Mapping[str, Any], settings: TrainSettings, reading: SceneOptions, *, code: str
) -> str:
    """Return a short digest of all inputs that determine the result of a training.

    Args:
        scene_digest: SHA-256 of the scene's files.
        recipe: all values of the recipe.
        settings: settings of the training.
        reading: options for reading the pictures.
        code: digest of the training code.

    Returns:
        Ten hexadecimal digits.
    """
    parts = [scene_digest, recipe, asdict(settings), asdict(reading), code]
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def most_memory(runs: Sequence[PlannedRun]) -> int:
    """Return an upper bound of the memory of a training in bytes, computed from file headers.

    Raises:
        PolarguideError: a scene is missing, or ``--memory`` is too small for it.
    """
    scales = {run.scene.path: run.reading.downscale for run in runs}
    pixels = {path: pixels_of(path, downscale) for path, downscale in scales.items()}
    kinds = {(run.scene.path, run.row.name): run for run in runs}.values()  # seeds need the same memory
    return max((_expected_memory(run, pixels[run.scene.path]) for run in kinds), default=0)


def _expected_memory(run: PlannedRun, pixels: Sequence[int]) -> int:
    recipe = run.row.recipe
    if isinstance(recipe, Recipe):
        gaussians = most_gaussians(sum(pixels), recipe, run.settings, None)
        return plan_memory(pixels, recipe, gaussians, limit=run.reading.memory).peak
    return plan_field_memory(pixels, recipe, limit=run.reading.memory).peak


def own_gpus(backend: Backend) -> tuple[str, ...]:
    """Return the names of this machine's GPUs for CUDA_VISIBLE_DEVICES, or () if ``backend`` uses the CPU."""
    if backend.device.type != "cuda":
        return ()
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return tuple(visible or map(str, range(torch.cuda.device_count())))


def jobs_at_a_time(options: ClusterOptions, count: int, memory: int, gpus: Sequence[str]) -> int:
    """Return the number of jobs that run at the same time, at least one and at most ``count``.

    Args:
        options: options of the computation, which may specify the number.
        count: number of jobs.
        memory: upper bound of the memory of each job in bytes.
        gpus: GPUs of this machine. Each job uses one of them.
    """
    if options.jobs or not options.local:
        return max(1, min(options.jobs or count, count))
    room = len(gpus) or (os.cpu_count() or 1) // options.threads
    if memory:
        room = min(room, int(SHARE * free_memory()) // memory)
    return max(1, min(room, count))


def trained_steps(run: Path) -> int | None:
    """Return the number of training steps at a run's checkpoint.

    Return None if the run has no checkpoint, or if the checkpoint does not record the number.
    """
    try:
        with safe_open(run / CHECKPOINT, framework="pt") as file:
            record = (file.metadata() or {}).get("polarguide", "")
        return int(record.rpartition(" ")[2])
    except (SafetensorError, OSError, ValueError):
        return None


def compared_steps(*specified: int | None) -> int:
    """Return the first specified number of steps, or ``STEPS`` if no number is specified.

    In a comparison, the number does not depend on the size of the pictures, so that scenes are comparable.
    """
    return next((steps for steps in specified if steps is not None), STEPS)


def model_digest(kind: type) -> str:
    """Return a digest of the source file of a plug-in's shading model. It is empty for models of this package."""
    file = Path(inspect.getfile(kind))
    return "" if PACKAGE in file.parents else _digest(file.parent, [file])


def open_compared(folder: str | Path, device: DeviceName = "auto") -> OpenedRun | FieldRun:
    """Open a run of a comparison.

    Raises:
        PolarguideError: the folder is not a run, is damaged, or was written by another version.
    """
    recipe = recipe_named(RunConfiguration.load(Path(folder)).recipe)
    if isinstance(recipe, Recipe):
        return OpenedRun.open(folder, recipe=recipe, device=device)
    return open_field(folder, recipe, device=device)
