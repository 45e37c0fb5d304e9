"""Prepare the pictures of a set for the fit: linear samples, with the angle and exposure of each picture."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture import checks
from polarguide.capture.brackets import Bracket
from polarguide.capture.calibration import ANGLES, Calibration, apply_orientation, orientation_calibration
from polarguide.capture.develop import COMPARABLE, require_one, stated_exposures
from polarguide.capture.exposures import Angle, Exposure, analyzers, turned
from polarguide.capture.filter.encoding import VIDEO, kind_of_file, transfer_of_pictures
from polarguide.capture.filter.shots import Shots, read_stack, stacked
from polarguide.capture.formats.pictures import linear_codes
from polarguide.capture.formats.stored import require_alike, rescaled
from polarguide.capture.layout import require_memory
from polarguide.capture.picture_sets import Mask, SetSamples
from polarguide.capture.sensor.pattern import FULL_16, Levels, estimate_levels, level_notes
from polarguide.capture.view import FULL_CODE, View
from polarguide.capture.view_reader import ViewData
from polarguide.core.errors import require
from polarguide_shots.options import ShotOptions
from polarguide_shots.sets import SetPicture, known_indices, read_frames

_COMPRESSED_FULL = 250
"""Stored value that counts as full scale in compressed video, which blurs the edge of clipped areas."""
_FITTED = 4 * (4 * 3 + 3 + 7)
"""Bytes per pixel that the fit needs for intensities, Stokes vectors and maps."""


def read_set(name: str, pictures: Sequence[SetPicture], options: ShotOptions) -> SetSamples:
    """Read the pictures of a set, one after the other.

    Args:
        name: name of the shot.
        pictures: pictures of the set.
        options: options of the shot.

    Raises:
        PolarguideError: a picture cannot be read, the pictures differ in size, depth or orientation, or memory is too
            small.
    """
    require_no_order(options.calibration, name)
    known = [picture for picture in pictures if not isinstance(picture.angle, str)]
    require_one(
        known[0].path.parent,
        ((kind_of_file(p.path) if p.frame is None else VIDEO, p.path) for p in known),
        "a set of one kind of file",
        COMPARABLE,
    )
    for picture in known:
        bracket = Bracket.of([picture.path])
        require(
            bracket.single,
            picture.path,
            expected="one exposure of each picture of a set at any angles",
            found=f"{len(bracket.files)} exposures",
            remedy="Use pictures at 0, 45, 90 and 135 degrees, or polarguide prepare, which merges exposures.",
        )
    stack = _stack(name, known[0].path, len(known), _read_each(known))
    gains, notes = _gains(known)
    return _samples(
        stack, pictures, gains, notes, list(dict.fromkeys(picture.path for picture in known)), options
    )


def samples_of_arrays(
    name: str, stored: NDArray[Any], angles: Sequence[Angle], options: ShotOptions
) -> SetSamples:
    """Return the samples of a set in memory.

    Args:
        name: name of the shot.
        stored: stored values [K, H, W, 3] of uint8 or uint16.
        angles: angles of the K pictures.
        options: options of the shot.
    """
    require_no_order(options.calibration, name)
    pictures = [SetPicture(Path(f"picture {k + 1}"), angle) for k, angle in enumerate(angles)]
    places = [k for k, angle in enumerate(angles) if not isinstance(angle, str)]
    return _samples(
        _stack(name, Path(name), len(places), (stacked(stored[k : k + 1]) for k in places)),
        pictures,
        [1.0] * len(places),
        [],
        [],
        options,
    )


def _stack(name: str, where: Path, count: int, pictures: Iterator[Shots]) -> tuple[Shots, np.dtype[Any]]:
    """Stack pictures to one array of uint16. The array has one channel if all pictures are gray.

    Args:
        name: name of the set.
        where: path for messages.
        count: number of pictures.
        pictures: iterator of the pictures.

    Returns:
        The stacked pictures; and the type of their stored values.

    Raises:
        PolarguideError: memory is too small for the pictures and their fit.
    """
    first = next(pictures)
    colors = 1 if _is_gray(first) else 3
    needed = (count * (2 * colors + 1) + _FITTED) * first.dark.size
    require_memory(
        where,
        needed,
        f"{count} pictures of {name}",
        remedy="Make the pictures smaller, all by the same factor.",
    )
    values = np.empty((count, *first.dark.shape, colors), np.uint16)
    lost = np.empty(values.shape[:3], bool)
    dark = np.ones(values.shape[1:3], bool)
    for place, shot in enumerate(itertools.chain([first], pictures)):
        if values.shape[3] == 1 and not _is_gray(shot):
            values = np.repeat(values, 3, axis=3)
        values[place] = shot.pictures[0, ..., : values.shape[3]]
        lost[place] = shot.clipped[0]
        dark &= shot.dark
    return Shots(values, first.orientation, lost, dark), first.pictures.dtype


def _is_gray(shot: Shots) -> bool:
    return bool((shot.pictures[..., :1] == shot.pictures).all())


def _samples(
    stack: tuple[Shots, np.dtype[Any]],
    pictures: Sequence[SetPicture],
    gains: Sequence[float],
    notes: Sequence[str],
    files: Sequence[Path],
    options: ShotOptions,
) -> SetSamples:
    """Convert stored values to linear samples in place, and rotate the pictures upright.

    Args:
        stack: result of ``_stack``.
        pictures: pictures of the set, including pictures at unknown angles.
        gains: exposures of the pictures at known angles.
        notes: notes for the user on the exposures.
        files: files of the pictures at known angles; empty for pictures in memory.
        options: options of the shot.
    """
    read, kind = stack
    known = [picture for picture in pictures if not isinstance(picture.angle, str)]
    angles = [float(picture.angle) for picture in known]
    code = read.orientation
    container = 8 * kind.itemsize
    levels, level_notes = levels_of_shot(read.pictures, container, options, bits=options.bits or container)
    full = levels.is_full(container)
    codes = np.arange(np.iinfo(kind).max + 1, dtype=kind)
    step = 1 / float(np.iinfo(kind).max)
    if not full:
        codes = rescaled(codes, levels.white)
        step = 1 / levels.white
    film = files[0] if known[0].frame is not None else None
    decision = transfer_of_pictures(
        files, options.transfer, lambda: [(_subset(read, codes), angles)], video=film
    )
    linear = linear_codes(codes, decision.transfer)
    # One picture at a time limits memory.
    for picture, clipped in zip(read.pictures, read.clipped, strict=True):
        if not full:
            clipped |= (picture >= levels.saturation).any(axis=2)
        picture[...] = linear[picture]
    turn = orientation_calibration(code)
    dark = apply_orientation(read.dark, code)
    return SetSamples(
        labels=tuple(picture.label for picture in known),
        values=apply_orientation(read.pictures.transpose(1, 2, 0, 3), code).transpose(2, 0, 1, 3),
        exposures=tuple(
            Exposure(float(turned(turned(angle, options.calibration), turn)), gain=gain)
            for angle, gain in zip(angles, gains, strict=True)
        ),
        lost=apply_orientation(read.clipped.transpose(1, 2, 0), code).transpose(2, 0, 1),
        dark=dark,
        masked=np.zeros(dark.shape, bool),
        step=step,
        notes=(
            *(decision.note, *filter(None, [decision.doubt]), *level_notes, *notes),
            *_unused(len(pictures) - len(known)),
        ),
    )


def _subset(read: Shots, codes: NDArray[Any]) -> Shots:
    """Return pictures that contain only some pixels. ``codes`` are the stored values of these pixels."""
    usable = checks.sampled(~(read.clipped.any(axis=0) | read.dark)[None])
    return Shots(codes[checks.sampled(read.pictures)], 1, ~usable, np.zeros(usable.shape[1:], bool))


def require_no_order(calibration: Calibration, name: str) -> None:
    """Check that a calibration has no gains and no order of the angles.

    Gains and order apply to pictures at 0, 45, 90 and 135 degrees only.

    Raises:
        PolarguideError: the calibration has gains or an order.
    """
    for field, given in (("gains", calibration.gains is not None), ("order", calibration.order != ANGLES)):
        require(
            not given,
            f"calibration ({field})",
            expected="pictures at 0, 45, 90 and 135 degrees, to which gains and order apply",
            found=f"{name}, a set of pictures at other angles",
            remedy="Remove gains and order; sense and zero apply. List gains in the column gain of angles.csv.",
        )


def _read_each(pictures: Sequence[SetPicture]) -> Iterator[Shots]:
    """Read pictures one after the other, and check that size, depth and orientation agree.

    Raises:
        PolarguideError: a picture cannot be read, or differs from the first picture.
    """
    first: Shots | None = None
    for path, group in itertools.groupby(pictures, key=lambda picture: picture.path):
        frames = [picture.frame for picture in group]
        for shot in _video(path, frames) if frames[0] is not None else [read_stack([path])] * len(frames):
            first = first or shot
            require_alike(path, shot.pictures[0], pictures[0].path, first.pictures[0])
            require(
                shot.orientation == first.orientation,
                path,
                expected=f"EXIF orientation {first.orientation} like {pictures[0].path.name}",
                found=str(shot.orientation),
                remedy="Keep the camera still within a set, or export all with the same orientation.",
            )
            yield shot


def _video(path: Path, frames: Sequence[int | None]) -> Iterator[Shots]:
    """Read frames of a video in the requested order."""
    ordered = sorted(frame for frame in frames if frame is not None)
    read = dict(zip(ordered, read_frames(path, ordered), strict=True))
    for frame in frames:
        picture = read[frame or 0]
        clipped = np.asarray((picture >= _COMPRESSED_FULL).any(axis=2))
        yield Shots(picture[None], 1, clipped[None], np.asarray(~picture.any(axis=2)))


def _gains(pictures: Sequence[SetPicture]) -> tuple[list[float], list[str]]:
    """Return the gain of each picture, and notes for the user.

    Gains come from the table, or else from the exposures that the files state.
    """
    gains = [picture.gain for picture in pictures]
    if all(gain is None and picture.frame is None for gain, picture in zip(gains, pictures, strict=True)):
        return stated_of_shot([picture.path for picture in pictures])
    return [1.0 if gain is None else gain for gain in gains], []


def samples_of_view(data: ViewData, full: int | None, options: ShotOptions) -> SetSamples:
    """Return the samples of a view of a scene folder whose angles are not the usual four.

    Args:
        data: the view.
        full: stored value at which the view saturates, or None.
        options: options of the shot.

    Raises:
        PolarguideError: the pictures at known angles do not determine Stokes vectors.
    """
    require_no_order(options.calibration, data.name)
    places = known_indices(data.name, data.exposures)
    saturated = data.saturated(full) & ~data.black
    return SetSamples(
        labels=tuple(f"picture {k + 1}" for k in places),
        values=data.codes[places] / np.float32(FULL_CODE) if data.is_radiance else data.codes[places],
        exposures=tuple(
            replace(e, angle=float(turned(e.angle or 0.0, options.calibration)))
            for e in (data.exposures[k] for k in places)
        ),
        lost=np.broadcast_to(saturated, (len(places), *saturated.shape)),
        dark=data.black,
        masked=data.invalid if data.mask is None else data.invalid | ~data.mask,
        step=1 / data.largest_value,
        notes=_unused(len(data.exposures) - len(places)),
    )


def behind_lens(view: View, intensities: Tensor, exposures: Sequence[Exposure]) -> Tensor:
    """Convert intensities [K, H, W, C] of a view to the values that polarizers behind the lens would give."""
    if view.mount == "sensor":
        return intensities
    rays = view.camera.rays()
    change = analyzers(exposures, rays, "sensor")[..., None, None] - analyzers(exposures, rays, "filter")
    return intensities + torch.einsum("ksyx,syxc->kyxc", change, view.stokes()[1:]) / 2


def state_of(view: View) -> tuple[Mask, Mask, float]:
    """Return three values of a view: a mask of dark pixels, a mask of saturated pixels, and the stored step.

    The step is the difference between two successive stored values, as a share of full scale.
    """
    codes = view.codes.numpy()
    peak = codes.max(axis=(0, 3))
    lost = view.saturated.numpy()
    # Pixels without polarization information are dark below half of the view's maximum, else saturated.
    dark = (lost & (peak < peak.max() / 2)) | (peak == 0)
    # Codes are multiples of one stored value unless they were decoded or averaged.
    step = 1 if codes.dtype == np.float32 else int(np.gcd.reduce(np.flatnonzero(np.bincount(codes.ravel()))))
    return dark, lost & ~dark, max(step, 1) / FULL_CODE


def samples_of_loaded(view: View) -> SetSamples:
    """Return the samples of a loaded view, including its mask and exposures.

    A filter before the lens is corrected.

    Raises:
        PolarguideError: the pictures at known angles do not determine Stokes vectors.
    """
    places = known_indices(view.name, view.exposures)
    dark, saturated, step = state_of(view)
    exposures = [replace(view.exposures[k], gain=1.0) for k in places]
    intensities = behind_lens(view, view.intensities()[places], exposures)
    invalid = view.invalid.numpy()
    return SetSamples(
        labels=tuple(f"picture {k + 1}" for k in places),
        values=intensities.numpy(),
        exposures=tuple(exposures),
        lost=np.broadcast_to(saturated, (len(places), *saturated.shape)),
        dark=dark,
        masked=invalid if view.mask is None else invalid | ~view.mask.numpy(),
        step=step,
        notes=_unused(len(view.exposures) - len(places)),
    )


def _unused(count: int) -> tuple[str, ...]:
    """Return a note for the user on the number of pictures that are not used because their angles are unknown."""
    return (f"{count} pictures without a known angle are not used.",) if count else ()


def stated_of_shot(paths: Sequence[Path]) -> tuple[list[float], list[str]]:
    """Return the relative exposures that the files of a shot state, and notes for the user.

    All exposures are 1 if a file states no exposure.
    """
    stated, missing = stated_exposures({"": paths})
    if not stated:
        return [1.0] * len(paths), [missing] if missing else []
    exposures = stated[""]
    factor = max(exposures) / min(exposures)
    return exposures, [f"The files state exposures that differ by a factor of {factor:.3g}; corrected."]


def levels_of_shot(
    values: NDArray[Any],
    container: int,
    options: ShotOptions,
    *,
    bits: int | None,
    black: float = 0.0,
    stated: int | None = None,
) -> tuple[Levels, list[str]]:
    """Estimate the levels (such as full scale) of the stored values of a single shot.

    If many samples have the same largest value, they are saturated. This value does not become the full scale, because
    all shots of a series must have the same full scale.

    Args:
        values: stored values, [K, ...].
        container: see ``capture.develop.levels_of_capture``.
        options: see ``capture.develop.levels_of_capture``.
        bits: number of bits of a sensor value, or None if it is unknown.
        black: see ``capture.develop.levels_of_capture``.
        stated: see ``capture.develop.levels_of_capture``.

    Returns:
        The levels, and notes for the user.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    largest = int(values.max())
    counts = None
    # Clipped values are a power of two minus 1. This test avoids the slow counting of all values.
    may_pile_up = container == 16 and largest < FULL_16 and largest & (largest + 1) == 0
    if may_pile_up and options.bits is None and options.saturation is None:
        parts = (np.bincount(part.ravel(), minlength=FULL_16 + 1) for part in values)
        counts = sum(parts, np.zeros(1, np.int64))
    levels = estimate_levels(
        largest, int(np.bitwise_or.reduce(values, None)), container,
        bits=bits, black=black, saturation=options.saturation, counts=counts, stated=stated, alone=True,
    )  # fmt: skip
    return levels, level_notes(levels, counts, container, bits, stated)
