"""Polarized path tracing that separates the two lobes of the first surface.

Mitsuba supplies geometry, polarized BSDFs and emitters; the integrator is our own, because those of Mitsuba add the
lobes. Two independent paths start at the first surface, one by the specular lobe and one by the diffuse lobe, so that
specular + diffuse = S0 holds for every sample and both layers carry full Stokes vectors. Polarization by further
surfaces is included.

Direct light is estimated by multiple importance sampling with the balance heuristic (Veach and Guibas 1995). All
emitters are unpolarized, so only the first column of every Mueller matrix is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from polarguide.synth.bsdf_sampling import DirectionSampler, sample_bsdf, sample_cosine
from polarguide.synth.sampler import Sampler

TINY = 1e-30
SHOWN = "shown"
"""Of a shape, the attribute that is 1 where the camera sees it and 0 where it is black to it."""
ROULETTE_FROM = 1
"""Number of surfaces after which Russian roulette starts."""


@dataclass(frozen=True)
class PathLimits:
    """Limits of the traced paths.

    Attributes:
        depth: largest number of surfaces on a path.
        clamp: largest radiance that one path may contribute from beyond its second surface, in scene units; the Stokes
            vector of a brighter path is scaled down as a whole. 0: no limit and no bias.
        shown_only: whether the camera sees only shapes whose attribute ``SHOWN`` is 1.
    """

    depth: int = 6
    clamp: float = 0.0
    shown_only: bool = False


def trace_paths(
    scene: Any, ray: Any, sampler: Sampler, limits: PathLimits
) -> tuple[list[Any], list[Any], Any]:
    """Trace the light that arrives along rays, separately for the lobes of the first surface.

    Args:
        scene: Mitsuba scene, of a polarized variant.
        ray: primary rays, with wavelengths in a spectral variant.
        sampler: random numbers of every ray.
        limits: of the paths.

    Returns:
        (specular, diffuse, emitted): [S0, S1, S2] of either lobe in Mitsuba's frame of the direction ``-ray.d``; the
        directly visible radiance of light sources and environment.
    """
    import drjit as dr
    import mitsuba as mi

    si = scene.ray_intersect(ray)
    seen = _shown(si) if limits.shown_only else mi.Bool(True)
    emitted = _emitted(scene, si, mi.Bool(True))
    if limits.shown_only:
        emitted *= dr.select(seen, 1.0, 0.0)  # the scalar variant evaluates emitters that are not active, too
    flags = mi.BSDFFlags
    lobes = []
    for kinds, sample_direction in (
        (flags.Glossy | flags.Delta, sample_bsdf),
        (flags.Diffuse, sample_cosine),
    ):
        context = mi.BSDFContext()
        context.type_mask = int(kinds)
        numbers = (sampler.next(), sampler.pair(), sampler.pair())
        start = (dr.identity(mi.Spectrum), numbers, si.is_valid() & seen)
        direct, after = _scatter(scene, ray, si, context, *start, sample_direction)
        lobes.append(_continue_paths(scene, direct, after, sampler, limits))
    return lobes[0], lobes[1], emitted


def _continue_paths(
    scene: Any, light: list[Any], after: tuple[Any, ...], sampler: Sampler, limits: PathLimits
) -> list[Any]:
    """Add to ``light`` what the paths collect after the first surface: [S0, S1, S2]."""
    import drjit as dr
    import mitsuba as mi

    both = mi.BSDFContext()

    def alive(depth: Any, s0: Any, s1: Any, s2: Any, active: Any, *_: Any) -> Any:
        return active

    def step(depth: Any, s0: Any, s1: Any, s2: Any, active: Any, ray: Any, gain: Any, place: Any, pdf: Any,
             delta: Any, random: Any) -> Any:  # fmt: skip
        si = scene.ray_intersect(ray, active)
        rival = 0.0
        if si.emitter(scene) is not None:  # always, except in the scalar variant
            seen_from = mi.DirectionSample3f(scene, si, place)
            rival = scene.pdf_emitter_direction(place, seen_from, active & (delta ^ True))
        share = dr.select(delta, 1.0, pdf / dr.maximum(pdf + rival, TINY))
        emitted = _emitted(scene, si, active) * dr.select(active, share, 0.0)
        found = _limited([gain[i, 0] * emitted for i in range(3)], limits.clamp, depth > 1)
        active = active & si.is_valid() & (depth < limits.depth)
        numbers = (random.next_float32(), _point(random), _point(random))
        direct, state = _scatter(scene, ray, si, both, gain, numbers, active, sample_bsdf)
        direct = _limited(direct, limits.clamp, mi.Bool(True))
        state = _russian_roulette(state, random.next_float32(), depth > ROULETTE_FROM)
        s0, s1, s2 = (s + a + b for s, a, b in zip((s0, s1, s2), found, direct, strict=True))
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
    """Direct light at a surface, and the continuation of the path.

    Args:
        context: selects the lobes.
        gain: Mueller matrix of the path from this surface to the camera.
        numbers: to choose a lobe, a direction and a light.
        sample_direction: samples directions, and evaluates the density of given ones.

    Returns:
        [S0, S1, S2] at the camera, and (active, ray, gain, place, density, delta) of the ray that leaves.
    """
    import drjit as dr
    import mitsuba as mi

    if active is False:  # the scalar variant: there is no surface
        dark = [mi.UnpolarizedSpectrum(0.0)] * 3
        return dark, (False, mi.Ray3f(ray), gain, mi.Interaction3f(si), 0.0, False)
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
    leaving.wavelengths = ray.wavelengths
    active = active & (density > 0)
    return direct, (active, mi.Ray3f(leaving), gain, mi.Interaction3f(si), density, delta)


def _russian_roulette(state: tuple[Any, ...], number: Any, where: Any) -> tuple[Any, ...]:
    """Russian roulette: end paths of small throughput at random, and raise the weight of the others."""
    import drjit as dr

    active, ray, gain, *rest = state
    chance = dr.select(where, dr.clip(dr.max(gain[0, 0]), 0.1, 1.0), 1.0)
    return active & (number < chance), ray, gain * (1 / chance), *rest


def _emitted(scene: Any, si: Any, active: Any) -> Any:
    """Unpolarized radiance of the light source or environment at an intersection."""
    import mitsuba as mi

    emitter = si.emitter(scene)
    return mi.UnpolarizedSpectrum(0.0) if emitter is None else emitter.eval(si, active)[0, 0]


def _shown(si: Any) -> Any:
    """Whether the camera sees the surface at an intersection; lights and the environment are not among them."""
    import mitsuba as mi

    if si.shape is None:  # the scalar variant
        return False
    return si.shape.eval_attribute_1(SHOWN, si, mi.Bool(si.is_valid())) > 0.5


def _limited(light: list[Any], limit: float, where: Any) -> list[Any]:
    """A Stokes vector scaled so that no wavelength of its S0 exceeds the limit."""
    import drjit as dr

    if limit <= 0:
        return light
    peak = dr.max(light[0])
    scale = dr.select(where & (peak > limit), limit / dr.maximum(peak, TINY), 1.0)
    return [part * scale for part in light]


def _point(random: Any) -> Any:
    import mitsuba as mi

    first = random.next_float32()
    return mi.Point2f(first, random.next_float32())
