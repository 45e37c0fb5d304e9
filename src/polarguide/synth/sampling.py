"""How a path chooses its direction at a surface, and how densely it would have chosen another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

LEAST_DENSITY = 1e-5
Sampler = Callable[[Any, Any, Any, Any, Any, Any], tuple[Any, Any]]


def by_surface(bsdf: Any, context: Any, si: Any, numbers: Any, toward: Any, active: Any) -> tuple[Any, Any]:
    """Directions as the surface draws them: (value, density) toward a light, and (direction, density, weight, delta)
    of a drawn one."""
    import mitsuba as mi

    given = bsdf.eval_pdf(context, si, toward, active)
    sample, weight = bsdf.sample(context, si, *numbers, active)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return given, (sample.wo, sample.pdf, weight, delta)


def by_cosine(bsdf: Any, context: Any, si: Any, numbers: Any, toward: Any, active: Any) -> tuple[Any, Any]:
    """Directions by Lambert's law; result as of ``by_surface``.

    Mitsuba 3.9 gives values of a coated surface's diffuse lobe rightly, but when that lobe alone is asked for, its
    densities are those of both lobes together.
    """
    import drjit as dr
    import mitsuba as mi

    value = bsdf.eval(context, si, toward, active)
    side = dr.sign(si.wi.z)  # surfaces have two sides
    there = dr.maximum(toward.z * side, 0.0) * dr.inv_pi
    wo = mi.warp.square_to_cosine_hemisphere(numbers[1])
    wo = mi.Vector3f(wo.x, wo.y, wo.z * side)
    density = dr.abs(wo.z) * dr.inv_pi
    active = active & (density > LEAST_DENSITY)
    inverse = dr.select(active, 1 / dr.maximum(density, LEAST_DENSITY), 0.0)
    weight = bsdf.eval(context, si, wo, active) * inverse
    return (value, there), (wo, dr.select(active, density, 0.0), weight, mi.Bool(False))
