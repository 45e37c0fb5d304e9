"""``calibrate_sensor``: shots of a polarizer -> a file of analyzer vectors, and a picture of what they are like."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from polarguide.capture.sensor.analyzer_file import SUFFIX, write_analyzers
from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder
from polarguide.core.progress import SILENT, Reporter
from polarguide.shots.calibration.fit import BlockChoice, choose_block, fit_pixels, shared
from polarguide.shots.calibration.report import Position, calibration_picture, lines, positions
from polarguide.shots.calibration.settings import CalibrateSettings
from polarguide.shots.calibration.shots import Measured, Shots
from polarguide.shots.calibration.solve import ShotFit, solve_shots
from polarguide.visualization.figures import write_png

MOST_DEFECTS = 0.05
"""Share of pixels without a plausible polarizer from which on the fault is not the sensor's."""
DOUBTFUL = 0.005
"""Misfit, and DoLP of a flat field, above which a warning is due: DoLP will be wrong by about as much."""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What came of it.

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
    measured = files.measure(reporter)
    fit = _solved(files, measured, settings, known)
    _say_shots(fit, settings, measured, reporter)
    light = fit.stokes(_diattenuation(settings))
    pixels = fit_pixels(files.linear(measured.levels, reporter), light, files.pattern)
    defects = int(pixels.defects.sum())
    if defects > MOST_DEFECTS * pixels.defects.size:
        raise PolarguideError(
            source,
            expected="polarizers near the angles of the sensor's pattern at nearly all pixels",
            found=f"others at {defects / pixels.defects.size:.0%} of them",
            remedy="Check --sensor, --offset-x and --offset-y, and that the polarizer covers the whole field.",
        )
    choice = choose_block(pixels, settings.offset, files.pattern, settings.block)
    vectors = shared(pixels, settings.offset, choice.block, files.pattern)
    reference = settings.reference or ("mean" if known is None else "angles")
    found = AnalyzerCalibration(
        settings.sensor, settings.lens, settings.offset, files.size, choice.block, vectors, reference,
        settings.polarizer_extinction,
    )  # fmt: skip
    make_folder(out.parent)
    said = positions(found)
    found = replace(found, sha256=write_analyzers(out, found))
    picture = out.with_suffix(".png")
    write_png(picture, calibration_picture(found, said, fit, measured.means, files.pattern))
    _say_choice(choice, settings, files, defects, reporter)
    for line in lines(found, said):
        reporter.say(line)
    return Calibrated(out, picture, found, said, fit, choice, defects)


def _require_apart(out: Path, shots: Path, settings: CalibrateSettings) -> None:
    """Refuse to write the picture among those that are read: the next call would take it for a shot."""
    for folder in (shots, settings.flat, settings.dark_frame):
        if (
            folder is not None
            and folder.is_dir()
            and os.path.realpath(folder) == os.path.realpath(out.parent)
        ):
            raise PolarguideError(
                out,
                expected=f"a place outside of {folder}",
                found="one among the shots, which would hold the picture, too",
                remedy="Give another --out; nothing was written.",
            )


def _require_new(out: Path) -> None:
    if out.suffix.lower() != SUFFIX:
        raise PolarguideError(
            "--out", expected=f"a file name that ends in {SUFFIX}", found=out.name, remedy="Correct it."
        )
    for path in (out, out.with_suffix(".png")):
        if path.exists() or path.is_symlink():
            raise PolarguideError(
                path,
                expected="a new file",
                found="one that exists",
                remedy="Give another --out, or remove it; nothing was written.",
            )


def _diattenuation(settings: CalibrateSettings) -> float:
    ratio = settings.polarizer_extinction
    return 1.0 if ratio is None else (ratio - 1.0) / (ratio + 1.0)


def _solved(
    files: Shots, measured: Measured, settings: CalibrateSettings, known: list[float] | None
) -> ShotFit:
    return solve_shots(
        measured.means,
        np.radians(files.pattern.angles.ravel().astype(np.float64)),
        known=known,
        flat=measured.flat,
        diattenuation=_diattenuation(settings),
        to_mean=(settings.reference or ("mean" if known is None else "angles")) == "mean",
        files=files.files,
    )


def _say_shots(fit: ShotFit, settings: CalibrateSettings, measured: Measured, reporter: Reporter) -> None:
    """What was found about the shots, and what nothing in them tells."""
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
            "Noise exceeds what single pixels really differ by: take more shots, or leave --block out."
        )
    if defects:
        reporter.say(
            f"{defects} pixels have no plausible polarizer, and got the vector of their neighborhood."
        )
