"""Differences between trainings of Gaussians and of fields: memory, trainer, model, files, and examined evidence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from polarguide.capture import Scene
from polarguide.capture.exposures import TABLE, Exposure, table_text
from polarguide.capture.layout import find_layout
from polarguide.capture.view import listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.core.system import MemoryBound
from polarguide.core.text import command
from polarguide.raster import Backend
from polarguide.runs.folder import CHECKPOINT, PLY
from polarguide.runs.health import Evidence, Polarization
from polarguide.runs.memory_plan import MemoryPlan, plan_field_memory, plan_memory
from polarguide.runs.model import GaussianModel, Model, write_run_ply
from polarguide.runs.painted import FOLDER
from polarguide.training.angles.polarizers import REMEDY, Judgment, Polarizers, predicts_filters
from polarguide.training.angles.trainer import AngleTrainer
from polarguide.training.distributed import Ranks
from polarguide.training.feed import ViewStore
from polarguide.training.metals.observations import blended, evenly
from polarguide.training.metals.search import looks
from polarguide.training.recipe import Method, Recipe
from polarguide.training.settings import ResolvedSettings
from polarguide.training.trainer import warn_of_unused_materials
from polarguide.visualization.figures import contact_sheet, radiance_to_rgb, scalar_to_rgb, write_png
from polarguide_bench.gnerp.model import FieldModel
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.gnerp.trainer import FieldTrainer

METALS_PICTURE, METAL_VIEWS = "metals.png", 6
"""The picture of a run that shows what is metal, and how many training views it has at most."""
ANY = 90.0
"""Degrees: as far as two angles can be apart."""


def report_polarizers(out: Path, scene: Scene, polarizers: Polarizers, reporter: Reporter) -> None:
    """Write ``angles.csv``, which can take the place of the scene's own, and name what is doubtful.

    Args:
        out: the run folder. scene: the capture. polarizers: as the training leaves them.
        reporter: receives a summary, and a warning for pictures that contradict their specified angles.
    """
    judgments = polarizers.judgments()
    if not judgments:
        return
    names = picture_names(scene)
    of = {(judgment.view, judgment.number): judgment for judgment in judgments}
    lines: list[tuple[str, str, Exposure, float | None, str]] = []
    for view in scene.views:
        for number, exposure in enumerate(view.exposures):
            file, judged = names[view.name][number], of.get((view.name, number))
            if judged is None:
                lines.append((file, view.name, exposure, None, ""))
                continue
            note = "doubtful" if judged.doubtful and not judged.specified.known else ""
            lines.append((file, view.name, judged.believed, judged.modulation, note))
    write_text(out / TABLE, table_text(lines))

    def named(chosen: Sequence[Judgment]) -> str:
        return f"{len(chosen)} of {len(judgments)} pictures ({listed([_name(names, j) for j in chosen])})"

    sought = [judgment for judgment in judgments if not judgment.specified.known]
    if sought:
        fitted = sum(judgment.believed.angle is not None for judgment in sought)
        doubtful = sum(judgment.doubtful for judgment in sought)
        reporter.say(
            f"angles found for {fitted} of {len(sought)} pictures; {doubtful} of {len(sought)} are doubtful: "
            f"{out / TABLE}"
        )
        if 2 * doubtful > len(sought):
            reporter.warn(f"Most angles are doubtful, and so are the layers and normals. {REMEDY}")
    vague = [judgment for judgment in sought if judgment.vague]
    if guessed := [judgment for judgment in vague if judgment.guesses]:
        reporter.warn(f"{named(guessed)} hardly determine their angle; the most likely one is used.")
    if lost := [judgment for judgment in vague if not judgment.guesses]:
        reporter.warn(f"{named(lost)} do not determine their angle and are used as photographs.")
    if unsettled := [judgment for judgment in sought if judgment.unsettled]:
        reporter.warn(
            f"{named(unsettled)} may be at another angle: the fits of the training do not agree on it."
        )
    if poor := [judgment for judgment in sought if judgment.poorly_explained and not judgment.unsettled]:
        reporter.warn(
            f"{named(poor)} may be at another angle: the scene explains them worse than the others, and hardly better "
            "than a filter turned by 90 degrees would."
        )
    if plain := [judgment for judgment in judgments if judgment.unfiltered]:
        reporter.warn(
            f"{named(plain)} look as if taken without a filter, or through a circular one mounted the wrong way round."
        )
    specified = [judgment for judgment in judgments if judgment.specified.angle is not None]
    if specified and all(judgment.limit >= ANY for judgment in specified):
        reporter.say(
            f"known angles were not checked: the model predicts polarization too poorly (pictures look "
            f"{specified[0].usual:.0f} degrees off in the median). "
            f"{command('inspect', scene.root)} checks them by itself."
        )
    if wrong := [judgment for judgment in judgments if judgment.contradicts]:
        first = wrong[0]
        reporter.warn(
            f"{named(wrong)} contradict their angles: {_name(names, first)} is specified at "
            f"{first.specified.words} degrees and looks as if at {first.angle:.0f}. {command('inspect', scene.root)} "
            "compares all angles by themselves; correct the names of the files or angles.csv where it agrees."
        )


def report_metals(out: Path, trainer: AngleTrainer, model: GaussianModel, reporter: Reporter) -> None:
    """Say what is metal and of what polarization cannot tell, and write ``metals.png`` with both."""
    undecided = trainer.undecided()
    if undecided is None:
        return
    gaussians, rasterize = model.state.gaussians, model.backend.rasterize
    views = evenly(trainer.scene.train_views, METAL_VIEWS)
    kinds = [
        [blended(gaussians, values, view.camera, rasterize).cpu() for view in views]
        for values in (gaussians["metalness"], undecided.float())
    ]
    metal, open_ = (
        100 * float(torch.stack([(k > 0.5).float().mean() for k in kind]).mean()) for kind in kinds
    )
    if not metal and not open_:
        (out / METALS_PICTURE).unlink(missing_ok=True)
        return
    rows = [
        [radiance_to_rgb(view.photograph()), *(scalar_to_rgb(kind[row], 0.0, 1.0) for kind in kinds)]
        for row, view in enumerate(views)
    ]
    labels = ["photograph", "metal", "undecided"]
    write_png(out / METALS_PICTURE, contact_sheet(rows, [view.name for view in views], labels))
    advice = ". Click on what is metal in the viewer (Materials), and resume" if open_ else ""
    reporter.say(
        f"metals: {metal:.1f} % of the pixels; undecided, as polarization cannot tell: {open_:.1f} %, see "
        f"{out / METALS_PICTURE}{advice}"
    )


def picture_names(scene: Scene) -> dict[str, list[str]]:
    """The files of each view's pictures; where the scene was not read from such files, the view and a number."""
    try:
        layout = find_layout(scene.root)
    except PolarguideError:
        layout = None
    names = {}
    for view in scene.views:
        names[view.name] = [f"{view.name}#{number}" for number in range(len(view.exposures))]
        if layout is not None and view.name in layout.names and layout.exposures(view.name) == view.exposures:
            names[view.name] = [path.name for path in layout.files(view.name)]
    return names


def _name(names: dict[str, list[str]], judgment: Judgment) -> str:
    return names[judgment.view][judgment.number]


AnyTrainer = AngleTrainer | FieldTrainer
"""The trainers that the training loop knows: what it asks of them, both have."""


class Family(ABC):
    """A kind of recipes. ``method`` is always of this kind, and so are states and trainers."""

    leaves: str
    """The file that a finished training of this kind has written at last."""

    @abstractmethod
    def plan(
        self, pixels: Sequence[int], method: Any, gaussians: int, limit: float | None, *, in_memory: bool
    ) -> MemoryPlan:
        """How a training stays within its memory; see ``plan_memory``."""

    def check(self, state: Any, settings: ResolvedSettings, out: Path) -> None:
        """Refuse a checkpoint that does not belong to the settings of its run.

        Raises:
            PolarguideError: the checkpoint does not belong to them.
        """
        if state.step > settings.steps:
            raise PolarguideError(
                out / CHECKPOINT,
                expected=f"the state of a training of {settings.steps} steps",
                found=f"the state after step {state.step}",
                remedy="Train again into a new folder.",
            )

    def go_back(
        self, state: Any, method: Any, settings: ResolvedSettings, out: Path, reporter: Reporter
    ) -> None:
        """Take a run back to where what was painted over it still counts.

        Args:
            state: state of the training; changed. None: it has not begun.

        Raises:
            PolarguideError: materials mean nothing to the recipe, or to a training this short.
        """
        raise PolarguideError(
            out / FOLDER,
            expected="a training that asks at some step what is metal",
            found=f"one of {method.name} in {settings.steps} steps, with --materials {settings.materials}",
            remedy="Remove the folder, or train polarguide-stokes in 1,500 steps or more.",
        )

    @abstractmethod
    def trainer(
        self,
        scene: Scene,
        method: Any,
        settings: ResolvedSettings,
        backend: Backend,
        state: Any,
        ranks: Ranks,
        store: ViewStore,
        reporter: Reporter,
        memory: MemoryBound,
    ) -> AnyTrainer:
        """The trainer; it reports its assumptions about the scene."""

    @abstractmethod
    def model(self, state: Any, method: Any, settings: ResolvedSettings, backend: Backend) -> Model:
        """The trained model, for scoring and viewing."""

    @abstractmethod
    def finish(self, out: Path, trainer: Any, model: Any, reporter: Reporter) -> None:
        """Write what a finished training leaves beside its checkpoint."""

    @abstractmethod
    def evidence(self, trainer: Any, method: Any) -> Evidence:
        """The evidence by which a finished training is examined."""


class GaussianFamily(Family):
    """Recipes of Gaussians."""

    leaves = PLY

    def plan(
        self, pixels: Sequence[int], method: Recipe, gaussians: int, limit: float | None, *, in_memory: bool
    ) -> MemoryPlan:
        """See ``Family``."""
        return plan_memory(pixels, method, gaussians, limit=limit, in_memory=in_memory)

    def check(self, state: Any, settings: ResolvedSettings, out: Path) -> None:
        """See ``Family``; refuses sums of the density control for other views a step, too."""
        super().check(state, settings, out)
        sums = state.statistics.gradient
        views = sums.shape[0] if sums.ndim == 2 else 1
        if views != settings.views_per_step:
            raise PolarguideError(
                out / CHECKPOINT,
                expected=f"the state of a training with {settings.views_per_step} views a step",
                found=f"a training with {views}",
                remedy="Train again into a new folder.",
            )

    def go_back(
        self, state: Any, method: Recipe, settings: ResolvedSettings, out: Path, reporter: Reporter
    ) -> None:
        """See ``Family``: to the last step at which metals are looked for."""
        last = max(looks(method, settings), default=None)
        if last is None:
            super().go_back(state, method, settings, out, reporter)
        elif state is not None and state.step > last:
            reporter.say(
                f"{out / FOLDER} has changed: training goes on from step {last}, which decides on metals"
            )
            state.step, state.frozen, state.footprints = last, None, None

    def trainer(
        self,
        scene: Scene,
        method: Recipe,
        settings: ResolvedSettings,
        backend: Backend,
        state: Any,
        ranks: Ranks,
        store: ViewStore,
        reporter: Reporter,
        memory: MemoryBound,
    ) -> AngleTrainer:
        """See ``Family``."""
        warn_of_unused_materials(scene, method, settings, backend, reporter.warn)
        trainer = AngleTrainer(scene, method, settings, backend, state, ranks, store, reporter.warn, memory)
        if trainer.polarizers.ignored:
            reporter.warn(_ignored(method))
        return trainer

    def model(
        self, state: Any, method: Recipe, settings: ResolvedSettings, backend: Backend
    ) -> GaussianModel:
        """See ``Family``."""
        return GaussianModel(state, method.shading.bind(settings.refractive_index), backend)

    def finish(self, out: Path, trainer: AngleTrainer, model: GaussianModel, reporter: Reporter) -> None:
        """See ``Family``: what was found out of polarizers, and the PLY."""
        report_polarizers(out, trainer.scene, trainer.polarizers, reporter)
        report_metals(out, trainer, model, reporter)
        centers = torch.stack([view.camera.center for view in trainer.scene.views])
        write_run_ply(out / PLY, model.state, model.shading, centers)

    def evidence(self, trainer: AngleTrainer, method: Recipe) -> Evidence:
        """See ``Family``. A look at a view takes two renderings without gradients, a third of a step each."""
        views = [trainer.polarizers.believed(view) for view in trainer.scene.train_views]
        filters, priors = predicts_filters(method), any(stage.weights.priors for stage in method.stages)
        judgments = trainer.polarizers.judgments()
        polarization = Polarization.of(views, judgments, measured=priors, fitted=filters)
        return Evidence(views, polarization, filters=filters, steps_a_view=1.0)


class FieldFamily(Family):
    """Recipes of neural fields."""

    leaves = CHECKPOINT

    def plan(
        self,
        pixels: Sequence[int],
        method: NeuralRecipe,
        gaussians: int,
        limit: float | None,
        *,
        in_memory: bool,
    ) -> MemoryPlan:
        """See ``Family``."""
        return plan_field_memory(pixels, method, limit=limit, in_memory=in_memory)

    def trainer(
        self,
        scene: Scene,
        method: NeuralRecipe,
        settings: ResolvedSettings,
        backend: Backend,
        state: Any,
        ranks: Ranks,
        store: ViewStore,
        reporter: Reporter,
        memory: MemoryBound,
    ) -> FieldTrainer:
        """See ``Family``."""
        if not all(view.is_determined for view in scene.train_views):
            reporter.warn(_ignored(method))
        return FieldTrainer(scene, method, settings, backend.device, state, store)

    def model(
        self, state: Any, method: NeuralRecipe, settings: ResolvedSettings, backend: Backend
    ) -> FieldModel:
        """See ``Family``."""
        return FieldModel(state, method, backend.device)

    def finish(self, out: Path, trainer: Any, model: Any, reporter: Reporter) -> None:
        """See ``Family``: nothing."""

    def evidence(self, trainer: FieldTrainer, method: NeuralRecipe) -> Evidence:
        """See ``Family``. A step takes some rays of a view."""
        views = trainer.scene.train_views
        polarization = Polarization.of(views, (), measured=method.weights.aolp > 0, fitted=False)
        pixels = max(view.camera.width * view.camera.height for view in views)
        return Evidence(views, polarization, filters=False, steps_a_view=pixels / method.sampling.rays)


def family_of(method: Method) -> Family:
    """The family of a recipe."""
    return FieldFamily() if isinstance(method, NeuralRecipe) else GaussianFamily()


def _ignored(method: Method) -> str:
    return (
        f"the recipe {method.name} has no term for single pictures through a filter: it takes them for "
        "photographs without one."
    )
