"""Evidence on the angles from 3D points that several views observe.

Light whose DoLP exceeds that of diffuse reflection at any zenith is specular, and its electric field ``e`` is
perpendicular to the surface normal. The fields of one point in several views therefore lie in one plane if order, sense
and zero of the angles are right, and in general not otherwise. No normals are needed, and points that a flat mirror
shows behind its surface are as good: all of them have the normal of the mirror.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from polarguide import optics
from polarguide.capture.colmap.model import ColmapModel
from polarguide.inspection.capture import InspectedView
from polarguide.inspection.likelihood import DEGREES, Evidence, spatial_cells, sum_by_cluster
from polarguide.inspection.orders import PAIRINGS, SENSES
from polarguide.inspection.surfaces import SurfaceSamples
from polarguide.vectors import dot, unit

SOURCE = "points observed in several views"
FEWEST_OBSERVATIONS = 4
FEWEST_POINTS = 20
LARGEST_MISFIT_DEG = 8.0
"""Median angle in degrees between fields and their common plane above which the evidence is not used."""
_LEAST_SCALE = 2e-4


def point_evidence(
    views: tuple[InspectedView, ...], model: ColmapModel, index: float, pairing: int = 0
) -> tuple[Evidence, SurfaceSamples | None]:
    """Log-likelihoods of all zeros and both senses, given the points of a COLMAP model.

    Args:
        views: the views with a pose.
        model: points and their observations.
        index: refractive index.
        pairing: the pairs of perpendicular pictures, an index into ``PAIRINGS``.

    Returns:
        The evidence; and, if it is usable, the observations with the normals found at the best zero.
    """
    observations = model.observations([view.name for view in views])
    fields, weights, degrees = _observed_fields(views, model.points.double(), observations, index, pairing)
    keep = (weights > 0).sum(dim=1) >= FEWEST_OBSERVATIONS
    count = int((weights[keep] > 0).sum())
    if int(keep.sum()) < FEWEST_POINTS:
        return Evidence(
            SOURCE, torch.zeros(1, 2, DEGREES), count, False, _too_few(int(keep.sum()), index)
        ), None
    weights, points = weights[keep].double(), model.points[keep]
    spreads = torch.stack([_spread(fields[sense][keep].double(), weights) for sense in range(len(SENSES))])
    observed = (weights > 0).sum(dim=1)
    certainty = (weights.sum(dim=1) / observed)[None, :, None]
    scale = max(float((spreads * certainty).amin(dim=(0, 2)).median()), _LEAST_SCALE)
    likelihood = -0.5 * (observed - 2.0)[None, :, None] * torch.log1p(spreads * certainty / scale)
    total = likelihood.sum(dim=1)
    sense, zero = divmod(int(total.argmax()), DEGREES)
    misfit = math.degrees(math.asin(min(1.0, float(spreads[sense, :, zero].median().sqrt()))))
    note = (
        f"{int(keep.sum())} points with {count} observations above the diffuse limit; at the best zero their fields "
        f"lie within {misfit:.1f}° of a plane (median)."
    )
    clusters = sum_by_cluster(likelihood.movedim(1, 0), spatial_cells(points))
    usable = misfit <= LARGEST_MISFIT_DEG
    evidence = Evidence(SOURCE, clusters.float(), count, usable, note)
    if not usable:
        return evidence, None
    return evidence, _seen_pixels(
        fields[sense][keep].double(), weights, degrees[keep].unbind(-1), points, zero
    )


def _seen_pixels(
    fields: Tensor, weights: Tensor, degrees: tuple[Tensor, ...], points: Tensor, zero: int
) -> SurfaceSamples:
    """Observations as samples: their DoLP, and the zenith of the normal perpendicular to the fields of their point."""
    e, p = fields.unbind(dim=2)
    turned = math.cos(math.radians(zero)) * e + math.sin(math.radians(zero)) * p
    moment = torch.einsum("pv,pvi,pvj->pij", weights, turned, turned)
    normals = torch.linalg.eigh(moment)[1][:, :, 0]
    across = math.cos(math.radians(zero)) * p - math.sin(math.radians(zero)) * e
    # The ray is perpendicular to both axes; the normal's component along the second is the sine of the zenith.
    sine = dot(across, normals[:, None].expand_as(across)).abs().clamp(max=1)
    good = weights > 0
    zenith = torch.asin(sine)[good].float()
    nothing = torch.zeros_like(zenith)
    return SurfaceSamples(
        nothing, degrees[0][good], degrees[1][good], nothing, zenith, points[good.nonzero()[:, 0]]
    )


def _too_few(found: int, index: float) -> str:
    limit = float(optics.diffuse_dolp_limit(index))
    return (
        f"Only {found} points have {FEWEST_OBSERVATIONS} observations with a DoLP above the diffuse limit "
        f"{limit:.2f}; {FEWEST_POINTS} are needed."
    )


def _observed_fields(
    views: tuple[InspectedView, ...], points: Tensor, seen: Tensor, index: float, pairing: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Fields in the world and the axes perpendicular to field and ray, [2, P, V, 2, 3]; weights [P, V]; DoLP and its
    noise [P, V, 2].
    """
    limit = float(optics.diffuse_dolp_limit(index))
    order = [PAIRINGS[pairing].index(angle) for angle in optics.ANGLES]
    fields = torch.zeros(len(SENSES), len(points), len(views), 2, 3)
    weights = torch.zeros(len(points), len(views))
    degrees = torch.zeros(len(points), len(views), 2)
    for column, view in enumerate(views):
        camera = view.camera
        assert camera is not None
        local = points @ camera.rotation.T + camera.translation
        depth = local[:, 2].clamp(min=1e-9)
        u = (camera.fx * local[:, 0] / depth + camera.cx) / camera.width
        v = (camera.fy * local[:, 1] / depth + camera.cy) / camera.height
        inside = (local[:, 2] > 1e-9) & (torch.minimum(u, v) > 0.01) & (torch.maximum(u, v) < 0.99)
        gray = view.intensities().mean(dim=-1)[order]
        noise = optics.intensity_noise(gray)
        planes = torch.cat((optics.stokes(gray), noise[None], (~view.usable).float()[None]))
        grid = torch.stack((2 * u - 1, 2 * v - 1), dim=-1).float()[None, None]
        sampled = grid_sample(planes[None], grid, align_corners=False)[0, :, 0]
        stokes, degree = sampled[:3], optics.dolp(sampled[:3])
        spread = optics.dolp_noise(stokes, sampled[3])
        degrees[:, column] = torch.stack((degree, spread), dim=-1)
        certain = degree > limit + 3 * spread
        good = seen[:, column] & inside & certain & (sampled[4] < 1e-3) & (stokes[0] > 0.02)
        # Light that was polarized before the reflection turns the field by about sqrt(1 - d^2) / d times its DoLP,
        # alike in many observations: hence the square of the inverse variance that this suggests.
        weights[:, column] = good * (degree**2 / (1.05 - degree**2)) ** 2
        x_ref, up_ref = optics.lens_frame(unit(local).float())
        turn = camera.rotation.float()
        angle = optics.aolp(stokes)
        for k, sense in enumerate(SENSES):
            cosine, sine = torch.cos(angle)[:, None], sense * torch.sin(angle)[:, None]
            fields[k, :, column, 0] = (cosine * x_ref + sine * up_ref) @ turn
            fields[k, :, column, 1] = (cosine * up_ref - sine * x_ref) @ turn
    return fields, weights, degrees


def _spread(fields: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean square of the fields' components along the best normal for every zero, [P, 180].

    A field rotated by z is ``cos z e + sin z p``, so the moments of all zeros follow from three moments.
    """
    share = weights / weights.sum(dim=1, keepdim=True)
    e, p = fields.unbind(dim=2)
    moments = [torch.einsum("pv,pvi,pvj->pij", share, a, b) for a, b in ((e, e), (p, p), (e, p))]
    mixed = moments[2] + moments[2].mT
    found = []
    for zero in range(DEGREES):
        c, s = math.cos(math.radians(zero)), math.sin(math.radians(zero))
        moment = c * c * moments[0] + s * s * moments[1] + s * c * mixed
        found.append(torch.linalg.eigvalsh(moment)[:, 0].clamp(min=0))
    return torch.stack(found, dim=1)
