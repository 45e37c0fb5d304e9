"""Render the pixels of a camera: Stokes vectors, separately for the specular and the diffuse lobe."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.geometry.camera import Camera
from polarguide.synth.settings import dr, mi
from polarguide.synth.transport import (
    PathLimits,
    Sampler,
    lens_stokes,
    opaque_value,
    pinhole,
    primary_rays,
    trace_paths,
)

PATHS_AT_ONCE = 1 << 20
"""Limits memory, and the delay of Ctrl-C."""
SCATTER = 0x9E3779B1


@dataclass(frozen=True, eq=False)
class LobeRadiance:
    """The light that reaches the pixels of a camera, in units of S0.

    Attributes:
        specular, diffuse: Stokes vectors of the two lobes of the first surface in the lens frame of each ray,
            [3, H, W, 3] float64.
        emitted: radiance of directly visible light sources and environment, [H, W, 3] float64.
    """

    specular: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    emitted: NDArray[np.float64]

    @property
    def stokes(self) -> NDArray[np.float64]:
        """Stokes vector of the picture, [3, H, W, 3]."""
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
    """Render a view.

    Args:
        scenes: one Mitsuba scene of a spectral variant, or three of a mono one: red, green and blue. The channels
            share their random numbers, so that the noise has no color.
        camera: pose and intrinsics; the reconstruction filter is a box of one pixel.
        samples: paths per pixel and lobe.
        seed: of the view.
        limits: of the paths.
        center: send all rays through the centers of pixels.
    """
    pixels = camera.width * camera.height
    passes = min(samples, -(-samples * pixels // PATHS_AT_ONCE))
    while samples % passes:  # passes of one size are traced once
        passes += 1
    batch = samples // passes
    total = np.zeros((pixels, 7, 3))
    for start in range(0, samples, batch):
        for channel, scene in enumerate(scenes):
            sums = _render_pass(scene, camera, (start, batch), seed, limits, center)
            if len(scenes) == 1:
                total += sums
            else:
                total[..., channel] += sums[..., 0]
    grid = (total / samples).reshape(camera.height, camera.width, 7, 3).transpose(2, 0, 1, 3)
    return LobeRadiance(grid[0:3], grid[3:6], grid[6])


def _render_pass(
    scene: Any, camera: Camera, part: tuple[int, int], seed: int, limits: PathLimits, center: bool
) -> NDArray[np.float64]:
    """Sums over some samples of each pixel: [pixels, 7, 3 or 1]."""
    pixels = camera.width * camera.height
    first, count = part
    lens, start = pinhole(camera), opaque_value(mi.UInt32, seed * SCATTER % 2**32)
    if mi.variant().startswith("scalar"):
        sums = np.zeros((pixels, 7, 3))
        for pixel in range(pixels):
            for sample in range(first, first + count):
                parts = _path(scene, lens, pixel, sample, start, limits, center)
                sums[pixel] += np.array([[float(v) for v in color] for color in parts])
        return sums
    part_values = [opaque_value(mi.UInt32, value) for value in (first, count)]
    totals = _compiled()(scene, lens, part_values, pixels, count, start, limits, center)
    return np.stack([column.numpy() for column in totals], -1).reshape(pixels, 7, -1).astype(np.float64)


@functools.cache
def _compiled() -> Callable[..., list[Any]]:
    """``_sums``, traced once per scene and picture size instead of once per pass: tracing costs as much time as
    100,000 paths."""
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
    """Sums over ``count`` samples of each pixel, all at once."""
    first, per_pixel = part
    index = dr.arange(mi.UInt32, pixels * count)
    pixel = index // per_pixel
    sample = index - pixel * per_pixel + first
    parts = _path(scene, lens, pixel, sample, seed, limits, center)
    flat = [value for color in parts for value in color]
    dr.eval(flat)
    return [dr.block_reduce(dr.ReduceOp.Add, value, count) for value in flat]


def _path(
    scene: Any, lens: list[Any], pixel: Any, sample: Any, seed: Any, limits: PathLimits, center: bool
) -> list[list[Any]]:
    """One sample in color: S0, S1, S2 of the specular and of the diffuse lobe, and the directly visible emission."""
    sampler = Sampler(mi.UInt32(pixel), mi.UInt32(sample), seed)
    spread, place = sampler.next(), sampler.pair()
    if center:
        place = mi.Point2f(0.5, 0.5)
    ray, x_ref = primary_rays(lens, mi.UInt32(pixel), place)
    weight: Any = 1.0
    if mi.is_spectral:
        ray.wavelengths, weight = mi.sample_rgb_spectrum(_shifted(spread))
    specular, diffuse, emitted = trace_paths(scene, ray, sampler, limits)
    parts = [*lens_stokes(specular, ray, x_ref), *lens_stokes(diffuse, ray, x_ref), emitted]
    if not mi.is_spectral:
        return [[part.x] for part in parts]
    colors = [mi.spectrum_to_srgb(part * weight, ray.wavelengths, True) for part in parts]
    return [[color.x, color.y, color.z] for color in colors]


def _shifted(sample: Any) -> Any:
    """Four equally spaced numbers modulo 1, one for each wavelength of a ray."""
    values = (sample + k / 4 for k in range(4))
    return mi.UnpolarizedSpectrum(*(dr.select(value >= 1.0, value - 1.0, value) for value in values))
