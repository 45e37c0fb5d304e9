"""``inspect_scene``: reads a capture, runs every check it can carry, and puts the findings together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture import Scene, load_scene
from polarguide.capture.layout import refuse_scene
from polarguide.core.errors import PolarguideError
from polarguide.core.files import check_out, require_inside
from polarguide.core.options import index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import check_options
from polarguide.inspection.angles import (
    AngleFindings,
    Evidence,
    combine_evidence,
    handedness_check,
    order_check,
    zero_check,
)
from polarguide.inspection.capture import Capture, InspectedView, ViewMeasurements, measure_view, read_capture
from polarguide.inspection.corrections import analyzer_check, corrected
from polarguide.inspection.evidence import (
    LONGEST,
    Surface,
    SurfaceSamples,
    normal_evidence,
    point_evidence,
    sample_surfaces,
    short_run,
    surface_of,
)
from polarguide.inspection.picture_checks import dielectric_check, find_pairing, light_checks, picture_checks
from polarguide.inspection.pose_checks import coverage_check, pose_check
from polarguide.inspection.settings import Check, InspectSettings, Verdict, worst
from polarguide.inspection.shots import (
    ShotFindings,
    agreement_checks,
    find_shots,
    pictures_check,
    shot_checks,
)
from polarguide.raster import Backend

SURE = 0.98
"""Probability from which on ``auto`` is content with the points."""
FEWEST_TO_TRAIN = 8
RUN_FOLDER = "short_run"


@dataclass(frozen=True, eq=False)
class Inspection:
    """The findings.

    Attributes:
        capture: what was inspected. settings: how. index: the refractive index that was used.
        measurements: of each view. checks: in the order in which they are shown.
        angles: order, sense and zero; of a capture with other pictures, what each tells of its polarizer.
    """

    capture: Capture
    settings: InspectSettings
    index: float
    measurements: tuple[ViewMeasurements, ...]
    checks: tuple[Check, ...]
    angles: AngleFindings | ShotFindings

    @property
    def verdict(self) -> Verdict:
        """The worst of all checks."""
        return worst(self.checks)

    def check(self, key: str) -> Check:
        """The check with this key."""
        return next(check for check in self.checks if check.key == key)


def inspection_folder(scene: Path, out: Path | None = None) -> Path:
    """The folder that an inspection writes: ``out``, or SCENE-inspection beside the scene.

    Raises:
        PolarguideError: there is a file of this name, or it would be written into a scene.
    """
    beside = scene.resolve().with_name(scene.resolve().name + "-inspection")
    folder = beside if out is None else out
    check_out(folder)
    refuse_scene(folder)
    require_inside(beside.parent if out is None else folder, folder, folder / RUN_FOLDER)
    return folder


def inspect_scene(
    path: Path, out: Path, settings: InspectSettings, backend: Backend, reporter: Reporter = SILENT
) -> Inspection:
    """Inspect a scene folder.

    Args:
        path: the scene; it may have no poses.
        out: folder for what is kept of a short training.
        settings: the user's choices.
        backend: what the short training runs on.
        reporter: receives the progress.

    Raises:
        PolarguideError: the scene cannot be read, or a setting is out of range.
    """
    check_options(settings)
    capture = read_capture(path, downscale=settings.downscale, transfer=settings.transfer, reporter=reporter)
    if settings.calibration is not None and not capture.four:
        raise PolarguideError(
            "--calibration",
            expected="a scene with four pictures of each view",
            found="one with other pictures",
            remedy="Leave --calibration out.",
        )
    if settings.calibration is not None:
        capture = corrected(capture, settings.calibration)
    index = index_of(settings.refractive_index, capture.refractive_index)
    measurements: list[ViewMeasurements] = []
    with reporter.track("measuring", len(capture.views)) as advance:
        for view in capture.views:
            measurements.append(measure_view(view, index))
            advance(len(measurements))
    if not capture.four:
        checks, shots = _shots(capture, measurements, out, settings, index, backend, reporter)
        return Inspection(capture, settings, index, tuple(measurements), tuple(checks), shots)
    pairing = find_pairing(capture)
    checks = picture_checks(capture, measurements, pairing)
    calibrated = analyzer_check(capture, settings.calibration)
    checks += [] if calibrated is None else [calibrated]
    with reporter.track("matching features", 1):
        checks += [pose_check(capture), coverage_check(capture)]
    angles, pixels = _angles(capture, out, settings, index, pairing or 0, backend, reporter)
    checks += [order_check(angles), handedness_check(angles), zero_check(angles)]
    checks.append(dielectric_check(measurements, pixels, index))
    return Inspection(capture, settings, index, tuple(measurements), tuple(checks), angles)


def _shots(
    capture: Capture,
    measurements: Sequence[ViewMeasurements],
    out: Path,
    settings: InspectSettings,
    index: float,
    backend: Backend,
    reporter: Reporter,
) -> tuple[list[Check], ShotFindings]:
    """The checks of a capture with other pictures than four angles a view, and what these tell of their polarizers."""
    checks = [pictures_check(capture), *agreement_checks(capture), *light_checks(capture, measurements)]
    with reporter.track("matching features", 1):
        checks += [pose_check(capture), coverage_check(capture)]
    if len(capture.posed) < FEWEST_TO_TRAIN:
        why = f"The angles are checked by a short training, which takes {FEWEST_TO_TRAIN} views with a pose."
        found = ShotFindings(why=why)
    elif settings.normals == "points":
        found = ShotFindings(
            why="The angles are checked by a short training, which --normals points leaves out."
        )
    else:
        scene = _training_scene(capture, settings, reporter, held_out=())
        with reporter.track("short training", settings.steps) as advance:
            found = find_shots(
                scene,
                out / RUN_FOLDER,
                steps=settings.steps,
                refractive_index=index,
                backend=backend,
                on_step=lambda report: advance(min(report.step + 1, settings.steps)),
            )
    return checks + shot_checks(found), found


def _angles(
    capture: Capture,
    out: Path,
    settings: InspectSettings,
    index: float,
    pairing: int,
    backend: Backend,
    reporter: Reporter,
) -> tuple[AngleFindings, SurfaceSamples | None]:
    """Order, sense and zero by what geometry there is; and the pixels with normals if there are any."""
    sources: list[Evidence] = []
    if capture.model is None or len(capture.posed) < 2:
        return combine_evidence(sources, pairing, capture.applied, mosaic=capture.origin == "mosaics"), None
    with reporter.track("weighing points", 1):
        evidence, pixels = point_evidence(capture.posed, capture.model, index, pairing)
    sources.append(evidence)
    angles = combine_evidence(sources, pairing, capture.applied, mosaic=capture.origin == "mosaics")
    sure = angles.posterior is not None and max(angles.posterior.probabilities) >= SURE
    if settings.normals == "points" or (settings.normals == "auto" and sure):
        return angles, pixels
    if len(capture.posed) < FEWEST_TO_TRAIN:
        return angles, pixels
    pixels = _trained_pixels(capture, out, settings, pairing, index, backend, reporter)
    sources.append(normal_evidence(pixels, index))
    return combine_evidence(sources, pairing, capture.applied, mosaic=capture.origin == "mosaics"), pixels


def _trained_pixels(
    capture: Capture,
    out: Path,
    settings: InspectSettings,
    pairing: int,
    index: float,
    backend: Backend,
    reporter: Reporter,
) -> SurfaceSamples:
    scene = _training_scene(capture, settings, reporter)
    with reporter.track("short training", settings.steps) as advance:
        state = short_run(
            scene,
            out / RUN_FOLDER,
            steps=settings.steps,
            backend=backend,
            on_step=lambda report: advance(report.step + 1),
            refractive_index=index,
        )
    with reporter.track("comparing with normals", len(capture.posed)) as advance:

        def surfaces() -> Iterator[tuple[InspectedView, Surface]]:
            for done, view in enumerate(capture.posed):
                yield view, surface_of(state, scene.view(view.name), backend)
                advance(done + 1)

        return sample_surfaces(surfaces(), pairing)


def _training_scene(
    capture: Capture, settings: InspectSettings, reporter: Reporter, held_out: Sequence[str] | None = None
) -> Scene:
    """The views with a pose at the size of a short training; ``held_out``: those to leave out, None: as ever."""
    factor = max(1, math.ceil(max(capture.size) / LONGEST))
    names = [view.name for view in capture.posed]
    scene = load_scene(
        capture.root,
        downscale=factor,
        transfer=settings.transfer,
        views=names,
        test_views=held_out,
        reporter=reporter,
    )
    if not scene.train_views:
        raise PolarguideError(
            capture.root, expected="views to train on", found="none", remedy="Use --normals points."
        )
    return scene
