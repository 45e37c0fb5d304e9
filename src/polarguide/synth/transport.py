"""Polarized path tracing that keeps the two lobes of the first surface apart.

Mitsuba supplies geometry, polarized reflection models and emitters; the walk is ours, because Mitsuba's own
integrators add up the lobes. From the first surface two independent paths are followed, one that leaves it by the
specular lobe and one by the diffuse lobe, so that specular + diffuse = S0 holds sample by sample and both layers
carry full Stokes vectors. Light that other surfaces polarized before arrives polarized.

Direct light is found by multiple importance sampling with the balance heuristic (Veach, Guibas 1995). Unpolarized
emitters are all there is, so that of every Mueller matrix only the first column is summed up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from polarguide.synth.draws import Draws
from polarguide.synth.sampling import Sampler, by_cosine, by_surface

TINY = 1e-30
LOTTERY_FROM = 1
"""Number of surfaces after which paths may end by chance."""


@dataclass(frozen=True)
class Walk:
    """How far light is followed.

    Attributes:
        depth: largest number of surfaces that a path touches.
        clamp: largest radiance that one path may bring from beyond its second surface, in scene units; the whole
            Stokes vector of a brighter one is scaled down, which keeps its polarization. 0: no limit, no bias.
    """

    depth: int = 6
    clamp: float = 0.0


def follow(scene: Any, ray: Any, draws: Draws, walk: Walk) -> tuple[list[Any], list[Any], Any]:
    """Light that arrives along rays, by the lobe of the first surface.

    Args:
        scene: Mitsuba scene, of a polarized variant.
        ray: primary rays, with wavelengths in a spectral variant.
        draws: random numbers of every ray.
        walk: limits.

    Returns:
        (specular, diffuse, seen): [S0, S1, S2] of either lobe in Mitsuba's frame of the direction ``-ray.d``, and the
        radiance that a light or the environment sends straight to the camera.
    """
    import drjit as dr
    import mitsuba as mi

    si = scene.ray_intersect(ray)
    seen = _emitted(scene, si, mi.Bool(True))
    flags = mi.BSDFFlags
    lobes = []
    for kinds, sampler in ((flags.Glossy | flags.Delta, by_surface), (flags.Diffuse, by_cosine)):
        context = mi.BSDFContext()
        context.type_mask = int(kinds)
        numbers = (draws.next(), draws.pair(), draws.pair())
        start = (dr.identity(mi.Spectrum), numbers, si.is_valid())
        direct, after = _scatter(scene, ray, si, context, *start, sampler)
        lobes.append(_onwards(scene, direct, after, draws, walk))
    return lobes[0], lobes[1], seen


def _onwards(scene: Any, light: list[Any], after: tuple[Any, ...], draws: Draws, walk: Walk) -> list[Any]:
    """``light`` and all that the paths collect behind the first surface: [S0, S1, S2]."""
    import drjit as dr
    import mitsuba as mi

    both = mi.BSDFContext()

    def alive(depth: Any, s0: Any, s1: Any, s2: Any, active: Any, *_: Any) -> Any:
        return active

    def step(depth: Any, s0: Any, s1: Any, s2: Any, active: Any, ray: Any, gain: Any, place: Any, pdf: Any,
             delta: Any, random: Any) -> Any:  # fmt: skip
        si = scene.ray_intersect(ray, active)
        rival = 0.0
        if si.emitter(scene) is not None:  # always, unless paths are followed one at a time
            seen_from = mi.DirectionSample3f(scene, si, place)
            rival = scene.pdf_emitter_direction(place, seen_from, active & (delta ^ True))
        share = dr.select(delta, 1.0, pdf / dr.maximum(pdf + rival, TINY))
        emitted = _emitted(scene, si, active) * dr.select(active, share, 0.0)
        found = _limited([gain[i, 0] * emitted for i in range(3)], walk.clamp, depth > 1)
        active = active & si.is_valid() & (depth < walk.depth)
        numbers = (random.next_float32(), _point(random), _point(random))
        direct, state = _scatter(scene, ray, si, both, gain, numbers, active, by_surface)
        direct = _limited(direct, walk.clamp, mi.Bool(True))
        state = _lottery(state, random.next_float32(), depth > LOTTERY_FROM)
        s0, s1, s2 = (s + a + b for s, a, b in zip((s0, s1, s2), found, direct, strict=True))
        return (depth + 1, s0, s1, s2, *state, random)

    start = (mi.UInt32(1), *light, *after, draws.later)
    end = dr.while_loop(start, alive, step, label="path", max_iterations=walk.depth + 1)
    draws.later = end[-1]
    return list(end[1:4])


def _scatter(
    scene: Any,
    ray: Any,
    si: Any,
    context: Any,
    gain: Any,
    numbers: tuple[Any, Any, Any],
    active: Any,
    sampler: Sampler,
) -> tuple[list[Any], tuple[Any, ...]]:
    """Direct light at a surface, and how the path goes on.

    Args:
        context: lobes that take part.
        gain: Mueller matrix of the path from this surface to the camera.
        numbers: to choose a lobe, a direction and a light.
        sampler: how directions are drawn.

    Returns:
        [S0, S1, S2] at the camera, and (active, ray, gain, place, density, delta) of the ray that leaves.
    """
    import drjit as dr
    import mitsuba as mi

    if active is False:  # one path at a time: there is no surface to ask
        dark = [mi.UnpolarizedSpectrum(0.0)] * 3
        return dark, (False, mi.Ray3f(ray), gain, mi.Interaction3f(si), 0.0, False)
    choose, turn, light = numbers
    bsdf = si.bsdf(ray)
    ds, brought = scene.sample_emitter_direction(si, light, True, active)
    lit = active & (ds.pdf > 0)
    toward = si.to_local(ds.d)
    (value, pdf), (wo, density, weight, delta) = sampler(bsdf, context, si, (choose, turn), toward, active)
    back = gain @ si.to_world_mueller(value, -toward, si.wi)
    share = dr.select(ds.delta, 1.0, ds.pdf / dr.maximum(ds.pdf + pdf, TINY))
    arriving = brought[0, 0] * dr.select(lit, share, 0.0)
    direct = [back[i, 0] * arriving for i in range(3)]
    gain = gain @ si.to_world_mueller(weight, -wo, si.wi)
    leaving = si.spawn_ray(si.to_world(wo))
    leaving.wavelengths = ray.wavelengths
    active = active & (density > 0)
    return direct, (active, mi.Ray3f(leaving), gain, mi.Interaction3f(si), density, delta)


def _lottery(state: tuple[Any, ...], number: Any, where: Any) -> tuple[Any, ...]:
    """Russian roulette: paths that bring little end early, the others count for more."""
    import drjit as dr

    active, ray, gain, *rest = state
    chance = dr.select(where, dr.clip(dr.max(gain[0, 0]), 0.1, 1.0), 1.0)
    return active & (number < chance), ray, gain * (1 / chance), *rest


def _emitted(scene: Any, si: Any, active: Any) -> Any:
    """Radiance of the light or environment at an intersection, unpolarized."""
    import mitsuba as mi

    emitter = si.emitter(scene)
    return mi.UnpolarizedSpectrum(0.0) if emitter is None else emitter.eval(si, active)[0, 0]


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
