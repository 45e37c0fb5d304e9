"""Estimation of polarizer angles in a training, and judgments on their reliability.

Unknown angles are estimated, and known angles are checked for contradictions. The model predicts Stokes vectors, from
which the angle and the gain of a picture behind a polarizer follow by least squares. The fits take place between the
steps of a training.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.capture.angle_evidence import TO_DEVIATION, AngleEstimate, mean_angle
from polarguide.capture.exposures import Exposure, normalized
from polarguide.capture.variants import smaller
from polarguide.capture.view import ANGLES
from polarguide.core.progress import SILENT
from polarguide.optics import Mount
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.callback import AnyCallback, Callback
from polarguide.training.callbacks import method_callbacks
from polarguide.training.context import ANGLE_COLUMNS, TrainingContext, TrainingState
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import AngleRules, Position, Recipe
from polarguide.training.settings import ResolvedSettings
from polarguide.training.storage import ViewStore

ROUNDS = 6
"""Number of reweighted least-squares fits that approximate the minimum of absolute differences."""
SOFT = 0.001
"""Intensity difference below which the weight of a pixel stays constant."""
FLOOR = 0.02
"""S0 below which the weight of a pixel stays constant."""
BLOCK = 16
"""Side in pixels of the squares within which errors may be correlated."""


@dataclass(frozen=True)
class FittedAngle:
    """Polarizer angle fitted to a picture.

    Attributes:
        angle: angle in degrees in [0, 180), as ``Exposure.angle``.
        gain: brightness of the picture over its predicted brightness.
        modulation: polarization of the picture over its predicted polarization. It is 1 behind a polarizer, 0 without a
            polarizer, and above 1 if the prediction is too small.
        spread: standard deviation of the angle in degrees, at most 90.
        doubt: standard deviation of the modulation, at most 1.
        misfit: mean residual over the mean light of the picture.
        misfit_across: mean residual for the polarizer turned by 90 degrees, over the mean light of the picture.
    """

    angle: float
    gain: float
    modulation: float
    spread: float
    doubt: float
    misfit: float
    misfit_across: float


def fit_angle(
    intensity: Tensor, stokes: Tensor, weight: Tensor, rays: Tensor, mount: Mount
) -> FittedAngle | None:
    """Fit the polarizer angle t and the gain g of a picture to predicted Stokes vectors.

    The model is ``I = (g S0 + x S1 + y S2) / 2`` with (x, y) = g (cos 2t, sin 2t). Iteratively reweighted least squares
    minimize the absolute differences over the square of S0. Prediction errors grow with the light, and dark surfaces
    have the highest degrees of polarization. Light that the model cannot explain therefore has little influence on the
    angle. The analyzer of a filter in front of the lens depends on the pixel. For such a filter, (x, y) rotates the
    analyzer of the previous iteration.

    Args:
        intensity: [H, W, 3] linear intensities of the picture.
        stokes: [3, H, W, 3] predicted Stokes vectors.
        weight: [H, W] weights of the pixels, 0 for pixels without a measurement.
        rays: [H, W, 3] unit directions from the camera, camera axes.
        mount: place of the polarizer.

    Returns:
        The fitted angle, or None if there is no polarization that determines it.
    """
    flat = (weight / (stokes[0].mean(dim=-1).clamp(min=0) + FLOOR) ** 2)[..., None].expand_as(intensity)
    plain = flat.reshape(-1).double()
    y = intensity.reshape(-1).double()
    s0, s1, s2 = (part.reshape(-1).double() / 2 for part in stokes)
    angle = 0.0
    weights = plain
    solution = torch.zeros(3, dtype=torch.float64)
    columns = torch.stack((s0, s1, s2))
    for turn in range(ROUNDS):
        if mount == "filter":
            cosine, sine = (
                part[..., None].expand_as(intensity).reshape(-1).double()
                for part in optics.filter_analyzer(angle, rays).unbind(0)
            )
            columns = torch.stack((s0, s1 * cosine + s2 * sine, s2 * cosine - s1 * sine))
        moments = (columns * weights) @ columns.T
        spectrum = torch.linalg.eigvalsh(moments)
        if not torch.isfinite(spectrum).all() or spectrum[0] <= 1e-9 * spectrum[-1].clamp(min=1e-30):
            return None
        solution = torch.linalg.solve(moments, (columns * weights) @ y)
        if mount == "filter":
            angle += math.atan2(float(solution[2]), float(solution[1])) / 2
        if turn < ROUNDS - 1:
            weights = plain / ((y - solution @ columns).abs() + SOFT)
    gain, x, y2 = (float(value) for value in solution)
    if mount == "sensor":
        angle = math.atan2(y2, x) / 2
    length = math.hypot(x, y2)
    if gain <= 0 or length == 0:
        return None
    covariance = _covariance(columns, plain, y - solution @ columns, intensity.shape)
    if mount == "filter":  # relative to the previous analyzer, the second component is almost 0
        x = length
        y2 = 0.0
    across = torch.tensor([0.0, -y2, x], dtype=torch.float64) / length
    spread = math.degrees(math.sqrt(max(0.0, float(across @ covariance @ across))) / length / 2)
    doubt = math.sqrt(max(0.0, float(torch.linalg.eigvalsh(covariance[1:, 1:])[-1]))) / gain
    modulation = length / gain
    fair = plain.sqrt()
    light = float((fair * y).sum())
    turned = solution * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    misfit, crossed = (float((fair * (y - of @ columns).abs()).sum()) / light for of in (solution, turned))
    return FittedAngle(
        math.degrees(angle) % 180.0, gain, modulation, min(spread, 90.0), min(doubt, 1.0), misfit, crossed
    )


def _covariance(columns: Tensor, weights: Tensor, residuals: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the covariance [3, 3] of a solution that minimizes absolute differences.

    It is a sandwich estimate. The density of the residuals at zero is estimated from the residuals below their median.
    Errors may be correlated within squares of side ``BLOCK``.
    """
    width = residuals[weights > 0].abs().median().clamp(min=1e-9)
    slope = (columns * (weights * (residuals.abs() <= width) / width)) @ columns.T
    scores = (columns * weights * residuals.sign()).reshape(3, *shape).sum(dim=-1)
    blocks = torch.nn.functional.avg_pool2d(scores[None], BLOCK, ceil_mode=True, divisor_override=1)[0]
    sums = blocks.reshape(3, -1)
    inverse = torch.linalg.pinv(slope)
    return inverse @ (sums @ sums.T) @ inverse


REMEDY = (
    "Note the angle of each shot; or take three or four shots of each view at known angles, from a tripod; or treat "
    "the pictures as ordinary photographs: prepare them with --angles none."
)
"""Advice for captures in which most angles are doubtful."""
UNFITTED = (0.0, 1.0, 0.0, 90.0, 1.0, 0.0, 0.0)
"""Values of ``FittedAngle`` for a picture without polarization that determines an angle."""
Predict = Callable[[View], Tensor]
"""Function that predicts the Stokes vectors [3, H, W, 3] of a view from the current state."""


@dataclass(frozen=True, kw_only=True)
class Judgment(FittedAngle):
    """Reliability of the polarizer angle of a picture, according to the fits of a training.

    ``angle`` is the mean of the fits that determine an angle. If no fit determines one, it is the mean of the fits that
    are usable as a best guess. The other values of ``FittedAngle`` are taken from the last of these fits.

    Attributes:
        view: name of the view.
        number: index of the picture among the exposures of the view.
        specified: exposure of the capture.
        believed: exposure that the training assumes.
        scatter: scatter of the fitted angles about their mean in degrees; 90 if less than half of the fits determine an
            angle.
        usual: median difference in degrees between fitted and specified angles, over pictures with a determined angle
            in the same fit. It measures how well the model predicts polarization.
        unexplained: product of two ratios of the last fit. The first is the misfit over the median misfit of all
            pictures. The second is the misfit over the misfit with the polarizer turned by 90 degrees. The product is
            large for a picture that the model explains worse than the other pictures, and hardly better than with a
            turned polarizer.
        overruled: True if the other pictures of the view show that its angle is not wrong; see
            ``Polarizers._overruled``.
        rules: constants of the judgment.
    """

    view: str
    number: int
    specified: Exposure
    believed: Exposure
    scatter: float = 0.0
    unexplained: float = 0.0
    usual: float = 0.0
    overruled: bool = False
    rules: AngleRules = field(default_factory=AngleRules, repr=False)

    @property
    def unfiltered(self) -> bool:
        """True if the picture looks as if taken without a filter."""
        return self.modulation + self.doubt < self.rules.weak

    @property
    def vague(self) -> bool:
        """True if the picture does not determine its angle."""
        return (self.spread > self.rules.vague or self.modulation < self.rules.weak) and not self.unfiltered

    @property
    def tells(self) -> bool:
        """True if the picture determines its angle."""
        return not self.vague and not self.unfiltered

    @property
    def guesses(self) -> bool:
        """True if the angle is usable as a best guess."""
        return self.spread <= self.rules.lost and self.modulation >= self.rules.weak

    @property
    def unsettled(self) -> bool:
        """True if the picture determines an angle in each fit, but the fits disagree."""
        return self.tells and self.scatter > self.rules.disagree

    @property
    def poorly_explained(self) -> bool:
        """True if the model explains the picture poorly, so that the fitted angle may be wrong."""
        return self.tells and self.unexplained > self.rules.poor

    @property
    def estimate(self) -> AngleEstimate:
        """Comparison of the fitted angle with the specified one."""
        floor = self.rules.contradicts
        return AngleEstimate(self.angle, self.spread, self.specified.angle, floor, self.usual)

    @property
    def contradicts(self) -> bool:
        """True if the picture contradicts its specified angle."""
        return not (self.unfiltered or self.overruled) and self.estimate.contradicts

    def resembles(self, other: Judgment) -> bool:
        """Return True if the fitted angle equals the specified angle of another picture within its spread."""
        return not replace(self.estimate, stated=other.specified.angle or 0.0, usual=0.0).contradicts

    @property
    def doubtful(self) -> bool:
        """True if the angle that the training uses is probably wrong."""
        sought = not self.specified.known and (not self.tells or self.unsettled or self.poorly_explained)
        return sought or self.unfiltered or self.contradicts


class Polarizers:
    """Pictures behind polarizers whose angles are fitted, and the results of all fits.

    Pictures of a polarization camera are skipped. All pictures are skipped if the recipe does not use pictures behind
    filters. If there are searches, unknown angles are fitted in two of them, and the second search begins with the
    angles of the first. Otherwise they are fitted in the second half of the training.

    Args:
        scene: the capture.
        recipe: the method.
        steps: steps of the training.
        table: results of F earlier calls of ``fit`` for P pictures, [F, P, 8] float64. None means that there was no
            fit.
        search: number of steps of a search for unknown angles. 0 means that there is no search.

        Attributes:
            table: results of all fits.
            beliefs: exposures that the training assumes for fitted views, by the name of the view.
            ignored: True if the recipe ignores the filters of some pictures.

    Raises:
        ValueError: the table has another number of rows.
    """

    def __init__(
        self, scene: Scene, recipe: Recipe, steps: int, table: Tensor | None = None, search: int = 0
    ) -> None:
        uses = predicts_filters(recipe)
        self._views = [view for view in scene.train_views if uses and not view.is_four]
        self._places = [
            (view, k)
            for view in self._views
            for k, exposure in enumerate(view.exposures)
            if exposure.filtered
        ]
        self._unknown = any(not view.exposures[k].known for view, k in self._places)
        rules = self._rules = recipe.angle_rules
        times = [rules.first] if self._unknown else [*rules.checks]
        while self._unknown and times[-1] + rules.every <= rules.last + 1e-9:
            times.append(times[-1] + rules.every)
        length = search if search and self._unknown else steps
        rounds = (times, rules.again) if search and self._unknown else (times,)
        self._rounds = [
            sorted({round(share * length) for share in shares}) for shares in rounds if self._places
        ]
        if table is not None and table.shape[1] != len(self._places):
            raise ValueError(f"angles of {table.shape[1]} pictures, not {len(self._places)}")
        self.table = table
        self.ignored = not uses and any(not view.measures_radiance for view in scene.train_views)
        self.beliefs = self._beliefs()

    def due(self, step: int) -> bool:
        """Return True if angles are fitted before a step."""
        return not self.settled and step in self._rounds[self.ended]

    @property
    def ended(self) -> int:
        """Number of finished searches."""
        count = 0 if self.table is None else len(self.table)
        return sum(count >= end for end in itertools.accumulate(map(len, self._rounds)))

    @property
    def settled(self) -> bool:
        """True if all fits are done."""
        return self.ended == len(self._rounds)

    @property
    def search(self) -> int:
        """Number of steps of all searches for unknown angles; 0 if all angles are known."""
        return sum(times[-1] for times in self._rounds) if self._unknown else 0

    @property
    def searched(self) -> int:
        """Number of steps of finished searches."""
        return sum(times[-1] for times in self._rounds[: self.ended]) if self._unknown else 0

    def believed(self, view: View) -> View:
        """Return a view with the exposures that the training assumes for it."""
        exposures = self.beliefs.get(view.name)
        return view if exposures is None or exposures == view.exposures else view.with_exposures(exposures)

    def resolved(self, scene: Scene) -> Scene:
        """Return a scene with the exposures that the training assumes for its views."""
        return replace(scene, views=tuple(self.believed(view) for view in scene.views))

    def fit(self, predict: Predict) -> Tensor:
        """Fit all angles.

        Args:
            predict: predicts the Stokes vectors of a view.

        Returns:
            Results [P, 8] float64. Columns 0 to 6 are the values of ``FittedAngle``. Column 7 is 1 if the fit
            succeeded, else 0.
        """
        rows = []
        for view in self._views:
            stokes = predict(view)
            local = view.to(stokes.device)
            weight = (~(local.invalid | local.saturated)).to(stokes)
            rays = local.camera.rays(device=stokes.device)
            for k, intensity in enumerate(local.intensities()):
                if not view.exposures[k].filtered:
                    continue
                fitted = fit_angle(intensity, stokes, weight, rays, view.mount)
                rows.append([*UNFITTED, 0.0] if fitted is None else [*dataclasses.astuple(fitted), 1.0])
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, ANGLE_COLUMNS)

    def take(self, table: Tensor) -> set[str]:
        """Adopt a table of all fits [F, P, 8], and return the names of the views whose exposures have changed."""
        self.table = table
        earlier = self.beliefs
        self.beliefs = self._beliefs()
        return {name for name, exposures in self.beliefs.items() if earlier.get(name) != exposures}

    def judgments(self) -> list[Judgment]:
        """Return the judgment of each picture; empty before the first fit."""
        if self.table is None:
            return []
        common = self._common_gain(self.table[-1])
        # Only fits of the latest search are used, because earlier fits are worse.
        ends = itertools.accumulate(map(len, self._rounds), initial=0)
        latest = self.table[max(end for end in ends if end < len(self.table)) :]
        fits = zip(*map(self._judged, latest), strict=True)
        judgments = []
        for rows, poor in zip(fits, _unexplained(self.table[-1]), strict=True):
            telling = [row for row in rows if row.tells] or [row for row in rows if row.guesses]
            judgment = replace((telling or rows)[-1], unexplained=poor)
            if telling:
                angles = [row.angle for row in telling]
                spreads = [row.spread for row in telling]
                angle, scatter = mean_angle(angles, spreads, self._rules.least_spread)
                is_scattered = len(telling) < len(rows) / 2
                judgment = replace(judgment, angle=angle, scatter=90.0 if is_scattered else scatter)
            if wrong := [row for row in rows if row.contradicts]:
                judgment = replace(wrong[-1], unexplained=poor)
            judgments.append(
                judgment
                if judgment.specified.known
                else replace(judgment, believed=_belief(judgment, common))
            )
        return [replace(judgment, overruled=self._overruled(judgment, judgments)) for judgment in judgments]

    def _overruled(self, judgment: Judgment, judgments: Sequence[Judgment]) -> bool:
        """Return True if the other pictures of the view show that a contradicted angle is right.

        This requires at least three other pictures that do not contradict their angles. Four pictures determine more
        than a Stokes vector. A single wrong angle makes the sums of perpendicular pairs differ, which ``prepare`` and
        ``inspect`` check. The sums stay equal only if two pictures are exchanged, and then each of them resembles the
        other.
        """
        if not judgment.contradicts:
            return False
        view = [other for other in judgments if other.view == judgment.view]
        if len(view) < len(ANGLES) or any(not j.specified.known for j in view):
            return False
        return not any(
            other.contradicts and judgment.resembles(other) and other.resembles(judgment)
            for other in view
            if other.number != judgment.number
        )

    def _judged(self, fit: Tensor) -> list[Judgment]:
        """Return the judgment of each picture according to a single fit [P, 8]."""
        rows = [
            Judgment(
                *row[:-1],
                view=view.name,
                number=k,
                specified=view.exposures[k],
                believed=view.exposures[k],
                rules=self._rules,
            )
            for (view, k), row in zip(self._places, fit.tolist(), strict=True)
        ]
        offs = [abs(row.estimate.off) for row in rows if row.tells and row.specified.angle is not None]
        usual = median(offs) if offs else 0.0
        return [replace(row, usual=usual) for row in rows]

    def _common_gain(self, fit: Tensor) -> float | None:
        """Return the median gain as a reference for single gains.

        Return None if the gains differ so little that all exposures are treated as equal.
        """
        rows = [row for (view, k), row in zip(self._places, fit, strict=True) if not view.exposures[k].known]
        gains = [float(row[1]) for row in rows if row[-1]]
        if len(gains) < self._rules.fewest:
            return None
        middle = median(gains)
        spread = TO_DEVIATION * median(abs(math.log(gain / middle)) for gain in gains)
        return middle if spread > self._rules.locked else None

    def _beliefs(self) -> dict[str, tuple[Exposure, ...]]:
        judged = [] if self.table is None else self._places
        believed = {view.name: list(view.exposures) for view, _ in judged}
        for judgment in self.judgments():
            believed[judgment.view][judgment.number] = judgment.believed
        return {name: tuple(exposures) for name, exposures in believed.items()}


def predicts_filters(recipe: Recipe) -> bool:
    """Return True if a recipe learns from pictures behind filters.

    Such a recipe renders S0, S1 and S2.
    """
    return "specular" in recipe.shading.layers and any(stage.weights.stokes > 0 for stage in recipe.stages)


def search_steps(recipe: Recipe, settings: ResolvedSettings) -> int:
    """Return the number of steps of a search for unknown angles, or 0 if there is no search."""
    return min(recipe.angle_rules.search_steps, settings.steps) if settings.begin_again else 0


def _unexplained(fit: Tensor) -> list[float]:
    """Return ``Judgment.unexplained`` of each picture in a fit [P, 8]; 0 for pictures without a fitted angle."""
    misfit, across, counted = fit[:, -3:].unbind(1)
    middle = misfit[counted > 0].median() if bool(counted.any()) else misfit.new_ones(())
    values: list[float] = (misfit**2 / (middle * across).clamp(min=1e-12)).tolist()
    return values


def _belief(judgment: Judgment, common: float | None) -> Exposure:
    """Return the exposure that is assumed for a picture without a specified angle.

    A picture without a fitted angle is treated as a photograph without a filter.
    """
    specified = judgment.specified
    if judgment.unfiltered:
        return replace(specified, filtered=False)
    if not judgment.guesses:
        return specified
    gain = specified.gain if common is None else specified.gain * judgment.gain / common
    return replace(specified, angle=normalized(judgment.angle), gain=gain)


class AngleFits(Callback[TrainingLoop]):
    """Callback that fits polarizer angles during a training.

    Short trainings on small pictures search for unknown angles. Then the training begins again with the angles
    that were found. If ``TrainSettings.begin_again`` is False, there is no search, and unknown angles are fitted
    between the steps of the training. Known angles are compared with the pictures between these steps.

    Args:
        context: context of the training.
        table: table of all earlier fits. None means that there was no fit.

    Attributes:
        polarizers: fitted angles.
        begins_again: True if a search precedes the training.
        current: context of the next schedule, which is a search or the training itself.
    """

    def __init__(self, context: TrainingContext, table: Tensor | None) -> None:
        self._context = context
        self._schedule_next(table)

    def _schedule_next(self, table: Tensor | None) -> None:
        """Choose the next schedule: another search, or the training if all angles have been found."""
        context = self._context
        scene = context.scene
        steps = context.settings.steps
        search = search_steps(context.recipe, context.settings)
        self.polarizers = Polarizers(scene, context.recipe, steps, table, search)
        self.begins_again = context.settings.begin_again and self.polarizers.search > 0
        self._searches = self.begins_again and not self.polarizers.settled
        self.current = context
        if self._searches:
            small = smaller(scene, context.recipe.angle_rules.search_size)
            settings = replace(context.settings, steps=search)
            self.current = replace(
                context, scene=small, settings=settings, store=ViewStore(), reporter=SILENT
            )
            self.polarizers = Polarizers(small, context.recipe, search, table, search)
        elif self.begins_again:
            self.current = replace(context, scene=self.polarizers.resolved(scene))

    def begin(self, loop: TrainingLoop) -> None:
        """Apply the earlier fits."""
        loop.state.angles = self.polarizers.table
        if self.begins_again:
            loop.offset = self.polarizers.searched
            loop.total = self._context.settings.steps + self.polarizers.search
        if self._searches or not self.begins_again:
            loop.feed.set_exposures(self.polarizers.beliefs)

    def before_step(self, loop: TrainingLoop, position: Position) -> None:
        """Fit angles if a fit is due before this step."""
        if not self.polarizers.due(loop.state.step):
            return
        loop.whole = False
        ended = self.polarizers.ended
        self._fit(loop)
        if self._searches and self.polarizers.ended > ended:
            self._schedule_next(loop.state.angles)
            loop.begin(self.current, None)
        loop.whole = True

    @torch.no_grad()
    def _fit(self, loop: TrainingLoop) -> None:
        """Fit all angles to the Stokes vectors that the current state predicts."""
        state = loop.state
        context = loop.current
        request = RenderRequest(sh_degree=loop.schedule.sh_degree(state.step))

        def predicted(view: View) -> Tensor:
            context.memory.clear()
            result = render(
                state.gaussians,
                view.camera,
                context.backend.rasterize,
                request,
                shading=context.shading,
                light=state.light,
            )
            return context.shading.predicted_stokes(result, view.camera)

        table = self.polarizers.fit(predicted).to(context.backend.device)
        earlier = [] if state.angles is None else [*state.angles]
        state.angles = torch.stack([*earlier, table.cpu()])
        changed = self.polarizers.take(state.angles)
        loop.feed.set_exposures({name: self.polarizers.beliefs[name] for name in changed})


def gaussian_training(
    context: TrainingContext, state: TrainingState | None = None, callbacks: Iterable[AnyCallback] = ()
) -> tuple[TrainingLoop, AngleFits]:
    """Create the loop of a training of Gaussians, with a callback that fits polarizer angles.

    Args:
        context: context of the training.
        state: state to resume from, which may be in the middle of a search. None starts from the beginning.
        callbacks: additional callbacks, which run after the callbacks of the method.

    Returns:
        A tuple of the loop and its callback that fits the angles.
    """
    fits = AngleFits(context, None if state is None else state.angles)
    return TrainingLoop(context, [fits, *method_callbacks(), *callbacks], state, fits.current), fits
