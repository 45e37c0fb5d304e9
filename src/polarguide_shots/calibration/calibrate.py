"""Calibrate a polarization sensor with shots of a polarizer.

The result is an analyzer vector for each pixel or block of pixels. It maps a Stokes vector to the measured intensity.
"""

from __future__ import annotations

import os
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
from polarguide.core.errors import require
from polarguide.core.files import make_folder
from polarguide.core.progress import SILENT, Reporter
from polarguide.visualization.figures import write_png
from polarguide_shots.calibration.report import Position, calibration_picture, lines, positions
from polarguide_shots.calibration.settings import CalibrateSettings
from polarguide_shots.calibration.shots import ShotFit, ShotMeans, Shots, solve_shots

BLOCK = 32
"""Default width of the square blocks that share an analyzer vector, in pixels."""
NEIGHBORHOOD = 31
"""Width of the square from which the brightness of the light is estimated, in cells of one color."""
LEAST_THROUGHPUT = 0.5
"""Smallest relative throughput of a polarizer without a defect."""
MOST_THROUGHPUT = 1.5
"""Largest relative throughput of a polarizer without a defect."""
MOST_DIATTENUATION = 1.3
"""Largest diattenuation of a polarizer without a defect."""

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class AnalyzerFit:
    """Analyzer vectors that are fitted to single pixels.

    Attributes:
        vectors: [H, W, 3]. The first components of a color have a local mean of 1/2.
        noise: variance of a vector, estimated from the residuals of its shots. It is summed over components and
            averaged over pixels.
        defects: mask [H, W] of the pixels without a plausible polarizer.
    """

    vectors: Array
    noise: float
    defects: NDArray[np.bool_]


@dataclass(frozen=True)
class BlockChoice:
    """Chosen size of the blocks that share an analyzer vector.

    Attributes:
        block: width of a block in pixels. For single pixels, it is the period of the pattern.
        noise: standard deviation of a pixel's vector because of noise, as a share of its throughput.
        scatter: standard deviation of the true vectors within a block, as a share of their throughput.
    """

    block: int
    noise: float
    scatter: float


def fit_pixels(
    shots: Iterable[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    light: NDArray[np.float64],
    pattern: Pattern,
) -> AnalyzerFit:
    """Fit the analyzer vector of each pixel.

    Args:
        shots: linear intensities [H, W] of each shot, and a mask [H, W] of saturated samples.
        light: Stokes vectors of the shots, [T, 3].
        pattern: pattern of the region.
    """
    moments: Any = 0.0
    squares: Any = 0.0
    saturated: Any = False
    for (values, clipped), stokes in zip(shots, light, strict=True):
        moments = moments + stokes[:, None, None] * values
        squares = squares + np.square(values, dtype=np.float64)
        saturated = saturated | clipped
    normal = np.linalg.inv(light.T @ light)
    vectors = np.einsum("ij,jhw->ihw", normal, moments)
    variance = np.maximum(squares - np.einsum("ihw,ihw->hw", vectors, moments), 0.0) / max(1, len(light) - 3)
    level = _brightness(2 * vectors[0], pattern)
    vectors /= level
    defects = saturated | ~plausible(
        np.moveaxis(vectors, 0, -1), np.radians(tiled(pattern.angles, squares.shape))
    )
    sound = ~defects
    noise = float(np.mean((variance / level**2)[sound]) * np.trace(normal)) if sound.any() else 0.0
    return AnalyzerFit(np.ascontiguousarray(np.moveaxis(vectors, 0, -1), np.float32), noise, defects)


def plausible(vectors: Any, nominal: Any) -> NDArray[np.bool_]:
    """Return a mask of the analyzer vectors that a polarizer without a defect may have.

    Args:
        vectors: analyzer vectors [..., 3].
        nominal: nominal angles of the polarizers in radians.
    """
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
    """Choose the size of the blocks that share an analyzer vector.

    Single pixels are chosen if their noise is less than the scatter of the vectors within a block.

    Args:
        pixels: vectors of single pixels.
        offset: column and row of the first sample in the sensor.
        pattern: pattern of the region.
        specified: width of a block that the user specified, or None.
    """
    around = _neighborhoods(pixels, offset, pattern)
    deviation = (pixels.vectors - around).astype(np.float64)
    deviation[pixels.defects] = 0.0
    # A common deviation of the pixels of a cell changes its brightness, not its polarization.
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
    """Return the analyzer vectors of the calibration file. They are means over blocks, without defective pixels.

    If a block is a single pixel, a defective pixel gets the mean of its neighborhood.

    Args:
        pixels: vectors of single pixels.
        offset: column and row of the first sample in the sensor.
        block: width of a block in pixels.
        pattern: pattern of the region.

    Returns:
        [rows, columns, P, P, 3] as in ``AnalyzerCalibration.vectors``.
    """
    if block <= pattern.period:
        around = _neighborhoods(pixels, offset, pattern)
        vectors = np.where(pixels.defects[..., None], around, pixels.vectors)
        pixels = replace(pixels, vectors=vectors, defects=np.zeros_like(pixels.defects))
    return block_means(pixels, offset, block, pattern)


def block_means(pixels: AnalyzerFit, offset: tuple[int, int], block: int, pattern: Pattern) -> Array:
    """Return the mean vectors of blocks, for each position in the pattern.

    If all pixels of a block are defective, it gets the mean over the sensor. Arguments and result are as in ``shared``.
    """
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
    """Return for each pixel the mean vector of the block that contains it, [H, W, 3]."""
    means = block_means(pixels, offset, BLOCK, pattern)
    y = np.arange(pixels.vectors.shape[0]) + offset[1]
    x = np.arange(pixels.vectors.shape[1]) + offset[0]
    rows = y // BLOCK - offset[1] // BLOCK
    columns = x // BLOCK - offset[0] // BLOCK
    period = pattern.period
    return np.asarray(means[rows[:, None], columns, (y % period)[:, None], x % period])


def _brightness(throughput: NDArray[np.float64], pattern: Pattern) -> NDArray[np.float64]:
    """Fit a smooth surface to the brightness of each color, [H, W].

    The surface is a plane over each cell. Without this fit, an illumination that is not uniform would look like
    polarization.

    Args:
        throughput: throughput of the pixels, [H, W].
        pattern: pattern of the region.
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
        # The period of 4 pixels includes incomplete cells at the edges.
        own = np.ix_(
            (np.arange(out.shape[0]) - top) // 2 % 2 == row,
            (np.arange(out.shape[1]) - left) // 2 % 2 == column,
        )
        out[own] = surface[own]
    return out


def _at_places(
    cells: NDArray[np.float64], corner: tuple[int, int], step: int, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Interpolate values of cells at all pixels. A cell has 2x2 pixels.

    Args:
        cells: values of the cells.
        corner: column and row of the first cell.
        step: distance between two cells in pixels.
        shape: rows and columns of the result.
    """
    x = ((np.arange(shape[1]) - corner[0] - 0.5) / step).astype(np.float32)
    y = ((np.arange(shape[0]) - corner[1] - 0.5) / step).astype(np.float32)
    return np.asarray(
        cv2.remap(cells, *np.meshgrid(x, y), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64
    )


def _smooth(values: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Smooth values by fitting a plane to the square around each value.

    The result is the value of the plane at the center. Squares are smaller at the edges.
    """
    y, x = np.mgrid[: values.shape[0], : values.shape[1]].astype(np.float64)

    def box(plane: NDArray[np.float64]) -> NDArray[np.float64]:
        plane = np.ascontiguousarray(plane)
        return np.asarray(
            cv2.boxFilter(plane, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    count = box(np.ones_like(values))
    mean = box(values) / count
    # x and y are not correlated in a square: each contributes its own slope.
    result = mean
    for axis in (x, y):
        center = box(axis) / count
        spread = box(axis * axis) / count - center**2
        slope = (box(values * axis) / count - mean * center) / np.maximum(spread, 1e-9)
        result = result - slope * (center - axis)
    return result


MOST_DEFECTS = 0.05
"""Largest share of defective pixels in a plausible calibration. A larger share indicates wrong settings or shots."""
DOUBTFUL = 0.005
"""Smallest misfit, or DoLP of a flat field, that causes a warning. The DoLP has errors of this size."""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Result of a calibration.

    Attributes:
        path: path of the calibration file.
        picture: path of the PNG file next to it.
        calibration: content of the calibration file.
        positions: properties of the polarizers at each position of the pattern.
        shots: angles and brightness of the shots.
        choice: size of the blocks.
        defects: number of pixels without a plausible polarizer. They got the vector of their block.
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

    First, the means over the sensor give the angle and brightness of each shot. Then linear least squares gives the
    vector of each pixel from its own intensities. A factor that neighboring pixels have in common (light, vignetting)
    is removed from the vectors.

    Args:
        source: folder of mosaics of a linear polarizer in front of a uniform light, at five or more angles.
        out: file to write, ``.safetensors``. A picture of the same name is written next to it.
        settings: settings of the shots and the calibration.
        reporter: receiver of progress and messages.

    Raises:
        PolarguideError: a file or setting is invalid, the shots contradict each other, or ``out`` exists.
    """
    settings = settings.checked()
    _require_new(out, Path(source), settings)
    files = Shots(Path(source), settings)
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
    pixels = fit_pixels(files.linear(measured.levels, reporter), fit.stokes(diattenuation), files.pattern)
    defects = int(pixels.defects.sum())
    require(
        defects <= MOST_DEFECTS * pixels.defects.size,
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


def _require_new(out: Path, shots: Path, settings: CalibrateSettings) -> None:
    """Check that the output files do not exist, and are not in a folder of shots.

    The next calibration would read files in a folder of shots.

    Raises:
        PolarguideError: the suffix is wrong, a file exists, or ``out`` is in a folder of shots.
    """
    require(
        out.suffix.lower() == SUFFIX,
        "--out",
        expected=f"a file name that ends in {SUFFIX}",
        found=out.name,
        remedy=f"End the name in {SUFFIX}.",
    )
    for path in (out, out.with_suffix(".png")):
        require(
            not os.path.lexists(path),
            path,
            expected="a new file",
            found="an existing file",
            remedy="Give another --out, or remove it; nothing was written.",
        )
    for folder in (shots, settings.flat, settings.dark_frame):
        require(
            folder is None or not folder.is_dir() or folder.resolve() != out.parent.resolve(),
            out,
            expected=f"a place outside of {folder}",
            found="the folder of the shots, where the picture would count as a shot",
            remedy="Give another --out; nothing was written.",
        )


def _say_shots(fit: ShotFit, settings: CalibrateSettings, measured: ShotMeans, reporter: Reporter) -> None:
    """Print the values that were estimated from the shots, and the assumptions that were needed."""
    angles = ", ".join(f"{angle:.1f}" for angle in np.degrees(fit.angles))
    reporter.say(
        f"{len(fit.angles)} shots, polarizer at {angles} degrees; misfit {fit.misfit:.2%} of their mean."
    )
    if settings.angles is not None:
        drift = fit.levels.max() / fit.levels.min() - 1
        reporter.say(f"The light behind the polarizer varied by {drift:.1%}; corrected.")
        if settings.reference == "mean":
            zero = np.degrees(-fit.zero)
            reporter.say(
                f"The zero of the given angles differs by {zero:+.2f} degrees from the sensor's mean."
            )
    else:
        reporter.say(
            "The angles were estimated. The zero of the angles is the mean of the positions, because the shots do not "
            "determine it."
        )
        if measured.flat is None:
            reporter.say(
                "Without --angles and --flat, the light is assumed to be steady and unpolarized. Deviations would look "
                "like an error of the sensor."
            )
    if settings.polarizer_extinction is None:
        reporter.say(
            "The polarizer is assumed to be ideal: extinction ratios include the polarizer (--polarizer-extinction)."
        )
    if fit.misfit > DOUBTFUL:
        reporter.warn(
            f"The shots disagree by {fit.misfit:.2%}, which limits the accuracy of the calibration."
        )
    if fit.flat_dolp is not None and settings.angles is not None:
        reporter.say(
            f"The flat field, which was not used, has a DoLP of {fit.flat_dolp:.3f} with the calibration."
        )
        if fit.flat_dolp > DOUBTFUL:
            reporter.warn("The flat field or the light behind the polarizer is polarized.")


def _say_choice(
    choice: BlockChoice, settings: CalibrateSettings, files: Shots, defects: int, reporter: Reporter
) -> None:
    single = choice.block == files.pattern.period
    reporter.say(
        f"Pixels of a block differ by {choice.scatter:.2%}, the noise of one pixel's vector is {choice.noise:.2%}: "
        f"{'each pixel has a vector' if single else f'blocks of {choice.block} pixels share vectors'}"
        f"{'' if settings.block is None else ' (--block)'}."
    )
    if single and choice.noise > choice.scatter:
        reporter.warn(
            "Pixels differ by less than their noise: a calibration of single pixels is less accurate than a "
            "calibration of blocks. Take more shots, or leave --block out."
        )
    if defects:
        reporter.say(
            f"{defects} pixels have no plausible polarizer, and got the vector of their neighborhood."
        )
