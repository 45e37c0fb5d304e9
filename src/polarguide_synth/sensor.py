"""Simulate a camera: Stokes vectors of its pixels, raw mosaics of a polarization sensor, and shots through a filter.

Full well, read noise and extinction ratio are close to those of Sony's IMX250MYR. Photon noise has a Poisson
distribution, read noise a normal distribution (EMVA 1288).
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import INVERSE, apply_orientation, orientation_calibration
from polarguide.capture.sensor.pattern import sensor_pattern, tiled
from polarguide.geometry.camera import Camera
from polarguide.geometry.polarizer import malus
from polarguide.optics.color import srgb_encode_array
from polarguide_synth.mesh import Array
from polarguide_synth.settings import dr, mi
from polarguide_synth.transport import (
    PathLimits,
    Sampler,
    lens_stokes,
    pinhole,
    primary_rays,
    trace_paths,
)


@dataclass(frozen=True)
class Sensor:
    """Parameters of a sensor.

    Attributes:
        full_well: electrons at full scale.
        read_noise: standard deviation of the read noise in electrons.
        extinction: extinction ratio of the polarizers.
        gains: gains of the samples behind polarizers at 0, 45, 90 and 135 degrees.
        bits: bits of a stored value.
        black: black level in stored values.
    """

    full_well: float = 10500.0
    read_noise: float = 2.4
    extinction: float = 300.0
    gains: tuple[float, float, float, float] = (1.0, 0.985, 1.01, 0.992)
    bits: int = 12
    black: int = 64


def noisy(intensity: Array, noise: float, random: np.random.Generator, sensor: Sensor) -> Array:
    """Add photon and read noise to intensities.

    Args:
        intensity: linear intensities of any shape. 1 is full scale.
        noise: amount of noise. 1 simulates an exposure to the full well, 2 an exposure with a quarter of that light, 0
            no noise.
        random: generator of random numbers.
        sensor: full well and read noise.
    """
    if noise <= 0:
        return intensity
    electrons = sensor.full_well / noise**2
    counts = random.poisson(np.clip(intensity, 0, None) * electrons) + random.normal(
        0, sensor.read_noise, intensity.shape
    )
    return np.asarray(counts / electrons)


def exposure_suffix(stops: Sequence[float]) -> list[str]:
    """Return the end of the file name of each exposure, such as ``_ev-3``. One normal exposure has an empty end."""
    return [""] if tuple(stops) == (0.0,) else [f"_ev{stop:g}" for stop in stops]


def mosaic(
    stokes: Array, name: str, noise: float, random: np.random.Generator, sensor: Sensor, light: float = 1.0
) -> NDArray[np.uint16]:
    """Return the raw mosaic [H, W] that a sensor stores.

    An extinction ratio E scales S1 and S2 by (E - 1) / (E + 1). A monochrome sensor measures the mean of the colors.

    Args:
        stokes: Stokes vectors [3, H, W, 3], full scale 1.
        name: name of the sensor.
        noise: amount of noise, as for ``noisy``.
        random: generator of random numbers.
        sensor: parameters of the sensor.
        light: exposure relative to the normal exposure.
    """
    pattern = sensor_pattern(name)
    angles = tiled(pattern.angles, stokes.shape[1:3])
    if pattern.colors is None:
        samples = stokes.mean(-1)
    else:
        colors = tiled(pattern.colors, stokes.shape[1:3])
        samples = np.take_along_axis(stokes, colors[None, ..., None], -1)[..., 0]
    contrast = (sensor.extinction - 1) / (sensor.extinction + 1)
    value = light * malus((samples[0], contrast * samples[1], contrast * samples[2]), np.radians(angles))
    value = noisy(value, noise, random, sensor) * np.array(sensor.gains)[angles // 45]
    top = (1 << sensor.bits) - 1
    return np.clip(np.round(sensor.black + value * (top - sensor.black)), 0, top).astype(np.uint16)


STOPS = 0.3
"""Largest deviation of the simulated automatic exposure from its mean, in stops."""
STEP = 15
"""Degrees between two marks on the ring of the filter. Simulated angles are multiples of it."""
QUALITY = 95
"""JPEG quality of shots through a filter."""
_TIME = Fraction(1, 60)
_TURNS = (1, 1, 1, 6, 8, 3)


@dataclass(frozen=True)
class FilterShot:
    """Settings of a simulated photograph of a view through a filter.

    Attributes:
        angle: transmission axis of the filter, degrees counter-clockwise from the horizontal of the displayed picture.
        stops: exposure relative to the mean exposure, in stops. 1 is twice the light.
        orientation: EXIF orientation of the stored picture, 1, 3, 6 or 8.
        noted: True if the file states the exposure time.
    """

    angle: float
    stops: float = 0.0
    orientation: int = 1
    noted: bool = True

    @property
    def body_angle(self) -> int:
        """Angle of the filter relative to the camera body (the rows of the stored picture), 0 to 179 degrees."""
        return round(self.angle - orientation_calibration(self.orientation).zero) % 180


def plan_shot(seed: int, number: int) -> FilterShot:
    """Choose the angle, exposure and orientation of the photograph of view ``number`` at random."""
    random = np.random.default_rng((seed, 47, number))
    return FilterShot(
        STEP * int(random.integers(0, 180 // STEP)),
        float(random.uniform(-STOPS, STOPS)),
        int(random.choice(_TURNS)),
    )


def behind_filter(stokes: Array, rays: Array, degrees: float) -> Array:
    """Return the intensities [H, W, 3] behind an ideal polarizing sheet in front of the lens.

    The sheet absorbs along an axis ``c`` in the plane of the picture. A ray ``d`` keeps the field perpendicular to
    ``d`` and ``c``. The angle of this field in the lens frame of the ray differs from pixel to pixel.

    Args:
        stokes: Stokes vectors [3, H, W, 3] in the lens frame.
        rays: unit vectors [H, W, 3] in camera axes.
        degrees: transmission axis of the filter, counter-clockwise as displayed.
    """
    angle = np.radians(degrees)
    absorbed = np.array([np.sin(angle), np.cos(angle), 0.0])
    field = np.cross(rays, absorbed)
    x, y, z = np.moveaxis(rays, -1, 0)
    right = np.stack([1 - x * x / (1 + z), -x * y / (1 + z), -x], axis=-1)
    up = np.stack([x * y / (1 + z), y * y / (1 + z) - 1, y], axis=-1)
    passed = np.arctan2((field * up).sum(-1), (field * right).sum(-1))
    return np.asarray(malus(stokes, passed[..., None]))


def filter_jpeg(
    stokes: Array, rays: Array, shot: FilterShot, noise: float, random: np.random.Generator, sensor: Sensor
) -> bytes:
    """Return the JPEG file that a camera would store, with noise, sRGB encoding and 8 bits.

    The picture is rotated like the camera.

    Args:
        stokes: Stokes vectors [3, H, W, 3] of the upright picture in the lens frame, full scale 1.
        rays: unit vectors [H, W, 3] of the upright picture.
        shot: angle, exposure and orientation.
        noise: amount of noise, as for ``noisy``.
        random: generator of random numbers.
        sensor: parameters of the sensor.
    """
    light = behind_filter(stokes, rays, shot.angle) * 2.0**shot.stops
    encoded = srgb_encode_array(np.clip(noisy(light, noise, random, sensor), 0.0, 1.0))
    stored = apply_orientation(np.rint(255 * encoded).astype(np.uint8), INVERSE[shot.orientation])
    _, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(stored[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    )
    block = b"Exif\0\0" + exif_tags(
        shot.orientation, _TIME * Fraction(2.0**shot.stops) if shot.noted else None
    )
    segment = b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block
    return data[:2].tobytes() + segment + data[2:].tobytes()


def exif_tags(orientation: int, time: Fraction | None) -> bytes:
    """Return the EXIF data of a picture, with its orientation.

    If a time is given, the data also contains exposure time, f-number and ISO speed.
    """
    if time is None:
        return b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)
    head = b"MM\0*" + struct.pack(">I", 8)
    first = struct.pack(">HHHIHHHHIII", 2, 274, 3, 1, orientation, 0, 34665, 4, 1, 38, 0)
    entries = struct.pack(">HHHIIHHIIHHIHHI", 3, 33434, 5, 1, 80, 33437, 5, 1, 88, 34855, 3, 1, 100, 0, 0)
    seconds = time.limit_denominator(1_000_000)
    return head + first + entries + struct.pack(">IIII", seconds.numerator, seconds.denominator, 8, 1)


PATHS_AT_ONCE = 1 << 20
"""Batch size in paths. It limits memory, and the delay after Ctrl-C."""
SCATTER = 0x9E3779B1
"""Multiplier that makes the seeds of successive views very different."""


@dataclass(frozen=True, eq=False)
class LobeRadiance:
    """Radiance at the pixels of a camera in units of S0, separated by the lobes of the first surface.

    Attributes:
        specular: [3, H, W, 3] float64, Stokes vectors of the specular lobe in the lens frame of each ray.
        diffuse: [3, H, W, 3] float64, Stokes vectors of the diffuse lobe in the lens frame of each ray.
        emitted: [H, W, 3] float64, radiance of directly visible light sources and environment.
    """

    specular: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    emitted: NDArray[np.float64]

    @property
    def stokes(self) -> NDArray[np.float64]:
        """Stokes vectors of the whole picture, [3, H, W, 3]."""
        total = self.specular + self.diffuse
        total[0] += self.emitted
        return total


def render_lobes(
    scenes: Sequence[Any],
    camera: Camera,
    samples: int,
    *,
    seed: int,
    limits: PathLimits,
    center: bool = False,
) -> LobeRadiance:
    """Render the radiance of a view, separated by the lobes of the first surface.

    Args:
        scenes: Mitsuba scenes for red, green and blue. They share their random numbers, so the noise has no color.
        camera: pose and intrinsics. The reconstruction filter is a box of one pixel.
        samples: paths per pixel and lobe.
        seed: seed of the view.
        limits: limits of the paths.
        center: True to send all rays through the centers of pixels.
    """
    pixels = camera.width * camera.height
    passes = min(samples, -(-samples * pixels // PATHS_AT_ONCE))
    while samples % passes:  # passes of equal size share one trace
        passes += 1
    batch = samples // passes
    total = np.zeros((pixels, 7, 3))
    for start in range(0, samples, batch):
        for channel, scene in enumerate(scenes):
            total[..., channel] += _render_pass(scene, camera, (start, batch), seed, limits, center)
    grid = (total / samples).reshape(camera.height, camera.width, 7, 3).transpose(2, 0, 1, 3)
    return LobeRadiance(grid[0:3], grid[3:6], grid[6])


def _render_pass(
    scene: Any, camera: Camera, part: tuple[int, int], seed: int, limits: PathLimits, center: bool
) -> NDArray[np.float64]:
    """Sum the samples of each pixel, [pixels, 7].

    ``part`` contains the number of the first sample, and the number of samples.
    """
    pixels = camera.width * camera.height
    first, count = part
    lens = pinhole(camera)
    start = dr.opaque(mi.UInt32, seed * SCATTER % 2**32)
    part_values = [dr.opaque(mi.UInt32, value) for value in (first, count)]
    totals = _compiled()(scene, lens, part_values, pixels, count, start, limits, center)
    return np.stack([column.numpy() for column in totals], -1).astype(np.float64)


@functools.cache
def _compiled() -> Callable[..., list[Any]]:
    """Return a version of ``_sums`` that is traced only once per scene and picture size.

    Tracing takes as long as 100,000 paths.
    """
    return dr.freeze(_sums, warn_after=1 << 30)


def _sums(
    scene: Any,
    lens: list[Any],
    part: list[Any],
    pixels: int,
    count: int,
    seed: Any,
    limits: PathLimits,
    center: bool,
) -> list[Any]:
    """Trace ``count`` samples of each pixel in one batch, and return their sums."""
    first, per_pixel = part
    index = dr.arange(mi.UInt32, pixels * count)
    pixel = index // per_pixel
    sample = index - pixel * per_pixel + first
    parts = _path(scene, lens, pixel, sample, seed, limits, center)
    dr.eval(parts)
    return [dr.block_reduce(dr.ReduceOp.Add, part, count) for part in parts]


def _path(
    scene: Any, lens: list[Any], pixel: Any, sample: Any, seed: Any, limits: PathLimits, center: bool
) -> list[Any]:
    """Trace one sample of a pixel.

    Returns:
        S0, S1 and S2 of the specular lobe and of the diffuse lobe; and directly visible emission.
    """
    sampler = Sampler(mi.UInt32(pixel), mi.UInt32(sample), seed)
    sampler.next()  # earlier versions sampled a wavelength with the first number
    place = sampler.pair()
    if center:
        place = mi.Point2f(0.5, 0.5)
    ray, x_ref = primary_rays(lens, mi.UInt32(pixel), place)
    specular, diffuse, emitted = trace_paths(scene, ray, sampler, limits)
    parts = [*lens_stokes(specular, ray, x_ref), *lens_stokes(diffuse, ray, x_ref), emitted]
    return [part.x for part in parts]
