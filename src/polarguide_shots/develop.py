"""From the files of a shot, a raw mosaic or pictures, to linear intensities at four angles, and what is wrong there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from polarguide.capture import checks
from polarguide.capture.calibration import UNIT_GAINS, oriented, pair_ratio
from polarguide.capture.develop import (
    LinearShots,
    MosaicFiles,
    as_displayed,
    calibration_of,
    levels_of_shot,
    pair_gains,
    sample_blocks,
)
from polarguide.capture.exposures import FOUR
from polarguide.capture.filter.camera_files import apply_orientation
from polarguide.capture.filter.develop import moved_shots
from polarguide.capture.filter.encoding import transfer_of_pictures
from polarguide.capture.filter.shots import _READ, Shots, read_stack, require_four_shots, stacked
from polarguide.capture.layout import (
    KEPT,
    READ,
    find_layout,
    require_memory_of_each,
    select_views,
)
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic, spoiled
from polarguide.capture.sensor.pattern import (
    SIDE,
    Levels,
    require_kind,
    unusable_samples,
)
from polarguide.capture.view import ANGLES, FULL_CODE, View
from polarguide.capture.view_reader import ViewData, read_view
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_file
from polarguide_shots.maps import (
    Developed,
    Map,
    Mask,
    Part,
    estimated_noise,
    given_noise,
    interpolation_factors,
)
from polarguide_shots.options import ShotOptions
from polarguide_shots.samples import (
    SetSamples,
    behind_lens,
    read_set,
    samples_of_arrays,
    samples_of_view,
    state_of,
    stated_of_shot,
)
from polarguide_shots.sets import ExposureSet

AROUND = 32
"""Pixels around a part that are developed with it: more than any interpolation reaches."""


_GAINS = {
    "off": "I0 + I90 is {:+.2%} off I45 + I135: the angles or the encoding are probably wrong.",
    "corrected": "I0 + I90 is {:+.2%} off I45 + I135; corrected.",
    "left": "I0 + I90 is {:+.2%} off I45 + I135; not corrected (--gains auto does, a calibration does better).",
}


def develop_mosaic(shot: ExposureSet, options: ShotOptions, part: Part | None) -> Developed:
    files = MosaicFiles(options)
    stored = files.read(shot.where, shot.stored)
    pattern = files.pattern
    dark = files.dark(stored.shape)
    values = files.cut(stored)
    container = 8 * stored.dtype.itemsize
    full = None
    if shot.stored is None:
        container, full = files.depth(shot.files[0], stored)
    levels, notes = levels_of_shot(
        stored, container, options, bits=options.bits, black=options.black_level, stated=full
    )
    levels = replace(levels, gamma=options.gamma)
    assert options.sensor is not None
    require_kind(options.sensor, sample_blocks(values, SIDE), levels)
    ratio, _ = files.light_of_blocks([sample_blocks(values, 2 * pattern.period)], levels, dark, values.shape)
    gains, gain_notes = pair_gains(ratio, options, _GAINS, calibrated=files.analyzers is not None)
    mode = options.demosaic
    way = options.interpolation
    step = DEMOSAIC_MODES[mode]
    x, y = files.corner
    cut = _cut(part, values.shape, step)
    whole = (values.shape[1] // step, values.shape[0] // step) if cut is not None else None
    if cut is not None:  # what is judged of the shot as a whole is judged
        values = np.ascontiguousarray(values[cut])
        dark = None if dark is None else dark[cut]
        x = x + cut[1].start
        y = y + cut[0].start
    saturated, black = unusable_samples(values, levels, dark)
    defective = defects([np.minimum(values, levels.white)], pattern.period)
    notes += [defects_note(int(defective.sum()), values.size)] if defective.any() else []
    linear, masks = files.linear(values, levels, dark, saturated, black, defective, corner=(x, y))
    saturated, black, defective = masks
    if gains != UNIT_GAINS:
        linear *= files.sample_factors(linear.shape, gains)
    lsb = 1 / (levels.white - levels.black)
    noise = given_noise(options, lsb)
    if noise is None:
        cells = {int(pattern.angles[r, c]): linear[r::2, c::2] for r, c in np.ndindex(2, 2)}
        bad = saturated | black | defective
        good = ~(bad[::2, ::2] | bad[1::2, ::2] | bad[::2, 1::2] | bad[1::2, 1::2])
        noise = estimated_noise([cells[angle] for angle in ANGLES], good, lsb)
    picture = demosaic(linear, saturated, pattern, mode=mode, interpolation=way, colored=False)
    dark_pixels, masked = (
        spoiled(samples, pattern, mode=mode, interpolation=way) for samples in (black, defective)
    )
    factors, averaged = interpolation_factors(options.sensor, x, y, mode)
    turned = np.broadcast_to(factors.mean(axis=0), factors.shape)  # one that mixes all four angles
    return Developed(
        intensities=oriented(picture.intensities, options.calibration),
        dark=dark_pixels,
        saturated=picture.invalid,
        masked=masked,
        noise=noise,
        factors=oriented(factors, options.calibration) if options.calibration.permutes else turned,
        mean_variance=averaged,
        pair_ratio=ratio,
        notes=(*notes, *gain_notes),
        origin=(0, 0) if cut is None else (cut[1].start // step, cut[0].start // step),
        whole=whole,
    )


def _cut(part: Part | None, shape: tuple[int, ...], step: int) -> tuple[slice, slice] | None:
    """The samples of a mosaic that a part of its picture needs: whole superpixels, with ``AROUND`` around them.

    Args:
        part: part of the picture. shape: shape of the mosaic, rows and columns. step: samples of a pixel, each way.

    Returns:
        Rows and columns; None for all, where hardly any would be left out.
    """
    if part is None:
        return None
    ends = []
    for begin, length, most in ((part[1], part[3], shape[0]), (part[0], part[2], shape[1])):
        low = max(0, begin * step - AROUND) // 8 * 8
        ends.append(slice(low, max(low, min(most, -(-((begin + length) * step + AROUND) // 8) * 8))))
    rows, columns = ends
    area = (rows.stop - rows.start) * (columns.stop - columns.start)
    return (rows, columns) if 0 < 2 * area <= shape[0] * shape[1] else None


_MAPS = 4 * (4 * 3 + 3 + 5)
"""Bytes for each pixel of the intensities and of what is derived from them first, all at once."""


def develop(shot: ExposureSet, options: ShotOptions, part: Part | None = None) -> Developed:
    """Read the files of a shot; of a mosaic, develop at least ``part`` of the picture, None: all of it.

    Raises:
        PolarguideError: one is missing, cannot be read, or does not fit the others or the options.
    """
    if shot.kind == "mosaic":
        try:
            return develop_mosaic(shot, options, part)
        except PolarguideError as error:
            path = shot.where
            if error.where.startswith(str(path)):
                raise
            # An option or the dark frame does not fit this file; of many, it has to be named.
            raise PolarguideError(
                f"{path} ({error.where})", expected=error.expected, found=error.found, remedy=error.remedy
            ) from error
    if shot.kind == "filter":
        return _filter(shot, options)
    data, scale = _read_view(shot, options)
    return _undistorted(
        oriented(data.codes.astype(np.float32) / np.float32(FULL_CODE), options.calibration),
        data.black,
        np.zeros(data.black.shape, bool) if scale is None else np.asarray(data.peak >= scale),
        data.invalid,
        data.mask,
        1 / int(np.iinfo(data.peak.dtype).max),
        options,
    )


def set_samples(shot: ExposureSet, options: ShotOptions) -> SetSamples | None:
    """Samples of a view at any polarizer angles; None for four angles or a mosaic, which ``develop`` reads.

    Raises:
        PolarguideError: a file is missing, cannot be read, or does not fit the others or the options.
    """
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
    calibration_of(options)


def _four(shot: ExposureSet, levels: Levels | None = None) -> Shots:
    """The four pictures of a shot, of its files or in memory.

    Raises:
        PolarguideError: a file cannot be read, or they differ in size, depth or orientation.
    """
    if shot.stored is not None:
        return stacked(shot.stored, levels=levels)
    require_memory_of_each(
        list(shot.files.values()),
        _READ,
        "four shots",
        remedy="Make the pictures smaller, all by the same factor.",
    )
    return read_stack([shot.files[angle] for angle in ANGLES], levels=levels)


def _filter(shot: ExposureSet, options: ShotOptions) -> Developed:
    if shot.stored is None:
        require_four_shots(shot.paths[0].parent, {shot.name: shot.files})
    paths = [shot.files[angle] for angle in ANGLES] if shot.stored is None else []
    shots = _four(shot)
    container = 8 * shots.pictures.dtype.itemsize
    levels, notes = levels_of_shot(shots.pictures, container, options, bits=options.bits or container)
    if not levels.is_full(container):
        shots = _four(shot, levels)
    decision = transfer_of_pictures(paths, options.transfer, lambda: [(shots, ANGLES)])
    notes += [decision.note, *filter(None, [decision.doubt])]
    linear = LinearShots.of(shots, decision.transfer, align=options.align)
    moved = moved_shots(linear.shifts)
    notes += [f"Shots moved, in pixels: {', '.join(moved)}."] if moved else []
    stated: Sequence[float] = UNIT_GAINS
    if options.gains != "none" and paths:
        stated, corrected = stated_of_shot(paths)
        notes += corrected
    labels = [path.name for path in paths] or [f"picture {number}" for number in (1, 2, 3, 4)]
    intensities, _, warning = linear.evenly_exposed(labels, stated, options)
    notes += [f"Shots {warning}"] if warning else []
    usable = ~linear.invalid
    ratio = pair_ratio(intensities.mean(axis=3), usable)
    gains, gain_notes = pair_gains(ratio, options, _GAINS)
    intensities = intensities / np.asarray(gains, np.float32)[:, None, None, None]
    lsb = 1 / float(levels.white)
    noise = given_noise(options, lsb)
    # The luminance is the mean of three samples, whose noise is independent but in gray files, where they are copies.
    samples = 1 if (shots.pictures[..., :1] == shots.pictures).all() else 3
    factor = 1.0 if noise is None else 1 / samples
    noise = noise or estimated_noise(intensities.mean(axis=3), usable, lsb / samples**0.5)
    dark, saturated, outside = (
        np.ascontiguousarray(apply_orientation(mask, shots.orientation))
        for mask in (linear.dark, linear.saturated, linear.outside)
    )
    return Developed(
        intensities=np.ascontiguousarray(as_displayed(intensities, options.calibration, shots.orientation)),
        dark=dark,
        saturated=saturated,
        masked=outside,
        noise=noise,
        factors=np.full((4, 1, 1), factor, np.float32),
        mean_variance=factor,
        pair_ratio=ratio,
        notes=(*notes, *gain_notes),
    )


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
    data = read_view(layout, shot.view, factor=1, transfer="srgb" if options.transfer == "srgb" else "linear")
    return data, checks.full_scale(data.histogram, int(np.iinfo(data.peak.dtype).max))


def develop_view(view: View, options: ShotOptions) -> Developed:
    """The intensities of a view of a scene at 0, 45, 90 and 135 degrees, as its ``codes`` and masks are."""
    intensities = behind_lens(view, view.intensities(), FOUR)
    dark, lost, step = state_of(view)
    return _undistorted(
        intensities.numpy(),
        dark,
        lost,
        view.invalid.numpy(),
        None if view.mask is None else view.mask.numpy(),
        step,
        options,
    )


def _undistorted(
    intensities: Map,
    dark: Mask,
    saturated: Mask,
    invalid: Mask,
    foreground: Mask | None,
    lsb: float,
    options: ShotOptions,
) -> Developed:
    """Return a picture of a scene, whose samples are its pixels."""
    gray = intensities.mean(axis=3)
    good = ~(saturated | dark | invalid)
    return Developed(
        intensities=intensities,
        dark=dark,
        saturated=saturated,
        masked=invalid if foreground is None else invalid | ~foreground,
        noise=given_noise(options, lsb) or estimated_noise(gray, good, lsb),
        factors=np.ones((4, 1, 1), np.float32),
        mean_variance=1.0,
        pair_ratio=pair_ratio(gray, good),
        notes=(),
    )
