"""Checks that need only the pictures: pair sums, encoding, exposure, saturation, noise, polarization."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from polarguide import optics
from polarguide.capture import checks
from polarguide.capture.angle_evidence import PAIRINGS, swaps
from polarguide.capture.checks import MeasuredGains, measured_gains, pair_moments
from polarguide.capture.view import ANGLES, FULL_CODE, listed
from polarguide.inspection.angles import AngleFindings
from polarguide.inspection.capture import POLARIZED, Capture, ViewMeasurements
from polarguide.inspection.evidence import ZENITH_MARGIN, SurfaceSamples
from polarguide.inspection.settings import LCD_TEST, Check, Verdict

PAIR_ERROR = 0.05
"""Median |I0 + I90 - I45 - I135| / S0 of a view above which its four pictures are inconsistent."""
UNEQUAL = 0.01
"""Deviation of the pair ratio from 1 for a warning; real sensors have about 0.02."""
VERY_UNEQUAL = 0.04
"""The same for the verdict "wrong"; a picture that is exposed 5 % longer gives 0.025."""
OTHERWISE = 0.08
"""Largest difference of the logarithms of the gains of two angles for a warning; angles marked to two degrees leave
0.07, real sensors 0.04."""
VERY_OTHERWISE = 0.17
"""The same for the verdict "wrong". An exposure that differs by a third of a stop gives 0.23."""
UNSTEADY = 0.01
"""Deviation of a view's pair ratio from the capture's."""
SATURATED = 0.05
"""Share of saturated pixels from which on a view gets a warning."""
BLOWN = 0.3
"""Share of saturated pixels from which on a capture is wrong."""
LITTLE = 0.05
"""Share of polarized pixels below which a capture gets a warning."""
ALMOST_NONE = 0.005
"""Share of polarized pixels below which a capture is wrong."""
NOISY = 0.03
"""Noise of one intensity as a share of S0 / 2: three times its DoLP noise is then 0.13."""

UNDEREXPOSED = 0.01
"""99th percentile of the values below which the exposure of a view was too short."""


def find_pairing(capture: Capture) -> int | None:
    """The pairs of perpendicular pictures by their sums, an index into ``PAIRINGS``; None if they do not decide."""
    residuals = np.array([view.measures.residuals for view in capture.views])
    residuals = residuals[residuals.max(axis=1) > 0]
    if len(residuals) == 0:
        return None
    exposed = measured_exposures(capture)
    if exposed is not None and exposed.pairing is not None and max(exposed.errors) < OTHERWISE / 3:
        return exposed.pairing  # whatever the exposures are
    medians = np.median(residuals, axis=0)
    best = int(medians.argmin())
    others = np.delete(medians, best)
    return best if medians[best] < 0.5 * float(others.min()) else None


def measured_exposures(capture: Capture) -> MeasuredGains | None:
    """The exposures of the four angles by the pair sums of all views; None where they are too dark."""
    moments = [
        pair_moments(view.intensities().mean(dim=-1).numpy(), view.usable.numpy()) for view in capture.views
    ]
    return measured_gains(np.concatenate(moments))


def picture_checks(
    capture: Capture, measurements: Sequence[ViewMeasurements], pairing: int | None
) -> list[Check]:
    """All checks of this file, in their order on the page."""
    if capture.origin == "stokes":
        computed = "The four pictures were computed from Stokes vectors: their sums agree by construction."
        return [
            *(Check(key, "n/a", computed) for key in ("pair_sums", "encoding", "exposure")),
            _saturation(capture, measurements),
            Check("noise", "n/a", computed),
            _polarization(measurements),
        ]
    encoding = _encoding(capture, pairing)
    # A bent response looks like exposures that differ.
    exposed = measured_exposures(capture) if encoding.verdict == "ok" else None
    return [
        _pairs(capture, measurements, pairing),
        encoding,
        _exposure(measurements, pairing, exposed),
        _saturation(capture, measurements),
        _noise(measurements),
        _polarization(measurements),
    ]


def light_checks(capture: Capture, measurements: Sequence[ViewMeasurements]) -> list[Check]:
    """The checks that apply to pictures at any angles: saturation and brightness."""
    return [_saturation(capture, measurements), _brightness(measurements)]


def _pairs(capture: Capture, measurements: Sequence[ViewMeasurements], pairing: int | None) -> Check:
    key = "pair_sums"
    error = float(np.median([r.sum_error for r in measurements]))
    figures = {"median_error": error, "pairing": None if pairing is None else list(PAIRINGS[pairing])}
    if pairing is not None and pairing > 0:
        finding = f"The pair sums agree only if {swaps(PAIRINGS[pairing])}."
        remedy = "Rename the files; once the whole order is decided, --fix does it."
        return Check(key, "wrong", finding, remedy, figures=figures)
    off = tuple(r.view for r in measurements if r.sum_error > PAIR_ERROR)
    if not off:
        finding = f"I0 + I90 and I45 + I135 differ by {error:.1%} of S0 (median)."
        return Check(key, "ok", finding, figures=figures)
    shown = listed(list(off))
    finding = (
        f"I0 + I90 and I45 + I135 differ by more than {PAIR_ERROR:.0%} of S0 in {len(off)} views ({shown})."
    )
    remedy = "Check whether something moved or the light changed between the shots, or whether files were exchanged."
    return Check(
        key, "wrong" if 2 * len(off) > len(measurements) else "warning", finding, remedy, off, figures
    )


WRONG = 0.18
"""Curvature of the response, beside ``checks.BENT``: a gamma of 0.8 has -0.125, of 0.73 -0.18; DoLP is then off by as
much as the gamma. Smooth areas of a real sensor's pictures, whose response is close to linear, have -0.17."""
_SURE_BEND = 4.0


def _encoding(capture: Capture, pairing: int | None) -> Check:
    key = "encoding"
    views = [
        checks.pair_slopes(view.codes.numpy(), view.usable.numpy(), checks.FOUR_PAIRS)
        for view in capture.views
    ]
    found = checks.curvature_of(list(itertools.chain.from_iterable(views)))
    if found is None or pairing not in (None, 0):
        why = "too few pixels are polarized" if found is None else "the pictures are paired wrongly"
        return Check(key, "n/a", f"The curvature of the response cannot be measured: {why}.")
    slope = found.value
    figures = {"curvature": slope, "curvature_error": found.error}
    finding = f"Curvature of the response {slope:+.2f}; linear files have 0, sRGB read as linear about -0.6."
    sure = abs(slope) > _SURE_BEND * found.error
    doubtful, certain = np.abs(checks.ENCODED if slope < 0 else checks.DECODED)
    if abs(slope) <= doubtful and not (sure and abs(slope) > checks.BENT):
        return Check(key, "ok", finding, figures=figures)
    wrong = abs(slope) > certain or (sure and abs(slope) > WRONG)
    remedy = "The files seem linear but are decoded (or have another tone curve): try --transfer linear."
    if slope < 0:
        remedy = (
            "The files seem display-encoded (gamma): export linear ones, or read them with --transfer srgb; mosaics of "
            f"a camera with gamma are prepared with --gamma (here about {1 / (1 - 2 * slope):.2f})."
        )
    return Check(key, "wrong" if wrong else "warning", finding, remedy, figures=figures)


def _exposure(
    measurements: Sequence[ViewMeasurements], pairing: int | None, exposed: MeasuredGains | None
) -> Check:
    known = [r for r in measurements if r.pair_ratio is not None]
    if not known or pairing not in (None, 0):
        return Check("exposure", "n/a", "The pair sums cannot be compared.")
    ratio = float(np.median([r.pair_ratio for r in known]))
    off = tuple(r.view for r in known if abs((r.pair_ratio or ratio) - ratio) > UNSTEADY)
    figures: dict[str, Any] = {"pair_ratio": ratio, "unsteady_views": len(off)}
    finding = f"(I0 + I90) / (I45 + I135) is {ratio:.3f} (median); ideal analyzers have 1."
    verdict: Verdict = "ok"
    remedy = ""
    if abs(ratio - 1) > UNEQUAL:
        verdict = "wrong" if abs(ratio - 1) > VERY_UNEQUAL else "warning"
        finding += f" If only one picture deviates, it does by {2 * abs(ratio - 1):.0%}."
        remedy = (
            "Let prepare estimate the gains (it does by default), or measure them on unpolarized light and give "
            "--calibration. The pair sums do not show which of the four deviates."
        )
    apart = 0.0 if exposed is None else float(np.ptp(exposed.logs))
    if exposed is not None and apart > max(OTHERWISE, 3 * max(exposed.errors)):
        figures["exposures"] = list(np.exp(exposed.logs))
        wrong = verdict == "wrong" or apart > max(VERY_OTHERWISE, 3 * max(exposed.errors))
        verdict = "wrong" if wrong else "warning"
        each = ", ".join(
            f"{angle}°: {value:.2f}" for angle, value in zip(ANGLES, np.exp(exposed.logs), strict=True)
        )
        finding += f" Pixel by pixel, they agree if the angles were exposed by {each}."
        remedy = (
            "Prepare the original files, whose EXIF says the exposure, with --gains auto; or give gains with "
            "--calibration. An angle that is off by several degrees looks alike."
        )
    if off:
        verdict = "warning" if verdict == "ok" else verdict
        finding += f" It differs by more than {UNSTEADY:.0%} in {len(off)} views ({listed(list(off))})."
        remedy = remedy or "Look for automatic exposure, flicker, or motion between the shots."
    return Check("exposure", verdict, finding, remedy, off, figures)


def _saturation(capture: Capture, measurements: Sequence[ViewMeasurements]) -> Check:
    key = "saturation"
    shares = [r.saturated for r in measurements]
    lost = [r.saturated + r.invalid for r in measurements]
    figures = {
        "saturated": float(np.mean(shares)),
        "worst": max(shares),
        "invalid": float(np.mean([r.invalid for r in measurements])),
        "dark": float(np.mean([r.dark for r in measurements])),
    }
    largest = max(view.peak for view in capture.views)
    if capture.bits == 16 and 0 < largest < (FULL_CODE + 1) // 16:
        finding = f"No value of the 16-bit files exceeds {largest}."
        remedy = "The data were not scaled to 16 bits: multiply the values, or run prepare with --bits."
        return Check(key, "wrong", finding, remedy, figures=figures)
    off = tuple(r.view for r, share in zip(measurements, lost, strict=True) if share > SATURATED)
    finding = (
        f"{np.mean(shares):.1%} of the pixels are at full scale, at most {max(shares):.1%} in a view; "
        f"{figures['invalid']:.1%} are marked invalid, {figures['dark']:.1%} are too dark to be used."
    )
    if not off:
        return Check(key, "ok", finding, figures=figures)
    finding += f" Over {SATURATED:.0%} are lost in {len(off)} views ({listed(list(off))})."
    remedy = (
        "These pixels carry no polarization and are excluded. Invalid ones may have clipped in the camera: expose "
        "shorter, keep lamps out of the picture."
    )
    return Check(key, "wrong" if float(np.mean(lost)) > BLOWN else "warning", finding, remedy, off, figures)


def _noise(measurements: Sequence[ViewMeasurements]) -> Check:
    share = float(np.median([r.noise_share for r in measurements]))
    bright = float(np.median([r.bright for r in measurements]))
    off = tuple(r.view for r in measurements if r.noise_share > NOISY or r.bright < UNDEREXPOSED)
    finding = (
        f"Noise of one intensity is {share:.2%} of the photograph (median, after averaging down), so that a DoLP "
        f"of {3 * 2**0.5 * share / 2:.3f} is three times its noise; "
        f"the 99th percentile of the values is {bright:.0%} of full scale."
    )
    figures = {"noise_share": share, "bright": bright}
    if not off:
        return Check("noise", "ok", finding, figures=figures)
    wrong = 2 * len(off) > len(measurements) and bright < UNDEREXPOSED
    finding += f" Dark or noisy: {len(off)} views ({listed(list(off))})."
    remedy = "Use a longer exposure at the lowest gain, or average several shots."
    return Check("noise", "wrong" if wrong else "warning", finding, remedy, off, figures)


def with_noise(angles: AngleFindings, measurements: Sequence[ViewMeasurements]) -> AngleFindings:
    """Return the findings with noise in the error of the zero if the check of noise warns.

    There, values are steps of a tone curve or what a compression left of them, which is not independent from pixel to
    pixel. So the error that it makes in the AoLP of one strongly polarized pixel is that of all of them together.
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
    finding = f"The 99th percentile of the values is {bright:.0%} of full scale (median view)."
    figures = {"bright": bright}
    off = tuple(r.view for r in measurements if r.bright < UNDEREXPOSED)
    if not off:
        return Check("brightness", "ok", finding, figures=figures)
    verdict: Verdict = "wrong" if 2 * len(off) > len(measurements) else "warning"
    finding += f" Dark: {len(off)} views ({listed(list(off))})."
    return Check("brightness", verdict, finding, "Use a longer exposure.", off, figures)


def _polarization(measurements: Sequence[ViewMeasurements]) -> Check:
    share = float(np.median([r.polarized for r in measurements]))
    median = float(np.median([r.dolp[0] for r in measurements]))
    finding = (
        f"{share:.0%} of the pixels have a DoLP above {POLARIZED:g} and above three times its noise; "
        f"the median DoLP is {median:.3f}."
    )
    strongest = float(np.median([r.dolp[1] for r in measurements]))
    noise = 3 * math.sqrt(2) / 2 * float(np.median([r.noise_share for r in measurements]))
    figures = {"polarized": share, "median_dolp": median, "p99_dolp": strongest}
    if share >= LITTLE:
        return Check("low_dolp", "ok", finding, figures=figures)
    verdict: Verdict = "wrong" if share < ALMOST_NONE else "warning"
    remedy = (
        "Polarization carries little information here. Photograph surfaces obliquely (50 to 65 degrees), from lower "
        "views; check that the filter is a linear polarizer, the right way round, and that the exposure was fixed."
    )
    if (strongest < POLARIZED or share < ALMOST_NONE) and noise < POLARIZED:
        verdict = "wrong"
        finding = (
            "No modulation: was the filter reversed, or missing? The four pictures show the same light but for "
            f"noise; 99 % of the pixels (median view) have a DoLP under {strongest:.3f}, and {share:.1%} one above "
            "three times their noise."
        )
        remedy = LCD_TEST
    return Check("low_dolp", verdict, finding, remedy, figures=figures)


NOT_DIELECTRIC = 0.15
"""Share of the pixels with normals, or of all pixels, above which the check warns."""


def dielectric_check(
    measurements: Sequence[ViewMeasurements], pixels: SurfaceSamples | None, index: float
) -> Check:
    """Check whether large areas are polarized more strongly than a dielectric under unpolarized light can be."""
    above = float(torch.tensor([r.above_limit for r in measurements]).median())
    limit = float(optics.diffuse_dolp_limit(index))
    finding = f"{above:.0%} of the pixels (median view) have a DoLP above the diffuse limit ({limit:.2f})."
    figures: dict[str, Any] = {"above_diffuse_limit": above}
    share = above
    if pixels is None or len(pixels.aolp) == 0:
        finding += (
            " Without normals, reflections of a smooth dielectric cannot be distinguished from metal or sky."
        )
    else:
        share = float(exceeds_dielectric(pixels, index).float().mean())
        figures["unexplained"] = share
        finding += f" {share:.0%} of pixels with a normal have a DoLP above the maximum of both lobes at their zenith."
    if share <= NOT_DIELECTRIC:
        return Check("dielectric", "ok", finding, figures=figures)
    remedy = (
        "Bare metal, sky or its reflection, or a screen? The model assumes dielectrics under unpolarized light: "
        "exclude such areas with masks, and expect worse normals there."
    )
    return Check("dielectric", "warning", finding, remedy, figures=figures)


def exceeds_dielectric(pixels: SurfaceSamples, index: float) -> torch.Tensor:
    """Whether the DoLP exceeds that of specular and diffuse light at every zenith within the margin, [N] bool."""
    steps = torch.linspace(-ZENITH_MARGIN, ZENITH_MARGIN, 7)
    zenith = (pixels.zenith[:, None] + steps).clamp(0, math.pi / 2)
    most = torch.maximum(optics.specular_dolp(zenith, index), optics.diffuse_dolp(zenith, index)).amax(dim=1)
    return pixels.dolp > most + 3 * pixels.noise
