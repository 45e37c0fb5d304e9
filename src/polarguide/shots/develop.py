"""From the files of a shot to linear intensities at four angles, and what is wrong with each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from polarguide.capture import checks
from polarguide.capture.calibration import UNIT_GAINS, oriented, pair_ratio
from polarguide.capture.exposures import FOUR, analyzers
from polarguide.capture.filter.develop import (
    align_shots,
    decide_transfer,
    estimate_shifts,
    linear_intensities,
    require_known_encoding,
)
from polarguide.capture.filter.exif import apply_orientation, orientation_calibration
from polarguide.capture.filter.shots import Shots, read_shots, require_four_shots, stacked
from polarguide.capture.formats.pictures import is_lossy
from polarguide.capture.layout import KEPT, READ, find_layout, require_memory_of_each, select_views
from polarguide.capture.sensor.pattern import Levels
from polarguide.capture.view import ANGLES, FULL_CODE, View
from polarguide.capture.view_reader import ViewData, read_view
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_file
from polarguide.preparation.shot_exposures import corrected_note, exposures_of_view, stated_exposures
from polarguide.shots.exposures import ExposureSet
from polarguide.shots.maps import Developed, Map, Mask, Part, estimated_noise, gains_of, given_noise
from polarguide.shots.mosaic import calibration_of, develop_mosaic
from polarguide.shots.options import ShotOptions
from polarguide.shots.samples import (
    SetSamples,
    levels_of_shot,
    read_set,
    samples_of_arrays,
    samples_of_loaded,
    samples_of_view,
)
from polarguide.shots.sets import known_places

_MAPS = 4 * (4 * 3 + 3 + 5)
"""Bytes for each pixel of the intensities and of what is derived from them first, all at once."""


def develop(shot: ExposureSet, options: ShotOptions, part: Part | None = None) -> Developed:
    """Read the files of a shot; of a mosaic, develop at least ``part`` of the picture, None: all of it.

    Raises:
        PolarguideError: one is missing, cannot be read, or does not fit the others or the options.
    """
    if shot.fault is not None:
        raise shot.fault
    options.require_kind(shot.kind, shot.name)
    if shot.kind == "mosaic":
        try:
            return develop_mosaic(shot, options, part)
        except PolarguideError as error:
            path = shot.where
            if error.where.startswith(str(path)):
                raise
            # An option or the dark frame does not fit this file; of many, it has to be named.
            where = f"{path} ({error.where})"
            raise PolarguideError(
                where, expected=error.expected, found=error.found, remedy=error.remedy
            ) from error
    return _filter(shot, options) if shot.kind == "filter" else _scene_view(shot, options)


def set_samples(shot: ExposureSet, options: ShotOptions) -> SetSamples | None:
    """The samples of a set, or of a view of a scene at other angles; None of a shot that ``develop`` takes.

    Raises:
        PolarguideError: a file is missing, cannot be read, or does not fit the others or the options.
    """
    if shot.fault is not None:
        raise shot.fault
    options.require_kind(shot.kind, shot.name)
    if shot.kind == "set" and shot.stored is not None:
        return samples_of_arrays(shot.name, shot.stored, shot.angles, options)
    if shot.kind == "set":
        return read_set(shot.name, shot.pictures, options)
    if shot.kind != "scene" or shot.files:
        return None
    data, scale = _read_view(shot, options)
    return samples_of_view(data, scale, options)


def check_files(options: ShotOptions) -> None:
    """Check once, before many shots, the files that all of them are developed with.

    Raises:
        PolarguideError: there is none, or the calibration is damaged or of another sensor.
    """
    if options.dark_frame is not None:
        require_file(options.dark_frame, expected="a dark frame", remedy="Check --dark-frame.")
    if options.analyzers is not None:
        calibration_of(options.analyzers).require_sensor(options.sensor, options.analyzers)


def _four(shot: ExposureSet, levels: Levels | None = None) -> Shots:
    """The four pictures of a shot, of its files or in memory."""
    return (
        read_shots(shot.files, levels=levels) if shot.stored is None else stacked(shot.stored, levels=levels)
    )


def _filter(shot: ExposureSet, options: ShotOptions) -> Developed:
    if shot.stored is None:
        require_four_shots(shot.paths[0].parent, {shot.name: shot.files})
    paths = [shot.files[angle] for angle in ANGLES] if shot.stored is None else []
    shots = _four(shot)
    levels, notes = levels_of_shot(shots.pictures, 8 * shots.pictures.dtype.itemsize, options)
    if levels is not None:
        shots = _four(shot, levels)
    transfer: str = options.transfer
    if transfer == "auto":
        if paths:
            require_known_encoding(paths[0])
        decision = decide_transfer([shots], lossy=bool(paths) and is_lossy(paths[0]))
        transfer = decision.transfer
        notes += [f"Transfer {decision.reason}.", *filter(None, [decision.doubt])]
    linear = linear_intensities(shots.pictures, transfer)
    lsb = 1 / float(np.iinfo(shots.pictures.dtype).max if levels is None else levels.white)
    clipped, dark = shots.clipped, shots.dark
    if options.align:
        shifts = estimate_shifts(linear)
        linear, clipped = align_shots(linear, clipped, shifts)
        moved = [
            f"{angle} by ({-shift.x:+.2f}, {-shift.y:+.2f})"
            for angle, shift in zip(ANGLES, shifts, strict=True)
            if shift.corrected
        ]
        notes += [f"Shots moved, in pixels: {', '.join(moved)}."] if moved else []
    saturated = np.asarray(clipped.any(axis=0))
    stated = stated_exposures({shot.name: paths}).get(shot.name) if paths else None
    exposed = np.asarray(stated or UNIT_GAINS)
    notes += [corrected_note(stated)] if stated else []
    if options.gains == "auto" and options.calibration.gains is None:
        measured = exposures_of_view(
            _labels(paths), linear.mean(axis=3), ~(saturated | dark), exposed.tolist()
        )
        exposed = np.asarray(measured.gains)
        notes += [f"Shots {measured.warning}"] if measured.warning else []
    if (exposed != 1.0).any():
        linear = linear / exposed.astype(np.float32)[:, None, None, None]
    gray = linear.mean(axis=3)
    ratio = pair_ratio(gray, ~(saturated | dark))
    gains, said = gains_of(ratio, options)
    if gains != UNIT_GAINS:
        linear = linear / np.asarray(gains, np.float32)[:, None, None, None]
        gray = linear.mean(axis=3)
    noise = given_noise(options, lsb)
    # The luminance is the mean of three samples, whose noise is independent but in gray files, where they are copies.
    samples = 1 if (shots.pictures[..., :1] == shots.pictures).all() else 3
    factor = 1.0 if noise is None else 1 / samples
    noise = noise or estimated_noise(gray, ~(saturated | dark), lsb / samples**0.5)
    turned = np.stack(
        [apply_orientation(p, shots.orientation) for p in oriented(linear, options.calibration)]
    )
    upright = oriented(turned, orientation_calibration(shots.orientation))
    return Developed(
        intensities=np.ascontiguousarray(upright),
        dark=np.ascontiguousarray(apply_orientation(dark, shots.orientation)),
        saturated=np.ascontiguousarray(apply_orientation(saturated, shots.orientation)),
        masked=np.zeros(upright.shape[1:3], bool),
        noise=noise,
        factors=np.full((4, 1, 1), factor, np.float32),
        mean_variance=factor,
        pair_ratio=ratio,
        notes=(*notes, *said),
    )


def _labels(paths: Sequence[Path]) -> list[str]:
    """What messages call four shots."""
    return [path.name for path in paths] or [f"picture {number}" for number in range(1, len(ANGLES) + 1)]


def _scene_view(shot: ExposureSet, options: ShotOptions) -> Developed:
    data, scale = _read_view(shot, options)
    largest = int(np.iinfo(data.peak.dtype).max)
    intensities = oriented(data.codes.astype(np.float32) / np.float32(FULL_CODE), options.calibration)
    saturated = np.zeros(data.black.shape, bool) if scale is None else np.asarray(data.peak >= scale)
    masks = data.black, saturated, data.invalid, data.mask
    return _undistorted(intensities, masks, 1 / largest, options)


def _read_view(shot: ExposureSet, options: ShotOptions) -> tuple[ViewData, int | None]:
    """A view of a scene, and the stored value at which it saturates; None where it does not."""
    assert shot.root is not None
    layout = find_layout(shot.root)
    select_views(layout, [shot.view])
    require_memory_of_each(
        shot.paths,
        max(1, len(shot.paths) // 4) * (KEPT + READ) + _MAPS,
        "a view",
        remedy="Free memory, or prepare the scene in a smaller size.",
    )
    transfer = "srgb" if options.transfer == "srgb" else "linear"
    data = read_view(layout, shot.view, factor=1, transfer=transfer)
    return data, checks.full_scale(data.histogram, int(np.iinfo(data.peak.dtype).max))


def develop_view(view: View, options: ShotOptions) -> Developed:
    """The intensities of a view of a scene at 0, 45, 90 and 135 degrees, as its ``codes`` and masks are."""
    intensities = view.intensities()
    if view.mount == "filter":  # what a sensor with analyzers behind the lens would have measured
        rays, stokes = view.camera.rays(), view.stokes()
        turned = analyzers(FOUR, rays, "sensor")[..., None, None] - analyzers(FOUR, rays, "filter")
        intensities = intensities + torch.einsum("ksyx,syxc->kyxc", turned, stokes[1:]) / 2
    dark, lost, step = _state_of(view)
    masks = dark, lost, view.invalid.numpy(), None if view.mask is None else view.mask.numpy()
    return _undistorted(intensities.numpy(), masks, step, options)


def samples_of(view: View) -> SetSamples:
    """The samples of a view of a scene at other angles.

    Raises:
        PolarguideError: its pictures do not determine Stokes vectors.
    """
    known_places(view.name, view.exposures)
    return samples_of_loaded(view, *_state_of(view))


def _state_of(view: View) -> tuple[Mask, Mask, float]:
    """Dark and saturated pixels of a view, and one stored value as a share of full scale."""
    codes = view.codes.numpy()
    peak, lost = codes.max(axis=(0, 3)), view.saturated.numpy()
    # Of pixels without polarization information, those nearer to black than to the brightest of the view are dark.
    dark = (lost & (peak < peak.max() / 2)) | (peak == 0)
    # Codes are multiples of what one stored value is, unless they were decoded or averaged.
    step = int(np.gcd.reduce(np.flatnonzero(np.bincount(codes.ravel()))))
    return dark, lost & ~dark, max(step, 1) / FULL_CODE


def _undistorted(
    intensities: Map, masks: tuple[Mask, Mask, Mask, Mask | None], lsb: float, options: ShotOptions
) -> Developed:
    """A picture of a scene, whose samples are its pixels. masks: dark, saturated, invalid, foreground."""
    dark, saturated, invalid, foreground = masks
    gray = intensities.mean(axis=3)
    good = ~(saturated | dark | invalid)
    noise = given_noise(options, lsb) or estimated_noise(gray, good, lsb)
    return Developed(
        intensities=intensities,
        dark=dark,
        saturated=saturated,
        masked=invalid if foreground is None else invalid | ~foreground,
        noise=noise,
        factors=np.ones((4, 1, 1), np.float32),
        mean_variance=1.0,
        pair_ratio=pair_ratio(gray, good),
        notes=(),
    )
