"""Scores of a run on its test views, rendering speed, and the error sheet ``errors.png``.

``metrics.json`` contains the scores, and the digest and commit of the code that computed them.
"""

from __future__ import annotations

import ast
import hashlib
import json
import math
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, NamedTuple, TypedDict

import msgspec
import torch
from torch import Tensor

import polarguide
from polarguide import _native, optics
from polarguide.capture import View
from polarguide.capture.view import listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import decode, read_record, shortened
from polarguide.core.system import peak_memory_mib
from polarguide.gaussians.initialize import camera_reach
from polarguide.geometry.coverage import (
    HAZE_DEPTH,
    ConfirmedSurfaces,
    Coverage,
    DepthMap,
    depth_map_of_rendering,
    depth_map_of_truth,
)
from polarguide.optics import Mount
from polarguide.optics.color import shown
from polarguide.results.evaluation.mesh import mesh_scores
from polarguide.results.evaluation.metric import Metric
from polarguide.results.evaluation.metrics import Selection, normal_angles_deg
from polarguide.results.evaluation.scores import ErrorsByObject, ViewScores, score_view, summarize
from polarguide.results.evaluation.table import (
    HIGHEST_PSNR,
    METRICS,
    OBJECT_METRICS,
    PART_SHARES,
    PLUGGED,
    RUN_METRICS,
    registered_digests,
)
from polarguide.results.evaluation.target import SceneFacts, ViewTarget
from polarguide.results.rendering.mesh import RESOLUTION, Surface, fused_surface
from polarguide.runs.callbacks import Stopwatch
from polarguide.runs.folder import RunLog
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult
from polarguide.training.angles.polarizers import fit_angle
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, contact_sheet

PACKAGE = Path(__file__).parents[2]
COMMIT = "_commit.txt"
"""File in an installed package that contains the commit of its build. It is empty if the commit is unknown."""
DIGITS = 16
NOT_SCORING = ("inspection", "viewer", "api", "cli", "__main__.py")
"""Parts of the package that neither training nor scoring imports."""
NOT_TRAINING = ("results", *NOT_SCORING)
"""Parts of the package that training never imports."""
BENCH = "polarguide_bench"
"""Neighboring package with the recipes of comparisons."""
BENCH_METHODS = ("recipes.py", "polgs.py", "gnerp", "datasets")
"""Parts of the bench that prepare and train."""
BENCH_TABLES = ("join.py", "tables.py", "figures.py", "report.py", "verbs.py")
"""Parts of the bench that only write tables and reports of finished scores."""


@lru_cache
def code_digest(package: Path = PACKAGE, *, training: bool = False) -> str:
    """Hash the code that trains and scores, and the compiled library, to 16 hexadecimal digits.

    Comments and docstrings do not change the digest.

    Args:
        package: folder of the package. The bench is its sibling.
        training: hash only code that training imports, so that a change of the scoring does not invalidate trained
            runs.
    """
    left_out = NOT_TRAINING if training else NOT_SCORING
    sources = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in left_out]
    bench = package.with_name(BENCH)
    for path in bench.rglob("*.py"):
        part = path.relative_to(bench).parts[0]
        if part in BENCH_METHODS if training else part not in BENCH_TABLES:
            sources.append(path)
    compiled = [path for path in package.glob("_native.*") if path.suffix != ".pyi"]
    return _digest(package.parent, [*sources, *compiled])


def _digest(folder: Path, files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(files):
        data = path.read_bytes()
        content = _code_hash(data) if path.suffix == ".py" else hashlib.sha256(data).hexdigest()
        digest.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return digest.hexdigest()[:DIGITS]


@cache
def _code_hash(source: bytes) -> str:
    """Hash the syntax tree of a source without docstrings.

    The result is cached, because the digests with and without ``training`` share most files.
    """
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def commit(package: Path = PACKAGE) -> str | None:
    """Return the commit of an installed build, or of the repository that contains the running source.

    A repository that contains the project in a subfolder is ignored.

    Args:
        package: folder of the package.

    Returns:
        The hash of the commit, or None if it is unknown.
    """
    stamp = package / COMMIT
    if stamp.exists():
        return stamp.read_text(encoding="utf-8").strip() or None
    command = ["git", "-C", str(package), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        git = subprocess.run(command, capture_output=True, text=True, check=True)
    except (
        FileNotFoundError,
        subprocess.CalledProcessError,
    ):  # Git is not installed, or there is no repository.
        return None
    top, head = git.stdout.splitlines()
    return head if Path(top, "src", package.name).resolve() == package.resolve() else None


METRICS_FILE = "metrics.json"
_REMEDY = "Score the run again with this version: polarguide eval."


class Provenance(TypedDict):
    """Facts that are needed to repeat a run. Additional fields are allowed."""

    recipe: str
    seed: int
    commit: str | None
    versions: dict[str, str]
    device: str
    downscale: int
    scene_hash: str


_Decibels = Annotated[float, msgspec.Meta(le=HIGHEST_PSNR)] | None


def _fields(metrics: Sequence[Metric], *reasons: str) -> list[Any]:
    """Return the fields of a record: the metrics, and texts that explain null values."""
    values: list[Any] = []
    for metric in metrics:
        kind = _Decibels if metric.unit == "dB" else float | None
        # A record may be older than the installation of the metric's package.
        values.append((metric.key, kind, None) if metric in PLUGGED else (metric.key, kind))
    values.sort(key=len)  # Fields with a default come last.
    return [*values, *((f"{key}_reason", str | None, None) for key in reasons)]


_VIEW_REASONS = ("lpips", "flip", "stokes_error")
_RUN_REASONS = (*_VIEW_REASONS, "fps", "train_seconds", "peak_memory_mib", "mesh_fscore_1")


_OBJECT = msgspec.defstruct(
    "Object",
    [
        ("pixels", int),
        ("views", int),
        *_fields([metric for metric in METRICS if metric.key in OBJECT_METRICS]),
        ("material", str | None, None),
        *((metric.key, float | None, None) for metric in PART_SHARES),
    ],
    kw_only=True,
)
"""Errors over the pixels of an object or a class of material in all test views."""
_PARTS = GenericAlias(dict, (str, _OBJECT))


@cache
def _structures(metrics: tuple[Metric, ...]) -> tuple[type, type]:
    """Return the types of the scores of a view, and of the record in ``metrics.json``, for all metrics."""
    view = msgspec.defstruct("View", _fields([m for m in metrics if m.of == "view"], *_VIEW_REASONS))
    run = msgspec.defstruct(
        "Run",
        [
            *_fields(metrics, *_RUN_REASONS),
            ("views", Annotated[dict[str, Any], msgspec.Meta(min_length=1)]),
            ("provenance", Provenance),
            ("objects", _PARTS, msgspec.field(default_factory=dict)),
            ("materials", _PARTS, msgspec.field(default_factory=dict)),
        ],
        kw_only=True,
    )
    return view, run


def write_metrics(
    path: str | Path,
    *,
    views: Mapping[str, ViewScores],
    run: Mapping[str, float | int | str | None],
    provenance: Mapping[str, Any],
    objects: Mapping[str, Any] | None = None,
    materials: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write ``metrics.json`` atomically.

    The top level holds the means of ``summarize``, the keys of ``run``, ``views``, ``objects``, ``materials``
    and ``provenance``. NaN becomes null.

    Args:
        path: the file; its folder must exist.
        views: scores by view name, at least one view.
        run: values of ``RUN_METRICS`` by key. A missing value is written as null. Entries such as ``fps_reason``
            explain a null.
        provenance: the keys of ``Provenance``; other keys are allowed.
        objects, materials: errors of each object and of each class of material, see ``ErrorsByObject.records``.

    Returns:
        The record.

    Raises:
        PolarguideError: the record does not pass ``validate_metrics``.
    """
    finite: dict[str, Any] = {
        name: {key: _finite(value) for key, value in scores.items()} for name, scores in views.items()
    }
    record: dict[str, Any] = {
        **summarize(finite),
        **{metric.key: None for metric in RUN_METRICS},
        **{key: _finite(value) for key, value in run.items()},
        "views": finite,
        "objects": dict(objects or {}),
        "materials": dict(materials or {}),
        "provenance": dict(provenance),
    }
    validate_metrics(record, where=path)
    write_text(Path(path), json.dumps(record, indent=2, allow_nan=False) + "\n")
    return record


def read_metrics(run: Path) -> dict[str, Any]:
    """Read the scores in a run folder.

    Raises:
        PolarguideError: the run has no scores, or the file is not a valid record.
    """
    path = run / METRICS_FILE
    if not path.exists():
        raise PolarguideError(
            path, expected="the scores of a run", found="none", remedy="Run polarguide eval."
        )
    record = read_record(path, dict[str, Any], remedy=_REMEDY)
    validate_metrics(record, path)
    return record


def validate_metrics(record: Any, where: str | Path = METRICS_FILE) -> None:
    """Validate a record against the schema of ``metrics.json``.

    Args:
        record: the parsed file.
        where: name of the record in an error.

    Raises:
        PolarguideError: the record is invalid. The error names the first invalid key.
    """
    view, run = _structures(tuple(METRICS))
    decode(record, run, where, remedy=_REMEDY)
    _check_reason(record, where)
    for name, scores in record["views"].items():
        decode(scores, view, f"{where}, view {name}", remedy=_REMEDY)
        _check_reason(scores, f"{where}, view {name}")


def _check_reason(scores: Mapping[str, Any], where: object) -> None:
    reason = scores.get("lpips_reason")
    if scores["lpips"] is None and not reason:
        raise PolarguideError(
            f"{where} (lpips_reason)",
            expected="a reason, because lpips is null",
            found=shortened(reason),
            remedy=_REMEDY,
        )


def _finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON cannot represent, by None."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


ERRORS_FILE = "errors.png"
MOST_VIEWS = 8
"""Maximum number of views in the error sheet."""
PICTURE_HIGH = 0.25
"""Difference of displayed values that is drawn at full brightness in the heat map of a picture."""
NORMAL_HIGH = 45.0
"""Angle in degrees that is drawn at full brightness in the heat map of normals."""
BRIGHTEST = (0.05, 0.5)
"""Lower and upper bound of the DoLP that is drawn at full brightness in a picture of polarization."""
MAP = "inferno"
NOT_COUNTED = 90
"""Gray level of pixels that a score does not count."""
STRIPES = 48
"""Number of stripes across a picture. Stripes mark pixels whose content is visible in no training view."""
COLUMNS = {
    "photograph": "photograph",
    "final": "picture error",
    "normal": "normal error",
    "specular": "specular error",
    "diffuse": "diffuse error",
    "measured": "AoLP x DoLP",
    "predicted": "predicted",
    "stokes": "S1, S2 error",
}
"""Heading of each column of the error sheet. A column without pictures is left out."""


class _SheetRow(NamedTuple):
    """Row of the error sheet.

    Attributes:
        name: name of the view.
        pictures: pictures by column.
        measured: [3, H, W, 3] measured Stokes vectors, or None if the pictures do not determine them.
        predicted: [3, H, W, 3] predicted Stokes vectors, or None without a prediction.
        mask: [H, W] pixels whose polarization is scored.
        unseen: [H, W] pixels that no training view shows.
    """

    name: str
    pictures: dict[str, Picture]
    measured: Tensor | None
    predicted: Tensor | None
    mask: Tensor
    unseen: Tensor


class ErrorSheet:
    """Sheet of error maps with one row per view and a color scale below each column.

    Heat maps are black at zero error and bright at the end of their scale. Pixels without a score are gray.
    Gray stripes in the error of picture and polarization mark pixels whose content no training view shows.

    - Layers and picture: absolute difference of displayed values, mean over channels.
    - Polarization: mean Stokes vector of the channels, with AoLP as hue and DoLP as brightness.
    - Error of polarization: |S1 error| + |S2 error|, mean over channels.

    The scales of polarization end near the 90th percentile of the measured values.

    Args:
        views: number of views. At most ``MOST_VIEWS`` evenly spaced views are drawn.
    """

    def __init__(self, views: int) -> None:
        self._chosen = range(0, views, max(1, math.ceil(views / MOST_VIEWS)))
        self._added = 0
        self._rows: list[_SheetRow] = []

    def add(self, view: View, target: ViewTarget, result: RenderResult, stokes: Tensor | None) -> None:
        """Add the next view if the sheet draws it.

        Args:
            view: the test view.
            target: its ground truth.
            result: its rendering.
            stokes: [3, H, W, 3] predicted Stokes vectors; None without a prediction.
        """
        self._added += 1
        if self._added - 1 not in self._chosen:
            return
        pictures = {
            "photograph": figures.radiance_to_rgb(target.photograph),
            "final": _difference(result.final, target.photograph, target.valid),
        }
        for name in ("specular", "diffuse"):
            layer = result.layers.get(name)
            lobe = getattr(target, name)
            if layer is not None and lobe is not None and target.foreground is not None:
                pictures[name] = _difference(layer, lobe / 2, target.foreground)
        if "normal" in result.layers and target.normal is not None and target.surface is not None:
            angles = normal_angles_deg(result.normal.nan_to_num(), target.normal)
            pictures["normal"] = _heat(angles, target.surface.mask, NORMAL_HIGH)
        unseen = target.unseen.cpu()
        _hatch(pictures["final"], unseen)
        keep = target.valid if target.polarized is None else target.polarized
        predicted = None if stokes is None else stokes.cpu().nan_to_num()
        measured = view.stokes() if view.is_determined else None
        self._rows.append(_SheetRow(view.name, pictures, measured, predicted, keep.mask.cpu(), unseen))

    def write(self, path: Path) -> None:
        """Write the sheet, or no file if it has no view."""
        if not self._rows:
            return
        ends = {**dict.fromkeys(("final", "specular", "diffuse"), PICTURE_HIGH), "normal": NORMAL_HIGH}
        headings = dict(COLUMNS)
        if any(row.measured is not None and row.predicted is not None for row in self._rows):
            brightest, ends["stokes"] = self._draw_polarization()
            headings["measured"] = f"AoLP x DoLP / {brightest:g}"
        keys = [key for key in COLUMNS if any(key in row.pictures for row in self._rows)]
        rows: list[list[Picture | None]] = [[row.pictures.get(key) for key in keys] for row in self._rows]
        bars = {
            key: figures.scale_bar(0.0, end, MAP, "deg" if key == "normal" else "")
            for key, end in ends.items()
        }
        bars |= dict.fromkeys(("measured", "predicted"), figures.angle_wheel())
        bars["photograph"] = figures.color_patch(NOT_COUNTED, "gray: no score, stripes: unseen")
        sheet = contact_sheet(
            rows,
            [row.name for row in self._rows],
            [headings[key] for key in keys],
            footer=[bars[key] for key in keys],
        )
        figures.write_png(path, sheet)

    def _draw_polarization(self) -> tuple[float, float]:
        """Add the pictures of polarization; return the DoLP at full brightness and the end of the error scale."""
        counted = [row.measured[:, row.mask] for row in self._rows if row.measured is not None]
        degrees = torch.cat([optics.dolp(optics.luminance(values)) for values in counted])
        brightest = min(max(_rounded_percentile(degrees), BRIGHTEST[0]), BRIGHTEST[1])
        high = _rounded_percentile(torch.cat([_polarization_magnitude(values) for values in counted]))
        for _, pictures, measured, predicted, keep, unseen in self._rows:
            if measured is None:
                continue
            pictures["measured"] = _polarization(measured, brightest)
            if predicted is not None:
                pictures["predicted"] = _polarization(predicted, brightest)
                pictures["stokes"] = _heat(_polarization_magnitude(predicted - measured), keep, high)
                _hatch(pictures["stokes"], unseen)
        return brightest, high


def _difference(pred: Tensor, true: Tensor, keep: Selection) -> Picture:
    error = (shown(pred.nan_to_num(nan=0.0)) - shown(true)).abs().mean(dim=-1)
    return _heat(error, keep.mask, PICTURE_HIGH)


def _heat(values: Tensor, keep: Tensor, high: float) -> Picture:
    picture = figures.scalar_to_rgb(values, 0.0, high, MAP)
    picture[~keep.cpu().numpy()] = NOT_COUNTED
    return picture


def _hatch(picture: Picture, unseen: Tensor) -> None:
    """Draw diagonal stripes over the pixels [H, W] whose content no training view shows."""
    height, width = unseen.shape
    diagonal = torch.arange(height)[:, None] + torch.arange(width)
    spacing = max(4, width // STRIPES)
    stripes = unseen & (diagonal % spacing < spacing // 4)
    picture[stripes.numpy()] = NOT_COUNTED


def _polarization_magnitude(stokes: Tensor) -> Tensor:
    """Return |S1| + |S2| of Stokes vectors [3, ..., C], averaged over channels."""
    return stokes[1:].abs().sum(dim=0).mean(dim=-1)


def _polarization(stokes: Tensor, brightest: float) -> Picture:
    mean = optics.luminance(stokes)
    return figures.aolp_to_rgb(optics.aolp(mean), (optics.dolp(mean) / brightest).clamp(max=1))


def _rounded_percentile(values: Tensor) -> float:
    """Return the 90th percentile of values, rounded up to 1, 2 or 5 times a power of ten, but at least 0.001."""
    ordered = values.flatten().sort().values
    value = max(float(ordered[int(0.9 * (len(ordered) - 1))]) if len(ordered) else 0.0, 1e-3)
    power = 10.0 ** math.floor(math.log10(value))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * (1 - 1e-9))


@torch.no_grad()
def cross_fitted(view: View, final: Tensor, stokes: Tensor | None) -> Tensor:
    """Predict the photograph of a view whose pictures do not determine S0, for a fair comparison.

    Gain, angle and modulation of the analyzer are unknown, so they are fitted (``training.angles.fit``). The fit on the
    left half of the picture predicts the right half. The fit on the right half predicts the left half. So no pixel is
    scored with a fit that used this pixel.

    Args:
        view: the view.
        final: [H, W, 3] rendered S0/2.
        stokes: [3, H, W, 3] predicted Stokes vectors; None fits only the gain.

    Returns:
        [H, W, 3] linear radiance, on the device of ``final``.
    """
    local = view.to(final.device)
    measured = local.photograph().to(final)
    rays = local.camera.rays(device=final.device)
    good = (~(local.invalid | local.saturated)).to(final)
    polarized = torch.zeros_like(final).expand(2, *final.shape) if stokes is None else stokes[1:]
    predicted = torch.cat((2 * final[None], polarized)).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    left = torch.arange(final.shape[1], device=final.device) < final.shape[1] // 2
    by_right, by_left = (
        _behind_fitted_analyzer(measured, predicted, good * half, rays, view.mount) for half in (~left, left)
    )
    return torch.where(left[None, :, None], by_right, by_left)


def _behind_fitted_analyzer(
    measured: Tensor, stokes: Tensor, weight: Tensor, rays: Tensor, mount: Mount
) -> Tensor:
    """Fit the analyzer to the weighted pixels, and predict all pixels [H, W, 3] behind it."""
    angle = fit_angle(measured, stokes, weight, rays, mount)
    if angle is None:
        counted = weight[..., None]
        gain = (counted * measured).sum() / (counted * stokes[0] / 2).sum().clamp(min=1e-12)
        return gain * stokes[0] / 2
    cosine, sine = optics.analyzer(math.radians(angle.angle), rays, mount)[..., None].to(stokes)
    polarized = angle.modulation * (stokes[1] * cosine + stokes[2] * sine)
    return angle.gain * (stokes[0] + polarized) / 2


MINIMUM_SECONDS = 1.5
"""Minimum duration of a speed measurement, in seconds."""
MOST_SECONDS = 40.0
"""Longest expected duration of a full speed measurement, in seconds. A slower one times fewer views, once each."""
NO_PEAK = "the process used more memory before scoring"
OTHER_WORK = "other work ran on the machine at the same time"


def evaluate(
    run: OpenedRun,
    *,
    speed: bool = False,
    surface: Callable[[], Surface] | None = None,
    reporter: Reporter = SILENT,
) -> dict[str, Any]:
    """Score the test views of a run and write ``metrics.json`` and ``errors.png`` into its folder.

    Args:
        run: the run to score, or an object with the attributes of a run that this module reads.
        speed: measure frames per second. Other work on the machine makes this measurement invalid.
        surface: computes the surface for the mesh scores. None fuses rendered depth maps to a surface.
        reporter: receives progress and warnings.

    Returns:
        The record in ``metrics.json``: means over the views, ``views`` by name, ``objects``, ``materials``
        and ``provenance``.

    Raises:
        PolarguideError: the scene cannot be read or has no test views.
    """
    peak_before = peak_memory_mib()
    tests = run.scene.test_views
    if not tests:
        raise PolarguideError(
            run.scene.root,
            expected="at least one test view",
            found="none: all views were used for training",
            remedy='List test views in split.json, {"test": ["<view>", ...]}, and train again.',
        )
    facts = SceneFacts.of(run.scene)
    for warning in facts.warnings:
        reporter.warn(warning)
    fitted = [view.name for view in tests if not view.measures_radiance]
    if fitted:
        reporter.say(f"scored with an analyzer fitted on the other half of the picture: {listed(fitted)}")
    coverage, surfaces = _coverage(run, reporter)
    views = {}
    by_object = ErrorsByObject(facts.objects)
    sheet = ErrorSheet(len(tests))
    with reporter.track("scoring", len(tests)) as advance:
        for view in tests:
            nearest = surfaces.nearest(view.camera)
            views[view.name] = _score(run, view, facts, coverage.seen[view.name], nearest, by_object, sheet)
            advance(len(views))
    sheet.write(run.folder / ERRORS_FILE)
    memory = _peak_memory(peak_before)  # The mesh scores below are not part of rendering.
    with reporter.track("measuring the mesh"):
        mesh = mesh_scores(surface or (lambda: _fuse_depths(run)), tests)
    objects, materials = by_object.records()
    seconds, alone = RunLog(run.folder).elapsed()
    timed = alone and seconds > 0
    no_time = "the run has no training log" if alone else OTHER_WORK
    fps = _speed(run, normals=False) if speed else None
    no_speed = OTHER_WORK if speed else "not requested"
    return write_metrics(
        run.folder / METRICS_FILE,
        views=views,
        run={
            "fps": fps,
            "fps_reason": no_speed if fps is None else None,
            "fps_layers": _speed(run, depth=True) if speed else None,
            "train_seconds": seconds if timed else None,
            "train_seconds_reason": None if timed else no_time,
            "gaussians": run.model.gaussians,
            "steps": run.steps,
            **memory,
            **mesh,
        },
        objects=objects,
        materials=materials,
        provenance=_provenance(run),
    )


def _coverage(run: OpenedRun, reporter: Reporter) -> tuple[Coverage, ConfirmedSurfaces]:
    """Find the pixels of the test views that a training view shows, and the surfaces that two training views confirm.

    The depth of a test view comes from the ground truth if it has one. All other depths are rendered.
    """
    scene = run.scene
    training = scene.train_views
    centers = torch.stack([view.camera.center for view in training])
    middle, radius = camera_reach(
        (scene.points if len(scene.points) else centers).double().numpy(), centers.numpy()
    )

    def surface(view: View) -> DepthMap:
        result = run.model.render(view.camera, normals=False, depth=True, surface=True)
        return depth_map_of_rendering(
            view.camera, result.depth, result.alpha, torch.from_numpy(middle), radius
        )

    held_out = {}
    for view in scene.test_views:
        truth = view.ground_truth
        known = None if truth is None else truth.depth
        held_out[view.name] = surface(view) if known is None else depth_map_of_truth(view.camera, known)
    coverage = Coverage(held_out)
    grids = []
    with reporter.track("finding the photographed pixels", len(training)) as advance:
        for count, view in enumerate(training, start=1):
            depths = surface(view)
            coverage.add(depths)
            grids.append(depths.on_grid())
            advance(count)
    return coverage, ConfirmedSurfaces(grids)


def _score(
    run: OpenedRun,
    view: View,
    facts: SceneFacts,
    seen: Tensor,
    nearest: Tensor,
    by_object: ErrorsByObject,
    sheet: ErrorSheet,
) -> ViewScores:
    # The target is created first, because a later copy to the device would wait for the rendering.
    target = ViewTarget.of_view(view, facts, run.model.device).with_coverage(seen, nearest > 0)
    result = run.model.render(view.camera, depth=True, surface=True)
    stokes = run.model.stokes(result, view.camera)
    if not view.measures_radiance:
        result = result.with_layers(final=cross_fitted(view, result.final, stokes))
    in_free_space = run.model.alpha_in_front(view.camera, HAZE_DEPTH * nearest)
    in_front = None
    if target.depth is not None:
        in_front = run.model.alpha_in_front(view.camera, HAZE_DEPTH * target.depth)
    undecided = None if target.owner is None else run.undecided(view.camera)
    if undecided is not None:
        result = result.with_layers(undecided=undecided)
    sheet.add(view, target, result, stokes)
    return score_view(
        target, result, stokes=stokes, in_front=in_front, in_free_space=in_free_space, by_object=by_object
    )


def _peak_memory(before: float | None) -> dict[str, Any]:
    """Return the peak memory of this process in MiB, or the reason why it is unknown.

    The peak belongs to the scoring only if it exceeds ``before``, the peak before the scoring.
    """
    peak = peak_memory_mib()
    if peak is None or before is None:
        return {"peak_memory_mib": None, "peak_memory_mib_reason": "the operating system does not report it"}
    if peak == before:  # for example after a training in this process
        return {"peak_memory_mib": None, "peak_memory_mib_reason": NO_PEAK}
    return {"peak_memory_mib": peak, "peak_memory_mib_reason": None}


def _fuse_depths(run: OpenedRun) -> Surface:
    surface, _, _ = fused_surface(
        run.cameras, lambda camera: run.model.render(camera, depth=True, surface=True), resolution=RESOLUTION
    )
    return surface


def _speed(run: OpenedRun, *, normals: bool = True, depth: bool = False) -> float | None:
    def draw(view: View) -> None:
        run.model.render(view.camera, normals=normals, depth=depth)
        if run.model.device.type == "cuda":
            torch.cuda.synchronize(run.model.device)

    return frames_per_second(draw, run.scene.test_views)


def _provenance(run: OpenedRun) -> dict[str, Any]:
    configuration = run.configuration
    device = run.model.device
    processor = torch.cuda.get_device_name(device) if device.type == "cuda" else _native.simd()
    return {
        "recipe": configuration.recipe,
        "seed": configuration.settings.seed,
        "commit": commit(),
        "sources": code_digest(),
        "metrics": registered_digests(),
        "versions": {
            "polarguide": polarguide.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "device": f"{device} ({processor}, {_native.thread_count()} threads)",
        "downscale": configuration.downscale,
        "scene_hash": run.scene.digest,
        "scene": run.scene.name,
        "refractive_index": configuration.settings.refractive_index,
    }


def frames_per_second(draw: Callable[[View], object], views: Sequence[View]) -> float | None:
    """Measure the rendering speed: the median over views of 1 / seconds for ``draw``.

    Each view is drawn once without timing and then at least three times. If this would take longer than
    ``MOST_SECONDS``, only the first view is warmed up, and as many views as fit into that time are timed
    once.

    Args:
        draw: renders one view and returns after the rendering is complete.
        views: the views.

    Returns:
        Frames per second; None if other work ran on the machine at the same time.
    """
    first = _seconds(draw, views[0])
    rounds = 3
    slow = 4 * len(views) * first > MOST_SECONDS
    if slow:
        rounds = 1
        views = views[: max(1, int(MOST_SECONDS / first))]
    else:
        for view in views[1:]:
            draw(view)
    times: list[list[float]] = [[] for _ in views]
    stopwatch = Stopwatch()
    begin = time.perf_counter()
    while len(times[0]) < rounds or (not slow and time.perf_counter() - begin < MINIMUM_SECONDS):
        for seconds, view in zip(times, views, strict=True):
            seconds.append(_seconds(draw, view))
    _, alone = stopwatch.read()
    return 1 / statistics.median(statistics.median(seconds) for seconds in times) if alone else None


def _seconds(draw: Callable[[View], object], view: View) -> float:
    start = time.perf_counter()
    draw(view)
    return time.perf_counter() - start
