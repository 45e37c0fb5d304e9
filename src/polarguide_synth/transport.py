"""Polarized path tracing that separates the specular and the diffuse lobe of the first surface.

Mitsuba supplies geometry, polarized BSDFs and emitters. The integrator is our own, because Mitsuba's integrators add
the lobes. Two independent paths start at the first surface, one by the specular lobe and one by the diffuse lobe.
Therefore specular + diffuse = S0 holds for every sample, and both layers carry full Stokes vectors. Polarization by
further surfaces is included.

Direct light is estimated by multiple importance sampling with the balance heuristic (Veach and Guibas 1995). All
emitters are unpolarized, so only the first column of every Mueller matrix is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from polarguide.geometry.camera import Camera
from polarguide_synth.settings import dr, mi


def pinhole(camera: Camera) -> list[Any]:
    """Convert a camera to Mitsuba's types.

    Returns:
        Width of the picture; (fx, fy, cx, cy); axes of the camera in the world; and its center.
    """
    inner = [dr.opaque(mi.Float, value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
    # The rows of the world-to-camera rotation are the camera's axes in the world.
    axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in row)) for row in camera.rotation]
    origin = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.center))
    return [dr.opaque(mi.UInt32, camera.width), inner, axes, origin]


def primary_rays(camera: list[Any], pixel: Any, place: Any) -> tuple[Any, Any]:
    """Create rays from the camera through points in pixels.

    Args:
        camera: result of ``pinhole``.
        pixel: index of the pixel, row by row.
        place: position in the pixel, [0, 1)^2.

    Returns:
        Mitsuba's rays; and the x axis of the lens frame of each ray (see ``optics.lens_frame``), in world axes.
    """
    width, (fx, fy, cx, cy), axes, origin = camera
    row = pixel // width
    x = (mi.Float(pixel - row * width) + place.x - cx) / fx
    y = (mi.Float(row) + place.y - cy) / fy
    d = dr.normalize(mi.Vector3f(x, y, mi.Float(1.0)))
    scale = 1 / (1 + d.z)
    x_ref = mi.Vector3f(1 - d.x * d.x * scale, -d.x * d.y * scale, -d.x)
    ray, right = (axes[0] * v.x + axes[1] * v.y + axes[2] * v.z for v in (d, x_ref))
    return mi.Ray3f(origin, ray), right


def lens_stokes(light: list[Any], ray: Any, x_ref: Any) -> list[Any]:
    """Convert Stokes vectors from Mitsuba's frame of ``-ray.d`` to the lens frame.

    Both conventions measure angles counter-clockwise as seen against the light. They differ only in the direction of
    angle 0.

    Args:
        light: [S0, S1, S2].
        ray: primary rays.
        x_ref: x axis of the lens frame of each ray, in world axes.
    """
    forward = -ray.d
    turn = mi.mueller.rotate_stokes_basis(forward, mi.mueller.stokes_basis(forward), x_ref)
    s0, s1, s2 = light
    return [s0, s1 * turn[1, 1] + s2 * turn[1, 2], s1 * turn[2, 1] + s2 * turn[2, 2]]


_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41)
"""Primes whose square roots are the steps of the random sequence, one for each dimension."""
_RANGE = 2**32
"""Number of 32-bit integers."""


class Sampler:
    """Generator of random numbers for one sample of each pixel.

    The first dimensions follow a Kronecker sequence with the square roots of primes, with a random shift per pixel and
    dimension (Cranley and Patterson 1976). Every single sample is uniform. Estimates are therefore unbiased.

    Args:
        pixel: index of the pixel.
        sample: index of the sample in its pixel, counted over all passes.
        seed: seed of the view, as Mitsuba's unsigned integer.

    Attributes:
        later: generator of independent numbers for the remaining dimensions.
    """

    def __init__(self, pixel: Any, sample: Any, seed: Any) -> None:
        self._pixel = pixel
        self._sample = sample
        self._seed = seed
        self._used = 0
        self.later = mi.PCG32(1, mi.sample_tea_64(pixel, seed) + mi.UInt64(sample), mi.UInt64(sample))

    def next(self) -> Any:
        """Return random numbers in [0, 1) for the next dimension of the sequence."""
        step = int((_PRIMES[self._used] ** 0.5 % 1) * _RANGE)
        self._used += 1
        shift = mi.sample_tea_32(self._pixel, self._seed + mi.UInt32(self._used))[0]
        # Integers modulo 2^32: floats lose digits as the index grows.
        value = mi.UInt32((self._sample * mi.UInt32(step) + shift) & mi.UInt32(_RANGE - 1))
        return dr.minimum(mi.Float(value) * (1 / _RANGE), 1 - 2.0**-24)

    def pair(self) -> Any:
        """Return random points in a unit square, from the next two dimensions of the sequence."""
        return mi.Point2f(self.next(), self.next())


LEAST_DENSITY = 1e-5
"""Smallest density of a sampled direction, per steradian."""
DirectionSampler = Callable[[Any, Any, Any, Any, Any, Any], tuple[Any, Any]]


def sample_bsdf(bsdf: Any, context: Any, si: Any, numbers: Any, toward: Any, active: Any) -> tuple[Any, Any]:
    """Sample a direction with Mitsuba's BSDF.

    Returns:
        (value, density) of the BSDF for the direction ``toward`` a light; and (direction, density, weight, delta) of
        the sampled direction.
    """
    evaluated = bsdf.eval_pdf(context, si, toward, active)
    sample, weight = bsdf.sample(context, si, *numbers, active)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return evaluated, (sample.wo, sample.pdf, weight, delta)


def sample_cosine(
    bsdf: Any, context: Any, si: Any, numbers: Any, toward: Any, active: Any
) -> tuple[Any, Any]:
    """Sample a direction with a density proportional to the cosine.

    It replaces ``sample_bsdf`` for the diffuse lobe of a coated surface. Mitsuba 3.9 evaluates this lobe correctly. If
    only this lobe is selected, however, its densities are those of both lobes together.

    Returns:
        The same values as ``sample_bsdf``.
    """
    value = bsdf.eval(context, si, toward, active)
    side = dr.sign(si.wi.z)  # surfaces have two sides
    toward_density = dr.maximum(toward.z * side, 0.0) * dr.inv_pi
    wo = mi.warp.square_to_cosine_hemisphere(numbers[1])
    wo = mi.Vector3f(wo.x, wo.y, wo.z * side)
    density = dr.abs(wo.z) * dr.inv_pi
    active = active & (density > LEAST_DENSITY)
    weight = bsdf.eval(context, si, wo, active) * dr.select(
        active, 1 / dr.maximum(density, LEAST_DENSITY), 0.0
    )
    return (value, toward_density), (wo, dr.select(active, density, 0.0), weight, mi.Bool(False))


TINY = 1e-30
"""Lower bound of divisors, to avoid a division by zero."""
VISIBLE = "visible"
"""Name of the attribute of a shape that is 1 if the camera sees it, and 0 if it is black to the camera."""
ROULETTE_FROM = 1
"""Number of surfaces on a path after which Russian roulette starts."""


@dataclass(frozen=True)
class PathLimits:
    """Limits of the traced paths.

    Attributes:
        depth: largest number of surfaces on a path.
        clamp: largest radiance that one path may contribute from beyond its second surface, in scene units. The Stokes
            vector of a brighter path is scaled down as a whole. If 0, there is no limit and no bias.
        visible_only: True to show the camera only shapes whose attribute ``VISIBLE`` is 1.
    """

    depth: int = 6
    clamp: float = 0.0
    visible_only: bool = False


def trace_paths(
    scene: Any, ray: Any, sampler: Sampler, limits: PathLimits
) -> tuple[list[Any], list[Any], Any]:
    """Trace the light that arrives along rays, separately for the two lobes of the first surface.

    Args:
        scene: Mitsuba scene.
        ray: primary rays.
        sampler: random numbers of every ray.
        limits: limits of the paths.

    Returns:
        [S0, S1, S2] of the specular lobe in Mitsuba's frame of the direction ``-ray.d``; [S0, S1, S2] of the diffuse
        lobe; and the directly visible radiance of light sources and environment.
    """
    si = scene.ray_intersect(ray)
    visible = _visible(si) if limits.visible_only else mi.Bool(True)
    emitted = _emitted(scene, si, mi.Bool(True))
    if limits.visible_only:
        emitted *= dr.select(visible, 1.0, 0.0)
    flags = mi.BSDFFlags
    lobes = []
    for kinds, sample_direction in (
        (flags.Glossy | flags.Delta, sample_bsdf),
        (flags.Diffuse, sample_cosine),
    ):
        context = mi.BSDFContext()
        context.type_mask = int(kinds)
        numbers = (sampler.next(), sampler.pair(), sampler.pair())
        start = (dr.identity(mi.Spectrum), numbers, si.is_valid() & visible)
        direct, after = _scatter(scene, ray, si, context, *start, sample_direction)
        lobes.append(_continue_paths(scene, direct, after, sampler, limits))
    return lobes[0], lobes[1], emitted


def _continue_paths(
    scene: Any, light: list[Any], after: tuple[Any, ...], sampler: Sampler, limits: PathLimits
) -> list[Any]:
    """Continue paths after the first surface, and add the light that they collect.

    Args:
        scene: Mitsuba scene.
        light: [S0, S1, S2] of the light up to the first surface.
        after: state of the paths after the first surface, from ``_scatter``.
        sampler: random numbers of every path.
        limits: limits of the paths.

    Returns:
        [S0, S1, S2] of all light.
    """
    both = mi.BSDFContext()

    def alive(depth: Any, s0: Any, s1: Any, s2: Any, active: Any, *_: Any) -> Any:
        return active

    def step(depth: Any, s0: Any, s1: Any, s2: Any, active: Any, ray: Any, gain: Any, place: Any, pdf: Any,
             delta: Any, random: Any) -> Any:  # fmt: skip
        si = scene.ray_intersect(ray, active)
        sample = mi.DirectionSample3f(scene, si, place)
        rival = scene.pdf_emitter_direction(place, sample, active & (delta ^ True))
        share = dr.select(delta, 1.0, pdf / dr.maximum(pdf + rival, TINY))
        emitted = _emitted(scene, si, active) * dr.select(active, share, 0.0)
        limited = _limited([gain[i, 0] * emitted for i in range(3)], limits.clamp, depth > 1)
        active = active & si.is_valid() & (depth < limits.depth)
        numbers = (random.next_float32(), _point(random), _point(random))
        direct, state = _scatter(scene, ray, si, both, gain, numbers, active, sample_bsdf)
        direct = _limited(direct, limits.clamp, mi.Bool(True))
        state = _russian_roulette(state, random.next_float32(), depth > ROULETTE_FROM)
        s0, s1, s2 = (s + a + b for s, a, b in zip((s0, s1, s2), limited, direct, strict=True))
        return (depth + 1, s0, s1, s2, *state, random)

    start = (mi.UInt32(1), *light, *after, sampler.later)
    end = dr.while_loop(start, alive, step, label="path", max_iterations=limits.depth + 1)
    sampler.later = end[-1]
    return list(end[1:4])


def _scatter(
    scene: Any,
    ray: Any,
    si: Any,
    context: Any,
    gain: Any,
    numbers: tuple[Any, Any, Any],
    active: Any,
    sample_direction: DirectionSampler,
) -> tuple[list[Any], tuple[Any, ...]]:
    """Estimate the direct light at a surface, and continue the path in a new direction.

    Args:
        scene: Mitsuba scene.
        ray: rays that arrive.
        si: intersections of the rays with surfaces.
        context: selection of the lobes.
        gain: Mueller matrix of the path from this surface to the camera.
        numbers: random numbers for a lobe, a direction and a light.
        active: True for paths that continue.
        sample_direction: ``sample_bsdf`` or ``sample_cosine``.

    Returns:
        [S0, S1, S2] of the direct light at the camera; and (active, ray, gain, place, density, delta) of the ray that
        leaves.
    """
    choose, turn, light = numbers
    bsdf = si.bsdf(ray)
    ds, brought = scene.sample_emitter_direction(si, light, True, active)
    lit = active & (ds.pdf > 0)
    toward = si.to_local(ds.d)
    (value, pdf), (wo, density, weight, delta) = sample_direction(
        bsdf, context, si, (choose, turn), toward, active
    )
    back = gain @ si.to_world_mueller(value, -toward, si.wi)
    share = dr.select(ds.delta, 1.0, ds.pdf / dr.maximum(ds.pdf + pdf, TINY))
    arriving = brought[0, 0] * dr.select(lit, share, 0.0)
    direct = [back[i, 0] * arriving for i in range(3)]
    gain = gain @ si.to_world_mueller(weight, -wo, si.wi)
    leaving = si.spawn_ray(si.to_world(wo))
    active = active & (density > 0)
    return direct, (active, mi.Ray3f(leaving), gain, mi.Interaction3f(si), density, delta)


def _russian_roulette(state: tuple[Any, ...], number: Any, where: Any) -> tuple[Any, ...]:
    """End paths of small throughput at random, and increase the weight of the remaining paths to compensate."""
    active, ray, gain, *rest = state
    chance = dr.select(where, dr.clip(dr.max(gain[0, 0]), 0.1, 1.0), 1.0)
    return active & (number < chance), ray, gain * (1 / chance), *rest


def _emitted(scene: Any, si: Any, active: Any) -> Any:
    """Return the unpolarized radiance of the light source or environment at an intersection."""
    return si.emitter(scene).eval(si, active)[0, 0]


def _visible(si: Any) -> Any:
    """Return True if the camera sees the surface at an intersection. Return False for lights and the environment."""
    return si.shape.eval_attribute_1(VISIBLE, si, mi.Bool(si.is_valid())) > 0.5


def _limited(light: list[Any], limit: float, where: Any) -> list[Any]:
    """Scale down a Stokes vector if S0 exceeds the limit. A limit of 0 has no effect."""
    if limit <= 0:
        return light
    peak = dr.max(light[0])
    scale = dr.select(where & (peak > limit), limit / dr.maximum(peak, TINY), 1.0)
    return [part * scale for part in light]


def _point(random: Any) -> Any:
    return mi.Point2f(random.next_float32(), random.next_float32())
