"""Sampling of directions at a surface, and the density of given directions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

LEAST_DENSITY = 1e-5
DirectionSampler = Callable[[Any, Any, Any, Any, Any, Any], tuple[Any, Any]]


def sample_bsdf(bsdf: Any, context: Any, si: Any, numbers: Any, toward: Any, active: Any) -> tuple[Any, Any]:
    """Sample a direction by Mitsuba's BSDF.

    Returns:
        (value, density) for the direction ``toward`` a light; (direction, density, weight, delta) of the sampled one.
    """
    import mitsuba as mi

    given = bsdf.eval_pdf(context, si, toward, active)
    sample, weight = bsdf.sample(context, si, *numbers, active)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return given, (sample.wo, sample.pdf, weight, delta)


def sample_cosine(
    bsdf: Any, context: Any, si: Any, numbers: Any, toward: Any, active: Any
) -> tuple[Any, Any]:
    """Sample a direction with a density proportional to the cosine; returns what ``sample_bsdf`` does.

    Mitsuba 3.9 evaluates the diffuse lobe of a coated surface correctly, but if only this lobe is selected, its
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
