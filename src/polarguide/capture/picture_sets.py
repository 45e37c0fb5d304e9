"""Detect wrong pictures among the pictures of one view, which were taken through a filter at known angles.

Each picture is predicted from the other pictures of the view. A large residual is a sign of a wrong angle, a different
exposure, or motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import gammaincinv

from polarguide.capture.angle_evidence import AngleEstimate
from polarguide.capture.exposures import WELL_CONDITIONED, Exposure, conditioning, nominal
from polarguide.capture.view import FULL_CODE

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


class SetLimits:
    """Constants of the comparison of pictures.

    Attributes:
        marks: precision of the marks on a filter ring, in degrees. A smaller difference of angles is no error.
        against: largest ratio of a picture's residual to the median residual of the others at which it agrees with
            them.
        brighter: relative difference of brightness above which a message calls a wrong picture brighter or darker.
        most_pixels: largest number of pixels that are compared.
        fewest_pixels: smallest number of pixels for a comparison.
        determined: largest standard error in degrees at which an estimated angle is reported.
        over_noise: smallest ratio of the polarization's variation over the picture to its noise.
        explained: share of the squared residual above which another angle explains most of a contradiction.
        moving: share of pixels that this test ignores: those with the largest residuals at the other angle.
    """

    marks = 2.0
    against = 4.0
    brighter = 0.03
    most_pixels = 20_000
    fewest_pixels = 200
    determined = 1.0
    over_noise = 3.0
    explained = 0.5
    moving = 0.2


@dataclass(frozen=True, eq=False)
class SetSamples:
    """Pictures of one view at K angles, from which Stokes vectors are fitted.

    Attributes:
        labels: labels of the pictures for messages.
        values: linear uint16 codes or float32 intensities, [K, H, W, C]. C is 1 if all pictures are gray, otherwise 3.
        exposures: polarizer angle and gain of each picture.
        lost: mask of the saturated pixels of each picture, [K, H, W].
        dark: mask of the pixels that are 0 in all pictures, [H, W].
        masked: mask of the pixels that are excluded from the fit, [H, W].
        step: difference of two successive stored values, relative to full scale.
        notes: messages for the user.
    """

    labels: tuple[str, ...]
    values: NDArray[Any]
    exposures: tuple[Exposure, ...]
    lost: Mask
    dark: Mask
    masked: Mask
    step: float
    notes: tuple[str, ...] = ()

    @property
    def rows(self) -> NDArray[np.float32]:
        """Malus's law as a matrix [K, 3]. Its product with a Stokes vector is the intensity in each of K pictures."""
        pairs = nominal(self.exposures).numpy()
        return np.asarray(np.concatenate((np.ones_like(pairs[:, :1]), pairs), axis=1) / 2, np.float32)

    @property
    def gains(self) -> NDArray[np.float32]:
        """Number by which the values of each picture are divided, [K]."""
        return np.array([exposure.gain for exposure in self.exposures], np.float32)

    def intensities(self, at: Any) -> NDArray[np.float32]:
        """Return the linear intensities of some pixels divided by the gains, [K, ..., C].

        Args:
            at: index of the pixels in an array [H, W].
        """
        chosen = self.values[(slice(None), *at)] if isinstance(at, tuple) else self.values[:, at]
        scale = np.float32(FULL_CODE) if self.values.dtype == np.uint16 else np.float32(1)
        gains = self.gains.reshape(-1, *[1] * (chosen.ndim - 1))
        return np.asarray(chosen.astype(np.float32) / (scale * gains))

    def gray(self, at: Any) -> NDArray[np.float32]:
        """Return the mean of ``intensities`` over the color channels, [K, ...]."""
        return mean_color(self.intensities(at))


def mean_color(colors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of one or three color channels [..., C] as a contiguous array [...].

    This is faster than NumPy's mean over an axis of length 3.
    """
    if colors.shape[-1] == 1:
        return np.ascontiguousarray(colors[..., 0])
    return np.asarray((colors[..., 0] + colors[..., 1] + colors[..., 2]) / np.float32(3))


@dataclass(frozen=True)
class PictureFit:
    """Comparison of one picture of a view with its prediction from the other pictures.

    Attributes:
        label: name of the file; for a video also the number of the frame.
        angle: stated polarizer angle as displayed, in degrees.
        gain: number by which the values of the picture are divided.
        looks_like: angle in degrees at which the prediction matches the picture best. It is ``None`` if the light does
            not determine the angle, or if the angle differs from the stated one without explaining the residual.
        error: standard error of ``looks_like`` in degrees, or None.
        residual: root mean square of the residuals, relative to full scale.
        left_out: True if the picture is excluded from the fit of Stokes vectors.
    """

    label: str
    angle: float
    gain: float
    looks_like: float | None
    error: float | None
    residual: float
    left_out: bool


@dataclass(frozen=True)
class SetJudgment:
    """Result of the comparison of K pictures of a view.

    Attributes:
        pictures: result for each picture.
        used: mask of the pictures that agree with each other, [K] bool. Stokes vectors are fitted to these pictures.
        notes: messages for the user.
    """

    pictures: tuple[PictureFit, ...]
    used: NDArray[np.bool_]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Prediction(AngleEstimate):
    """Comparison of a picture with its prediction from the Stokes vectors of the other pictures.

    Attributes:
        gain: ratio of the picture's brightness to the predicted brightness.
        residual: root mean square of the differences from the prediction.
        explained: share of the squared differences that the estimated angle and gain remove.
    """

    floor: float = SetLimits.marks
    gain: float = 1.0
    residual: float = 0.0
    explained: float = 0.0

    @property
    def agrees(self) -> bool:
        """True if the estimated angle agrees with the stated one within the precision of the marks."""
        return abs(self.off) <= SetLimits.marks

    @property
    def explains(self) -> bool:
        """True if the estimated angle explains most of the differences, unlike for motion or stray light."""
        return self.explained > SetLimits.explained

    @property
    def is_credible(self) -> bool:
        """True if the estimated angle agrees with the stated one, or explains most of the differences."""
        return self.agrees or self.explains


def chosen_pixels(samples: SetSamples) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the row indices and the column indices of pixels that are usable in every picture.

    If there are more pixels than ``SetLimits.most_pixels``, return an evenly spread subset.
    """
    good = ~(samples.dark | samples.masked)
    for lost in samples.lost:
        good &= ~lost
    places = np.flatnonzero(good)
    places = places[:: max(1, len(places) // SetLimits.most_pixels)]
    return np.unravel_index(places, good.shape)  # type: ignore[return-value]


def judge(samples: SetSamples, gray: Floats) -> SetJudgment:
    """Compare the pictures of a view with each other, and choose the pictures for the fit of Stokes vectors.

    The other pictures give a Stokes vector at each pixel. Malus's law predicts the picture from these vectors, with one
    unknown angle and one unknown gain for all pixels. The picture with the largest deviation is excluded. This is
    repeated as long as enough pictures agree without it.

    Args:
        samples: pictures of the view.
        gray: luminance [K, N] at pixels that are usable in every picture.
    """
    count = len(samples.labels)
    used = np.ones(count, bool)
    reasons: dict[int, str] = {}
    while gray.shape[1] >= SetLimits.fewest_pixels:
        predicted = _predictions(samples, gray, used, used)
        # The candidates are the pictures with the largest residual and with the largest error of the angle.
        candidates = (
            max(predicted, key=lambda k: predicted[k].residual),
            max(predicted, key=lambda k: abs(predicted[k].off)),
        )
        worst = next((k for k in candidates if _contradicts(samples, gray, used, k, predicted[k])), None)
        if worst is None:
            break
        used[worst] = False
        reasons[worst] = _reason(samples, worst, predicted[worst])
    notes = [reasons[k] for k in sorted(reasons)]
    final = _predictions(samples, gray, used, np.ones(count, bool))
    determined = [final[k] for k in np.flatnonzero(used).tolist() if final[k].angle is not None]
    off_by = float(np.median([abs(fit.off) for fit in determined])) if determined else 0.0
    if count > 3 and off_by > SetLimits.marks:
        notes.append(
            f"The angles contradict each other by {off_by:.0f} degrees (median). "
            f"{int(used.sum())} pictures are too few to identify the wrong ones."
            if any(fit.explains for fit in determined)
            else "The pictures contradict each other, and wrong angles explain at most half of it. Look also for "
            "motion, changing light, and glare around a lamp."
        )
    fits = tuple(
        PictureFit(
            label=samples.labels[k],
            angle=samples.exposures[k].angle or 0.0,
            gain=samples.exposures[k].gain,
            looks_like=round(fit.angle, 1) if fit.angle is not None and fit.is_credible else None,
            error=fit.error if fit.angle is not None and fit.is_credible else None,
            residual=fit.residual,
            left_out=not used[k],
        )
        for k, fit in final.items()
    )
    return SetJudgment(fits, used, tuple(notes))


def _contradicts(samples: SetSamples, gray: Floats, used: Mask, worst: int, predicted: _Prediction) -> bool:
    """Return True if a picture contradicts the others.

    This is the case if its angle or its residual deviates far more than the angles or residuals of the other pictures.
    """
    rows = samples.rows.astype(np.float64)
    rest = used.copy()
    rest[worst] = False
    if rest.sum() < 4 or conditioning(torch.from_numpy(2 * rows[rest, 1:])) < WELL_CONDITIONED:
        return False
    others = _predictions(samples, gray, rest, rest).values()
    typical = float(np.median([abs(other.off) for other in others]))
    residual = float(np.median([other.residual for other in others]))
    contradicts = replace(predicted, usual=typical).contradicts
    return contradicts or predicted.residual > SetLimits.against * residual


def _reason(samples: SetSamples, k: int, predicted: _Prediction) -> str:
    """Describe for the user why a picture is rejected."""
    change = predicted.gain - 1
    if predicted.explains and not predicted.agrees:
        reason = f"looks like {predicted.angle:.0f} degrees: its angle is probably wrong"
    elif predicted.explains and abs(change) > SetLimits.brighter:
        way = "brighter" if change > 0 else "darker"
        reason = f"is {abs(change):.0%} {way} than the others predict (exposure or light)"
    else:
        reason = "contradicts the others (motion, light or a wrong angle)"
    return f"{samples.labels[k]} ({samples.exposures[k].angle or 0.0:g} degrees) {reason}. It is left out."


def _predictions(samples: SetSamples, gray: Floats, used: Mask, chosen: Mask) -> dict[int, _Prediction]:
    """Predict each picture in ``chosen`` from the other pictures in ``used``.

    The keys of the result are indices of pictures.
    """
    rows = samples.rows.astype(np.float64)
    predicted = {}
    for k in np.flatnonzero(chosen).tolist():
        others = used.copy()
        others[k] = False
        predicted[k] = _predict(rows, gray, others, k, samples.exposures[k].angle or 0.0)
    return predicted


def _predict(rows: Floats, gray: Floats, others: Mask, k: int, stated: float) -> _Prediction:
    """Predict picture ``k`` from the pictures ``others``, and fit its angle and gain by least squares.

    A polarizer at the angle t transmits ``m = (1, cos 2t, sin 2t) / 2`` times the Stokes vector. The fit minimizes the
    sum of ``(I - g m)^2`` over all pixels, where I is the intensity of the picture and g its gain. The contribution of
    noise is subtracted from the second moments of the Stokes vectors. Otherwise, unpolarized light would seem to
    determine an angle.
    """
    if not gray.shape[1]:  # a picture is saturated at every pixel
        return _Prediction(None, math.inf, stated)
    inverse = np.linalg.pinv(rows[others])
    stokes = inverse @ gray[others]
    picture = gray[k]
    pixels = picture.size
    residuals = gray[others] - rows[others] @ stokes
    freedom = int(others.sum()) - 3
    leverage = float(((rows[k] @ inverse) ** 2).sum())
    residual = math.sqrt(float(np.mean((picture - rows[k] @ stokes) ** 2)) / (1 + leverage))
    # The estimate is robust to a few moving pixels. Without redundancy, the residual of this picture is used.
    noise = residual**2 if freedom < 1 else typical_variance((residuals**2).sum(axis=0), freedom)
    extra = noise * inverse @ inverse.T / 4
    moments = stokes @ stokes.T / (4 * pixels) - extra
    product = stokes @ picture / (2 * pixels)
    angles = np.arange(0.0, 180.0, 0.1)
    doubled = 2 * np.radians(angles)
    forms = np.stack([np.ones_like(doubled), np.cos(doubled), np.sin(doubled)])
    along = np.maximum((forms * (moments @ forms)).sum(axis=0), 1e-30)
    gain = product @ forms / along
    best = int(np.argmax(np.where(gain > 0, gain * (product @ forms), -np.inf)))
    form = forms[:, best]
    slope = 2 * np.array([0.0, -form[2], form[1]])
    spread = float(slope @ moments @ slope - (slope @ moments @ form) ** 2 / along[best])
    certain = spread > SetLimits.over_noise * float(slope @ extra @ slope) and spread > 0
    error = math.inf
    if certain:
        error = math.degrees(math.sqrt(noise * (1 + leverage) / (pixels * spread)) / float(gain[best]))
    angle = float(angles[best]) if error < SetLimits.determined else None
    before = (picture - rows[k] @ stokes) ** 2
    after = (picture - float(gain[best]) / 2 * form @ stokes) ** 2
    still = after <= np.quantile(after, 1 - SetLimits.moving)
    total = float(before[still].sum())
    explained = 1 - float(after[still].sum()) / total if total else 0.0
    return _Prediction(angle, error, stated, gain=float(gain[best]), residual=residual, explained=explained)


def typical_variance(squares: Floats, freedom: int) -> float:
    """Return a robust estimate of the variance from the median of ``squares``.

    Each element of ``squares`` is a sum of ``freedom`` squared residuals.
    """
    return float(np.median(squares)) / float(2 * gammaincinv(freedom / 2, 0.5))
