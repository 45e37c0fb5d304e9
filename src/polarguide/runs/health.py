"""Health of a finished training, from training views alone: ``health.json`` of the run folder.

A training can end normally with a result that nobody should use. Each fact here is a way in which that happens, has a
limit with a meaning in ``Limits``, and leads to a warning that names views and says what to do.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Literal

import msgspec
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from polarguide.capture import View
from polarguide.capture.exposures import analyzers
from polarguide.capture.variants import BLACK, black_pixels
from polarguide.capture.view import listed
from polarguide.core.files import write_text
from polarguide.core.progress import Reporter
from polarguide.core.records import read_record
from polarguide.core.text import command
from polarguide.gaussians.densify import Densification, free_space
from polarguide.optics.color import srgb_encode
from polarguide.runs.model import GaussianModel
from polarguide.training.angles.polarizers import Judgment
from polarguide.training.photometric import behind_analyzer

Word = Literal["measured", "fitted", "none"]
Count = Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class PolarizationSupport:
    """How far the layers and normals of a run rest on polarization.

    Attributes:
        measured: training views whose pictures determine the Stokes vector of every pixel.
        fitted: training views with pictures at too few angles for that: the model was fitted to them.
        none: training views that tell the recipe nothing of polarization; there, layers and normals are its guess.
        pictures: pictures of the fitted views that the training judged. doubtful: those whose angle is in doubt.
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
            views: with what is believed of their pictures. judgments: what the training says of these.
            measured, fitted: whether the recipe reads the polarization of views that determine it, and of others.
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
        """The evidence of most training views; of two with equally many, the weaker one."""
        counts: dict[Word, int] = {"none": self.none, "fitted": self.fitted, "measured": self.measured}
        return max(counts, key=lambda word: counts[word])

    @property
    def text(self) -> str:
        """The word, with the views that it does not hold for and the pictures that are in doubt."""
        doubts = f" ({self.doubtful} of {self.pictures} pictures doubtful)" if self.pictures else ""
        counts = {"measured": self.measured, "fitted": self.fitted, "none": self.none}
        more = {"measured": "", "fitted": doubts, "none": ""}
        total = sum(counts.values())
        others = [w for w in counts if counts[w] and w != self.word]
        if not others:
            guess = " (layers and normals are a guess of the model)" if self.word == "none" else ""
            return f"{self.word}{more[self.word]}{guess}"
        first = f"{self.word} in {counts[self.word]} of {total} views{more[self.word]}"
        return ", ".join([first, *(f"{w} in {counts[w]}{more[w]}" for w in others)])


HEALTH = "health.json"
MOST_VIEWS = 64
TIME_SHARE = 0.02
"""Of a training's steps: what the check may take. Looking at a view takes no longer than a step."""
NEIGHBORS = 6
"""Views that a view is compared with; with fewer, none can be told to be unlike the others."""
HIGHEST_PSNR = 100.0
"""What a PSNR above it, and the infinite one of equal pictures, is recorded as."""
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


@dataclass(frozen=True)
class Limits:
    """From where on a fact is worth a warning.

    Attributes:
        far: dB under the median of the views nearest to it: 10 are ten times their squared error. Views of sound
            scenes differ from those beside them by up to 6.
        scattered: the same in robust standard deviations of such differences, for scenes where they differ by more.
        brighter: times the brightest intensity that was measured anywhere. A filter hides more than half of the light
            only where more than half of it is polarized, and then in every view.
        burned: share of the pixels of a view that are brighter than that: a spot of 9 x 9 pixels of 320 x 240.
        exposed: stops by which a view is brighter or darker than predicted, in any color, compared with other views:
            half of the third of a stop by which cameras set exposures.
        fog: mean share of the light of a view that comes from where no surface can be: what one sees in dark places.
        bare: share of the pixels of a view that are holes: there is mostly nothing, and less than half of the light
            that was measured, which no filter explains.
        unseen: share of the Gaussians that no view sees: of the size of a file, and what one sees from elsewhere.
    """

    far: float = 10.0
    scattered: float = 3.0
    brighter: float = 2.0
    burned: float = 0.001
    exposed: float = 0.17
    fog: float = 0.01
    bare: float = 0.01
    unseen: float = 0.1


LIMITS = Limits()


@dataclass(frozen=True)
class ViewHealth:
    """Facts of one training view.

    Attributes:
        psnr: PSNR of what was predicted of its pictures, as shown, in dB; None where no pixel counts.
        beside: median of those of the views nearest to it; None where there are not enough.
        burned: share of the pixels that are brighter than ``Limits.brighter`` times what was measured anywhere.
        fog: mean share of the light that comes from where no surface can be; None where no points tell that.
        bare: share of the pixels that are holes, see ``Limits.bare``.
        stops: median of measured over predicted light in R, G and B; None where no pixel counts.
    """

    psnr: float | None
    beside: float | None
    burned: Share
    fog: Share | None
    bare: Share
    stops: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Health:
    """Health of a training.

    Attributes:
        polarization: what layers and normals rest on.
        warnings: a few sentences each, for people: what is wrong, in which views, and what to do.
        views: those that were looked at, by name. brightest: linear intensity that was measured in them.
        unseen: share of the Gaussians that are outside all of these; None where there are none, or where the training
            was too short to look at enough views.
    """

    polarization: PolarizationSupport
    warnings: tuple[str, ...] = ()
    views: dict[str, ViewHealth] = dataclasses.field(default_factory=dict)
    brightest: float | None = None
    unseen: Share | None = None

    @property
    def summary(self) -> str:
        """A sentence about a run that nothing is to be warned of, or of which nothing is known."""
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
        """Read ``health.json``; None where a training has not ended, or was one of a version without such a check.

        Raises:
            PolarguideError: the file cannot be read, or is not such a record.
        """
        if not os.path.lexists(run / HEALTH):
            return None
        return read_record(run / HEALTH, cls, remedy="Remove it: nothing but warnings is lost.")


@dataclass(frozen=True, eq=False)
class TrainingEvidence:
    """The evidence by which a finished training is examined.

    Attributes:
        views: all training views, with what is believed of their pictures. polarization: what it rests on.
        filters: whether the recipe learns what is behind filters.
    """

    views: Sequence[View]
    polarization: PolarizationSupport
    filters: bool

    def chosen(self, steps: int) -> list[View]:
        """Views to look at after a training of so many steps, spread evenly: see ``TIME_SHARE``."""
        count = min(MOST_VIEWS, len(self.views), int(TIME_SHARE * steps))
        places = torch.linspace(0, len(self.views) - 1, count).round().long().tolist() if count else []
        return [self.views[place] for place in places]


@torch.no_grad()
def examine(
    model: GaussianModel, evidence: TrainingEvidence, points: Tensor, steps: int, reporter: Reporter
) -> Health:
    """Look at training views; changes nothing of the model.

    Args:
        model: what was learned. evidence: of its training. points: of the scene, [M, 3]. steps: it took.
        reporter: receives progress.
    """
    views = evidence.chosen(steps)
    if not views:
        return Health(evidence.polarization)
    brightest = max(map(_brightest, views))
    cameras = [view.camera for view in views]
    free = free_space(points, cameras, Densification.free_share, Densification.free_quantile)
    nearest = free.radii.tolist()
    by_view = {}
    visible = None
    with reporter.track("checking the result", len(views)) as advance:
        for view, near in zip(views, nearest, strict=True):
            facts, radii = _look(model, view, LIMITS.brighter * brightest, near, evidence.filters)
            by_view[view.name] = facts
            if radii is not None:
                visible = radii > 0 if visible is None else visible | (radii > 0)
            advance(len(by_view))
    for name, psnr in _beside(views, {name: facts.psnr for name, facts in by_view.items()}).items():
        by_view[name] = dataclasses.replace(by_view[name], beside=psnr)
    enough = len(views) == min(MOST_VIEWS, len(evidence.views))  # others may see what a few do not
    unseen = float((~visible).float().mean()) if visible is not None and enough else None
    return Health(evidence.polarization, tuple(warnings_of(by_view, unseen)), by_view, brightest, unseen)


def _counted(view: View) -> Tensor:
    """Pixels [H, W] whose measurement counts."""
    return ~(view.invalid | view.saturated)


def _brightest(view: View) -> float:
    """The largest linear intensity that was measured in a view; 0 where no pixel counts."""
    measured = view.intensities().amax(dim=(0, 3))[_counted(view)]
    return float(measured.max()) if len(measured) else 0.0


def _look(
    model: GaussianModel, view: View, limit: float, near: float, filters: bool
) -> tuple[ViewHealth, Tensor | None]:
    """Facts of a view, and the radii of the Gaussians in it.

    Args:
        limit: intensity above which a pixel is burned. near: depth up to which there can be no surface; 0: unknown.
        filters: whether the model predicts what is behind them.
    """
    local = view.to(model.device)
    camera = view.camera
    result = model.render(camera)
    counted = _counted(local)
    stokes = model.stokes(result, camera) if filters else None
    measured, predicted = _compared(local, result.final, stokes)
    errors = srgb_encode(predicted.nan_to_num(0.0, 1.0, 0.0).clamp(0, 1)) - srgb_encode(measured.clamp(0, 1))
    error = errors[:, counted].square().mean().double()
    psnr = None if bool(error.isnan()) else min(float(-10 * torch.log10(error)), HIGHEST_PSNR)
    burned = ~(result.final <= limit).all(dim=-1) & counted
    photograph = local.photograph().mean(dim=-1)
    light = result.final.mean(dim=-1)
    unlit = black_pixels(view).to(model.device) | ~counted
    inner = max_pool2d(unlit.float()[None], 3, stride=1, padding=1)[0] == 0  # edges are blended
    bare = inner & (result.alpha < 0.5) & (light < photograph / 2)
    fog = None
    if near > 0:
        depth = torch.full_like(result.alpha, near)
        fog = float((model.alpha_in_front(camera, depth) * result.alpha).mean().clamp(0, 1))
    stops = _stops(measured.mean(dim=0), predicted.mean(dim=0), counted)
    return ViewHealth(psnr, None, _share(burned), fog, _share(bare), stops), result.training.get("radii")


def _stops(measured: Tensor, predicted: Tensor, counted: Tensor) -> tuple[float, float, float] | None:
    """Medians of measured over predicted light [H, W, 3] by color, where neither is black; None where all is."""
    lit = counted & (torch.minimum(measured, predicted).amin(dim=-1) > BLACK)
    if not bool(lit.any()):
        return None
    red, green, blue = torch.log2(measured[lit] / predicted[lit]).median(dim=0).values.tolist()
    return red, green, blue


def _compared(view: View, final: Tensor, stokes: Tensor | None) -> tuple[Tensor, Tensor]:
    """Measured and predicted pictures of a view: [K, H, W, 3] linear each.

    That is each picture behind its filter, where that is predicted, and else the photograph.
    """
    indices = [k for k, exposure in enumerate(view.exposures) if exposure.known]
    if stokes is None or not indices:
        return view.photograph()[None], final[None]
    rays = view.camera.rays(device=final.device)
    behind = analyzers([view.exposures[k] for k in indices], rays, view.mount)
    predicted = torch.stack([final + behind_analyzer(stokes, each) for each in behind])
    return view.intensities()[indices], predicted


def _beside(views: Sequence[View], psnr: Mapping[str, float | None]) -> dict[str, float]:
    """For each view the median PSNR of those nearest to it, by where cameras stand and look; empty for few views."""
    scored = [view for view in views if psnr[view.name] is not None]
    if len(scored) <= NEIGHBORS:
        return {}
    centers = torch.stack([view.camera.center for view in scored])
    away = (centers - centers.mean(dim=0)).norm(dim=1).mean().clamp(min=1e-12)
    places = torch.cat((centers / away, torch.stack([view.camera.rotation[2] for view in scored])), dim=1)
    distances = torch.cdist(places, places).fill_diagonal_(torch.inf)
    nearest = distances.topk(NEIGHBORS, largest=False).indices.tolist()
    values = [float(psnr[view.name] or 0.0) for view in scored]
    return {
        view.name: median(values[place] for place in row) for view, row in zip(scored, nearest, strict=True)
    }


def _share(pixels: Tensor) -> float:
    return float(pixels.float().mean())


def warnings_of(views: Mapping[str, ViewHealth], unseen: float | None, limits: Limits = LIMITS) -> list[str]:
    """Warnings, the gravest first.

    Args:
        views: those that were looked at. unseen: as of ``Health``. limits: from where on.
    """
    warnings = []
    bare = {name: view.bare for name, view in views.items() if view.bare > limits.bare}
    burned = {name: view.burned for name, view in views.items() if view.burned > limits.burned}
    if burned:
        warnings.append(
            f"the result has burned: {_worst(burned)} are over {limits.brighter:g} times as bright as anything that "
            "was measured. Their pictures do not determine the light there: do not use this run; add pictures of "
            "these views at other angles, or without a filter, and train again."
        )
    exposed = {name: stops for name, stops in _exposed(views, limits).items() if name not in burned | bare}
    explained = burned | bare | exposed
    far = [name for name in _far_under(views, limits) if name not in explained]
    if far:
        worst = ", ".join(
            f"{name} ({views[name].psnr:.1f} dB, beside {views[name].beside:.1f})" for name in far[:4]
        )
        more = f" and {len(far) - 4} more" if len(far) > 4 else ""
        warnings.append(
            f"training views far under those beside them: {worst}{more}. Pose, polarizer angle, exposure or focus of "
            f"these photographs may be wrong: {command('render', 'RUN', '--views', ','.join(far[:4]))} compares them "
            "with the run; correct them or leave them out."
        )
    if exposed:
        told = listed([f"{name} {stops:+.2f}" for name, stops in exposed.items()])
        warnings.append(
            f"training views brighter or darker than the result predicts, or of other colors (stops: {told}): their "
            "exposure or white balance differs and was not corrected. Leave them out, or prepare with --gains auto."
        )
    fog = {name: view.fog for name, view in views.items() if view.fog is not None and view.fog > limits.fog}
    if fog:
        warnings.append(
            f"fog hangs before the cameras of {_worst(fog, 'of the light')}, where no surface can be, and new "
            "views near them show it: add views from there, or, if the subject stands alone, train with --background "
            "black or masked."
        )
    if bare:
        warnings.append(
            f"the result has holes where the photographs show something: {_worst(bare)}. Add views or points there; "
            "if surroundings are missing, train with --background scene."
        )
    if unseen is not None and unseen > limits.unseen:
        warnings.append(
            f"{100 * unseen:.0f} % of the Gaussians are outside all of the {len(views)} training views that were "
            "looked at: nothing is known of them. Keep them out of exports with a crop box (polarguide present --crop)."
        )
    return warnings


def _exposed(views: Mapping[str, ViewHealth], limits: Limits) -> dict[str, float]:
    """Stops by which views are exposed otherwise than the others, the strongest first."""
    known = {name: torch.tensor(view.stops) for name, view in views.items() if view.stops is not None}
    if len(known) <= NEIGHBORS:
        return {}
    stops = torch.stack(list(known.values()))
    off = stops - stops.median(dim=0).values
    least = max(limits.exposed, limits.scattered * 1.4826 * float(off.abs().median()))
    strongest = {name: max(row.tolist(), key=abs) for name, row in zip(known, off, strict=True)}
    order = sorted(strongest, key=lambda name: -abs(strongest[name]))
    return {name: strongest[name] for name in order if abs(strongest[name]) > least}


def _far_under(views: Mapping[str, ViewHealth], limits: Limits) -> list[str]:
    """The views whose PSNR is far under that of the views beside them, the lowest first."""
    drops = {
        name: view.beside - view.psnr
        for name, view in views.items()
        if view.psnr is not None and view.beside is not None
    }
    if not drops:
        return []
    scatter = 1.4826 * median(abs(drop) for drop in drops.values())
    least = max(limits.far, limits.scattered * scatter)
    return sorted((name for name in drops if drops[name] > least), key=lambda name: -drops[name])


def _worst(shares: Mapping[str, float], of: str = "of the pixels") -> str:
    """Views by their shares, the largest first."""
    names = sorted(shares, key=lambda name: -shares[name])
    first, *rest = names
    return listed([f"{first} ({100 * shares[first]:.1f} % {of})", *rest])
