"""``calibrate_sensor``: shots of a polarizer -> a file of analyzer vectors, and a picture of what they are like."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.sensor.analyzers import (
    FARTHEST_ANGLE,
    LEAST_DIATTENUATION,
    SUFFIX,
    AnalyzerCalibration,
    grid_shape,
    write_analyzers,
)
from polarguide.capture.sensor.pattern import Pattern, tiled
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder
from polarguide.core.progress import SILENT, Reporter
from polarguide.visualization.figures import write_png
from polarguide_shots.calibration.report import Position, calibration_picture, lines, positions
from polarguide_shots.calibration.settings import CalibrateSettings
from polarguide_shots.calibration.shots import ShotMeans, Shots
from polarguide_shots.calibration.solve import ShotFit, solve_shots

BLOCK = 32
"""Side of a block in pixels, where it is not given."""
NEIGHBORHOOD = 31
"""Cells of one color, each way, whose mean brightness is that of a uniform light at the middle one."""
LEAST_THROUGHPUT = 0.5
"""A polarizer with less throughput is a defect of the sensor."""
MOST_THROUGHPUT = 1.5
"""A polarizer with more throughput is a defect of the sensor."""
MOST_DIATTENUATION = 1.3
"""A polarizer with more diattenuation is a defect of the sensor."""

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class AnalyzerFit:
    """Analyzer vectors of single pixels.

    Attributes:
        vectors: [H, W, 3]; around each pixel, the mean of the first components of its color is 1/2.
        noise: variance of a vector by the deviations of its shots: sum over components, mean over pixels.
        defects: pixels without a plausible polarizer, [H, W].
    """

    vectors: Array
    noise: float
    defects: NDArray[np.bool_]


@dataclass(frozen=True)
class BlockChoice:
    """Whether pixels get vectors of their own.

    Attributes:
        block: side in pixels of what shares a vector; the pattern's period for single pixels.
        noise: standard deviation of a single pixel's vector by noise, as a share of its throughput.
        scatter: the same of what really differs between the pixels of a block.
    """

    block: int
    noise: float
    scatter: float


def fit_pixels(
    shots: Iterable[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    light: NDArray[np.float64],
    pattern: Pattern,
) -> AnalyzerFit:
    """Fit the vector of each pixel.

    Args:
        shots: linear intensities [H, W] of each shot, and whether they are saturated.
        light: Stokes vectors of the shots, [T, 3].
        pattern: pattern of the region.
    """
    moments: Any = None
    for (values, clipped), stokes in zip(shots, light, strict=True):
        if moments is None:
            moments = np.zeros((3, *values.shape))
            squares = np.zeros(values.shape)
            saturated = np.zeros(values.shape, bool)
        moments += stokes[:, None, None] * values
        squares += np.square(values, dtype=np.float64)
        saturated |= clipped
    normal = np.linalg.inv(light.T @ light)
    vectors = np.einsum("ij,jhw->ihw", normal, moments)
    rest = np.maximum(squares - np.einsum("ihw,ihw->hw", vectors, moments), 0.0)
    variance = rest / max(1, len(light) - 3)
    level = _brightness(2 * vectors[0], pattern)
    vectors /= level
    defects = saturated | ~plausible(
        np.moveaxis(vectors, 0, -1), np.radians(tiled(pattern.angles, squares.shape))
    )
    sound = ~defects
    noise = float(np.mean((variance / level**2)[sound]) * np.trace(normal)) if sound.any() else 0.0
    return AnalyzerFit(np.ascontiguousarray(np.moveaxis(vectors, 0, -1), np.float32), noise, defects)


def plausible(vectors: Any, nominal: Any) -> NDArray[np.bool_]:
    """Whether vectors [..., 3] are those of polarizers near their nominal angles (radians, broadcastable to [...])."""
    gain = 2 * vectors[..., 0]
    strength = 2 * np.hypot(vectors[..., 1], vectors[..., 2])
    cosine = vectors[..., 1] * np.cos(2 * nominal) + vectors[..., 2] * np.sin(2 * nominal)
    return np.asarray(
        (gain > LEAST_THROUGHPUT)
        & (gain < MOST_THROUGHPUT)
        & (strength > LEAST_DIATTENUATION * gain)
        & (strength < MOST_DIATTENUATION * gain)
        & (2 * cosine > strength * np.cos(2 * FARTHEST_ANGLE))
    )


def choose_block(
    pixels: AnalyzerFit, offset: tuple[int, int], pattern: Pattern, specified: int | None
) -> BlockChoice:
    """Choose what shares a vector: single pixels where their noise is less than what their mean over a block hides."""
    around = _neighborhoods(pixels, offset, pattern)
    deviation = (pixels.vectors - around).astype(np.float64)
    deviation[pixels.defects] = 0.0
    # What is common to the pixels of a cell changes its brightness, not its polarization.
    left, top = pattern.cell_corner()
    height, width = (
        (length - cut) // 2 for length, cut in zip(pixels.defects.shape, (top, left), strict=True)
    )
    inside = (slice(top, top + 2 * height), slice(left, left + 2 * width))
    common = (2 * deviation[inside][..., 0]).reshape(height, 2, width, 2).mean(axis=(1, 3))
    deviation[inside] -= np.repeat(np.repeat(common, 2, axis=0), 2, axis=1)[..., None] * around[inside]
    sound = ~pixels.defects
    spread = float((deviation[sound] ** 2).sum(axis=1).mean()) if sound.any() else 0.0
    scatter = max(0.0, spread - pixels.noise)
    block = specified or (BLOCK if scatter <= pixels.noise else pattern.period)
    return BlockChoice(max(block, pattern.period), 2 * pixels.noise**0.5, 2 * scatter**0.5)


def shared(pixels: AnalyzerFit, offset: tuple[int, int], block: int, pattern: Pattern) -> Array:
    """The vectors that go into the file: means over blocks, in which defects have no part.

    Where each pixel has its own, a defect gets the mean of its neighborhood.

    Args:
        pixels: the single vectors. offset: column and row of the sensor at which they start. block: side in pixels.
        pattern: pattern of the region.

    Returns:
        [rows, columns, P, P, 3] as in ``AnalyzerCalibration.vectors``.
    """
    if block > pattern.period:
        return block_means(pixels, offset, block, pattern)
    around = _neighborhoods(pixels, offset, pattern)
    vectors = np.where(pixels.defects[..., None], around, pixels.vectors)
    return block_means(
        replace(pixels, vectors=vectors, defects=np.zeros_like(pixels.defects)), offset, block, pattern
    )


def block_means(pixels: AnalyzerFit, offset: tuple[int, int], block: int, pattern: Pattern) -> Array:
    """Mean vectors of blocks by place in the pattern; the mean over the sensor where no pixel is sound."""
    height, width, _ = pixels.vectors.shape
    period = pattern.period
    rows, columns = grid_shape(offset, (width, height), block)
    out = np.zeros((rows, columns, period, period, 3))
    for row, column in np.ndindex(period, period):
        part = pixels.vectors[row::period, column::period]
        sound = ~pixels.defects[row::period, column::period]
        y = (np.arange(row, height, period) + offset[1]) // block - offset[1] // block
        x = (np.arange(column, width, period) + offset[0]) // block - offset[0] // block
        where = (y[:, None] * columns + x)[sound]
        count = np.bincount(where, minlength=rows * columns)
        sums = [np.bincount(where, part[..., k][sound], rows * columns) for k in range(3)]
        means = np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]
        means[count == 0] = part[sound].mean(axis=0, dtype=np.float64)
        out[:, :, (row + offset[1]) % period, (column + offset[0]) % period] = means.reshape(rows, columns, 3)
    return out.astype(np.float32)


def _neighborhoods(pixels: AnalyzerFit, offset: tuple[int, int], pattern: Pattern) -> Array:
    """The mean vector of the block around each pixel, [H, W, 3]."""
    means = block_means(pixels, offset, BLOCK, pattern)
    y = np.arange(pixels.vectors.shape[0]) + offset[1]
    x = np.arange(pixels.vectors.shape[1]) + offset[0]
    rows = y // BLOCK - offset[1] // BLOCK
    columns = x // BLOCK - offset[0] // BLOCK
    period = pattern.period
    return np.asarray(means[rows[:, None], columns, (y % period)[:, None], x % period])


def _brightness(throughput: NDArray[np.float64], pattern: Pattern) -> NDArray[np.float64]:
    """Relative illumination of each pixel, [H, W]: a smooth surface fitted to the brightness of its color.

    It is smooth, and a plane over a cell, so that a light that is not quite uniform does not look like polarization.

    Args:
        throughput: [H, W]. pattern: pattern of the region.
    """
    left, top = pattern.cell_corner()
    height, width = ((length - cut) // 2 for length, cut in zip(throughput.shape, (top, left), strict=True))
    inner = throughput[top : top + 2 * height, left : left + 2 * width]
    cells = inner.reshape(height, 2, width, 2).mean(axis=(1, 3))
    if pattern.colors is None:
        return _at_places(_smooth(cells, NEIGHBORHOOD), (left, top), 2, throughput.shape)
    out = np.empty_like(throughput)
    for row, column in np.ndindex(2, 2):
        plane = _smooth(cells[row::2, column::2], NEIGHBORHOOD // 2)
        surface = _at_places(plane, (left + 2 * column, top + 2 * row), 4, out.shape)
        # Pixels beyond the first and last whole cell belong to a cell of this color, too: places repeat every 4.
        own = np.ix_(
            (np.arange(out.shape[0]) - top) // 2 % 2 == row,
            (np.arange(out.shape[1]) - left) // 2 % 2 == column,
        )
        out[own] = surface[own]
    return out


def _at_places(
    cells: NDArray[np.float64], corner: tuple[int, int], step: int, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """A surface of cells, 2x2 pixels that lie ``step`` apart from a corner on, interpolated at all pixels."""
    x = ((np.arange(shape[1]) - corner[0] - 0.5) / step).astype(np.float32)
    y = ((np.arange(shape[0]) - corner[1] - 0.5) / step).astype(np.float32)
    surface = cv2.remap(cells, *np.meshgrid(x, y), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(surface, np.float64)


def _smooth(values: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """The plane of least squares through the square around each value, at its middle; smaller squares at the edges."""
    y, x = np.mgrid[: values.shape[0], : values.shape[1]].astype(np.float64)

    def box(plane: NDArray[np.float64]) -> NDArray[np.float64]:
        plane = np.ascontiguousarray(plane)
        return np.asarray(
            cv2.boxFilter(plane, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    count = box(np.ones_like(values))
    right = box(x) / count - x
    below = box(y) / count - y
    mean = box(values) / count
    # Squares are products of intervals: x and y are not correlated in them.
    spread_x = box(x * x) / count - (box(x) / count) ** 2
    spread_y = box(y * y) / count - (box(y) / count) ** 2
    slope_x = (box(values * x) / count - mean * (box(x) / count)) / np.maximum(spread_x, 1e-9)
    slope_y = (box(values * y) / count - mean * (box(y) / count)) / np.maximum(spread_y, 1e-9)
    return np.asarray(mean - slope_x * right - slope_y * below)


MOST_DEFECTS = 0.05
"""Share of pixels without a plausible polarizer from which on the fault is not the sensor's."""
DOUBTFUL = 0.005
"""Misfit, and DoLP of a flat field, above which a warning is due: DoLP will be wrong by about as much."""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The outcome of a calibration.

    Attributes:
        path: the file. picture: the PNG beside it.
        calibration: what the file holds. positions: what it is like.
        shots: angles and levels of the shots. choice: what shares a vector, and why.
        defects: number of pixels without a plausible polarizer, which got the vector of their block.
    """

    path: Path
    picture: Path
    calibration: AnalyzerCalibration
    positions: list[Position]
    shots: ShotFit
    choice: BlockChoice
    defects: int


def calibrate_sensor(
    source: Path, out: Path, settings: CalibrateSettings, reporter: Reporter = SILENT
) -> Calibrated:
    """Estimate the analyzer vectors of a sensor (superpixel calibration, Powell and Gruev 2013).

    Angles and levels of the shots are found first, from means over the sensor; then every pixel's vector by linear
    least squares from its own intensities. A common factor of all pixels around one (the light, the lens's fall-off) is
    not part of the vectors.

    Args:
        source: folder of mosaics of a linear polarizer before a uniform light, at five or more angles.
        out: file to write, ``.safetensors``; a picture of the same name goes beside it.
        settings: how the shots were taken. reporter: told how far it is, and the findings.

    Raises:
        PolarguideError: a file or setting cannot be used, the shots contradict each other, or ``out`` exists.
    """
    settings = settings.checked()
    _require_new(out)
    files = Shots(Path(source), settings)
    _require_apart(out, Path(source), settings)
    known = settings.known_angles(files.files)
    reference = settings.reference or ("mean" if known is None else "angles")
    ratio = settings.polarizer_extinction
    diattenuation = 1.0 if ratio is None else (ratio - 1.0) / (ratio + 1.0)
    measured = files.measure(reporter)
    fit = solve_shots(
        measured.means,
        np.radians(files.pattern.angles.ravel().astype(np.float64)),
        known=known,
        flat=measured.flat,
        diattenuation=diattenuation,
        to_mean=reference == "mean",
        files=files.files,
    )
    _say_shots(fit, settings, measured, reporter)
    light = fit.stokes(diattenuation)
    pixels = fit_pixels(files.linear(measured.levels, reporter), light, files.pattern)
    defects = int(pixels.defects.sum())
    if defects > MOST_DEFECTS * pixels.defects.size:
        raise PolarguideError(
            source,
            expected="polarizers near the angles of the sensor's pattern at nearly all pixels",
            found=f"other angles at {defects / pixels.defects.size:.0%} of the pixels",
            remedy="Check --sensor, --offset-x and --offset-y, and that the polarizer covers the whole field.",
        )
    choice = choose_block(pixels, settings.offset, files.pattern, settings.block)
    vectors = shared(pixels, settings.offset, choice.block, files.pattern)
    calibration = AnalyzerCalibration(
        settings.sensor, settings.lens, settings.offset, files.size, choice.block, vectors, reference, ratio
    )  # fmt: skip
    make_folder(out.parent)
    analyzers = positions(calibration)
    calibration = replace(calibration, sha256=write_analyzers(out, calibration))
    picture = out.with_suffix(".png")
    write_png(picture, calibration_picture(calibration, analyzers, fit, measured.means, files.pattern))
    _say_choice(choice, settings, files, defects, reporter)
    for line in lines(calibration, analyzers):
        reporter.say(line)
    return Calibrated(out, picture, calibration, analyzers, fit, choice, defects)


def _require_apart(out: Path, shots: Path, settings: CalibrateSettings) -> None:
    """Refuse to write the picture among those that are read: the next call would take it for a shot."""
    for folder in (shots, settings.flat, settings.dark_frame):
        if folder is not None and folder.is_dir() and folder.resolve() == out.parent.resolve():
            raise PolarguideError(
                out,
                expected=f"a place outside of {folder}",
                found="the folder of the shots, where the picture would count as a shot",
                remedy="Give another --out; nothing was written.",
            )


def _require_new(out: Path) -> None:
    if out.suffix.lower() != SUFFIX:
        raise PolarguideError(
            "--out",
            expected=f"a file name that ends in {SUFFIX}",
            found=out.name,
            remedy=f"End the name in {SUFFIX}.",
        )
    for path in (out, out.with_suffix(".png")):
        if path.exists() or path.is_symlink():
            raise PolarguideError(
                path,
                expected="a new file",
                found="an existing file",
                remedy="Give another --out, or remove it; nothing was written.",
            )


def _say_shots(fit: ShotFit, settings: CalibrateSettings, measured: ShotMeans, reporter: Reporter) -> None:
    """Report of the estimates from the shots, and of quantities that the shots do not determine."""
    angles = ", ".join(f"{angle:.1f}" for angle in np.degrees(fit.angles))
    reporter.say(
        f"{len(fit.angles)} shots, polarizer at {angles} degrees; misfit {fit.misfit:.2%} of their mean."
    )
    if settings.angles is not None:
        drift = f"{fit.levels.max() / fit.levels.min() - 1:.1%}"
        reporter.say(f"The light behind the polarizer varied by {drift}; corrected.")
        if settings.reference == "mean":
            zero = np.degrees(-fit.zero)
            reporter.say(f"The zero of the angles given lay {zero:+.2f} degrees off the sensor's mean.")
    else:
        reporter.say(
            "Angles were estimated. The shots do not tell their zero: the positions' mean deviation from their names "
            "is taken as zero."
        )
        if measured.flat is None:
            reporter.say(
                "Without --angles and --flat, the light is taken as steady and unpolarized: what it is not would look "
                "like an error of the sensor."
            )
    if settings.polarizer_extinction is None:
        reporter.say(
            "The polarizer is taken as ideal: extinction ratios are those of polarizer and sensor together "
            "(--polarizer-extinction)."
        )
    if fit.misfit > DOUBTFUL:
        reporter.warn(f"The shots disagree by {fit.misfit:.2%}: the calibration can be no better.")
    if fit.flat_dolp is not None and settings.angles is not None:
        reporter.say(f"The flat field, which had no part in this, has a DoLP of {fit.flat_dolp:.3f} with it.")
        if fit.flat_dolp > DOUBTFUL:
            reporter.warn("The flat field, or the light behind the polarizer, is not unpolarized.")


def _say_choice(
    choice: BlockChoice, settings: CalibrateSettings, files: Shots, defects: int, reporter: Reporter
) -> None:
    own = choice.block == files.pattern.period
    reporter.say(
        f"Pixels of a block differ by {choice.scatter:.2%}, the noise of one pixel's vector is {choice.noise:.2%}: "
        f"{'each pixel has its own' if own else f'blocks of {choice.block} pixels share vectors'}"
        f"{'' if settings.block is None else ' (as asked)'}."
    )
    if own and choice.noise > choice.scatter:
        reporter.warn(
            "Pixels differ by less than their noise: a calibration of single pixels is less accurate than one of "
            "blocks. Take more shots, or leave --block out."
        )
    if defects:
        reporter.say(
            f"{defects} pixels have no plausible polarizer, and got the vector of their neighborhood."
        )
