"""A camera before a scene: Stokes vectors of all its pixels, lobe by lobe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.camera import Camera
from polarguide.synth.draws import Draws
from polarguide.synth.transport import Walk, follow

PATHS_AT_ONCE = 1 << 19
"""Bounds memory, and the time until Ctrl-C is heard."""
SCATTER = 0x9E3779B1


@dataclass(frozen=True, eq=False)
class Light:
    """What reaches the pixels of a camera, in units of S0.

    Attributes:
        specular, diffuse: Stokes vectors of the two lobes of the first surface in the lens frame of each ray,
            [3, H, W, 3] float64.
        seen: radiance of lights and environment that are seen directly, [H, W, 3] float64.
    """

    specular: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    seen: NDArray[np.float64]

    @property
    def stokes(self) -> NDArray[np.float64]:
        """Stokes vector of the picture, [3, H, W, 3]."""
        total = self.specular + self.diffuse
        total[0] += self.seen
        return total


def expose(
    scenes: Sequence[Any],
    camera: Camera,
    samples: int,
    *,
    seed: int,
    walk: Walk,
    tick: Callable[[int], None] | None = None,
    centre: bool = False,
) -> Light:
    """Render a view.

    Args:
        scenes: one Mitsuba scene of a spectral variant, or three of a mono one: red, green and blue. The channels
            share their random numbers, so that noise has no colour of its own.
        camera: pose and intrinsics; the film is filtered with the box of a pixel.
        samples: paths per pixel and lobe.
        seed: of the view.
        walk: limits of the paths.
        tick: called with the number of samples done, after each pass.
        centre: send all rays through the centres of pixels.
    """
    pixels = camera.width * camera.height
    passes = -(-samples * pixels // PATHS_AT_ONCE)
    batch = -(-samples // passes)
    total = np.zeros((pixels, 7, 3))
    done = 0
    while done < samples:
        count = min(batch, samples - done)
        for channel, scene in enumerate(scenes):
            found = _expose_once(scene, camera, (done, count), seed, walk, centre)
            if len(scenes) == 1:
                total += found
            else:
                total[..., channel] += found[..., 0]
        done += count
        if tick is not None:
            tick(done)
    grid = (total / samples).reshape(camera.height, camera.width, 7, 3).transpose(2, 0, 1, 3)
    return Light(grid[0:3], grid[3:6], grid[6])


def _expose_once(
    scene: Any, camera: Camera, part: tuple[int, int], seed: int, walk: Walk, centre: bool
) -> NDArray[np.float64]:
    """Sums over some samples of each pixel: [pixels, 7, 3 or 1]."""
    import mitsuba as mi

    pixels = camera.width * camera.height
    if mi.variant().startswith("scalar"):
        first, count = part
        sums = np.zeros((pixels, 7, 3))
        for pixel in range(pixels):
            for sample in range(first, first + count):
                parts = _path(scene, camera, pixel, sample, seed, walk, centre)
                sums[pixel] += np.array([[float(v) for v in colour] for colour in parts])
        return sums
    import drjit as dr

    count = dr.opaque(mi.UInt32, part[1])
    index = dr.arange(mi.UInt32, pixels * part[1])
    pixel = index // count
    sample = index - pixel * count + dr.opaque(mi.UInt32, part[0])
    parts = _path(scene, camera, pixel, sample, seed, walk, centre)
    flat = [value for colour in parts for value in colour]
    dr.eval(flat)
    columns = [dr.block_reduce(dr.ReduceOp.Add, value, part[1]).numpy() for value in flat]
    return np.stack(columns, -1).reshape(pixels, 7, -1).astype(np.float64)


def _path(
    scene: Any, camera: Camera, pixel: Any, sample: Any, seed: int, walk: Walk, centre: bool
) -> list[list[Any]]:
    """The colours of one sample: S0, S1, S2 of the specular and of the diffuse lobe, and what is seen directly."""
    import mitsuba as mi

    draws = Draws(mi.UInt32(pixel), mi.UInt32(sample), _number(mi.UInt32, seed * SCATTER % 2**32))
    spread, place = draws.next(), draws.pair()
    if centre:
        place = mi.Point2f(0.5, 0.5)
    ray, x_ref = primary_rays(camera, mi.UInt32(pixel), place)
    weight: Any = 1.0
    if mi.is_spectral:
        ray.wavelengths, weight = mi.sample_rgb_spectrum(_shifted(spread))
    specular, diffuse, seen = follow(scene, ray, draws, walk)
    parts = [*lens_stokes(specular, ray, x_ref), *lens_stokes(diffuse, ray, x_ref), seen]
    if not mi.is_spectral:
        return [[part.x] for part in parts]
    colours = [mi.spectrum_to_srgb(part * weight, ray.wavelengths, True) for part in parts]
    return [[colour.x, colour.y, colour.z] for colour in colours]


def primary_rays(camera: Camera, pixel: Any, place: Any) -> tuple[Any, Any]:
    """Rays through points of pixels.

    Args:
        camera: pose and intrinsics.
        pixel: index of the pixel, row by row.
        place: point in the pixel, [0, 1)^2.

    Returns:
        Mitsuba's rays, and image right in the lens frame of each ray (see ``optics.lens_frame``), in world axes.
    """
    import drjit as dr
    import mitsuba as mi

    inner = (camera.fx, camera.fy, camera.cx, camera.cy)
    fx, fy, cx, cy = (_number(mi.Float, value) for value in inner)
    width = _number(mi.UInt32, camera.width)
    row = pixel // width
    x = (mi.Float(pixel - row * width) + place.x - cx) / fx
    y = (mi.Float(row) + place.y - cy) / fy
    d = dr.normalize(mi.Vector3f(x, y, mi.Float(1.0)))
    scale = 1 / (1 + d.z)
    x_ref = mi.Vector3f(1 - d.x * d.x * scale, -d.x * d.y * scale, -d.x)
    axes = [mi.Vector3f(*(_number(mi.Float, float(v)) for v in row)) for row in camera.rotation]
    origin = mi.Point3f(*(_number(mi.Float, float(v)) for v in camera.centre))
    # The rows of the world-to-camera rotation are the camera's axes in the world.
    ray, right = (axes[0] * v.x + axes[1] * v.y + axes[2] * v.z for v in (d, x_ref))
    return mi.Ray3f(origin, ray), right


def lens_stokes(light: list[Any], ray: Any, x_ref: Any) -> list[Any]:
    """S0, S1, S2 in the project's lens frame of light that arrives along rays, from Mitsuba's frame of ``-ray.d``.

    Mitsuba counts angles from its basis counter-clockwise as seen against the light, that is in the picture, as the
    project does; only the basis itself has to be turned.
    """
    import mitsuba as mi

    forward = -ray.d
    turn = mi.mueller.rotate_stokes_basis(forward, mi.mueller.stokes_basis(forward), x_ref)
    s0, s1, s2 = light
    return [s0, s1 * turn[1, 1] + s2 * turn[1, 2], s1 * turn[2, 1] + s2 * turn[2, 2]]


def _number(kind: Any, value: float) -> Any:
    """A number that is no literal of the compiled code, so that one kernel serves all views."""
    import drjit as dr
    import mitsuba as mi

    return kind(value) if mi.variant().startswith("scalar") else dr.opaque(kind, value)


def _shifted(sample: Any) -> Any:
    """Four equally spaced numbers modulo 1, one for each wavelength of a ray."""
    import drjit as dr
    import mitsuba as mi

    values = (sample + k / 4 for k in range(4))
    return mi.UnpolarizedSpectrum(*(dr.select(value >= 1.0, value - 1.0, value) for value in values))
