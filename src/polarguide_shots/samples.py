"""From the files of a set to the samples that are fitted: linear values of its pictures, their angles and exposures."""

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
from polarguide.capture.calibration import ANGLES, Calibration
from polarguide.capture.develop import COMPARABLE, levels_of_shot, require_one, stated_exposures
from polarguide.capture.exposures import Angle, Exposure, analyzers, turned
from polarguide.capture.filter.camera_files import apply_orientation, orientation_calibration
from polarguide.capture.filter.encoding import VIDEO, kind_of_file, transfer_of_pictures
from polarguide.capture.filter.shots import Shots, read_stack, stacked
from polarguide.capture.formats.headers import rescaled
from polarguide.capture.formats.pictures import linear_codes
from polarguide.capture.layout import require_memory
from polarguide.capture.picture_sets import Mask, SetSamples
from polarguide.capture.view import FULL_CODE, View
from polarguide.capture.view_reader import ViewData, require_alike
from polarguide.core.errors import PolarguideError
from polarguide_shots.options import ShotOptions
from polarguide_shots.sets import SetPicture, known_places, read_frames

# Compression smears the edge of clipped areas over a few values.
_COMPRESSED_FULL = 250
_FITTED = 4 * (4 * 3 + 3 + 7)
"""Bytes for each pixel of what is fitted: intensities, Stokes vectors and maps."""


def read_set(name: str, pictures: Sequence[SetPicture], options: ShotOptions) -> SetSamples:
    """Read the pictures of a set, one after the other.

    Raises:
        PolarguideError: one cannot be read, they differ in size, depth or orientation, or they do not fit into memory.
    """
    require_no_order(options.calibration, name)
    known = [picture for picture in pictures if not isinstance(picture.angle, str)]
    kinds = ((kind_of_file(p.path) if p.frame is None else VIDEO, p.path) for p in known)
    require_one(known[0].path.parent, kinds, "a set of one kind of file", COMPARABLE)
    read = _gathered(name, known[0].path, len(known), _read_each(known))
    gains, notes = _gains(known)
    files = list(dict.fromkeys(picture.path for picture in known))
    return _samples(read, pictures, gains, notes, files, options)


def samples_of_arrays(
    name: str, stored: NDArray[Any], angles: Sequence[Angle], options: ShotOptions
) -> SetSamples:
    """Return the samples of a set in memory.

    Args:
        name: name of the shot.
        stored: [K, H, W, 3] uint8 or uint16.
        angles: angles of the K pictures.
        options: options of the shot.
    """
    require_no_order(options.calibration, name)
    pictures = [SetPicture(Path(f"picture {k + 1}"), angle) for k, angle in enumerate(angles)]
    places = [k for k, angle in enumerate(angles) if not isinstance(angle, str)]
    read = _gathered(name, Path(name), len(places), (stacked(stored[k : k + 1]) for k in places))
    return _samples(read, pictures, [1.0] * len(places), [], [], options)


def _gathered(name: str, where: Path, count: int, pictures: Iterator[Shots]) -> tuple[Shots, np.dtype[Any]]:
    """Pictures as one array of uint16, of one channel where all are gray; and the type that they were stored in.

    Args:
        name: of the set. where: for messages. count: how many pictures there are. pictures: one at a time.

    Raises:
        PolarguideError: the pictures and what is fitted to them do not fit into memory.
    """
    first = next(pictures)
    colors = 1 if _is_gray(first) else 3
    needed = (count * (2 * colors + 1) + _FITTED) * first.dark.size
    remedy = "Make the pictures smaller, all by the same factor."
    require_memory(where, needed, f"{count} pictures of {name}", remedy=remedy)
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
    gathered: tuple[Shots, np.dtype[Any]],
    pictures: Sequence[SetPicture],
    gains: Sequence[float],
    notes: Sequence[str],
    files: Sequence[Path],
    options: ShotOptions,
) -> SetSamples:
    """Return linear samples, upright, of stored ones, whose arrays are used up.

    Args:
        gathered: result of ``_gathered``.
        pictures: pictures of the set, also those without a known angle.
        gains: exposures of the pictures at known angles.
        notes: notes for the user on the exposures.
        files: files of the pictures at known angles; empty for pictures in memory.
        options: options of the shot.
    """
    read, kind = gathered
    known = [picture for picture in pictures if not isinstance(picture.angle, str)]
    angles = [float(picture.angle) for picture in known]
    code = read.orientation
    container = 8 * kind.itemsize
    bits = options.bits or container
    measured, level_notes = levels_of_shot(read.pictures, container, options, bits=bits)
    levels = None if measured.is_full(container) else measured
    every = np.arange(np.iinfo(kind).max + 1, dtype=kind)
    step = 1 / float(np.iinfo(kind).max)
    if levels is not None:
        every = rescaled(every, levels.white)
        step = 1 / levels.white
    film = files[0] if known[0].frame is not None else None
    decision = transfer_of_pictures(
        files, options.transfer, lambda: [(_judged(read, every), angles)], video=film
    )
    linear = linear_codes(every, decision.transfer)
    as_stored = levels is None and kind == np.uint16 and decision.transfer == "linear"
    # One picture at a time limits memory.
    for picture, clipped in zip(read.pictures, read.clipped, strict=True):
        if levels is not None:
            clipped |= (picture >= levels.saturation).any(axis=2)
        if not as_stored:
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


def _judged(read: Shots, every: NDArray[Any]) -> Shots:
    """A sample of pictures with full scale that of the type of ``every``, which has what each stored value becomes."""
    usable = ~(read.clipped.any(axis=0) | read.dark)
    pictures = checks.sampled(read.pictures)
    sample = checks.sampled(usable[None])
    return Shots(every[pictures], 1, ~sample, np.zeros(sample.shape[1:], bool))


def require_no_order(calibration: Calibration, name: str) -> None:
    """Refuse what a calibration says of pictures called 0, 45, 90 and 135 for pictures at other angles.

    Raises:
        PolarguideError: the calibration has gains or another order.
    """
    for field, given in (("gains", calibration.gains is not None), ("order", calibration.order != ANGLES)):
        if given:
            raise PolarguideError(
                f"calibration ({field})",
                expected="pictures at 0, 45, 90 and 135 degrees: the option is for these",
                found=f"{name}, a set of pictures at other angles",
                remedy="Leave it out; sense and zero apply, and angles.csv has a column gain.",
            )


def _read_each(pictures: Sequence[SetPicture]) -> Iterator[Shots]:
    """Each picture as read; all of one size, depth and orientation.

    Raises:
        PolarguideError: one cannot be read, or differs.
    """
    first: Shots | None = None
    for path, group in itertools.groupby(pictures, key=lambda picture: picture.path):
        frames = [picture.frame for picture in group]
        for shot in _video(path, frames) if frames[0] is not None else [read_stack([path])] * len(frames):
            first = first or shot
            require_alike(path, shot.pictures[0], pictures[0].path, first.pictures[0])
            if shot.orientation != first.orientation:
                raise PolarguideError(
                    path,
                    expected=f"EXIF orientation {first.orientation} like {pictures[0].path.name}",
                    found=str(shot.orientation),
                    remedy="Keep the camera still within a set, or export all with the same orientation.",
                )
            yield shot


def _video(path: Path, frames: Sequence[int | None]) -> Iterator[Shots]:
    """Frames of a video, in the order that is asked for, as pictures are read."""
    rising = sorted(frame for frame in frames if frame is not None)
    read = dict(zip(rising, read_frames(path, rising), strict=True))
    for frame in frames:
        picture = read[frame or 0]
        clipped = np.asarray((picture >= _COMPRESSED_FULL).any(axis=2))
        yield Shots(picture[None], 1, clipped[None], np.asarray(~picture.any(axis=2)))


def _gains(pictures: Sequence[SetPicture]) -> tuple[list[float], list[str]]:
    """The gain of each picture: as the table states, else as the files state their exposure; and notes."""
    gains = [picture.gain for picture in pictures]
    if all(gain is None and picture.frame is None for gain, picture in zip(gains, pictures, strict=True)):
        return stated_of_shot([picture.path for picture in pictures])
    return [1.0 if gain is None else gain for gain in gains], []


def samples_of_view(data: ViewData, full: int | None, options: ShotOptions) -> SetSamples:
    """The samples of a view of a scene as stored, at other angles than the usual four; ``full``: where it saturates.

    Raises:
        PolarguideError: its known pictures do not determine Stokes vectors.
    """
    require_no_order(options.calibration, data.name)
    places = known_places(data.name, data.exposures)
    saturated = np.zeros(data.black.shape, bool) if full is None else np.asarray(data.peak >= full)
    return SetSamples(
        labels=tuple(f"picture {k + 1}" for k in places),
        values=data.codes[places],
        exposures=tuple(
            replace(e, angle=float(turned(e.angle or 0.0, options.calibration)))
            for e in (data.exposures[k] for k in places)
        ),
        lost=np.broadcast_to(saturated, (len(places), *saturated.shape)),
        dark=data.black,
        masked=data.invalid if data.mask is None else data.invalid | ~data.mask,
        step=1 / float(np.iinfo(data.peak.dtype).max),
        notes=_unused(len(data.exposures) - len(places)),
    )


def behind_lens(view: View, intensities: Tensor, exposures: Sequence[Exposure]) -> Tensor:
    """Intensities of a view [K, H, W, C] at some exposures, as polarizers behind the lens would have measured them."""
    if view.mount == "sensor":
        return intensities
    rays = view.camera.rays()
    more = analyzers(exposures, rays, "sensor")[..., None, None] - analyzers(exposures, rays, "filter")
    return intensities + torch.einsum("ksyx,syxc->kyxc", more, view.stokes()[1:]) / 2


def state_of(view: View) -> tuple[Mask, Mask, float]:
    """Dark and saturated pixels of a view, and one stored value as a share of full scale."""
    codes = view.codes.numpy()
    peak = codes.max(axis=(0, 3))
    lost = view.saturated.numpy()
    # Of pixels without polarization information, those nearer to black than to the brightest of the view are dark.
    dark = (lost & (peak < peak.max() / 2)) | (peak == 0)
    # Codes are multiples of what one stored value is, unless they were decoded or averaged.
    step = int(np.gcd.reduce(np.flatnonzero(np.bincount(codes.ravel()))))
    return dark, lost & ~dark, max(step, 1) / FULL_CODE


def samples_of_loaded(view: View) -> SetSamples:
    """The samples of a view as loaded: with its mask, its exposures, and rays through a filter before the lens.

    Raises:
        PolarguideError: its known pictures do not determine Stokes vectors.
    """
    places = known_places(view.name, view.exposures)
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
    """The note about pictures that a fit cannot use."""
    return (f"{count} pictures without a known angle are not used.",) if count else ()


def stated_of_shot(paths: Sequence[Path]) -> tuple[list[float], list[str]]:
    """The relative exposures that the files of a single shot state, else ones; and notes for the user."""
    stated, missing = stated_exposures({"": paths})
    if not stated:
        return [1.0] * len(paths), [missing] if missing else []
    exposures = stated[""]
    factor = max(exposures) / min(exposures)
    return exposures, [f"The files state exposures that differ by a factor of {factor:.3g}; corrected."]
