"""Health and reports of a finished training, as callbacks at its end.

A training can end normally although its result is unusable. Each value in ``health.json`` measures one possible fault.
If a value exceeds its limit in ``Limits``, a warning names the views and a remedy. No value depends on a held-out
photograph. The reports at the end cover polarizer angles and metals.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from types import MappingProxyType
from typing import Annotated, Literal

import msgspec
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from polarguide.capture import Scene, View
from polarguide.capture.angle_evidence import TO_DEVIATION
from polarguide.capture.exposures import TABLE, Exposure, analyzers, table_text
from polarguide.capture.layout import find_layout
from polarguide.capture.variants import BLACK, black_pixels
from polarguide.capture.view import listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.core.records import read_record
from polarguide.core.text import command
from polarguide.gaussians.initialize import camera_reach
from polarguide.geometry.camera import Camera
from polarguide.geometry.coverage import HAZE_DEPTH, ConfirmedSurfaces, depth_map_of_rendering
from polarguide.optics.color import srgb_encode
from polarguide.runs.callbacks import CURVE_POINTS, HeldOutScore
from polarguide.runs.folder import PLY
from polarguide.runs.model import GaussianModel, write_run_ply
from polarguide.shading.result import RenderResult
from polarguide.training.angles.polarizers import REMEDY, AngleFits, Judgment, Polarizers, predicts_filters
from polarguide.training.callback import Callback
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.observations import blended, evenly
from polarguide.training.metals.search import MetalSearch
from polarguide.training.photometric import behind_analyzer
from polarguide.visualization.figures import contact_sheet, radiance_to_rgb, scalar_to_rgb, write_png

Word = Literal["measured", "fitted", "none"]
Count = Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class PolarizationSupport:
    """Numbers of training views by the quality of their polarization data.

    They tell how far layers and normals of a run are based on measured polarization.

    Attributes:
        measured: number of views whose pictures determine the Stokes vector of every pixel.
        fitted: number of views with pictures at too few polarizer angles to determine it. The model was fitted to these
            pictures.
        none: number of views without polarization that the recipe uses. Their layers and normals are a guess of the
            model.
        pictures: number of pictures in the fitted views whose angle was judged.
        doubtful: number of these pictures whose angle is doubtful.
    """

    measured: Count
    fitted: Count
    none: Count
    pictures: Count = 0
    doubtful: Count = 0

    @classmethod
    def of(
        cls, views: Sequence[View], judgments: Sequence[Judgment], *, measured: bool, fitted: bool
    ) -> PolarizationSupport:
        """Count the training views of a run.

        Args:
            views: training views with the exposures that the training assumed.
            judgments: judgments of the training on their pictures.
            measured: True if the recipe reads the polarization of views that determine the Stokes vector.
            fitted: True if the recipe reads the polarization of other views.
        """
        determined = {view.name for view in views if view.is_determined}
        single = [
            view.name
            for view in views
            if view.name not in determined and any(e.angle is not None for e in view.exposures)
        ]
        counts = (len(determined) if measured else 0, len(single) if fitted else 0)
        judged = [judgment for judgment in judgments if judgment.view in single]
        doubtful = sum(judgment.doubtful for judgment in judged)
        return cls(*counts, len(views) - sum(counts), len(judged), doubtful)

    @property
    def word(self) -> Word:
        """Quality of polarization data that most training views have. Ties go to the lower quality."""
        counts: dict[Word, int] = {"none": self.none, "fitted": self.fitted, "measured": self.measured}
        return max(counts, key=lambda word: counts[word])

    @property
    def text(self) -> str:
        """Quality of polarization data of most views, with the numbers of other views and doubtful pictures."""
        counts = {"measured": self.measured, "fitted": self.fitted, "none": self.none}
        notes = dict.fromkeys(counts, "")
        if self.pictures:
            notes["fitted"] = f" ({self.doubtful} of {self.pictures} pictures doubtful)"
        if self.none == sum(counts.values()):
            return f"{self.word} (layers and normals are a guess of the model)"
        words = sorted((word for word in counts if counts[word]), key=lambda word: word != self.word)
        if len(words) == 1:
            return f"{self.word}{notes[self.word]}"
        texts = [f"{word} in {counts[word]}{notes[word]}" for word in words[1:]]
        first = f"{self.word} in {counts[self.word]} of {sum(counts.values())} views{notes[self.word]}"
        return ", ".join([first, *texts])


HEALTH = "health.json"
"""Name of the record in a run folder."""
MOST_VIEWS = 64
"""Largest number of examined views."""
TIME_SHARE = 0.02
"""Largest number of examined training views, as a share of the number of steps. On a CPU, a view takes about a step."""
CURVE_VIEWS = 4
"""Largest number of held-out views that are scored during a training."""
NEIGHBORS = 6
"""Number of neighbors with which a view is compared. Smaller captures are not compared."""
HIGHEST_PSNR = 100.0
"""Upper bound of recorded PSNR values in dB, needed because the PSNR of equal pictures is infinite."""
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


@dataclass(frozen=True)
class Limits:
    """Limits of the measured values, beyond which a warning is given.

    Attributes:
        far: difference in dB by which the PSNR of a view is lower than the median PSNR of its nearest views. 10 dB mean
            ten times the squared error. In sound scenes, neighboring views differ by up to 6 dB.
        scattered: difference as above, in robust standard deviations of all differences. It replaces ``far`` in scenes
            with larger differences.
        brighter: factor on the brightest measured intensity. A pixel is burned if it is brighter than the product.
            Polarization alone does not explain such light, because a filter hides more than half of the light only
            where more than half of it is polarized.
        burned: share of burned pixels in a view. The default corresponds to a spot of 9 x 9 pixels in 320 x 240.
        exposed: difference in stops between the brightness of a view and its prediction, in any color, relative to
            other views. Cameras change exposures in steps of a third of a stop, and the default is half of a step.
        haze: mean alpha of a view in free space, in front of surfaces that two training views confirm. At this value
            the haze changes a picture by up to 5 of 255 levels.
        bare: share of pixels of a view that are holes. A hole is mostly transparent and has less than half of the
            measured light, which no filter explains.
        unseen: share of Gaussians that no view shows. They enlarge files and appear in views from other sides.
    """

    far: float = 10.0
    scattered: float = 3.0
    brighter: float = 2.0
    burned: float = 0.001
    exposed: float = 0.17
    haze: float = 0.02
    bare: float = 0.01
    unseen: float = 0.1


LIMITS = Limits()


@dataclass(frozen=True)
class ViewHealth:
    """Measured values of one training view.

    Attributes:
        psnr: PSNR in dB of the predicted pictures of the view, as displayed. None without a valid pixel.
        beside: median PSNR in dB of the nearest views. None if there are too few views.
        burned: share of pixels that are brighter than ``Limits.brighter`` times the brightest measured intensity.
        bare: share of pixels that are holes, see ``Limits.bare``.
        stops: median of measured over predicted light in R, G and B, in stops. None without a valid pixel.
    """

    psnr: float | None
    beside: float | None
    burned: Share
    bare: Share
    stops: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Health:
    """Health of a training.

    Attributes:
        polarization: numbers of views by the quality of their polarization data.
        warnings: messages, each with a fault, the affected views, and a remedy.
        views: values of the examined views by name.
        haze: mean alpha in free space of the examined views and of the held-out views by name, see ``Limits.haze``.
            Views without a confirmed surface are missing.
        brightest: largest linear intensity that was measured in the examined views.
        unseen: share of Gaussians that no examined view shows. None if a short training examined too few views.
    """

    polarization: PolarizationSupport
    warnings: tuple[str, ...] = ()
    views: dict[str, ViewHealth] = dataclasses.field(default_factory=dict)
    haze: dict[str, Share] = dataclasses.field(default_factory=dict)
    brightest: float | None = None
    unseen: Share | None = None

    @property
    def summary(self) -> str:
        """Message with the number of examined views and the worst PSNR."""
        psnrs = {name: view.psnr for name, view in self.views.items() if view.psnr is not None}
        if not psnrs:
            return "health: no training view was looked at, the training was too short"
        worst = min(psnrs, key=lambda name: psnrs[name])
        return (
            f"health: {len(self.views)} training views looked at, the worst is {worst} with {psnrs[worst]:.1f} dB "
            f"(median {median(psnrs.values()):.1f})"
        )

    def save(self, run: Path) -> None:
        """Write ``health.json``."""
        record = dataclasses.asdict(self)
        record["polarization"] = {"word": self.polarization.word, **record["polarization"]}
        write_text(run / HEALTH, json.dumps(record, indent=1) + "\n")

    @classmethod
    def load(cls, run: Path) -> Health | None:
        """Read ``health.json`` from a run folder.

        Return None if the training is unfinished, or if its version of polarguide did not write this file.

        Raises:
            PolarguideError: the file cannot be read or is invalid.
        """
        if not os.path.lexists(run / HEALTH):
            return None
        return read_record(run / HEALTH, cls, remedy="Remove it; it only holds warnings.")


class RecordedWarnings(Reporter):
    """Reporter that passes messages on and records the warnings.

    Args:
        reporter: receives the messages.

    Attributes:
        warnings: all warnings.
    """

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self.warnings = list[str]()

    def say(self, text: str) -> None:
        """See ``Reporter``."""
        self._reporter.say(text)

    def warn(self, text: str) -> None:
        """See ``Reporter``."""
        self.warnings.append(text)
        self._reporter.warn(text)


@dataclass(frozen=True, eq=False)
class TrainingEvidence:
    """Data with which a finished training is examined.

    Attributes:
        views: all training views, with the exposures that the training assumed.
        polarization: numbers of these views by the quality of their polarization data.
        filters: True if the recipe learns from pictures behind filters.
        held_out: cameras of the held-out views by name.
    """

    views: Sequence[View]
    polarization: PolarizationSupport
    filters: bool
    held_out: Mapping[str, Camera] = dataclasses.field(default_factory=dict)

    def chosen(self, steps: int) -> list[View]:
        """Return the views to examine after a training of ``steps`` steps, evenly spread; see ``TIME_SHARE``."""
        count = min(MOST_VIEWS, len(self.views), int(TIME_SHARE * steps))
        places = torch.linspace(0, len(self.views) - 1, count).round().long().tolist() if count else []
        return [self.views[place] for place in places]


@torch.no_grad()
def examine(
    model: GaussianModel, evidence: TrainingEvidence, points: Tensor, steps: int, reporter: Reporter
) -> Health:
    """Render training views, compare them with the photographs, and collect warnings.

    Args:
        model: the trained model.
        evidence: views and polarization data of its training.
        points: [M, 3] SfM points of the scene.
        steps: number of steps of the training.
        reporter: receives progress.
    """
    views = evidence.chosen(steps)
    if not views:
        return Health(evidence.polarization)
    brightest = max(map(_brightest, views))
    centers = torch.stack([view.camera.center for view in evidence.views]).numpy()
    middle, reach = camera_reach(points.double().numpy() if len(points) else centers, centers)
    center = torch.from_numpy(middle)
    by_view = {}
    radii = []
    depths = []
    with reporter.track("checking the result", len(views)) as advance:
        for view in views:
            result = model.render(view.camera, depth=True, surface=True)
            by_view[view.name] = _examine_view(
                model, view, result, LIMITS.brighter * brightest, evidence.filters
            )
            radii.append(result.training["radii"])
            alpha = result.alpha.cpu() * ~view.invalid.cpu()
            depths.append(depth_map_of_rendering(view.camera, result.depth, alpha, center, reach).on_grid())
            advance(len(by_view))
    cameras = {**{view.name: view.camera for view in views}, **evidence.held_out}
    for name, psnr in _neighbor_psnr(views, {name: facts.psnr for name, facts in by_view.items()}).items():
        by_view[name] = dataclasses.replace(by_view[name], beside=psnr)
    unseen = None
    if len(views) == min(MOST_VIEWS, len(evidence.views)):  # a part of the views would miss visible Gaussians
        unseen = float((torch.stack(radii).amax(dim=0) <= 0).float().mean())
    invalid = {view.name: view.invalid.cpu() for view in views}
    haze = haze_of_views(model, cameras, ConfirmedSurfaces(depths), invalid)
    warnings = tuple(warnings_of(by_view, unseen, haze))
    return Health(evidence.polarization, warnings, by_view, haze, brightest, unseen)


def haze_of_views(
    model: GaussianModel,
    cameras: Mapping[str, Camera],
    surfaces: ConfirmedSurfaces,
    invalid: Mapping[str, Tensor] = MappingProxyType({}),
) -> dict[str, float]:
    """Return the mean alpha in free space of each view, over valid pixels with a confirmed surface.

    Args:
        model: the trained model.
        cameras: cameras of the views by name.
        surfaces: surfaces that training views confirm.
        invalid: masks [H, W] of invalid pixels by name. Other views have none.

    Returns:
        Alpha in [0, 1] by name. Views without a confirmed surface are missing.
    """
    haze = {}
    for name, camera in cameras.items():
        nearest = surfaces.nearest(camera)
        confirmed = nearest > 0
        if name in invalid:
            confirmed &= ~invalid[name]
        if bool(confirmed.any()):
            alpha = model.alpha_in_front(camera, HAZE_DEPTH * nearest).cpu()
            haze[name] = float(alpha[confirmed].mean())
    return haze


def _counted(view: View) -> Tensor:
    """Return the mask [H, W] of valid and unsaturated pixels."""
    return ~(view.invalid | view.saturated)


def _brightest(view: View) -> float:
    """Return the largest linear intensity that was measured in a view; 0 without a valid pixel."""
    measured = view.intensities().amax(dim=(0, 3))[_counted(view)]
    return float(measured.max()) if len(measured) else 0.0


def _examine_view(
    model: GaussianModel, view: View, result: RenderResult, limit: float, filters: bool
) -> ViewHealth:
    """Return the measured values of a view.

    Args:
        model: the trained model.
        view: the view.
        result: its rendering.
        limit: intensity above which a pixel is burned.
        filters: True if the model predicts pictures behind filters.
    """
    local = view.to(model.device)
    camera = view.camera
    counted = _counted(local)
    stokes = model.stokes(result, camera) if filters else None
    measured, predicted = _compared(local, result.final, stokes)
    psnr = _psnr(predicted, measured, counted)
    burned = ~(result.final <= limit).all(dim=-1) & counted
    photograph = local.photograph().mean(dim=-1)
    light = result.final.mean(dim=-1)
    unlit = black_pixels(view).to(model.device) | ~counted
    inner = max_pool2d(unlit.float()[None], 3, stride=1, padding=1)[0] == 0  # edges are blended
    bare = inner & (result.alpha < 0.5) & (light < photograph / 2)
    stops = _stops(measured.mean(dim=0), predicted.mean(dim=0), counted)
    return ViewHealth(psnr, None, _share(burned), _share(bare), stops)


def _psnr(predicted: Tensor, measured: Tensor, counted: Tensor) -> float | None:
    """Return the PSNR of linear pictures [K, H, W, 3] in dB, as displayed; None if no pixel of ``counted`` is True."""
    errors = srgb_encode(predicted.nan_to_num(0.0, 1.0, 0.0).clamp(0, 1)) - srgb_encode(measured.clamp(0, 1))
    error = errors[:, counted].square().mean().double()
    return None if bool(error.isnan()) else min(float(-10 * torch.log10(error)), HIGHEST_PSNR)


def _stops(measured: Tensor, predicted: Tensor, counted: Tensor) -> tuple[float, float, float] | None:
    """Return the median of measured over predicted light for each color, in stops; None if all pixels are black."""
    lit = counted & (torch.minimum(measured, predicted).amin(dim=-1) > BLACK)
    if not bool(lit.any()):
        return None
    red, green, blue = torch.log2(measured[lit] / predicted[lit]).median(dim=0).values.tolist()
    return red, green, blue


def _compared(view: View, final: Tensor, stokes: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the measured and the predicted pictures of a view, each [K, H, W, 3] linear.

    If the model predicts Stokes vectors, these are all pictures behind filters at known angles. Otherwise it is the
    photograph.
    """
    indices = [k for k, exposure in enumerate(view.exposures) if exposure.known]
    if stokes is None or not indices:
        return view.photograph()[None], final[None]
    rays = view.camera.rays(device=final.device)
    behind = analyzers([view.exposures[k] for k in indices], rays, view.mount)
    predicted = torch.stack([final + behind_analyzer(stokes, each) for each in behind])
    return view.intensities()[indices], predicted


def _neighbor_psnr(views: Sequence[View], psnr: Mapping[str, float | None]) -> dict[str, float]:
    """Return, for each view, the median PSNR of its nearest views; empty if there are too few views.

    The distance between two views combines two parts. One is the distance of the camera centers, divided by the mean
    distance of the centers from their middle. The other is the difference of the viewing directions.
    """
    scored = [view for view in views if psnr[view.name] is not None]
    if len(scored) <= NEIGHBORS:
        return {}
    centers = torch.stack([view.camera.center for view in scored])
    distance = (centers - centers.mean(dim=0)).norm(dim=1).mean().clamp(min=1e-12)
    places = torch.cat((centers / distance, torch.stack([view.camera.rotation[2] for view in scored])), dim=1)
    distances = torch.cdist(places, places).fill_diagonal_(torch.inf)
    nearest = distances.topk(NEIGHBORS, largest=False).indices.tolist()
    values = [float(psnr[view.name] or 0.0) for view in scored]
    return {
        view.name: median(values[place] for place in row) for view, row in zip(scored, nearest, strict=True)
    }


def _share(pixels: Tensor) -> float:
    return float(pixels.float().mean())


def warnings_of(
    views: Mapping[str, ViewHealth],
    unseen: float | None,
    haze: Mapping[str, float],
    limits: Limits = LIMITS,
) -> list[str]:
    """Return the warnings, the most severe first.

    Args:
        views: values of the examined views by name.
        unseen: share of Gaussians that no view shows. None means unknown.
        haze: mean alpha in free space of training views and held-out views by name.
        limits: limits of the values.
    """
    warnings = []
    bare = {name: view.bare for name, view in views.items() if view.bare > limits.bare}
    burned = {name: view.burned for name, view in views.items() if view.burned > limits.burned}
    if burned:
        warnings.append(
            f"the result has burned: {_worst(burned)} are over {limits.brighter:g} times as bright as the brightest "
            "measured intensity. The pictures do not determine the light there. Do not use this run; add pictures of "
            "these views at other angles, or without a filter, and train again."
        )
    exposed = {name: off for name, off in _exposed(views, limits).items() if name not in burned | bare}
    explained = burned | bare | exposed
    poor = [name for name in _far_under(views, limits) if name not in explained]
    if poor:
        worst = ", ".join(
            f"{name} ({views[name].psnr:.1f} dB, neighbors {views[name].beside:.1f} dB)" for name in poor[:4]
        )
        rest = f" and {len(poor) - 4} more" if len(poor) > 4 else ""
        warnings.append(
            f"training views with a far lower PSNR than their neighbors: {worst}{rest}. Pose, polarizer angle, "
            "exposure or focus of these photographs may be wrong: "
            f"{command('render', 'RUN', '--views', ','.join(poor[:4]))} compares them "
            "with the run; correct them or leave them out."
        )
    if exposed:
        stops = listed([f"{name} {off:+.2f}" for name, off in exposed.items()])
        warnings.append(
            f"training views brighter or darker than the result predicts, or of other colors (stops: {stops}): their "
            "exposure or white balance differs and was not corrected. Leave them out, or prepare with --gains auto."
        )
    hazy = {name: alpha for name, alpha in haze.items() if alpha > limits.haze}
    if hazy:
        warnings.append(
            f"haze in front of {_worst(hazy, 'opacity')}: Gaussians lie in space through which training views see "
            "surfaces. Add views from these sides, or train with another --seed. For a subject without surroundings, "
            "train with --background black or masked."
        )
    if bare:
        warnings.append(
            f"the result has holes where the photographs show surfaces: {_worst(bare)}. Add views or points there. "
            "If surroundings are missing, train with --background scene."
        )
    if unseen is not None and unseen > limits.unseen:
        warnings.append(
            f"{100 * unseen:.0f} % of the Gaussians are outside all {len(views)} examined training views, which do not "
            "determine them. Keep them out of exports with a crop box (polarguide present --crop)."
        )
    return warnings


def _exposed(views: Mapping[str, ViewHealth], limits: Limits) -> dict[str, float]:
    """Find views whose exposure differs from the other views.

    Return their differences in stops by the name of the view, the largest first.
    """
    stops_by_view = {name: torch.tensor(view.stops) for name, view in views.items() if view.stops is not None}
    if len(stops_by_view) <= NEIGHBORS:
        return {}
    stops = torch.stack(list(stops_by_view.values()))
    deviations = stops - stops.median(dim=0).values
    threshold = max(limits.exposed, limits.scattered * TO_DEVIATION * float(deviations.abs().median()))
    strongest = {
        name: max(row.tolist(), key=abs) for name, row in zip(stops_by_view, deviations, strict=True)
    }
    order = sorted(strongest, key=lambda name: -abs(strongest[name]))
    return {name: strongest[name] for name in order if abs(strongest[name]) > threshold}


def _far_under(views: Mapping[str, ViewHealth], limits: Limits) -> list[str]:
    """Return the views with a far lower PSNR than their neighbors, the lowest first."""
    drops = {
        name: view.beside - view.psnr
        for name, view in views.items()
        if view.psnr is not None and view.beside is not None
    }
    scatter = TO_DEVIATION * median(map(abs, drops.values())) if drops else 0.0
    threshold = max(limits.far, limits.scattered * scatter)
    return sorted((name for name in drops if drops[name] > threshold), key=lambda name: -drops[name])


def _worst(shares: Mapping[str, float], of: str = "of the pixels") -> str:
    """Return the names of views as text, ordered by decreasing share, with the share of the first view."""
    first, *rest = sorted(shares, key=lambda name: -shares[name])
    return listed([f"{first} ({100 * shares[first]:.1f} % {of})", *rest])


def held_out_score(loop: TrainingLoop) -> HeldOutScore:
    """Return a function that computes the mean PSNR of a few held-out views with the current Gaussians.

    All calls in a training render at most ``TIME_SHARE`` of its number of steps. A short training scores no view.
    """
    context = loop.context
    scored = min(CURVE_VIEWS, int(TIME_SHARE * context.settings.steps / CURVE_POINTS))
    views = evenly(context.scene.test_views, scored) if scored else []

    @torch.no_grad()
    def score() -> float | None:
        model = GaussianModel(loop.state, context.shading, context.backend)
        scores = []
        for view in context.memory.between(views):
            local = view.to(model.device)
            final = model.render(view.camera).final
            scores.append(_psnr(final[None], local.photograph()[None], _counted(local)))
        finite = [value for value in scores if value is not None]
        return sum(finite) / len(finite) if finite else None

    return score


@dataclass(eq=False)
class HealthCheck(Callback[TrainingLoop]):
    """Callback that examines a finished training, writes ``health.json`` and reports a summary.

    Args:
        out: the run folder.
        fits: callback that fitted the polarizer angles of the training.
        reports: reporter of the other reports. Their warnings are added to ``health.json``.
    """

    out: Path
    fits: AngleFits
    reports: RecordedWarnings

    def at_end(self, loop: TrainingLoop) -> None:
        context = loop.context
        recipe = context.recipe
        polarizers = self.fits.polarizers
        views = [polarizers.believed(view) for view in context.views]
        filters = predicts_filters(recipe)
        priors = any(stage.weights.priors for stage in recipe.stages)
        support = PolarizationSupport.of(views, polarizers.judgments(), measured=priors, fitted=filters)
        held_out = {view.name: view.camera for view in context.scene.test_views}
        evidence = TrainingEvidence(views, support, filters=filters, held_out=held_out)
        model = GaussianModel(loop.state, context.shading, context.backend)
        health = examine(model, evidence, context.scene.points, context.settings.steps, context.reporter)
        for warning in health.warnings:
            context.reporter.warn(warning)
        health = dataclasses.replace(health, warnings=(*health.warnings, *self.reports.warnings))
        health.save(self.out)
        context.reporter.say(f"{health.summary}; polarization: {health.polarization.text}")


METALS_PICTURE = "metals.png"
"""Name of the picture of metals in a run folder."""
METAL_VIEWS = 6
"""Largest number of training views in that picture."""
LARGEST_DIFFERENCE = 90.0
"""Largest possible difference between two polarizer angles, in degrees."""


def report_polarizers(out: Path, scene: Scene, polarizers: Polarizers, reporter: Reporter) -> None:
    """Write ``angles.csv`` in the format of a scene, and report doubtful angles.

    Args:
        out: the run folder.
        scene: the capture.
        polarizers: angles of the finished training.
        reporter: receives a summary, and a warning for pictures that contradict their specified angles.
    """
    judgments = polarizers.judgments()
    if not judgments:
        return
    names = picture_files(scene)
    by_picture = {(judgment.view, judgment.number): judgment for judgment in judgments}
    lines: list[tuple[str, str, Exposure, float | None, str]] = []
    for view in scene.views:
        for number, exposure in enumerate(view.exposures):
            judged = by_picture.get((view.name, number))
            note = "doubtful" if judged and judged.doubtful and not judged.specified.known else ""
            believed, modulation = (judged.believed, judged.modulation) if judged else (exposure, None)
            lines.append((names[view.name][number], view.name, believed, modulation, note))
    write_text(out / TABLE, table_text(lines))

    def named(chosen: Sequence[Judgment]) -> str:
        return f"{len(chosen)} of {len(judgments)} pictures ({listed([names[j.view][j.number] for j in chosen])})"

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
    for chosen, fault in (
        (
            [judgment for judgment in vague if judgment.guesses],
            "hardly determine their angle; the most likely one is used.",
        ),
        (
            [judgment for judgment in vague if not judgment.guesses],
            "do not determine their angle and are used as photographs.",
        ),
        (
            [judgment for judgment in sought if judgment.unsettled],
            "may be at another angle: the fits of the training do not agree on it.",
        ),
        (
            [judgment for judgment in sought if judgment.poorly_explained and not judgment.unsettled],
            "may be at another angle: the scene explains them worse than the others, and hardly better than a filter "
            "turned by 90 degrees would.",
        ),
        (
            [judgment for judgment in judgments if judgment.unfiltered],
            "look as if taken without a filter, or through a circular one mounted the wrong way round.",
        ),
    ):
        if chosen:
            reporter.warn(f"{named(chosen)} {fault}")
    specified = [judgment for judgment in judgments if judgment.specified.angle is not None]
    if specified and all(judgment.estimate.limit >= LARGEST_DIFFERENCE for judgment in specified):
        reporter.say(
            f"known angles were not checked: the model predicts polarization too poorly (pictures look "
            f"{specified[0].usual:.0f} degrees off in the median). "
            f"{command('inspect', scene.root)} checks them separately."
        )
    if wrong := [judgment for judgment in judgments if judgment.contradicts]:
        first = wrong[0]
        reporter.warn(
            f"{named(wrong)} contradict their angles: {names[first.view][first.number]} is specified at "
            f"{first.specified.label} degrees and looks as if at {first.angle:.0f}. {command('inspect', scene.root)} "
            "compares all angles separately; correct the names of the files or angles.csv where it agrees."
        )


def report_metals(
    out: Path, scene: Scene, undecided: Tensor | None, model: GaussianModel, reporter: Reporter
) -> None:
    """Report metals and surfaces that may be metals, and write the picture ``metals.png`` of both.

    Args:
        out: the run folder.
        scene: the capture.
        undecided: result of ``MetalSearch.undecided``. With None, there is no report.
        model: the trained Gaussians.
        reporter: receives a summary.
    """
    if undecided is None:
        return
    gaussians = model.state.gaussians
    rasterize = model.backend.rasterize
    views = evenly(scene.train_views, METAL_VIEWS)
    kinds = [
        [blended(gaussians, values, view.camera, rasterize).cpu() for view in views]
        for values in (gaussians["metalness"], undecided.float())
    ]
    metal, unknown = (
        100 * float(torch.stack([(k > 0.5).float().mean() for k in kind]).mean()) for kind in kinds
    )
    if not metal and not unknown:
        (out / METALS_PICTURE).unlink(missing_ok=True)
        return
    rows = [
        [radiance_to_rgb(view.photograph()), *(scalar_to_rgb(kind[row], 0.0, 1.0) for kind in kinds)]
        for row, view in enumerate(views)
    ]
    labels = ["photograph", "metal", "undecided"]
    write_png(out / METALS_PICTURE, contact_sheet(rows, [view.name for view in views], labels))
    advice = (
        ". Label metal in materials/ of the scene (docs/how-to/train.md), and train again" if unknown else ""
    )
    reporter.say(
        f"metals: {metal:.1f} % of the pixels; undecided, because both materials fit: {unknown:.1f} %, see "
        f"{out / METALS_PICTURE}{advice}"
    )


def picture_files(scene: Scene) -> dict[str, list[str]]:
    """Return the file names of the pictures of each view.

    Pictures that were not read from separate files are named VIEW#NUMBER.
    """
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


@dataclass(eq=False)
class PolarizerReport(Callback[TrainingLoop]):
    """Callback that reports the polarizer angles at the end of a training.

    Args:
        out: the run folder.
        fits: callback that fitted the angles.
        reporter: receives the report.
    """

    out: Path
    fits: AngleFits
    reporter: Reporter

    def at_end(self, loop: TrainingLoop) -> None:
        report_polarizers(self.out, loop.context.scene, self.fits.polarizers, self.reporter)


@dataclass(eq=False)
class MetalReport(Callback[TrainingLoop]):
    """Callback that reports metals at the end of a training.

    Args:
        out: the run folder.
        reporter: receives the report.
    """

    out: Path
    reporter: Reporter

    def at_end(self, loop: TrainingLoop) -> None:
        context = loop.context
        model = GaussianModel(loop.state, context.shading, context.backend)
        undecided = MetalSearch(loop.current).undecided(loop.state)
        report_metals(self.out, context.scene, undecided, model, self.reporter)


@dataclass(eq=False)
class PlyFile(Callback[TrainingLoop]):
    """Callback that writes the trained Gaussians as a PLY file to the run folder ``out``."""

    out: Path

    def at_end(self, loop: TrainingLoop) -> None:
        context = loop.context
        centers = torch.stack([view.camera.center for view in context.scene.views])
        write_run_ply(self.out / PLY, loop.state, context.shading, centers)
