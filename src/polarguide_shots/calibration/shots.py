"""Shots of a polarizer in front of a uniform light: reading, validation, and means over the sensor."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.develop import sample_blocks
from polarguide.capture.layout import describe_contents, index_files
from polarguide.capture.sensor.pattern import (
    SIDE,
    Levels,
    Pattern,
    agreed_full_scale,
    estimate_levels,
    require_kind,
    sensor_pattern,
)
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES, RawFormat, read_mosaic
from polarguide.core.errors import require
from polarguide.core.files import require_folder
from polarguide.core.progress import Reporter
from polarguide_shots.calibration.settings import CalibrateSettings

FEWEST = 5
"""Smallest number of angles, the number of points that determine an ellipse."""
SATURATED = 0.001
"""Largest share of saturated samples of a shot, which allows for a few defects of the sensor."""
TOO_DARK = 0.02
"""Smallest mean of a shot, as a share of full scale."""
UNEVEN = 0.2
"""Smallest brightness of the dimmest part of a uniform light, as a share of the brightest part."""
TEXTURED = 0.05
"""Largest relative deviation of uniform light within 32 pixels."""
_CELLS = 16
_SMALLEST = 64

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShotMeans:
    """Levels and means of all shots.

    Attributes:
        levels: levels of the stored values.
        means: means of each shot over the sensor, [T, P * P], by position in the pattern of the region, row by row;
            full scale is 1.
        flat: means of the flat field, [P * P], or None.
    """

    levels: Levels
    means: Array
    flat: Array | None


class Shots:
    """The files of a calibration.

    Args:
        root: folder of the shots.
        settings: settings of the calibration.

    Attributes:
        files: shots of the polarizer, by name.
        pattern: pattern of the region, from its top-left pixel.

    Raises:
        PolarguideError: there are too few shots.
    """

    def __init__(self, root: Path, settings: CalibrateSettings) -> None:
        remedy = "Give the folder of the shots of the polarizer, one mosaic each."
        require_folder(root, expected="a folder of raw mosaics", remedy=remedy)
        self._settings = settings
        self._raw = RawFormat(settings.width, settings.height, settings.packing)
        self._flat = _files("--flat", settings.flat)
        self._dark = _files("--dark-frame", settings.dark_frame)
        others = {os.path.realpath(path) for path in (*self._flat, *self._dark)}
        paths = index_files(root, RAW_SUFFIXES)
        self.files = [paths[name] for name in sorted(paths) if os.path.realpath(paths[name]) not in others]
        require(
            len(self.files) >= FEWEST,
            root,
            expected=f"at least {FEWEST} shots of the polarizer, at different angles",
            found=f"{len(self.files)} ({describe_contents(root)})",
            remedy="Take more shots; twelve at steps of 15 degrees are a good number.",
        )
        self.pattern: Pattern = sensor_pattern(settings.sensor).shifted(*settings.offset)
        self._first: tuple[Path, tuple[int, ...], Any] | None = None
        self._floor: Any = settings.black_level

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the mosaics, after the first reading."""
        assert self._first is not None
        return self._first[1][1], self._first[1][0]

    def measure(self, reporter: Reporter) -> ShotMeans:
        """Read all files, and compute their levels and means.

        Raises:
            PolarguideError: a file is damaged, of another size, saturated, dark, or not of a uniform light.
        """
        files = [*self.files, *self._flat]
        period = self.pattern.period
        sums: list[Array] = []
        counts: list[NDArray[np.int64]] = []
        blocks: list[NDArray[Any]] = []
        stated: dict[Path, int | None] = {}
        light: Any = 0
        with reporter.track("reading shots", len(files) + len(self._dark)) as advance:
            if self._dark:
                total = sum(self._read(path).astype(np.float64) for path in self._dark)
                self._floor = np.asarray(total / len(self._dark), np.float32)
            dark = "dark frame" if self._dark else "black level"
            left, top = self.pattern.cell_corner()
            for number, path in enumerate(files, 1):
                values = self._read(path)
                counts.append(np.bincount(values.ravel(), minlength=256))
                if self._settings.bits is None:
                    stated[path] = self._raw.full_scale(path, values)
                if number <= len(self.files):
                    blocks.append(sample_blocks(values[top:, left:], SIDE))
                above = values.astype(np.float32) - np.float32(self._floor)
                planes = (above[row::period, column::period] for row, column in np.ndindex(period, period))
                sums.append(np.array([plane.mean(dtype=np.float64) for plane in planes]))
                mean = float(above.mean())
                require(
                    mean > 0,
                    path,
                    expected=f"a shot that is brighter than the {dark}",
                    found=f"a mean of {values.mean():.1f}, and {np.mean(self._floor):.1f} of the {dark}",
                    remedy="Take the dark frame with the lens covered, at the same exposure and gain.",
                )
                light = light + above / mean
                advance(number + len(self._dark))
        levels = self._levels(counts, agreed_full_scale(stated) if stated else None)
        for path, count in zip(files, counts, strict=True):
            share = float(count[levels.saturation :].sum() / count.sum())
            require(
                share <= SATURATED,
                path,
                expected=f"at most {SATURATED:.1%} saturated samples",
                found=f"{share:.1%}",
                remedy="Expose shorter: the brightest shot should stay below 90 % of full scale.",
            )
        require_kind(self._settings.sensor, np.concatenate(blocks), levels)
        self._require_uniform(light)
        means = np.stack(sums) / (levels.white - levels.black)
        dim = int(means.mean(axis=1).argmin())
        require(
            means[dim].mean() >= TOO_DARK,
            files[dim],
            expected=f"a mean intensity of at least {TOO_DARK:.0%} of full scale",
            found=f"{means[dim].mean():.1%}",
            remedy="Expose longer: half of full scale is good.",
        )
        shots = len(self.files)
        return ShotMeans(levels, means[:shots], means[shots:].mean(axis=0) if self._flat else None)

    def linear(
        self, levels: Levels, reporter: Reporter
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
        """Read each shot again: linear intensities [H, W] with full scale 1, and a mask [H, W] of saturated samples."""
        with reporter.track("fitting pixels", len(self.files)) as advance:
            for number, path in enumerate(self.files, 1):
                values = self._read(path)
                above = values.astype(np.float32) - np.float32(self._floor)
                yield above / np.float32(levels.white - levels.black), np.asarray(values >= levels.saturation)
                advance(number)

    def _read(self, path: Path) -> NDArray[Any]:
        values = read_mosaic(path, self._raw, least=_SMALLEST)
        if self._first is None:
            self._first = (path, values.shape, values.dtype)
        first, shape, kind = self._first
        require(
            (values.shape, values.dtype) == (shape, kind),
            path,
            expected=f"{shape[1]}x{shape[0]} pixels of {kind} like {first.name}",
            found=f"{values.shape[1]}x{values.shape[0]} of {values.dtype}",
            remedy="Take all shots, the dark frame and the flat field with the same region and depth.",
        )
        return values

    def _levels(self, counts: list[NDArray[np.int64]], stated: int | None) -> Levels:
        """Estimate the levels from counts of stored values, and the full scale that files state."""
        used = np.concatenate([np.flatnonzero(count) for count in counts])
        assert self._first is not None
        path, _, kind = self._first
        return estimate_levels(
            int(used.max()),
            int(np.bitwise_or.reduce(used)),
            self._raw.container(path, np.dtype(kind)),
            bits=self._settings.bits,
            black=0.0 if self._dark else self._settings.black_level,
            saturation=self._settings.saturation,
            stated=stated,
        )

    def _require_uniform(self, light: NDArray[np.float32]) -> None:
        """Check that the light is uniform: without texture, and without dark parts.

        Raises:
            PolarguideError: the light is not uniform.
        """
        left, top = self.pattern.cell_corner()
        step = self.pattern.period
        cut = light[top:, left:]
        cut = cut[: cut.shape[0] // step * step, : cut.shape[1] // step * step]
        # Each position of the pattern has its own throughput and color.
        cells = np.zeros((cut.shape[0] // step, cut.shape[1] // step))
        for row, column in np.ndindex(step, step):
            plane = cut[row::step, column::step]
            cells += plane / plane.mean(dtype=np.float64) / step**2
        side = _CELLS * 2 // step
        rows = cells.shape[0] // side
        columns = cells.shape[1] // side
        grid = cells[: rows * side, : columns * side].reshape(rows, side, columns, side).swapaxes(1, 2)
        blocks = grid.reshape(rows * columns, side * side)
        means = blocks.mean(axis=1)
        low, high = np.percentile(means, [1, 99])
        # A gradient is not texture: the plane through a block is subtracted.
        slope = (np.arange(side) + 0.5) / side - 0.5
        rest = blocks / means[:, None] - 1
        for tilt in (np.tile(slope, side), np.repeat(slope, side)):
            rest = rest - np.outer(rest @ tilt / (tilt @ tilt), tilt)
        texture = float(np.sqrt(np.mean(rest**2)))
        require(
            low >= UNEVEN * high and texture <= TEXTURED,
            self.files[0].parent,
            expected=f"a uniform light: its dimmest part above {UNEVEN:.0%}, texture below {TEXTURED:.0%}",
            found=f"{low / high:.0%} of the brightest part in the dimmest, {texture:.0%} of texture",
            remedy="Fill the field with the polarizer in front of a diffuser or an integrating sphere, out of focus.",
        )


def _files(option: str, path: Path | None) -> list[Path]:
    """Return a file, or the files of a folder.

    Raises:
        PolarguideError: the folder has no mosaic.
    """
    if path is None or not path.is_dir():
        return [] if path is None else [path]
    paths = list(index_files(path, RAW_SUFFIXES).values())
    require(
        paths,
        f"{option} {path}",
        expected="a mosaic, or a folder of mosaics",
        found=describe_contents(path),
        remedy="Leave it out, or give the files.",
    )
    return paths
