"""Recipes are data: a list of stages, each saying what is rendered, what is compared, and what happens when.

Nothing in the loop compares a step with a constant: boundaries are fractions of the total number of steps.
``Schedule`` lays the stages over the steps of a training.
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
from polarguide.training.rules import AngleRules, FlatRules, MetalRules, MetalViews

Action = str
"""Name of an action: the ``action`` of a callback, see ``training.callback``."""
Candidates = Literal["paper", "azimuths", "physical"]
Separation = Literal["paper", "exact"]
_REMEDY = "Correct the recipe."


@dataclass(frozen=True)
class Repeat:
    """Something that happens every so often.

    Attributes:
        action: what.
        fraction: fraction of all steps, the distance between two of them.
        minimum: never closer than this many steps.
    """

    action: Action
    fraction: float
    minimum: int = 1


@dataclass(frozen=True)
class Rounds:
    """Things that take turns, evenly spread over a stage in as many whole rounds as fit, one at least.

    So two of them never fall on each other, however many steps there are. The last turn of the last round falls on
    the end of the stage and is left out: it belongs to what follows (``on_enter`` of the next stage).

    Attributes:
        actions: what, in turn.
        fraction: fraction of all steps, the least distance between two turns.
        minimum: nor closer than this many steps. A stage too short for one such round has one all the same.
    """

    actions: tuple[Action, ...]
    fraction: float
    minimum: int = 1

    def turns(self, length: int, steps: int) -> dict[int, Action]:
        """The due actions by step, counted from the beginning of a stage of ``length`` of ``steps`` steps."""
        apart = max(1, self.minimum, round(self.fraction * steps))
        count = len(self.actions) * max(1, length // (apart * len(self.actions)))
        places = (round(turn * length / count) for turn in range(1, count))
        return {at: self.actions[k % len(self.actions)] for k, at in enumerate(places) if 0 < at < length}


@dataclass(frozen=True)
class Stage:
    """One phase of training.

    Attributes:
        name: shown while it runs.
        fraction: its share of all steps.
        reflection: whether the picture is shaded with deferred reflection.
        weights: weights of the losses.
        densify: whether the density control runs.
        repeats: what happens every so often in it.
        rounds: what happens in turns in it.
        on_enter: what happens at its first step.
        rate_factors: on the recipe's learning rates while it lasts, by name; 1 where not named.
        hold_normals: whether the terms on the layers reach the normals through Fresnel's equations alone, and not
            through what the layers mirror at them: the separated pictures are made with the normals of before, so that
            normals which follow them confirm their own errors.
        behind: where, in shares of the distance of the cameras from the middle of the points (nine tenths are nearer),
            terms on normals and depth begin to fade as movers of Gaussians, and from where on they only turn them
            (``training.behind``): behind the subject, surfaces that agree with their normals in place of the pictures
            have grown from there. None: they move everything.
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
    """How polarization priors are computed from the frozen Gaussians.

    Attributes:
        candidates: which polarization normals are considered: PolarGuide-GSDR's n, -n, R n, -R n ("paper"), the same
            with -n read as the opposite azimuth ("azimuths"), or the six that physics allows.
        live: whether each step chooses the candidate nearest to the normals that it renders, wherever the DoLP is over
            the threshold; otherwise the frozen Gaussians have chosen, and count only where they have a normal.
        separation: which separation supervises the layers.
        threshold: DoLP above which a pixel's normal is used.
        full_dolp: DoLP from which on a pixel's normal counts fully; below, in proportion.
        azimuth_weight: in [0, 1], how much the choice among candidates trusts azimuth over zenith.
        snr: ratio of the DoLP to its noise above which a pixel's normal is used; 0 switches the test off.
        chromatic: whether the polarization of color differences gives the plane where it is decided.
        chromatic_within: degrees from the Gaussians' normal up to which that of the color differences of a gray body
            counts fully, and from where on not at all: under colored light it is the light that differs, and it points
            anywhere. None: it counts wherever it is.
        azimuth_share, chromatic_share: of the pixels, the least that the terms on directions are averaged over, so that
            a view whose few pixels are polarized does not pull as hard as one that is polarized all over.
        bright: S0/2 from which on consistency counts fully whatever the DoLP, and below in proportion: where a surface
            shows something, its depth is known. 0: by the DoLP alone.
        flat: whether large flat surfaces are looked for, whose normal one view tells. flat_rules: how.
        astray: degrees between the Gaussians' normal and that of a flat surface from which on the latter replaces the
            former, which may know of ripples below.
        minimum_normal: length of a blended normal above which it guides: shorter ones mix surfaces.
        chromatic_plane_dolp: DoLP under which the plane of incidence of the color differences replaces the AoLP's.
        full_certainty: certainty (``optics.chromatic_normals``) from which on the normal of the color differences
            counts fully.
        gray: contrasts among the colors between which a body goes over from gray to colorful.
        metal_share: shares of metals between which a pixel goes over from a dielectric to a metal.
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
        opacity: opacities are raised to at least this.
        color_noise: half-width of the noise on the base color where strength is at most ``matte``.
        matte, glossy: strengths that bound the two kinds of Gaussian.
        widen: factor on the two longer scales where strength is at least ``glossy``.
        rest: steps for which opacities do not train afterwards (release); at most all steps over ``rest_part``.
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
    """Smaller pictures for the first steps, in which large ones show nothing that the Gaussians could take up yet.

    Attributes:
        share: share of all steps. factor: side of the boxes of pixels that are averaged.
        pixels: pixels of the largest training view, from which on there are such steps.
    """

    share: float = 0.5
    factor: int = 2
    pixels: int = 1_000_000


@dataclass(frozen=True)
class Recipe:
    """All that distinguishes one method from another.

    Attributes:
        name: as given to ``--recipe``.
        about: one line.
        stages: in order; their fractions add up to 1.
        rates: learning rates of what every recipe trains; that of the means is times the scene's extent.
        shading: how Gaussians and learned light make the picture in stages with reflection.
        means_decay: factor on the means' rate at the last step (exponential in between).
        oriented: whether normals keep the side from which training views see them ("orient_normals" finds it).
        metals: share of all steps between which refreshes look for metals, where the shading knows them.
        metal_rules: how. metal_views: from which measurements.
        angle_rules: how polarizer angles are fitted and judged.
        coarse: which steps look at smaller pictures.
        sh_fractions: shares of all steps at which SH degrees 1, 2 and 3 begin.
        ssim_weight: lambda in (1 - lambda) L1 + lambda (1 - SSIM).

    Raises:
        PolarguideError: stages that do not add up, or rates that are missing or name nothing that is learned.
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
        strangers = sorted(set(self.rates) - set(CORE_SHAPES))
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
            (bool(strangers), f"rates of {', '.join(CORE_SHAPES)}", ", ".join(map(str, strangers))),
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
        """Every per-Gaussian tensor, with the shape of one Gaussian's values."""
        own = {name: parameter.shape for name, parameter in self.shading.parameters.items()}
        return {**CORE_SHAPES, **(ORIENTED_SHAPES if self.oriented else {}), **own}

    @property
    def learning_rates(self) -> dict[str, float]:
        """Learning rates of the per-Gaussian tensors that learn, the shading model's included."""
        own = {name: parameter.rate for name, parameter in self.shading.parameters.items() if parameter.rate}
        return {**self.rates, **own}

    @property
    def light_rates(self) -> dict[str, float]:
        """Learning rates of the learned light's parameters."""
        return {name: parameter.rate for name, parameter in self.shading.light_parameters.items()}

    @property
    def actions(self) -> set[Action]:
        """Names of all actions that are due at some step."""
        names = set[Action]()
        for stage in self.stages:
            names.update(stage.on_enter, (repeat.action for repeat in stage.repeats))
            names.update(stage.rounds.actions if stage.rounds else ())
        return names

    def data(self) -> dict[str, Any]:
        """All values as plain JSON types, for a run's folder."""
        plain: dict[str, Any] = json.loads(json.dumps({**asdict(self), "shading": self.shading.data()}))
        return plain

    def differs(self, data: Mapping[str, Any]) -> bool:
        """True where a value differs from the one that a run's folder records; see ``values_differ``."""
        return values_differ(self.data(), data)


def values_differ(own: Mapping[str, Any], recorded: Mapping[str, Any]) -> bool:
    """True where a value of a recipe differs from a recorded one.

    Values that the record lacks count as equal, and the description is no value.
    """
    return _differs(own, {key: value for key, value in recorded.items() if key != "about"})


def _is_rate(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf


def check_recipe(recipe: Recipe, where: str) -> None:
    """Check all values of a recipe that another program has made, before anything is trained.

    Args:
        recipe: the recipe. where: for messages.

    Raises:
        PolarguideError: a value has another type, is not finite, or cannot be noted in a run's folder.
    """
    for name in ("name", "about"):
        text = getattr(recipe, name)
        if not isinstance(text, str) or not text.isprintable() or not text.strip():
            place = f"{where} ({name})"
            raise PolarguideError(place, expected="a line of text", found=repr(text), remedy=_REMEDY)
    if not isinstance(recipe.shading, ShadingModel):
        found = repr(recipe.shading)
        raise PolarguideError(f"{where} (shading)", expected="a ShadingModel", found=found, remedy=_REMEDY)
    _check_values(recipe, where, "")
    try:
        json.dumps(recipe.data(), allow_nan=False)
    except (TypeError, ValueError) as error:
        expected = "values that a run's folder can hold: numbers, texts, lists"
        raise PolarguideError(where, expected=expected, found=str(error), remedy=_REMEDY) from None


def _check_values(part: Any, where: str, path: str) -> None:
    """Check the fields of a dataclass and of those in it against their types; a shading model checks its own."""
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
    """Whether one of the values of ``then``, plain JSON, is another now; what it does not have counts for nothing."""
    if isinstance(then, dict):
        return not isinstance(now, dict) or any(_differs(now.get(key), value) for key, value in then.items())
    if isinstance(then, list) and isinstance(now, list) and len(now) == len(then):
        return any(map(_differs, now, then))
    return bool(now != then)


@dataclass(frozen=True)
class Position:
    """Where a step lies: its stage, and which actions are due before it.

    Attributes:
        stage: the stage.
        actions: due now, in order.
    """

    stage: Stage
    actions: tuple[Action, ...]


class Schedule:
    """The stages of a recipe laid over a number of steps.

    In a training so short that a stage has no step, its ``on_enter`` happens with that of the next one; the last stage
    always has a step.
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
        """The stage of a step (0-based) and the actions due before it."""
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
        """Steps between two occurrences."""
        return max(repeat.minimum, round(repeat.fraction * self.steps))

    def sh_degree(self, step: int) -> int:
        """SH degree in use at a step."""
        return sum(step >= f * self.steps for f in self.recipe.sh_fractions)

    def rates(self, step: int) -> dict[str, float]:
        """Learning rates at a step by name; that of the means is before the scene's extent."""
        factors = self.at(step).stage.rate_factors
        rates = {name: rate * factors.get(name, 1.0) for name, rate in self.recipe.learning_rates.items()}
        rates["means"] *= self.recipe.means_decay ** (step / max(1, self.steps - 1))
        return rates
