"""Recipes as data: stages with their rendering, losses and actions, and the constants of a method.

Stage boundaries are fractions of the number of steps, so that the loop compares no step with a constant. ``Schedule``
maps the stages of a recipe to the steps of a training.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, Literal, get_type_hints

from polarguide.core.errors import PolarguideError
from polarguide.core.records import decode
from polarguide.gaussians.densify import Densification
from polarguide.gaussians.gaussians import CORE_SHAPES, ORIENTED_SHAPES
from polarguide.gaussians.initialize import Initialization
from polarguide.shading.model import PLAIN, ShadingModel
from polarguide.training.losses import Weights as Weights


@dataclass(frozen=True)
class MetalRules:
    """Constants of the energy whose minimum decides on metals (``training.metals.search``).

    Attributes:
        prior: log likelihood ratio, in nats per view, by which a metal must be more likely than a dielectric.
        trust: upper bound of the evidence of a single Gaussian, in nats. With 3, one Gaussian of 20 may be wrong even
            if its evidence is strong.
        likeness: cost, in nats, of two similar neighboring Gaussians if only one of them is a metal.
        tint: standard deviation of the logarithm of a surface's tint relative to the mean light of the scene. Hardly
            any metal is more deeply colored than gold.
        surface: fixed cost, in nats, of each connected piece of metal. A piece that gains less is discarded.
    """

    prior: float = 0.45
    trust: float = 3.0
    likeness: float = 8.0
    tint: float = 0.3
    surface: float = 40.0


@dataclass(frozen=True)
class MetalViews:
    """Constants of the measurements on which the search for metals is based.

    The first metals also determine how much brighter the learned light should be. This factor is called the gain.

    Attributes:
        most_views: largest number of examined views, evenly spread.
        least_share: share of a Gaussian's largest blending weight. A view with a smaller weight of the Gaussian is
            ignored.
        least_normal: length of a blended normal above which a pixel is used. Shorter normals are mixtures of surfaces.
        cosines: smallest and largest cosine of the zenith angle at which a view is used. Light is unpolarized at normal
            incidence. Normals and reflectances are uncertain at grazing angles.
        dark: radiance that is added to the denominator of relative errors; full scale is 1.
        reach: radius around the middle of the points in which metals are searched, as a share of the cameras' distance.
            Gaussians farther away are behind the subject in views from the other side.
        contradicted: share of the labels of a view that other views may contradict without a warning.
        gain_views: number of views from which the gain is measured.
        gain_share: metal share above which a pixel is used for the gain.
        gain_pixels: least share of pixels that must be usable for the gain.
        most_gain: largest gain.
    """

    most_views: int = 32
    least_share: float = 0.3
    least_normal: float = 0.3
    cosines: tuple[float, float] = (0.25, 0.97)
    dark: float = 0.02
    reach: float = 0.5
    contradicted: float = 0.15
    gain_views: int = 10
    gain_share: float = 0.6
    gain_pixels: float = 0.003
    most_gain: float = 4.0


@dataclass(frozen=True)
class AngleRules:
    """Constants for estimating unknown polarizer angles and for checking known angles.

    Attributes:
        search_steps: number of steps of a short training that searches for angles before the main training. More steps
            are not better: flat mirroring surfaces, such as water, bend to explain their reflections without
            polarization.
        search_size: largest number of pixels along the longer side of the pictures in a search.
        first, every, last: schedule of the fits in a search, as shares of its steps. Angles are fitted from ``first``
            to ``last`` at intervals of ``every``, and the mean of the fits is used. Earlier fits would confirm the
            initial guess. Later fits would confirm errors that the model has learned by then.
        again: shares of the steps of a second search at which angles are fitted. It begins with the angles that the
            first search found. Most of them are right and improve the prediction for the remaining pictures. A third
            search brought no improvement on two scenes.
        checks: shares of all steps at which known angles are compared with the pictures. Early in a training, the model
            predicts little. Later, colors and surfaces have adapted to wrong angles. In a test at half size with 1,500
            steps, six of 63 angles were wrong by 45 or 90 degrees. The three checks found one, three and five of these
            errors, five in total, and rejected no correct angle.
        least_spread: spread in degrees below which the weight of a fit does not increase any more.
        weak: modulation below which an angle is unreliable. Wrong predictions reduce the modulation. Pictures through a
            filter seldom reach 1, and 0.5 is usual at the first fits.
        vague: spread in degrees above which a picture does not determine its angle.
        lost: spread in degrees above which a fitted angle is not used, not even as a best guess. A guess with an error
            of up to 30 degrees is better than the assumption that there was no filter. Fits with spreads of 20 to 60
            degrees mostly had errors under 20 degrees.
        disagree: scatter of the fitted angles of a picture, in degrees, above which the fits disagree.
        contradicts: difference in degrees above which a fitted angle contradicts the specified angle. The difference
            must also exceed three times the spread, and three standard deviations of the differences of all pictures.
            Users read angles from filter rings with errors of a few degrees.
        locked: standard deviation of the logarithms of fitted gains up to which exposures are treated as equal. At the
            first fit, it was 0.03 to 0.07 for equal exposures, and 0.13 for automatic exposures that differed by up to
            0.3 stops.
        fewest: least number of pictures from which the spread of gains is computed.
        poor: value of ``Judgment.unexplained`` above which a picture may have been taken at another angle. On four test
            scenes with two seeds, every picture with an error over 45 degrees exceeded this limit. At most five of the
            63 pictures exceeded it without such an error. The limit was chosen with one of these seeds.
    """

    search_steps: int = 900
    search_size: int = 160
    first: float = 0.5
    every: float = 0.05
    last: float = 0.65
    again: tuple[float, ...] = (0.5, 0.65, 0.8, 0.95)
    checks: tuple[float, ...] = (0.2, 0.3, 0.5)
    least_spread: float = 1.0
    weak: float = 0.22
    vague: float = 15.0
    lost: float = 45.0
    disagree: float = 10.0
    contradicts: float = 20.0
    locked: float = 0.1
    fewest: int = 4
    poor: float = 0.95


@dataclass(frozen=True)
class FlatRules:
    """Constants of the search for flat surfaces.

    Attributes:
        tries: number of random pixel pairs. Each pair proposes a normal.
        samples: approximate number of pixels on which the proposed normals are tested.
        close: largest sine of the angle between a normal and the plane of incidence of a pixel that agrees with it.
        apart: least sine of the angle between the directions of two pixels. Closer directions propose no normal.
        least: least share of a view that a flat surface must cover. By chance, one normal explains up to a sixth of a
            curved surface.
        faint: DoLP above which a pixel is used.
        slack: factor on Fresnel's DoLP, and offset that is added to the product. A pixel with a larger DoLP contradicts
            the normal.
        grazing: least cosine of the angle between a normal and the direction to the camera. Below it, the surface is
            not visible.
        window: side in pixels of the square around a pixel to which ``most`` refers.
        most: least share of the pixels in that square that must agree with the normal.
        alike: largest angle in degrees between the normals of two views that show the same flat surface.
        fewest, share: least number and least share of the views that must show the surface.
    """

    tries: int = 400
    samples: int = 12_000
    close: float = 0.03
    apart: float = 0.03
    least: float = 0.25
    faint: float = 0.05
    slack: tuple[float, float] = (1.1, 0.02)
    grazing: float = 0.05
    window: int = 9
    most: float = 0.7
    alike: float = 5.0
    fewest: int = 3
    share: float = 1 / 3


Action = str
"""Name of an action: the ``action`` of a callback, see ``training.callback``."""
Candidates = Literal["paper", "azimuths", "physical"]
Separation = Literal["paper", "exact"]
_REMEDY = "Correct the recipe."


@dataclass(frozen=True)
class Repeat:
    """An action that repeats at regular intervals.

    Attributes:
        action: name of the action.
        fraction: interval between two occurrences, as a fraction of all steps.
        minimum: shortest interval in steps.
    """

    action: Action
    fraction: float
    minimum: int = 1


@dataclass(frozen=True)
class Rounds:
    """Actions that take turns at regular intervals during a stage.

    A round runs every action once. A stage has as many complete rounds as fit into it, but at least one. Two actions
    never run before the same step. The last turn of the last round falls on the end of the stage and is left out,
    because ``on_enter`` of the next stage runs this action.

    Attributes:
        actions: the actions in their order.
        fraction: shortest interval between two turns, as a fraction of all steps.
        minimum: shortest interval in steps. A stage that is too short for one round has shorter intervals.
    """

    actions: tuple[Action, ...]
    fraction: float
    minimum: int = 1

    def turns(self, length: int, steps: int) -> dict[int, Action]:
        """Return the due actions by step, counted from the beginning of the stage.

        Args:
            length: number of steps of the stage.
            steps: number of steps of the training.
        """
        distance = max(1, self.minimum, round(self.fraction * steps))
        count = len(self.actions) * max(1, length // (distance * len(self.actions)))
        places = (round(turn * length / count) for turn in range(1, count))
        return {at: self.actions[k % len(self.actions)] for k, at in enumerate(places) if 0 < at < length}


@dataclass(frozen=True)
class Stage:
    """One phase of training.

    Attributes:
        name: displayed name.
        fraction: share of all steps.
        reflection: True to shade the picture with deferred reflection.
        weights: weights of the losses.
        densify: True to run the density control, which adds and removes Gaussians.
        repeats: actions that repeat within the stage.
        rounds: actions that take turns within the stage.
        on_enter: actions before the first step of the stage.
        rate_factors: factors on the learning rates of the recipe by name. Rates without a factor do not change.
        hold_normals: True if the terms on the layers change normals through Fresnel's equations only, and not through
            the mirrored light. The separated pictures were computed with earlier normals. Normals that follow these
            pictures would confirm their own errors.
        behind: two distances behind the subject between which terms on normals and depth fade. The unit is the distance
            of the cameras from the middle of the points, which nine tenths of the cameras do not exceed. Beyond the
            second distance, these terms only rotate Gaussians (``training.behind``). Without fading, surfaces grow
            behind the subject that agree with their normals but not with the pictures. None disables fading.
    """

    name: str
    fraction: float
    reflection: bool
    weights: Weights = field(default_factory=Weights)
    densify: bool = False
    repeats: tuple[Repeat, ...] = ()
    rounds: Rounds | None = None
    on_enter: tuple[Action, ...] = ()
    rate_factors: Mapping[str, float] = field(default_factory=dict)
    hold_normals: bool = False
    behind: tuple[float, float] | None = None


@dataclass(frozen=True)
class Priors:
    """Settings of the polarization priors, which are computed from the frozen Gaussians.

    Attributes:
        candidates: set of normals from which the polarization normal of a pixel is chosen. "paper" has the candidates
            n, -n, R n and -R n of PolarGuide-GSDR. "azimuths" has normals of opposite azimuth in place of -n and -R n.
            "physical" has the six normals that physics allows.
        live: True if each step chooses the candidate nearest to the rendered normal, at every pixel with a DoLP above
            the threshold. Otherwise, the frozen Gaussians choose, and pixels without a normal of these Gaussians are
            ignored.
        separation: method that separates specular and diffuse light to supervise the layers.
        threshold: DoLP above which the normal of a pixel is used.
        full_dolp: DoLP above which the normal of a pixel has full weight. Below it, the weight is proportional to the
            DoLP.
        azimuth_weight: weight in [0, 1] of the azimuth, relative to the zenith, in the choice among candidates.
        snr: ratio of the DoLP to its noise above which the normal of a pixel is used. 0 disables this test.
        chromatic: True to use the polarization of color differences where it determines the plane of incidence.
        chromatic_within: two angles in degrees. They limit the deviation of normals from color differences on gray
            bodies, because colored light gives these normals random directions. The weight of such a normal falls from
            1 at the first angle to the normal of the Gaussians to 0 at the second. None disables the limit.
        azimuth_share, chromatic_share: least share of a picture's pixels by which the terms on directions are divided.
            A view with few polarized pixels therefore has less influence than a fully polarized view.
        bright: S0/2 above which the consistency term has full weight for any DoLP, because the depth of bright surfaces
            is known. Below it, the weight is proportional to S0/2. With 0, only the DoLP determines the weight.
        flat: True to search for large flat surfaces, whose normal a single view determines.
        flat_rules: constants of that search.
        astray: angle in degrees between the normal of the Gaussians and the normal of a flat surface. Above this angle,
            the normal of the flat surface is used. Smaller differences may be ripples.
        minimum_normal: length above which a blended normal is used as a guide. Shorter normals are mixtures of
            surfaces.
        chromatic_plane_dolp: DoLP below which the color differences determine the plane of incidence, not the AoLP.
        full_certainty: certainty (``optics.chromatic_normals``) above which a normal from color differences has full
            weight.
        gray: two color contrasts. At the first, a body counts as gray, and at the second as fully colored.
        metal_share: two metal shares. At the first, a pixel counts as a dielectric, and at the second as a metal.
    """

    candidates: Candidates = "physical"
    live: bool = False
    separation: Separation = "exact"
    threshold: float = 0.05
    full_dolp: float = 0.3
    azimuth_weight: float = 0.5
    snr: float = 0.0
    chromatic: bool = False
    chromatic_within: tuple[float, float] | None = None
    azimuth_share: float = 0.0
    chromatic_share: float = 0.0
    bright: float = 0.0
    flat: bool = False
    flat_rules: FlatRules = field(default_factory=FlatRules)
    astray: float = 10.0
    minimum_normal: float = 0.3
    chromatic_plane_dolp: float = 0.03
    full_certainty: float = 3.0
    gray: tuple[float, float] = (0.2, 0.3)
    metal_share: tuple[float, float] = (0.25, 0.75)


@dataclass(frozen=True)
class Propagation:
    """Normal propagation of 3DGS-DR (Ye et al. 2024, Sec. 3.3).

    Attributes:
        opacity: lower bound of the opacities after the propagation.
        color_noise: half-width of the noise on the base color of matte Gaussians.
        matte: largest strength of a matte Gaussian.
        glossy: smallest strength of a glossy Gaussian.
        widen: factor on the two longer scales of glossy Gaussians.
        rest: number of steps after a propagation in which opacities are not trained, as in the release of 3DGS-DR.
        rest_part: divisor of the number of all steps. The quotient is an upper bound of ``rest``.
    """

    opacity: float = 0.9
    color_noise: float = 0.4
    matte: float = 0.05
    glossy: float = 0.02
    widen: float = 1.5
    rest: int = 200
    rest_part: int = 50


@dataclass(frozen=True)
class Coarse:
    """Smaller pictures in the first steps, in which Gaussians are too large for details.

    Attributes:
        share: share of all steps that use smaller pictures.
        factor: side in pixels of the squares that are averaged to one pixel.
        pixels: number of pixels of the largest training view above which smaller pictures are used.
    """

    share: float = 0.5
    factor: int = 2
    pixels: int = 1_000_000


@dataclass(frozen=True)
class Recipe:
    """All properties of a method.

    Attributes:
        name: value of ``--recipe``.
        about: description in one line.
        stages: stages in order; their fractions add up to 1.
        rates: learning rates of the parameters that every recipe has. The rate of the means is relative to the scene's
            extent.
        shading: model that computes the picture from Gaussians and learned light in stages with reflection.
        means_decay: factor on the rate of the means at the last step. The rate falls exponentially until then.
        oriented: True if normals keep the side from which training views see them (action "orient_normals").
        metals: two shares of all steps. Between them, each refresh of the priors searches for metals, if the shading
            model supports metals.
        metal_rules: constants of the decision on metals.
        metal_views: constants of the measurements for that decision.
        angle_rules: constants for fitting and judging polarizer angles.
        coarse: steps with smaller pictures.
        sh_fractions: shares of all steps at which SH degrees 1, 2 and 3 begin.
        ssim_weight: lambda in (1 - lambda) L1 + lambda (1 - SSIM).

    Raises:
        PolarguideError: stages do not add up, or rates are missing or belong to no learned parameter.
    """

    name: str
    about: str
    stages: tuple[Stage, ...]
    rates: Mapping[str, float]
    shading: ShadingModel = PLAIN
    means_decay: float = 0.1
    oriented: bool = False
    metals: tuple[float, float] = (0.4, 0.72)
    metal_rules: MetalRules = field(default_factory=MetalRules)
    metal_views: MetalViews = field(default_factory=MetalViews)
    angle_rules: AngleRules = field(default_factory=AngleRules)
    coarse: Coarse = field(default_factory=Coarse)
    sh_fractions: tuple[float, float, float] = (1 / 30, 2 / 30, 3 / 30)
    ssim_weight: float = 0.2
    densification: Densification = field(default_factory=Densification)
    initialization: Initialization = field(default_factory=Initialization)
    priors: Priors = field(default_factory=Priors)
    propagation: Propagation = field(default_factory=Propagation)

    def __post_init__(self) -> None:
        share = sum(stage.fraction for stage in self.stages)
        unknown = sorted(set(self.rates) - set(CORE_SHAPES))
        factors = [
            *self.rates.items(),
            *(item for stage in self.stages for item in stage.rate_factors.items()),
        ]
        wrong_rates = [f"{name} = {rate!r}" for name, rate in factors if not _is_rate(rate)]
        named = {name for stage in self.stages for name in stage.rate_factors}
        where = f"recipe {self.name}"
        for wrong, expected, found in (
            (abs(share - 1) > 1e-6, "stages whose fractions add up to 1", f"{share:g}"),
            ("means" not in self.rates, "a rate of the means", f"{[*self.rates]}"),
            (
                not named <= self.learning_rates.keys(),
                "rate factors of learned parameters",
                f"{sorted(named)}",
            ),
            (bool(unknown), f"rates of {', '.join(CORE_SHAPES)}", ", ".join(map(str, unknown))),
            (
                bool(wrong_rates),
                "rates and rate factors that are finite and not negative",
                ", ".join(wrong_rates),
            ),
        ):
            if wrong:
                raise PolarguideError(where, expected=expected, found=found, remedy=_REMEDY)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of the values of one Gaussian, for each tensor."""
        own = {name: parameter.shape for name, parameter in self.shading.parameters.items()}
        return {**CORE_SHAPES, **(ORIENTED_SHAPES if self.oriented else {}), **own}

    @property
    def learning_rates(self) -> dict[str, float]:
        """Learning rates of all trained per-Gaussian tensors, including the tensors of the shading model."""
        own = {name: parameter.rate for name, parameter in self.shading.parameters.items() if parameter.rate}
        return {**self.rates, **own}

    @property
    def light_rates(self) -> dict[str, float]:
        """Learning rates of the parameters of the learned light."""
        return {name: parameter.rate for name, parameter in self.shading.light_parameters.items()}

    @property
    def actions(self) -> set[Action]:
        """Names of all actions of the stages."""
        names = set[Action]()
        for stage in self.stages:
            names.update(stage.on_enter, (repeat.action for repeat in stage.repeats))
            names.update(stage.rounds.actions if stage.rounds else ())
        return names

    def data(self) -> dict[str, Any]:
        """Return all values as plain JSON types, for a run folder."""
        values = asdict(self)
        shading = {"model": type(self.shading).__name__, **values["shading"]}
        del shading["refractive_index"]  # it belongs to the run
        plain: dict[str, Any] = json.loads(json.dumps({**values, "shading": shading}))
        return plain

    def differs(self, data: Mapping[str, Any]) -> bool:
        """Return True if a value differs from the one in a run folder; see ``values_differ``."""
        return values_differ(self.data(), data)


def values_differ(own: Mapping[str, Any], recorded: Mapping[str, Any]) -> bool:
    """Return True if a value of a recipe differs from a recorded one.

    Missing recorded values count as equal. The description is not compared.
    """
    return _differs(own, {key: value for key, value in recorded.items() if key != "about"})


def _is_rate(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf


def check_recipe(recipe: Recipe, where: str) -> None:
    """Check all values of a recipe that another package defines.

    Args:
        recipe: the recipe.
        where: place for messages.

    Raises:
        PolarguideError: a value has another type, is not finite, or cannot be written to a run folder.
    """
    for name in ("name", "about"):
        text = getattr(recipe, name)
        if not isinstance(text, str) or not text.isprintable() or not text.strip():
            place = f"{where} ({name})"
            raise PolarguideError(place, expected="a line of text", found=repr(text), remedy=_REMEDY)
    if not isinstance(recipe.shading, ShadingModel):
        actual = repr(recipe.shading)
        raise PolarguideError(f"{where} (shading)", expected="a ShadingModel", found=actual, remedy=_REMEDY)
    _check_values(recipe, where, "")
    try:
        json.dumps(recipe.data(), allow_nan=False)
    except (TypeError, ValueError) as error:
        expected = "values that a run's folder can hold: numbers, texts, lists"
        raise PolarguideError(where, expected=expected, found=str(error), remedy=_REMEDY) from None


def _check_values(part: Any, where: str, path: str) -> None:
    """Check the fields of a dataclass and of nested dataclasses against their types; a shading model checks its own."""
    kinds = get_type_hints(type(part))
    for item in fields(part):
        value = getattr(part, item.name)
        place = f"{path}{item.name}"
        if isinstance(value, ShadingModel):
            continue
        inner = value if isinstance(value, tuple) else (value,)
        if inner and all(is_dataclass(each) for each in inner):
            for number, each in enumerate(inner):
                _check_values(each, where, f"{place}[{number}]." if isinstance(value, tuple) else f"{place}.")
        else:
            decode(value, kinds[item.name], f"{where} ({place})", remedy=_REMEDY)


def _differs(now: Any, then: Any) -> bool:
    """Return True if a value differs from plain JSON; keys that the JSON lacks count as equal."""
    if isinstance(then, dict):
        return not isinstance(now, dict) or any(_differs(now.get(key), value) for key, value in then.items())
    if isinstance(then, list) and isinstance(now, list) and len(now) == len(then):
        return any(map(_differs, now, then))
    return bool(now != then)


@dataclass(frozen=True)
class Position:
    """Position of a step in a schedule.

    Attributes:
        stage: the stage.
        actions: actions due before the step, in order.
    """

    stage: Stage
    actions: tuple[Action, ...]


class Schedule:
    """Stages of a recipe, mapped to a number of steps.

    If a training is so short that a stage has no step, the next stage also runs the ``on_enter`` actions of this stage.
    The last stage always has a step.
    """

    def __init__(self, recipe: Recipe, steps: int) -> None:
        self.recipe = recipe
        self.steps = steps
        self._starts: list[int] = []
        share = 0.0
        for stage in recipe.stages:
            self._starts.append(min(round(share * steps), steps - 1))
            share += stage.fraction
        ends = (*self._starts[1:], steps)
        self._turns = [
            stage.rounds.turns(end - start, steps) if stage.rounds else {}
            for stage, start, end in zip(recipe.stages, self._starts, ends, strict=True)
        ]

    def at(self, step: int) -> Position:
        """Return the stage of a step (0-based) and the actions due before it."""
        index = max(i for i, start in enumerate(self._starts) if start <= step)
        stage = self.recipe.stages[index]
        since = step - self._starts[index]
        if since == 0:
            begun = zip(self.recipe.stages, self._starts, strict=True)
            entered = (action for each, start in begun if start == step for action in each.on_enter)
            return Position(stage, tuple(dict.fromkeys(entered)))
        due = [r.action for r in stage.repeats if since % self.period(r) == 0]
        turn = self._turns[index].get(since)
        return Position(stage, (turn, *due) if turn else tuple(due))

    def period(self, repeat: Repeat) -> int:
        """Return the number of steps between two occurrences."""
        return max(repeat.minimum, round(repeat.fraction * self.steps))

    def sh_degree(self, step: int) -> int:
        """Return the SH degree of a step."""
        return sum(step >= f * self.steps for f in self.recipe.sh_fractions)

    def rates(self, step: int) -> dict[str, float]:
        """Return the learning rates of a step by name. The rate of the means is relative to the scene's extent."""
        factors = self.at(step).stage.rate_factors
        rates = {name: rate * factors.get(name, 1.0) for name, rate in self.recipe.learning_rates.items()}
        rates["means"] *= self.recipe.means_decay ** (step / max(1, self.steps - 1))
        return rates
