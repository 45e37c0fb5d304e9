"""Inspect a scene: read it, run all checks that apply, and write the report.

The report is an HTML page without scripts or external files, and ``inspection.json``. This module also contains the
checks of poses. They measure epipolar errors and gaps between the views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import max_pool2d

from polarguide import __version__, optics
from polarguide.capture import Scene, load_scene
from polarguide.capture.angle_evidence import OrderEvidence, posterior
from polarguide.capture.colmap.sfm import SAMPLE, log_false_alarms
from polarguide.capture.layout import refuse_scene
from polarguide.capture.view import listed
from polarguide.core.errors import require
from polarguide.core.files import check_out, make_folder, require_inside, write_text, write_whole
from polarguide.core.options import index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import check_options, to_json
from polarguide.core.text import printable
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import scene_frame
from polarguide.geometry.vectors import unit_array
from polarguide.inspection.angles import AngleFindings, angle_checks, combine_evidence
from polarguide.inspection.capture import (
    Capture,
    InspectedView,
    ViewMeasurements,
    measure_view,
    quantile,
    read_capture,
)
from polarguide.inspection.evidence import (
    LONGEST,
    SurfaceSamples,
    ViewSurface,
    normal_evidence,
    point_evidence,
    sample_surfaces,
    short_run,
    trained_surface,
)
from polarguide.inspection.picture_checks import (
    analyzer_check,
    dielectric_check,
    find_pairing,
    held_out_check,
    lens_check,
    light_checks,
    picture_checks,
    view_exposure_check,
    with_noise,
)
from polarguide.inspection.settings import Check, InspectSettings, Verdict, first_outcome, json_value, worst
from polarguide.inspection.shots import (
    ShotFindings,
    agreement_checks,
    estimate_shot_angles,
    pictures_check,
    shot_checks,
    strong_polarization,
)
from polarguide.raster import Backend
from polarguide.visualization import figures
from polarguide.visualization.figures import AOLP_FULL_DOLP, DOLP_HIGH, Picture
from polarguide.visualization.pages import data_uri, page

SIDE = 240
"""Largest width or height of the pictures on the page, in pixels."""
NOISE_HIGH = 0.05
EXCESS_HIGH = 0.1
SATURATED_COLOR = (255, 40, 40)
INVALID_COLOR = (60, 120, 255)


@dataclass(frozen=True)
class Layer:
    """A kind of picture on the page, such as the DoLP of a view.

    Attributes:
        key: name in HTML.
        label: name on the page.
        legend: description of its colors.
        ramp: color map of the legend's bar, or None.
        caption: function that returns the line below the picture of a view.
    """

    key: str
    label: str
    legend: str
    ramp: str | None
    caption: Callable[[ViewMeasurements], str]


LAYERS: tuple[Layer, ...] = (
    Layer("s0", "S0", "Photograph S0 / 2 in sRGB; the view's 99th percentile is white.", None,
          lambda r: f"99 % under {r.bright:.2f}"),
    Layer("dolp", "DoLP", f"0 to {DOLP_HIGH:g}", "inferno", lambda r: f"median {r.dolp[0]:.3f}, 99 % {r.dolp[1]:.2f}"),
    Layer("aolp", "AoLP", f"Angle of the field by color; dark where the DoLP is below {AOLP_FULL_DOLP:g}.", None,
          lambda r: f"{r.polarized:.0%} polarized"),
    Layer("saturation", "Saturation", "Red: one angle at full scale. Blue: marked invalid, or black.", None,
          lambda r: f"{r.saturated:.1%} + {r.invalid:.1%}"),
    Layer("noise", "Noise", f"Noise of one intensity relative to the photograph: 0 to {NOISE_HIGH:.0%}", "viridis",
          lambda r: f"median {r.noise_share:.2%}"),
    Layer("consistency", "Pair sums", f"|I0 + I90 - I45 - I135| / S0: 0 to {EXCESS_HIGH:.0%}", "magma",
          lambda r: f"median {r.sum_error:.1%}" + ("" if r.pair_ratio is None else f", ratio {r.pair_ratio:.3f}")),
)  # fmt: skip


SHOT_LAYERS: tuple[Layer, ...] = (
    Layer("s0", "Picture", "Mean of the view's pictures in sRGB; its 99th percentile is white.", None,
          lambda r: f"{r.exposures}; 99 % under {r.bright:.2f}"),
    Layer("saturation", "Saturation", "Red: one picture at full scale. Blue: marked invalid, or black.", None,
          lambda r: f"{r.saturated:.1%} + {r.invalid:.1%}"),
)  # fmt: skip
"""Kinds of pictures for captures whose angles are not the usual four."""


def layer_uris(view: InspectedView, layers: Sequence[Layer]) -> dict[str, str]:
    """Draw the pictures of a view for the page. Return them as data URIs by key."""
    photograph = view.intensities().mean(dim=0)
    rgb = figures.radiance_to_rgb(photograph / max(quantile(photograph, 0.99), 1e-6))
    pictures = {"s0": rgb, "saturation": _mark(rgb, view)}
    if layers is LAYERS:
        pictures |= _polarization_layers(view)
    return {layer.key: data_uri(pictures[layer.key], layer.key, SIDE) for layer in layers}


def _polarization_layers(view: InspectedView) -> dict[str, Picture]:
    """Draw the maps that need pictures at four angles."""
    gray = view.intensities().mean(dim=-1)
    stokes = optics.stokes(gray)
    s0 = stokes[0].clamp(min=1e-6)
    degree = optics.dolp(stokes)
    excess = (gray[0] + gray[2] - gray[1] - gray[3]).abs() / s0
    return {
        "dolp": figures.dolp_to_rgb(degree, DOLP_HIGH),
        "aolp": figures.aolp_to_rgb(optics.aolp(stokes), degree / AOLP_FULL_DOLP),
        "noise": figures.scalar_to_rgb(optics.intensity_noise(gray) / (s0 / 2), 0.0, NOISE_HIGH),
        "consistency": figures.scalar_to_rgb(excess, 0.0, EXCESS_HIGH, "magma"),
    }


def _mark(picture: Picture, view: InspectedView) -> Picture:
    """Draw the photograph in dark gray, with saturated and invalid pixels in color."""
    dim = (picture.mean(axis=-1, keepdims=True) * 0.6).astype(np.uint8).repeat(3, axis=-1)
    for mask, color in (
        (view.black | view.invalid, INVALID_COLOR),
        (view.saturated & ~view.black, SATURATED_COLOR),
    ):
        # Dilation keeps single pixels visible after downscaling.
        dim[(max_pool2d(mask[None].float(), 3, 1, 1)[0] > 0).numpy()] = color
    return dim


FILE = "inspection.html"


def inspection_html(inspection: Inspection, reporter: Reporter = SILENT) -> str:
    """Return the HTML page. All names and texts in it are escaped.

    Args:
        inspection: the findings.
        reporter: receiver of the progress.
    """
    capture = inspection.capture
    settings = inspection.settings
    layers = LAYERS if capture.four else SHOT_LAYERS
    marked = {name for check in inspection.checks for name in check.views}
    tiles = []
    with reporter.track("drawing", len(capture.views)) as advance:
        for view, measured in zip(capture.views, inspection.measurements, strict=True):
            uris = layer_uris(view, layers)
            pictures = [(layer, uris[layer.key], layer.caption(measured)) for layer in layers]
            tiles.append((measured.view, view.name in marked, pictures))
            advance(len(tiles))
    posed = f"{len(capture.posed)} with a pose" if capture.model is not None else "no poses"
    width, height = capture.size
    return page(
        "polarguide.inspection",
        "inspection.html",
        title=f"Inspection of {capture.name}",
        summary=f"{len(capture.views)} views of {width} x {height} pixels, {capture.bits} bits; {posed}",
        inspection=inspection,
        layers=layers,
        ramps={layer.ramp: figures.color_gradient(layer.ramp) for layer in layers if layer.ramp},
        wheel=data_uri(figures.angle_wheel(), "aolp", 2 * SIDE),
        tiles=tiles,
        figures=_figures(inspection.measurements),
        facts={
            "transfer": capture.transfer,
            "box filter": f"{capture.factor} x {capture.factor} pixels",
            "refractive index": f"{inspection.index:g}",
            "normals": f"{settings.normals}, {settings.steps} steps if trained",
            "SHA-256 of the pictures": capture.digest,
        },
    )


def _figures(measurements: Sequence[ViewMeasurements]) -> list[tuple[str, ...]]:
    """Return the header and the rows of the table of measurements. Single shots have fewer columns."""
    shots = any(r.exposures for r in measurements)
    columns: dict[str, Callable[[ViewMeasurements], str]] = {
        "view": lambda r: r.view,
        **({"pictures": lambda r: r.exposures or "0, 45, 90, 135"} if shots else {}),
        "99 % under": lambda r: f"{r.bright:.3f}",
        "saturated": lambda r: f"{r.saturated:.2%}",
        "invalid": lambda r: f"{r.invalid:.2%}",
        "dark": lambda r: f"{r.dark:.2%}",
        **({} if shots else _FOUR_COLUMNS),
    }
    return [tuple(columns), *(tuple(text(r) for text in columns.values()) for r in measurements)]


_FOUR_COLUMNS: dict[str, Callable[[ViewMeasurements], str]] = {
    "noise": lambda r: f"{r.noise_share:.2%}",
    "pair ratio": lambda r: "n/a" if r.pair_ratio is None else f"{r.pair_ratio:.4f}",
    "sum error": lambda r: f"{r.sum_error:.2%}",
    "DoLP median": lambda r: f"{r.dolp[0]:.3f}",
    "DoLP 99 %": lambda r: f"{r.dolp[1]:.3f}",
    "polarized": lambda r: f"{r.polarized:.1%}",
    "above diffuse limit": lambda r: f"{r.above_limit:.1%}",
}
"""Functions that format the columns of the table of measurements that need four angles, by column name."""


SCHEMA = 2
"""Version of the record. It increases if a key is removed or changes its meaning, but not for new keys."""
RECORD = "inspection.json"


def inspection_record(inspection: Inspection) -> dict[str, Any]:
    """Return the findings as plain JSON types. docs/reference/inspection.md describes the keys."""
    capture = inspection.capture
    return dict(
        json_value(
            {
                "schema": SCHEMA,
                "program": f"polarguide {__version__}",
                "scene": {
                    "name": capture.name,
                    "path": printable(str(capture.root.resolve())),
                    "views": len(capture.views),
                    "posed_views": len(capture.posed),
                    "size": list(capture.size),
                    "bits": capture.bits,
                    "digest": capture.digest,
                },
                "settings": {
                    "downscale": capture.factor,
                    "transfer": capture.transfer,
                    "refractive_index": inspection.index,
                    "normals": inspection.settings.normals,
                    "steps": inspection.settings.steps,
                },
                "verdict": inspection.verdict,
                "checks": [check.record() for check in inspection.checks],
                "angles": inspection.angles.record(),
                "views": [measured.record() for measured in inspection.measurements],
            }
        )
    )


def write_inspection(inspection: Inspection, out: Path, reporter: Reporter = SILENT) -> tuple[Path, Path]:
    """Write the page and ``inspection.json`` into a folder, and return their two paths.

    Raises:
        PolarguideError: a file cannot be written.
    """
    make_folder(out)
    write_whole(out / RECORD, to_json(inspection_record(inspection)))
    write_text(out / FILE, inspection_html(inspection, reporter))
    return out / FILE, out / RECORD


class PoseLimits:
    """Thresholds of the checks of poses, and of the decision to run the short training.

    Attributes:
        neighbors: number of views that each view is matched with.
        features: largest number of features of a view.
        ratio: largest ratio of the descriptor distance of a match to that of the second best match.
        accuracy_px: largest distance of a true match from its epipolar line, in pixels of the inspected picture.
        false_alarm: probability that a capture has a pair of views whose chance matches are judged.
        fewest_pairs: smallest number of pairs that judge a view. One pair does not tell which of its views is wrong.
        typical_px: median epipolar error in stored pixels above which a capture gets a warning.
        view_px: median epipolar error in stored pixels above which a single view may get a warning.
        stands_out: smallest ratio of a bad view's error to that of the median view.
        gap: angle in degrees to the nearest view above which a view is isolated.
        few_views: number of views below which a capture gets a warning.
        sure: probability of an order above which ``auto`` does not train.
        fewest_to_train: smallest number of views with a pose for a short training.
    """

    neighbors = 4
    features = 3000
    ratio = 0.75
    accuracy_px = 2.0
    false_alarm = 0.01
    fewest_pairs = 2
    typical_px = 2.0
    view_px = 2.0
    stands_out = 2.5
    gap = 25.0
    few_views = 20
    sure = 0.98
    fewest_to_train = 8


@dataclass(frozen=True)
class PairError:
    """Epipolar error of two views.

    Attributes:
        first, second: names of the views.
        matches: number of true matches.
        error: median distance of the true matches from their epipolar lines, in stored pixels.
    """

    first: str
    second: str
    matches: int
    error: float


def epipolar_errors(capture: Capture) -> list[PairError]:
    """Match each view that has a pose with the views that are nearest in position and viewing direction."""
    views = [(view.name, camera, *_features(view)) for view, camera in capture.cameras]
    pairs = _neighbor_pairs([camera for _, camera in capture.cameras])
    limit = math.log(PoseLimits.false_alarm / max(1, len(pairs)))
    errors = (_pair_error(views[i], views[j], capture.factor, limit) for i, j in pairs)
    return [error for error in errors if error is not None]


def view_errors(errors: Sequence[PairError]) -> dict[str, float]:
    """Return the error of each view, which is the lower quartile over its pairs.

    The lower quartile is not affected by a single bad neighbor. Views with fewer than ``fewest_pairs`` pairs are left
    out.
    """
    by_view: dict[str, list[float]] = {}
    for pair in errors:
        for name in (pair.first, pair.second):
            by_view.setdefault(name, []).append(pair.error)
    return {
        name: float(np.quantile(values, 0.25))
        for name, values in sorted(by_view.items())
        if len(values) >= PoseLimits.fewest_pairs
    }


def _features(view: InspectedView) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    gray = view.codes.numpy().astype(np.float64).mean(axis=(0, 3))
    top = max(float(np.percentile(gray, 99.5)), 1.0)
    encoded = (255 * np.clip(gray / top, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    sift = cv2.SIFT_create(nfeatures=PoseLimits.features, contrastThreshold=0.02)  # type: ignore[attr-defined]
    keypoints, descriptors = sift.detectAndCompute(encoded, None)
    # OpenCV has its first pixel center at 0, COLMAP at 0.5.
    places = np.array([point.pt for point in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    return places, None if descriptors is None else np.sqrt(
        descriptors / (descriptors.sum(1, keepdims=True) + 1e-9)
    )


def _neighbor_pairs(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    centers = np.stack([camera.center.numpy() for camera in cameras])
    axes = np.stack([camera.rotation[2].numpy() for camera in cameras])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    apart = apart / max(float(np.median(apart)), 1e-12) + 2 * (1 - axes @ axes.T)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1)[:, : min(PoseLimits.neighbors, len(cameras) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(near) for j in row})


_Features = tuple[str, Camera, NDArray[np.float64], NDArray[np.float32] | None]
"""Type of the features of a view: its name, its camera, their positions [N, 2], and their descriptors [N, 128]."""


def _pair_error(first: _Features, second: _Features, factor: int, limit: float) -> PairError | None:
    """Return the epipolar error of two views, or None if they have too few true matches.

    Matches are true if they agree on any epipolar geometry and if this agreement is no chance. The geometry of the
    poses does not matter, so that wrong poses do not hide themselves.

    Args:
        first, second: features of the views.
        factor: stored pixels per inspected pixel.
        limit: largest logarithm of the number of false alarms.
    """
    name1, camera1, x1, d1 = first
    name2, camera2, x2, d2 = second
    if d1 is None or d2 is None or min(len(d1), len(d2)) < 2:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    backward = {m.queryIdx: m.trainIdx for m in matcher.match(d2, d1)}
    matches = [
        m
        for m, n in matcher.knnMatch(d1, d2, k=2)
        if m.distance < PoseLimits.ratio * n.distance and backward.get(m.trainIdx) == m.queryIdx
    ]
    if len(matches) <= SAMPLE:
        return None
    places1 = x1[[m.queryIdx for m in matches]]
    places2 = x2[[m.trainIdx for m in matches]]
    accuracy = PoseLimits.accuracy_px
    _, inliers = cv2.findFundamentalMat(places1, places2, cv2.FM_RANSAC, accuracy, 0.9999, 5000)
    if inliers is None:
        return None
    true = inliers[:, 0] > 0
    share = 2 * accuracy * math.hypot(camera2.width, camera2.height) / (camera2.width * camera2.height)
    if log_false_alarms(len(matches), int(true.sum()), share) > limit:
        return None
    p1 = np.pad(places1[true], ((0, 0), (0, 1)), constant_values=1)
    p2 = np.pad(places2[true], ((0, 0), (0, 1)), constant_values=1)
    matrix = _fundamental(camera1, camera2)
    along2 = p1 @ matrix.T
    along1 = p2 @ matrix
    value = np.abs((p2 * along2).sum(axis=1))
    length = np.sqrt((along1[:, :2] ** 2).sum(1) + (along2[:, :2] ** 2).sum(1))
    if (length == 0).any():  # cameras at one place have no epipolar lines
        return None
    return PairError(name1, name2, int(true.sum()), float(np.median(np.sqrt(2) * value / length)) * factor)


def _fundamental(first: Camera, second: Camera) -> NDArray[np.float64]:
    """Return the fundamental matrix F of two views, with ``x2^T F x1 = 0`` (Hartley and Zisserman, Eq. 9.2)."""
    rotation = (second.rotation @ first.rotation.T).numpy()
    x, y, z = second.translation.numpy() - rotation @ first.translation.numpy()
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inner1, inner2 = (np.linalg.inv(camera.intrinsics.numpy()) for camera in (first, second))
    return np.asarray(inner2.T @ cross @ rotation @ inner1)


def pose_check(capture: Capture) -> Check:
    """Check that feature matches between views agree with the poses."""
    if capture.model is None:
        remedy = "Run polarguide prepare with --poses sfm or --poses PATH and a new --out."
        return Check("poses", "n/a", "There are no poses.", remedy)
    missing = tuple(view.name for view in capture.views if view.camera is None)
    errors = view_errors(epipolar_errors(capture))
    if len(errors) < 3:
        finding = "Too few features match between neighboring views to judge the poses."
        if missing:
            finding += f" {len(missing)} views have no pose."
        remedy = "Structure from motion needs static texture." if missing else ""
        figures: dict[str, Any] = {"views": {}, "without_pose": len(missing)}
        return Check("poses", "warning" if missing else "n/a", finding, remedy, missing, figures)
    typical = float(np.median(list(errors.values())))
    bad = tuple(
        name for name, e in errors.items() if e > max(PoseLimits.view_px, PoseLimits.stands_out * typical)
    )
    finding = f"Matches lie {typical:.2f} px from their epipolar lines (median view of {len(errors)})."
    unchecked = [view.name for view in capture.posed if view.name not in errors]
    if unchecked:
        finding += (
            f" Too few matches to check {len(unchecked)} of {len(capture.posed)} views: {listed(unchecked)}."
        )
    verdict: Verdict = "warning" if bad or missing else "ok"
    remedies = []
    if bad:
        finding += f" Much worse: {listed([f'{name} ({errors[name]:.1f} px)' for name in bad])}."
        remedies.append("Remove these views, or register them again.")
    if missing:
        finding += f" Without a pose: {len(missing)} views ({listed(list(missing))})."
        remedies.append("Remove the pictures of views without a pose, which train refuses, or register them.")
    if typical > PoseLimits.typical_px:
        verdict = "wrong" if typical > 2 * PoseLimits.typical_px else "warning"
        remedies.append("Refine the model (bundle adjustment), and check that it belongs to these pictures.")
    figures = {"median_px": typical, "views": errors, "without_pose": len(missing)}
    return Check("poses", verdict, finding, " ".join(remedies), (*bad, *missing), figures)


def coverage_check(capture: Capture) -> Check:
    """Check that neighboring views are close enough to each other."""
    cameras = [camera for _, camera in capture.cameras]
    if len(cameras) < 2:
        return Check("coverage", "n/a", "Fewer than two views have a pose.")
    focus = scene_frame(cameras).center
    directions = unit_array(torch.stack([camera.center - focus for camera in cameras]).numpy())
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1))) + 360 * np.eye(len(directions))
    nearest = angles.min(axis=1)
    spread = float(
        np.degrees(np.arccos(np.clip(directions @ unit_array(directions.mean(axis=0)), -1, 1))).max()
    )
    figures = {"views": len(directions), "median_step_deg": float(np.median(nearest)),
               "largest_step_deg": float(nearest.max()), "half_angle_deg": spread}  # fmt: skip
    finding = (
        f"{len(directions)} views, {np.median(nearest):.0f}° from the nearest view "
        f"(median; at most {nearest.max():.0f}°), "
        f"within {spread:.0f}° of their mean direction."
    )
    isolated = tuple(v.name for v, gap in zip(capture.posed, nearest, strict=True) if gap > PoseLimits.gap)
    outcome = first_outcome(
        (not isolated and len(directions) >= PoseLimits.few_views, "ok", finding, ""),
        (
            True,
            "warning",
            finding,
            "Reconstruction is unreliable across gaps: add views at most 15 degrees apart.",
        ),
    )
    return Check("coverage", *outcome, isolated, figures)


@dataclass(frozen=True, eq=False)
class Inspection:
    """Result of an inspection.

    Attributes:
        capture: the capture.
        settings: settings of the inspection.
        index: refractive index that was used.
        measurements: measurements of each view.
        checks: checks in the order of the page.
        angles: findings on the polarizer angles. For pictures at unusual angles, they are estimates for each picture.
    """

    capture: Capture
    settings: InspectSettings
    index: float
    measurements: tuple[ViewMeasurements, ...]
    checks: tuple[Check, ...]
    angles: AngleFindings | ShotFindings

    @property
    def verdict(self) -> Verdict:
        """Worst verdict of all checks."""
        return worst(self.checks)

    def check(self, key: str) -> Check:
        """Return the check with the given key."""
        return next(check for check in self.checks if check.key == key)


def inspection_folder(scene: Path, out: Path | None = None) -> Path:
    """Return the folder of an inspection: ``out`` if it is given, else SCENE-inspection next to the scene.

    Raises:
        PolarguideError: a file has this name, or the folder is inside a scene.
    """
    beside = scene.resolve().with_name(scene.resolve().name + "-inspection")
    folder = beside if out is None else out
    check_out(folder)
    refuse_scene(folder)
    require_inside(beside.parent if out is None else folder, folder)
    return folder


def inspect_scene(
    path: Path, settings: InspectSettings, backend: Backend, reporter: Reporter = SILENT
) -> Inspection:
    """Inspect a scene folder.

    Args:
        path: the scene. It may have no poses.
        settings: settings of the inspection.
        backend: device and rasterizer of the short training.
        reporter: receiver of the progress.

    Raises:
        PolarguideError: the scene cannot be read, or a setting is out of range.
    """
    check_options(settings)
    capture = read_capture(path, downscale=settings.downscale, transfer=settings.transfer, reporter=reporter)
    index = index_of(settings.refractive_index, capture.refractive_index)
    measurements: list[ViewMeasurements] = []
    with reporter.track("measuring", len(capture.views)) as advance:
        for view in capture.views:
            measurements.append(measure_view(view, index))
            advance(len(measurements))
    if not capture.four:
        checks, shots = _shots(capture, measurements, settings, index, backend, reporter)
        return Inspection(capture, settings, index, tuple(measurements), tuple(checks), shots)
    pairing = find_pairing(capture)
    checks = picture_checks(capture, measurements, pairing)
    calibrated = analyzer_check(capture)
    checks += [] if calibrated is None else [calibrated]
    checks.append(view_exposure_check(capture))
    with reporter.track("matching features", 1):
        checks += [pose_check(capture), lens_check(capture), coverage_check(capture), held_out_check(capture)]
    angles, pixels = _angles(capture, settings, index, pairing or 0, backend, reporter)
    angles = with_noise(angles, measurements)
    checks += [*angle_checks(angles), dielectric_check([r.above_limit for r in measurements], pixels, index)]
    return Inspection(capture, settings, index, tuple(measurements), tuple(checks), angles)


def _shots(
    capture: Capture,
    measurements: Sequence[ViewMeasurements],
    settings: InspectSettings,
    index: float,
    backend: Backend,
    reporter: Reporter,
) -> tuple[list[Check], ShotFindings]:
    """Return the checks of a capture with pictures at unusual angles, and the findings on their polarizers."""
    checks = [pictures_check(capture), *agreement_checks(capture), *light_checks(capture, measurements)]
    with reporter.track("matching features", 1):
        checks += [pose_check(capture), lens_check(capture), coverage_check(capture), held_out_check(capture)]
    needed = "The angles are checked by a short training, which"
    if len(capture.posed) < PoseLimits.fewest_to_train:
        findings = ShotFindings(why=f"{needed} needs {PoseLimits.fewest_to_train} views with a pose.")
    elif settings.normals == "points":
        findings = ShotFindings(why=f"{needed} --normals points disables.")
    else:
        scene = _training_scene(capture, settings, reporter, held_out=())
        with reporter.track("short training", settings.steps) as advance:
            findings = estimate_shot_angles(
                scene,
                steps=settings.steps,
                refractive_index=index,
                backend=backend,
                on_step=lambda report: advance(min(report.step + 1, settings.steps)),
            )
    strong = strong_polarization(capture, index)
    last = [dielectric_check(strong, None, index)] if strong else []
    return [*checks, *shot_checks(findings), *last], findings


def _angles(
    capture: Capture,
    settings: InspectSettings,
    index: float,
    pairing: int,
    backend: Backend,
    reporter: Reporter,
) -> tuple[AngleFindings, SurfaceSamples | None]:
    """Determine order, direction and zero of the angles from the available geometry.

    Returns:
        The findings; and the pixels with normals, or None if there are no normals.
    """
    sources: list[OrderEvidence] = []
    pixels = None
    trains = settings.normals != "points" and len(capture.posed) >= PoseLimits.fewest_to_train
    if capture.model is not None and len(capture.posed) >= 2:
        with reporter.track("evaluating points", 1):
            evidence, pixels = point_evidence(capture.posed, capture.model, index, pairing)
        sources.append(evidence)
        if settings.normals == "auto" and evidence.usable:
            trains = trains and max(posterior(evidence).probabilities) < PoseLimits.sure
        if trains:
            pixels = _trained_pixels(capture, settings, pairing, index, backend, reporter)
            sources.append(normal_evidence(pixels, index))
    return combine_evidence(sources, pairing, capture.applied, mosaic=capture.origin == "mosaics"), pixels


def _trained_pixels(
    capture: Capture,
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
            steps=settings.steps,
            backend=backend,
            on_step=lambda report: advance(report.step + 1),
            refractive_index=index,
        )
    with reporter.track("comparing with normals", len(capture.posed)) as advance:

        def surfaces() -> Iterator[tuple[InspectedView, ViewSurface]]:
            for done, view in enumerate(capture.posed):
                yield view, trained_surface(state, scene.view(view.name), backend)
                advance(done + 1)

        return sample_surfaces(surfaces(), pairing)


def _training_scene(
    capture: Capture, settings: InspectSettings, reporter: Reporter, held_out: Sequence[str] | None = None
) -> Scene:
    """Load the views that have a pose, at the size of a short training.

    Args:
        capture: the capture.
        settings: settings of the inspection.
        reporter: receiver of the progress.
        held_out: names of held-out views. If None, the default of a training is used.
    """
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
    require(
        scene.train_views,
        capture.root,
        expected="views to train on",
        found="none",
        remedy="Use --normals points.",
    )
    return scene
