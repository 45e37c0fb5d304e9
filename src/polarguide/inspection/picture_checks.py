"""Checks of pictures, without poses, and comparisons of views with each other at the points of the model.

The pictures alone show the consistency of the angles, the encoding, the exposure, saturation and noise. Points show
exposures and focal lengths.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import least_squares
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide import optics
from polarguide.capture import checks
from polarguide.capture.angle_evidence import PAIRINGS, TO_DEVIATION, AngleLimits, decide_pairing, swaps
from polarguide.capture.checks import MeasuredGains, measured_gains, pair_moments
from polarguide.capture.colmap.model import ColmapModel
from polarguide.capture.point_exposures import significant
from polarguide.capture.view import ANGLES, FULL_CODE, listed
from polarguide.core.files import read_file
from polarguide.core.records import decode
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.coverage import Coverage, DepthMap
from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import POLARIZED, Capture, ViewMeasurements
from polarguide.inspection.evidence import EvidenceLimits, SurfaceSamples
from polarguide.inspection.settings import LCD_TEST, Check, Verdict, first_outcome


class PictureLimits:
    """Thresholds of the checks of pictures.

    The "pair ratio" of a view is the median of (I0 + I90) / (I45 + I135).

    Attributes:
        pair_error: median |I0 + I90 - I45 - I135| / S0 of a view above which its four pictures are inconsistent.
        unequal: deviation of the pair ratio from 1 that causes a warning. Real sensors have about 0.02.
        very_unequal: deviation of the pair ratio from 1 for the verdict "wrong". A picture with 5 % more exposure gives
            0.025.
        exposed_unequal: largest difference of the logarithms of the gains of two angles without a warning. Angles set
            to two degrees give 0.07, real sensors 0.04.
        exposed_very_unequal: difference of the logarithms of the gains for the verdict "wrong". A third of a stop gives
            0.23.
        unsteady: largest deviation of a view's pair ratio from that of the capture.
        saturated: share of saturated pixels above which a view gets a warning.
        blown: share of saturated pixels above which a capture is wrong.
        little: share of polarized pixels below which a capture gets a warning.
        almost_none: share of polarized pixels below which a capture is wrong.
        noisy: largest noise of one intensity, as a share of S0 / 2. Three times the noise of the DoLP is then 0.13.
        underexposed: 99th percentile of the values below which a view is underexposed.
        bent: curvature of the response for the verdict "wrong" if it is significant. A gamma of 0.8 has -0.125, a gamma
            of 0.73 has -0.18; DoLP has a similar error. Smooth areas of a real sensor's pictures have -0.17.
        sure_bend: number of standard errors from which a curvature is significant. See ``AngleLimits.sure``.
        not_dielectric: share of pixels above which the check warns. It refers to pixels with normals if there are any,
            else to all pixels.
        darkest: percentile of the brightness at which the dynamic range starts. Darker pixels are noise.
    """

    pair_error = 0.05
    unequal = 0.01
    very_unequal = 0.04
    exposed_unequal = 0.08
    exposed_very_unequal = 0.17
    unsteady = 0.01
    saturated = 0.05
    blown = 0.3
    little = 0.05
    almost_none = 0.005
    noisy = 0.03
    underexposed = 0.01
    bent = 0.18
    sure_bend = 4.0
    not_dielectric = 0.15
    darkest = 1.0


def find_pairing(capture: Capture) -> int | None:
    """Find out which of the four pictures belong to perpendicular angles, by comparing sums of two pictures.

    Return an index into ``PAIRINGS``, or None if the sums do not decide.
    """
    residuals = np.array(
        [checks.measure(view.codes.numpy(), view.usable.numpy()).residuals for view in capture.views]
    )
    gains = measured_exposures(capture) if residuals.any() else None
    limit = PictureLimits.exposed_unequal / AngleLimits.sure
    if gains is not None and gains.pairing is not None and max(gains.errors) < limit:
        return gains.pairing  # also valid for unequal exposures
    return decide_pairing(residuals)


def measured_exposures(capture: Capture) -> MeasuredGains | None:
    """Estimate the relative exposures of the four angles, by comparing I0 + I90 with I45 + I135 in all views.

    Return None if the pictures are too dark.
    """
    moments = [
        pair_moments(view.intensities().mean(dim=-1).numpy(), view.usable.numpy()) for view in capture.views
    ]
    return measured_gains(np.concatenate(moments))


def picture_checks(
    capture: Capture, measurements: Sequence[ViewMeasurements], pairing: int | None
) -> list[Check]:
    """Return all checks of pictures at four angles, in their order on the page."""
    if capture.origin == "stokes":
        computed = "The four pictures were computed from Stokes vectors: their sums agree by construction."
        return [
            *(Check(key, "n/a", computed) for key in ("pair_sums", "encoding", "exposure")),
            _saturation(capture, measurements),
            Check("noise", "n/a", computed),
            _polarization(measurements),
        ]
    encoding = _encoding(capture, pairing)
    # A nonlinear response looks like different exposures.
    exposed = measured_exposures(capture) if encoding.verdict == "ok" else None
    return [
        _pairs(measurements, pairing),
        encoding,
        _exposure(measurements, pairing, exposed),
        _saturation(capture, measurements),
        _noise(measurements),
        _polarization(measurements),
    ]


def light_checks(capture: Capture, measurements: Sequence[ViewMeasurements]) -> list[Check]:
    """Return the checks for pictures at any angles, which are those of saturation and brightness."""
    return [_saturation(capture, measurements), _brightness(measurements)]


def _majority(views: Sequence[str], measurements: Sequence[ViewMeasurements]) -> Verdict:
    """Return "wrong" if a problem affects more than half of the views, else "warning"."""
    return "wrong" if 2 * len(views) > len(measurements) else "warning"


def _pairs(measurements: Sequence[ViewMeasurements], pairing: int | None) -> Check:
    error = float(np.median([r.sum_error for r in measurements]))
    off = () if pairing else tuple(r.view for r in measurements if r.sum_error > PictureLimits.pair_error)
    outcome = first_outcome(
        (
            pairing,
            "wrong",
            f"The pair sums agree only if {swaps(PAIRINGS[pairing or 0])}.",
            "Rename the files, or repeat prepare with --order and a new --out.",
        ),
        (not off, "ok", f"I0 + I90 and I45 + I135 differ by {error:.1%} of S0 (median).", ""),
        (
            off,
            _majority(off, measurements),
            f"I0 + I90 and I45 + I135 differ by more than {PictureLimits.pair_error:.0%} of S0 in {len(off)} views "
            f"({listed(list(off))}).",
            "Check for motion or light changes between the shots, and for exchanged files.",
        ),
    )
    return Check(
        "pair_sums",
        *outcome,
        off,
        {"median_error": error, "pairing": None if pairing is None else list(PAIRINGS[pairing])},
    )


def _encoding(capture: Capture, pairing: int | None) -> Check:
    slopes = [
        checks.pair_slopes(view.codes.numpy(), view.usable.numpy(), checks.FOUR_PAIRS)
        for view in capture.views
    ]
    curvature = checks.curvature_of(list(itertools.chain.from_iterable(slopes)))
    if curvature is None or pairing not in (None, 0):
        reason = "too few pixels are polarized" if curvature is None else "the pictures are paired wrongly"
        return Check("encoding", "n/a", f"The curvature of the response cannot be measured: {reason}.")
    bend = abs(curvature.value)
    sure = bend > PictureLimits.sure_bend * curvature.error
    doubtful, certain = np.abs(checks.ENCODED if curvature.value < 0 else checks.DECODED)
    finding = (
        f"The curvature of the response is {curvature.value:+.2f}; linear files have 0, sRGB about -0.6."
    )
    verdict: Verdict = "wrong" if bend > certain or (sure and bend > PictureLimits.bent) else "warning"
    outcome = first_outcome(
        (bend <= doubtful and not (sure and bend > checks.BENT), "ok", finding, ""),
        (
            curvature.value < 0,
            verdict,
            finding,
            "The files seem display-encoded (gamma). Export linear files, or read them with --transfer srgb. Prepare "
            f"mosaics of a camera with gamma with --gamma (here about {1 / (1 + 2 * bend):.2f}).",
        ),
        (
            True,
            verdict,
            finding,
            "The files seem linear but are decoded, or have another tone curve: try --transfer linear.",
        ),
    )
    return Check(
        "encoding", *outcome, figures={"curvature": curvature.value, "curvature_error": curvature.error}
    )


def _exposure(
    measurements: Sequence[ViewMeasurements], pairing: int | None, exposed: MeasuredGains | None
) -> Check:
    known = {r.view: r.pair_ratio for r in measurements if r.pair_ratio is not None}
    if not known or pairing not in (None, 0):
        return Check("exposure", "n/a", "The pair sums cannot be compared.")
    ratio = float(np.median(list(known.values())))
    off = tuple(view for view, own in known.items() if abs(own - ratio) > PictureLimits.unsteady)
    figures: dict[str, Any] = {"pair_ratio": ratio, "unsteady_views": len(off)}
    finding = f"(I0 + I90) / (I45 + I135) is {ratio:.3f} (median); ideal analyzers have 1."
    verdict: Verdict = "ok"
    remedy = ""
    if abs(ratio - 1) > PictureLimits.unequal:
        verdict = "wrong" if abs(ratio - 1) > PictureLimits.very_unequal else "warning"
        finding += f" If only one picture deviates, its deviation is {2 * abs(ratio - 1):.0%}."
        remedy = (
            "Let prepare estimate the gains (the default), or measure them in unpolarized light and use --calibration. "
            "The pair sums do not show which of the four deviates."
        )
    spread = 0.0 if exposed is None else float(np.ptp(exposed.logs))
    error = 0.0 if exposed is None else AngleLimits.sure * max(exposed.errors)
    if exposed is not None and spread > max(PictureLimits.exposed_unequal, error):
        gains = np.exp(exposed.logs).tolist()
        figures["exposures"] = gains
        wrong = verdict == "wrong" or spread > max(PictureLimits.exposed_very_unequal, error)
        verdict = "wrong" if wrong else "warning"
        each = ", ".join(f"{angle}°: {gain:.2f}" for angle, gain in zip(ANGLES, gains, strict=True))
        finding += f" The sums of all pixels agree if the exposures of the angles are {each}."
        remedy = (
            "Prepare the original files, whose EXIF states the exposure, with --gains auto; or specify gains with "
            "--calibration. An angle error of several degrees looks the same."
        )
    if off:
        verdict = "warning" if verdict == "ok" else verdict
        finding += f" It differs by more than {PictureLimits.unsteady:.0%} in {len(off)} views ({listed(list(off))})."
        remedy = remedy or "Look for automatic exposure, flicker, or motion between the shots."
    return Check("exposure", verdict, finding, remedy, off, figures)


def _saturation(capture: Capture, measurements: Sequence[ViewMeasurements]) -> Check:
    shares = [r.saturated for r in measurements]
    unusable = {r.view: r.saturated + r.invalid for r in measurements}
    invalid = float(np.mean([r.invalid for r in measurements]))
    dark = float(np.mean([r.dark for r in measurements]))
    largest = max(view.peak for view in capture.views)
    unscaled = capture.bits == 16 and 0 < largest < (FULL_CODE + 1) // 16
    off = tuple(view for view, share in unusable.items() if share > PictureLimits.saturated and not unscaled)
    finding = (
        f"{np.mean(shares):.1%} of the pixels are at full scale, at most {max(shares):.1%} in a view; "
        f"{invalid:.1%} are marked invalid, {dark:.1%} are too dark to be used."
    )
    finding += _range_text(capture, largest)
    outcome = first_outcome(
        (
            unscaled,
            "wrong",
            f"No value of the 16-bit files exceeds {largest}.",
            "The data are not scaled to 16 bits. Multiply the values, or run prepare with --bits.",
        ),
        (not off, "ok", finding, ""),
        (
            off,
            "wrong" if np.mean(list(unusable.values())) > PictureLimits.blown else "warning",
            f"{finding} Over {PictureLimits.saturated:.0%} are unusable in {len(off)} views ({listed(list(off))}).",
            "These pixels have no polarization and are excluded. Invalid pixels may have clipped in the camera: "
            "decrease the exposure, and keep lamps out of the picture.",
        ),
    )
    return Check(
        "saturation",
        *outcome,
        off,
        {"saturated": float(np.mean(shares)), "worst": max(shares), "invalid": invalid, "dark": dark},
    )


def _range_text(capture: Capture, largest: int) -> str:
    """Return a sentence on the dynamic range of merged exposures, or an empty text if no value exceeds full scale."""
    if largest <= FULL_CODE:
        return ""
    bright = np.concatenate(
        [view.intensities().mean(dim=(0, 3))[view.usable].numpy().ravel() for view in capture.views]
    )
    dark, high = np.percentile(bright, (PictureLimits.darkest, 100.0))
    stops = math.log2(max(high, 1e-12) / max(dark, 1e-12))
    return (
        f" Usable pixels cover {stops:.1f} stops between their 1st percentile and the brightest one. The largest value "
        f"is {largest / FULL_CODE:.1f} times full scale; pixels that clip in every exposure are marked invalid."
    )


def _noise(measurements: Sequence[ViewMeasurements]) -> Check:
    share = float(np.median([r.noise_share for r in measurements]))
    bright = float(np.median([r.bright for r in measurements]))
    off = tuple(
        r.view
        for r in measurements
        if r.noise_share > PictureLimits.noisy or r.bright < PictureLimits.underexposed
    )
    finding = (
        f"The noise of one intensity is {share:.2%} of the photograph (median, after averaging). A DoLP of "
        f"{3 * 2**0.5 * share / 2:.3f} is three times its noise. "
        f"The 99th percentile of the values is {bright:.0%} of full scale."
    )
    outcome = first_outcome(
        (not off, "ok", finding, ""),
        (
            off,
            _majority(off, measurements) if bright < PictureLimits.underexposed else "warning",
            f"{finding} Dark or noisy: {len(off)} views ({listed(list(off))}).",
            "Use a longer exposure at the lowest gain, or average several shots.",
        ),
    )
    return Check("noise", *outcome, off, {"noise_share": share, "bright": bright})


def with_noise(angles: AngleFindings, measurements: Sequence[ViewMeasurements]) -> AngleFindings:
    """Increase the uncertainty of the zero by the noise if the check of noise warns, and return the findings.

    In these captures, steps of a tone curve or compression cause noise that is not independent between pixels. The
    error of the AoLP of one strongly polarized pixel is then also the error of the zero.
    """
    share = float(np.median([r.noise_share for r in measurements]))
    degree = float(np.median([r.dolp[1] for r in measurements]))
    if angles.posterior is None or degree <= 0 or _noise(measurements).verdict == "ok":
        return angles
    systematic = math.degrees(share / math.sqrt(2) / (2 * degree))
    error = math.hypot(angles.posterior.offset_error, systematic)
    return replace(angles, posterior=replace(angles.posterior, offset_error=error))


def _brightness(measurements: Sequence[ViewMeasurements]) -> Check:
    bright = float(np.median([r.bright for r in measurements]))
    off = tuple(r.view for r in measurements if r.bright < PictureLimits.underexposed)
    finding = f"The 99th percentile of the values is {bright:.0%} of full scale (median view)."
    dark = f"{finding} Dark: {len(off)} views ({listed(list(off))})."
    outcome = first_outcome(
        (not off, "ok", finding, ""),
        (off, _majority(off, measurements), dark, "Use a longer exposure."),
    )
    return Check("brightness", *outcome, off, {"bright": bright})


def _polarization(measurements: Sequence[ViewMeasurements]) -> Check:
    share = float(np.median([r.polarized for r in measurements]))
    median, strongest = np.median([r.dolp for r in measurements], axis=0).tolist()
    noise = 3 * math.sqrt(2) / 2 * float(np.median([r.noise_share for r in measurements]))
    finding = (
        f"{share:.0%} of the pixels have a DoLP above {POLARIZED:g} and above three times its noise; "
        f"the median DoLP is {median:.3f}."
    )
    outcome = first_outcome(
        (share >= PictureLimits.little, "ok", finding, ""),
        (
            (strongest < POLARIZED or share < PictureLimits.almost_none) and noise < POLARIZED,
            "wrong",
            "No modulation: was the filter reversed, or missing? The four pictures differ only by noise. In the median "
            f"view, 99 % of the pixels have a DoLP below {strongest:.3f}, and {share:.1%} have one above three times "
            "its noise.",
            LCD_TEST,
        ),
        (
            True,
            "wrong" if share < PictureLimits.almost_none else "warning",
            finding,
            "The polarization is weak. Photograph surfaces obliquely (50 to 65 degrees), from lower views. Check that "
            "the filter is a linear polarizer with the right side in front, and that the exposure was fixed.",
        ),
    )
    return Check(
        "low_dolp", *outcome, figures={"polarized": share, "median_dolp": median, "p99_dolp": strongest}
    )


class _SceneNotes(msgspec.Struct):
    """Fields of ``scene.json`` that the inspection reports."""

    analyzers: dict[str, str] | None = None


def analyzer_check(capture: Capture) -> Check | None:
    """Report the calibration of the sensor that ``prepare`` applied. Return None if there is no calibration."""
    path = capture.root / "scene.json"
    data = read_file(path) if path.exists() else b"{}"
    analyzers = decode(data, _SceneNotes, path, remedy="Prepare the scene again.").analyzers
    if analyzers is None:
        return None
    lens = f" and {analyzers['lens']}" if analyzers.get("lens") else ""
    name = f"the calibration of {analyzers.get('sensor', '')}{lens} ({analyzers.get('sha256', '')[:16]})"
    return Check("analyzers", "ok", f"Prepared with {name}.", figures=analyzers)


def dielectric_check(shares: Sequence[float], pixels: SurfaceSamples | None, index: float) -> Check:
    """Check that large areas are not polarized more strongly than a dielectric under unpolarized light can be.

    Args:
        shares: share of pixels of each view whose DoLP exceeds the limit of diffuse light.
        pixels: pixels with normals, or None.
        index: refractive index.
    """
    share = float(torch.tensor(shares).median())
    limit = float(optics.diffuse_dolp_limit(index))
    finding = f"{share:.0%} of the pixels (median view) have a DoLP above the diffuse limit ({limit:.2f}). "
    figures = {"above_diffuse_limit": share}
    if pixels is None or len(pixels.aolp) == 0:
        finding += "Without normals, reflections of a smooth dielectric look like metal or sky."
    else:
        share = float(exceeds_dielectric(pixels, index).float().mean())
        figures["unexplained"] = share
        finding += f"{share:.0%} of pixels with a normal have a DoLP above the maximum of both lobes at their zenith."
    outcome = first_outcome(
        (share <= PictureLimits.not_dielectric, "ok", finding, ""),
        (
            True,
            "warning",
            finding,
            "Bare metal, sky or its reflection, or a screen? The model assumes dielectrics under unpolarized light. "
            "Exclude such areas with masks, or expect worse normals there.",
        ),
    )
    return Check("dielectric", *outcome, figures=figures)


def exceeds_dielectric(pixels: SurfaceSamples, index: float) -> torch.Tensor:
    """Return a mask [N] of pixels whose DoLP is too large for diffuse and specular light of a dielectric.

    The comparison covers every zenith within the margin of error.
    """
    steps = EvidenceLimits.zenith_margin * torch.linspace(-1, 1, 7)
    zenith = (pixels.zenith[:, None] + steps).clamp(0, math.pi / 2)
    most = torch.maximum(optics.specular_dolp(zenith, index), optics.diffuse_dolp(zenith, index)).amax(dim=1)
    return pixels.dolp > most + 3 * pixels.noise


class ViewLimits:
    """Thresholds of the checks that compare views.

    Attributes:
        fewest: smallest number of points for the estimate of a focal length.
        focal_differs: difference of the logarithm of a focal length that causes a warning. A difference of 1 % turns a
            ray at 30 degrees by 0.25 degrees.
        focal_wrong: difference of the logarithm of a focal length for the verdict "wrong".
        step: step of camera exposures in stops. If the error of an exposure is larger, equal exposures are not
            confirmed.
        unseen: largest share of a held-out view that no training view shows. Views with a larger share are named.
        cells: number of cells across a picture in which content is compared.
        most: approximate number of points from which the depths of these cells are computed.
    """

    fewest = 50
    focal_differs = 0.01
    focal_wrong = 0.05
    step = 1 / 3
    unseen = 0.1
    cells = 64
    most = 2000


def view_exposure_check(capture: Capture) -> Check:
    """Check that all views have equal exposure and white balance."""
    exposures = capture.exposures
    if exposures is None or not np.isfinite(exposures.logs).any():
        return Check("view_exposure", "n/a", "The model stores no points that views share.")
    logs = exposures.significant / math.log(2)
    known = np.isfinite(logs).all(axis=1)
    size = np.where(known, np.abs(logs).max(axis=1), 0.0)
    strongest = [int(k) for k in np.argsort(-size) if size[k] > 0]
    names = [view.name for view in capture.views]
    errors = [float(np.median(e[known])) / math.log(2) for e in (exposures.errors, exposures.color_errors)]
    figures = {
        "stops": {names[k]: [float(value) for value in logs[k]] for k in np.flatnonzero(known)},
        "error_stops": errors[0],
        "color_error_stops": errors[1],
        "unknown": int((~known).sum()),
    }
    precision = f"to {errors[0]:.2f} stops, colors to {errors[1]:.2f}"
    changes = [f"{names[k]} {logs[k][np.abs(logs[k]).argmax()]:+.2f}" for k in strongest]
    remedy = "Training and evaluation divide each color of these views by its gain."
    if capture.keeps_gains:
        remedy = "Prepare without --gains none, so that training divides each color of a view by its gain."
    outcome = first_outcome(
        (
            strongest,
            "warning",
            f"By shared points, exposure or white balance of {len(strongest)} of {len(names)} views differs from the "
            f"mean ({precision}). Stops: {listed(changes)}.",
            f"{remedy} Use fixed exposure and white balance for new captures.",
        ),
        (
            errors[0] > ViewLimits.step,
            "not verified",
            f"The views share too few points to compare their exposures ({precision}).",
            "Add views between the existing ones.",
        ),
        (True, "ok", f"Shared points are equally bright in all views ({precision}).", ""),
    )
    return Check("view_exposure", *outcome, tuple(names[k] for k in strongest), figures)


def held_out_check(capture: Capture) -> Check:
    """Check that training views show the content of the held-out views.

    The points of the model give the depth of each cell of a picture. Cells outside the convex hull of the points show
    background.
    """
    cameras = {view.name: camera for view, camera in capture.cameras}
    tests = [name for name in capture.test_names if name in cameras]
    if capture.model is None or not tests:
        return Check("held_out", "n/a", "No held-out view has a pose.")
    points = capture.model.points.double()
    points = points[:: max(1, len(points) // ViewLimits.most)]
    maps = {name: _point_depths(camera, points) for name, camera in cameras.items()}
    coverage = Coverage({name: maps[name] for name in tests})
    for name in maps.keys() - set(tests):
        coverage.add(maps[name])
    shares = {name: 1 - float(seen.double().mean()) for name, seen in coverage.seen.items()}
    named = sorted(
        (name for name in tests if shares[name] > ViewLimits.unseen), key=lambda name: -shares[name]
    )
    mean = sum(shares.values()) / len(shares)
    finding = f"Training views show {1 - mean:.0%} of the content of {len(tests)} held-out views."
    outcome = first_outcome(
        (not named, "ok", finding, ""),
        (
            True,
            "warning",
            f"{finding} Shares that none of them shows: {listed([f'{name} {shares[name]:.0%}' for name in named])}.",
            "Compare the scores of seen pixels, because other pixels can only be guessed. For new captures, add a low "
            "ring of views that shows the surroundings.",
        ),
    )
    return Check("held_out", *outcome, tuple(named), {"unseen": shares})


def _point_depths(camera: Camera, points: Tensor) -> DepthMap:
    """Return the depth of each cell of a picture, interpolated between the points [M, 3] that are visible in it."""
    cells = camera.downscaled(max(1, camera.width // ViewLimits.cells))
    _, depth, inside = seen_at(points - cells.center, cells)
    map_of_background = DepthMap(
        cells, torch.full((cells.height, cells.width), torch.inf, dtype=torch.float64)
    )
    local = cells.to_camera(points[inside] - cells.center).numpy()
    if len(local) < 3:
        return map_of_background
    places = local[:, :2] / local[:, 2:] * (cells.fx, cells.fy) + (cells.cx, cells.cy)
    rows, columns = np.mgrid[: cells.height, : cells.width] + 0.5
    try:
        inverse = LinearNDInterpolator(places, 1 / depth[inside].numpy(), fill_value=0.0)(columns, rows)
    except QhullError:  # all points on a line
        return map_of_background
    return DepthMap(cells, torch.from_numpy(inverse).reciprocal())


def lens_check(capture: Capture) -> Check:
    """Check that the focal length of each view agrees with the focal length that the view alone would have."""
    if capture.model is None:
        return Check("focal_lengths", "n/a", "There are no poses.")
    fits = {
        view.name: fit
        for view in capture.posed
        if (fit := _focal_length_alone(capture.model, view.name)) is not None
    }
    if len(fits) < 3:
        finding = f"Fewer than 3 views have {ViewLimits.fewest} points with positions in the pictures."
        return Check("focal_lengths", "n/a", finding)
    names = list(fits)
    logs, errors = np.array(list(fits.values())).T
    off = significant(np.abs(logs), errors) & (np.abs(logs) > ViewLimits.focal_differs)
    usual = float(np.sqrt(np.mean(logs**2)))
    order = [int(k) for k in np.argsort(-np.abs(logs)) if off[k]]
    changes = listed([f"{names[k]} {math.expm1(logs[k]):+.1%}" for k in order])
    finding = f"A fit of each view to fixed points changes its focal length by {usual:.1%} (rms)."
    outcome = first_outcome(
        (not order, "ok", finding, ""),
        (
            order,
            "wrong" if np.abs(logs[off]).max(initial=0) > ViewLimits.focal_wrong else "warning",
            f"{finding} It contradicts the model in {len(order)} views ({changes}).",
            "Poses are wrong if several cameras share one model: a phone that changed its lens, a zoom, or a crop. "
            "Prepare the original files, whose EXIF distinguishes them, or use a model with a camera for each.",
        ),
    )
    return Check(
        "focal_lengths",
        *outcome,
        tuple(names[k] for k in order),
        {"rms": usual, "views": dict(zip(names, (np.exp(logs) - 1).tolist(), strict=True))},
    )


def _focal_length_alone(model: ColmapModel, view: str) -> tuple[float, float] | None:
    """Estimate the focal length from one view alone, with fixed points, and compare it with the model.

    Pose and focal length minimize the distances in the picture. The error assumes independent distances.

    Returns:
        Logarithm of the ratio of the estimated focal length to the model's; and its standard error. None if there are
        too few points.
    """
    pixels, places = model.correspondences(view)
    if len(pixels) < ViewLimits.fewest:
        return None
    camera = model.camera(view)
    local = places @ camera.rotation.numpy().T + camera.translation.numpy()
    if not (local[:, 2] > 0).all():
        return None
    middle = local.mean(axis=0)
    depth = float(np.median(local[:, 2]))
    focal = np.array([camera.fx, camera.fy])
    center = np.array([camera.cx, camera.cy])

    def distances(change: NDArray[np.float64]) -> NDArray[Any]:
        rotated = (local - middle) @ Rotation.from_rotvec(change[:3]).as_matrix().T
        moved = rotated + middle + depth * change[3:6]
        projected = moved[:, :2] / moved[:, 2:] * np.exp(change[6]) * focal + center
        return np.asarray((projected - pixels).ravel())

    fitted = least_squares(distances, np.zeros(7), loss="soft_l1")
    deviation = TO_DEVIATION * float(np.median(np.abs(fitted.fun)))
    normal = fitted.jac.T @ fitted.jac
    if np.linalg.cond(normal) > 1e12:
        return None
    return float(fitted.x[6]), deviation * math.sqrt(float(np.linalg.inv(normal)[6, 6]))
