"""``polarguide prepare``."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import cv2
import tyro

from polarguide.capture.calibration import Calibration, read_calibration
from polarguide.cli.common import console, use_threads
from polarguide.cli.progress import ConsoleReporter
from polarguide.errors import PolarguideError
from polarguide.preparation import ORIGINS, PrepareSettings, prepare_scene


def prepare(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    format: Literal["auto", "mosaic", "filter", "pandora", "pisr", "nersp", "neisf", "gnerp"] = "auto",
    sensor: Literal["IMX250MYR", "IMX264MYR", "IMX250MZR"] | None = None,
    packing: Literal["10p", "12p", "12packed"] | None = None,
    width: int | None = None,
    height: int | None = None,
    bits: int | None = None,
    offset_x: int = 0,
    offset_y: int = 0,
    black_level: float = 0.0,
    dark_frame: Path | None = None,
    saturation: int | None = None,
    white_balance: str = "none",
    demosaic: Literal["half", "quarter", "full"] = "half",
    interpolation: Literal["bilinear", "guided"] = "bilinear",
    register: bool = True,
    transfer: Literal["auto", "linear", "srgb"] = "auto",
    align: bool = True,
    gains: Literal["auto", "none"] = "auto",
    calibration: Path | None = None,
    order: str | None = None,
    sense: Literal["cw", "ccw"] | None = None,
    zero: float | None = None,
    poses: str = "auto",
    matching: Literal["exhaustive", "sequential"] = "exhaustive",
    sfm_pictures: Literal["photograph", "minimum"] = "photograph",
    intrinsics: str | None = None,
    refine_intrinsics: bool = False,
    masks: Path | None = None,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Camera files to a scene folder: raw mosaics, shots through a rotating filter, published datasets.

    A preparation that was stopped goes on with the same command. docs/formats.md describes the files.

    Args:
        source: Folder of raw mosaics (one file a view), of filter shots (four folders or suffixes), or of a dataset.
        out: Scene folder to write.
        format: What the source is; auto looks for datasets and the four shots of a filter, else takes mosaics.
        sensor: Sensor of raw mosaics: MYR are color, MZR is monochrome.
        packing: Packing of .raw files (two different 12-bit packings exist; never guessed).
        width: Width of .raw files in pixels.
        height: Height of .raw files in pixels.
        bits: Bits of a sensor value in 16-bit files; without it 12 if no value exceeds 4095, else 16.
        offset_x: Column of the sensor at which the region of interest starts.
        offset_y: Row of the sensor at which it starts.
        black_level: Stored value without light.
        dark_frame: Picture with the lens covered, subtracted in place of the black level.
        saturation: Stored value from which the sensor saturates; without it full scale.
        white_balance: none, gray (the mean color becomes gray), or gains of R, G and B such as 1.9,1,1.6.
        demosaic: half, quarter or full resolution of the sensor.
        interpolation: How half and full fill in colors and angles.
        register: Bring the four angles of half size, which lie half a pixel apart, to one place.
        transfer: Encoding of filter shots (auto: the one under which the pair sums agree best) and of GNeRP.
        align: Estimate and correct small shifts between the four shots of a filter.
        gains: auto corrects what the light tells of the gains of the angles; none leaves them.
        calibration: JSON file with gains, order, sense and zero; the three flags below go first.
        order: Angle of the pictures called 0, 45, 90 and 135, such as 90,45,0,135.
        sense: How the angles count as the picture is displayed; without it ccw, or as the dataset says.
        zero: Where their zero lies, in degrees counter-clockwise from the image's horizontal.
        poses: sfm, dataset, none, or the path of a COLMAP model; auto takes those of a dataset, else sfm.
        matching: Pairs that SfM compares: all, or neighbors in the order of their names.
        sfm_pictures: What SfM finds features in: the photograph, or the minimum over the angles, which has less glare.
        intrinsics: fx,fy,cx,cy (and k1,k2,p1,p2) of all pictures as developed, for SfM; without it they are estimated.
        refine_intrinsics: Let SfM change the focal lengths and distortion given.
        masks: Folder of object masks called like the views; SfM looks at their white parts alone.
        seed: Seed of SfM.
        threads: Threads for the pictures; 0 takes all cores, as SfM always does.
    """
    use_threads(threads)
    if threads:
        cv2.setNumThreads(threads)
    settings = PrepareSettings(
        format=format, sensor=sensor, packing=packing, width=width, height=height, bits=bits,
        offset_x=offset_x, offset_y=offset_y, black_level=black_level,
        dark_frame=None if dark_frame is None else os.path.realpath(dark_frame), saturation=saturation,
        white_balance=white_balance, demosaic=demosaic, interpolation=interpolation, register=register,
        transfer=transfer, align=align, gains=gains, calibration=_calibration(calibration, order, sense, zero),
        poses=poses if poses in ORIGINS else os.path.realpath(poses), matching=matching, seed=seed,
        sfm_pictures=sfm_pictures, intrinsics=intrinsics, refine_intrinsics=refine_intrinsics,
        masks=None if masks is None else os.path.realpath(masks),
    )  # fmt: skip
    done = prepare_scene(source, out, settings, ConsoleReporter())
    without = f", {len(done.left_out)} left out" if done.left_out else ""
    console.print(f"scene: {done.folder} ({len(done.views)} views{without})", markup=False)
    if done.posed:
        console.print(f"next: polarguide train {done.folder} --out runs/{done.folder.name}", markup=False)
    else:
        console.print("it has no poses: repeat the command with --poses sfm or --poses PATH", markup=False)


def _calibration(path: Path | None, order: str | None, sense: str | None, zero: float | None) -> Calibration:
    """The calibration file, if any, with the flags over it."""
    found = Calibration() if path is None else read_calibration(path)
    if order is not None:
        try:
            first, second, third, fourth = (int(angle) for angle in order.split(","))
        except ValueError:
            raise PolarguideError(
                "--order",
                expected="four angles such as 90,45,0,135",
                found=repr(order),
                remedy="Name the angle of the pictures called 0, 45, 90 and 135, in this order.",
            ) from None
        found = replace(found, order=(first, second, third, fourth))
    if sense is not None:
        found = replace(found, sense=sense)
    return found if zero is None else replace(found, zero=zero)
