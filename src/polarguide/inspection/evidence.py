"""Find the true polarizer angles by comparing the polarization with surface normals and points.

Specular light is polarized perpendicular to the plane of incidence, diffuse light parallel to it. Normals come from a
short training on photographs, which are the means of the four pictures. They do not depend on the order of the
pictures. A comparison with the AoLP is therefore valid.

AoLP and azimuth of the normals agree modulo 90 degrees. The multiple of 90 degrees follows from certainly specular
pixels, whose DoLP exceeds that of diffuse light at their zenith.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.capture.angle_evidence import (
    DEGREES,
    PAIRINGS,
    SENSES,
    OrderEvidence,
    spatial_cells,
    sum_by_cluster,
)
from polarguide.capture.colmap.model import ColmapModel
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.inspection.capture import InspectedView
from polarguide.methods import recipe_named
from polarguide.raster import Backend
from polarguide.runs.folder import resolve
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.context import TrainingContext, TrainingState
from polarguide.training.losses import depth_normals
from polarguide.training.priors import guide_normals
from polarguide.training.recipe import Priors, Recipe
from polarguide.training.settings import StepReport, TrainSettings

NORMALS = "normals of a short training"
"""Name of the evidence from normals in the report."""
POINTS = "points observed in several views"
"""Name of the evidence from points in the report."""


_SENSES = torch.tensor(SENSES)[:, None]


def training_recipe(name: str) -> Recipe:
    """Return the recipe with the given name. It must have stages."""
    recipe = recipe_named(name)
    assert isinstance(recipe, Recipe)
    return recipe


class EvidenceLimits:
    """Thresholds and parameters for the evidence on the polarizer angles.

    Attributes:
        samples: largest number of pixels that are sampled in a view.
        zenith_margin: assumed largest error of the zenith in a rendered normal, radians. A pixel counts as certainly
            specular only if this error cannot explain its DoLP.
        least_zenith: smallest zenith in radians at which the azimuth of a normal is reliable.
        least_dolp: smallest DoLP at which the AoLP of a pixel is used.
        fewest_pixels: smallest number of pixels with a normal for a usable result.
        least_inliers: smallest share of pixels that must agree with their normals.
        largest_error: largest error of the normals, radians.
        least_concentration: smallest length of the mean of ``exp(4 i (AoLP - azimuth))``. It is 1 if AoLP and azimuth
            agree modulo 90 degrees, and 0 if they are unrelated.
        specular: share of certainly specular pixels that are polarized perpendicular to the plane of incidence.
        normal_errors: tested values for the error of normals, radians.
        inliers: tested values for the share of agreeing pixels.
        fewest_observations: smallest number of views that must observe a point.
        fewest_points: smallest number of points for a usable result.
        largest_misfit: largest median angle in degrees between the field directions of a point and their common plane.
        least_scale: lower bound of the mean square of the fields' components along a normal.
        opaque: smallest alpha at which a rendered normal is used.
        agreement: smallest cosine between the rendered normal and the normal that follows from the depth.
    """

    samples = 400
    zenith_margin = math.radians(15.0)
    least_zenith = math.radians(15.0)
    least_dolp = 0.03
    fewest_pixels = 500
    least_inliers = 0.5
    largest_error = math.radians(10.0)
    least_concentration = 0.25
    specular = 0.95
    normal_errors = tuple(math.radians(angle) for angle in (3.0, 6.0, 10.0, 16.0))
    inliers = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97)
    fewest_observations = 4
    fewest_points = 20
    largest_misfit = 8.0
    least_scale = 2e-4
    opaque = 0.9
    agreement = 0.9


@dataclass(frozen=True, eq=False)
class ViewSurface:
    """Normals and depths of the surface that one view shows.

    Attributes:
        camera: camera at the size of the maps.
        normal: [H, W, 3] unit normals in camera axes, on the side of the camera.
        depth: [H, W] depth along the camera's z axis.
        known: [H, W] bool, mask of reliable normals and depths.
    """

    camera: Camera
    normal: Tensor
    depth: Tensor
    known: Tensor


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Sampled pixels with a normal and a measured polarization.

    Attributes:
        aolp: measured AoLP, [N].
        dolp: measured DoLP, [N].
        noise: standard deviation of the DoLP, [N].
        azimuth: azimuth of the normal in radians, [N].
        zenith: zenith of the normal in radians, [N].
        position: position in the world, [N, 3].
    """

    aolp: Tensor
    dolp: Tensor
    noise: Tensor
    azimuth: Tensor
    zenith: Tensor
    position: Tensor = field(kw_only=True)

    def certainly_specular(self, index: float) -> Tensor:
        """Return a mask [N] of pixels whose DoLP is too large for diffuse light at their zenith."""
        most = optics.diffuse_dolp((self.zenith + EvidenceLimits.zenith_margin).clamp(max=math.pi / 2), index)
        return self.dolp > most + 2 * self.noise


def _polarization_planes(view: InspectedView, pairing: int) -> Tensor:
    """Return five maps [1, 5, H, W] of a view.

    They are the three components of the Stokes vector of the luminance, its noise, and 1 for unusable pixels.
    """
    gray = view.intensities().mean(dim=-1)[[PAIRINGS[pairing].index(angle) for angle in optics.ANGLES]]
    unusable = (~view.usable).float()
    return torch.cat((optics.stokes(gray), optics.intensity_noise(gray)[None], unusable[None]))[None]


def sample_surfaces(pairs: Iterable[tuple[InspectedView, ViewSurface]], pairing: int = 0) -> SurfaceSamples:
    """Sample at most 400 pixels per view that have a reliable normal and significant polarization.

    Args:
        pairs: views and their surfaces. The maps of a surface may be smaller than the pictures.
        pairing: pairing of the pictures, an index into ``PAIRINGS``.
    """
    generator = torch.Generator().manual_seed(0)
    samples: list[Tensor] = []
    for view, surface in pairs:
        planes = interpolate(_polarization_planes(view, pairing), size=surface.known.shape, mode="area")[0]
        stokes = planes[:3]
        degree = optics.dolp(stokes)
        spread = optics.dolp_noise(stokes, planes[3])
        rays = surface.camera.rays()
        zenith = optics.zenith(surface.normal, rays)
        good = (
            surface.known & (planes[4] < 1e-3) & (stokes[0] > 0.01) & (zenith > EvidenceLimits.least_zenith)
        )
        good &= (degree > EvidenceLimits.least_dolp) & (degree > 3 * spread)
        chosen = good.flatten().nonzero()[:, 0]
        chosen = chosen[torch.randperm(len(chosen), generator=generator)[: EvidenceLimits.samples]]
        position = surface.camera.to_world(rays / rays[..., 2:] * surface.depth[..., None])
        position = position + surface.camera.center.float()
        azimuth = optics.azimuth(surface.normal, rays)
        rows = (optics.aolp(stokes), degree, spread, azimuth, zenith, *position.unbind(-1))
        samples.append(torch.stack([row.flatten() for row in rows])[:, chosen])
    joined = torch.cat(samples, dim=1) if samples else torch.zeros(8, 0)
    return SurfaceSamples(*joined[:5], position=joined[5:].T)


def normal_evidence(pixels: SurfaceSamples, index: float) -> OrderEvidence:
    """Return the log-likelihood of every zero and both directions of the angles, given the normals.

    Twice a pixel's angle between AoLP and azimuth follows a mixture of three distributions: a von Mises distribution
    around the perpendicular, one around the parallel, and a uniform one. The first two have equal weights. For
    certainly specular pixels, the first has nearly all of the weight. Their width follows from the error of the normals
    divided by the sine of the zenith, and from the noise of the AoLP. The error of the normals and the uniform share
    are fitted by maximum likelihood.
    """
    count = len(pixels.aolp)
    fewest = EvidenceLimits.fewest_pixels
    if count < fewest:
        note = (
            f"Only {count} pixels have a reliable normal and significant polarization; {fewest} are needed."
        )
        return OrderEvidence(NORMALS, torch.zeros(1, len(SENSES), DEGREES), count, False, note)
    specular = pixels.certainly_specular(index)
    coarse = torch.arange(0, DEGREES, 4)
    fits = [
        (float(_log_likelihood(pixels, specular, coarse, error, inliers).sum(dim=0).max()), error, inliers)
        for error in EvidenceLimits.normal_errors
        for inliers in EvidenceLimits.inliers
    ]
    _, error, inliers = max(fits)
    values = _log_likelihood(pixels, specular, torch.arange(DEGREES), error, inliers)
    coherent = _concentration(pixels)
    note = (
        f"{count} pixels, {int(specular.sum())} of which are certainly specular. The AoLP of {inliers:.0%} agrees with "
        f"the normals, whose error is about {math.degrees(error):.0f}° (agreement modulo 90°: {coherent:.2f} of 1)."
    )
    usable = (
        inliers >= EvidenceLimits.least_inliers
        and error <= EvidenceLimits.largest_error
        and coherent >= EvidenceLimits.least_concentration
    )
    return OrderEvidence(NORMALS, sum_by_cluster(values, spatial_cells(pixels.position)), count, usable, note)


def _concentration(pixels: SurfaceSamples) -> float:
    """Return how well AoLP and azimuth agree modulo 90 degrees, in [0, 1].

    The result is the best over both directions of the angles and all zeros.
    """
    angles = 4 * (_SENSES * pixels.aolp - pixels.azimuth)
    return float(torch.hypot(torch.cos(angles).mean(dim=1), torch.sin(angles).mean(dim=1)).max())


def _log_likelihood(
    pixels: SurfaceSamples, specular: Tensor, zeros: Tensor, error: float, inliers: float
) -> Tensor:
    """Return the log-density of each pixel's angle, [N, 2, Z].

    Axes 2 and 3 are the direction of the angles, and the Z zeros in degrees.
    """
    aolp_noise = pixels.noise / (2 * pixels.dolp)
    variance = (error / torch.sin(pixels.zenith)) ** 2 + aolp_noise**2
    concentration = (1 / (4 * variance)).clamp(max=200.0)[:, None, None]
    height = 1 / (math.pi * torch.special.i0e(concentration))
    across = torch.where(specular, EvidenceLimits.specular, 0.5)[:, None, None]
    doubled = 2 * (_SENSES * pixels.aolp - pixels.azimuth).T
    cosine = torch.cos(doubled[:, :, None] + torch.deg2rad(2 * zeros.float()))
    lobes = across * torch.exp(-concentration * (1 + cosine))
    lobes += (1 - across) * torch.exp(-concentration * (1 - cosine))
    return torch.log((1 - inliers) / math.pi + inliers * height * lobes)


def point_evidence(
    views: tuple[InspectedView, ...], model: ColmapModel, index: float, pairing: int = 0
) -> tuple[OrderEvidence, SurfaceSamples | None]:
    """Return the log-likelihood of every zero and both directions of the angles, given the points of a COLMAP model.

    Args:
        views: views with a pose.
        model: points and their observations.
        index: refractive index.
        pairing: pairing of the pictures, an index into ``PAIRINGS``.

    Returns:
        The evidence; and the observations with the normals at the best zero, or None if the evidence is not usable.
    """
    observations = model.observations([view.name for view in views])
    fields, weights, degrees = _observed_fields(views, model.points.double(), observations, index, pairing)
    fewest = EvidenceLimits.fewest_observations
    keep = (weights > 0).sum(dim=1) >= fewest
    count = int((weights[keep] > 0).sum())
    if int(keep.sum()) < EvidenceLimits.fewest_points:
        note = (
            f"Only {int(keep.sum())} points have {fewest} observations with a DoLP above the diffuse limit "
            f"{float(optics.diffuse_dolp_limit(index)):.2f}; {EvidenceLimits.fewest_points} are needed."
        )
        return OrderEvidence(POINTS, torch.zeros(1, 2, DEGREES), count, False, note), None
    weights = weights[keep].double()
    points = model.points[keep]
    spreads = torch.stack([_spread(fields[sense][keep].double(), weights) for sense in range(len(SENSES))])
    observed = (weights > 0).sum(dim=1)
    certainty = (weights.sum(dim=1) / observed)[None, :, None]
    scale = max(float((spreads * certainty).amin(dim=(0, 2)).median()), EvidenceLimits.least_scale)
    likelihood = -0.5 * (observed - 2.0)[None, :, None] * torch.log1p(spreads * certainty / scale)
    sense, zero = divmod(int(likelihood.sum(dim=1).argmax()), DEGREES)
    misfit = math.degrees(math.asin(min(1.0, float(spreads[sense, :, zero].median().sqrt()))))
    note = (
        f"{int(keep.sum())} points with {count} observations above the diffuse limit. At the best zero, their fields "
        f"lie within {misfit:.1f}° of a plane (median)."
    )
    clusters = sum_by_cluster(likelihood.movedim(1, 0), spatial_cells(points))
    usable = misfit <= EvidenceLimits.largest_misfit
    evidence = OrderEvidence(POINTS, clusters.float(), count, usable, note)
    if not usable:
        return evidence, None
    return evidence, _point_samples(
        fields[sense][keep].double(), weights, degrees[keep].unbind(-1), points, zero
    )


def _point_samples(
    fields: Tensor, weights: Tensor, degrees: tuple[Tensor, ...], points: Tensor, zero: int
) -> SurfaceSamples:
    """Return the observations of points as samples.

    The normal of a point is perpendicular to its field directions, which gives its zenith.
    """
    e, p = fields.unbind(dim=2)
    rotated = math.cos(math.radians(zero)) * e + math.sin(math.radians(zero)) * p
    moment = torch.einsum("pv,pvi,pvj->pij", weights, rotated, rotated)
    normals = torch.linalg.eigh(moment)[1][:, :, 0]
    across = math.cos(math.radians(zero)) * p - math.sin(math.radians(zero)) * e
    # The ray is perpendicular to both axes; the normal's component along the second is the sine of the zenith.
    sine = dot(across, normals[:, None].expand_as(across)).abs().clamp(max=1)
    good = weights > 0
    zenith = torch.asin(sine)[good].float()
    zero_angle = torch.zeros_like(zenith)
    position = points[good.nonzero()[:, 0]]
    return SurfaceSamples(
        zero_angle, degrees[0][good], degrees[1][good], zero_angle, zenith, position=position
    )


def _observed_fields(
    views: tuple[InspectedView, ...], points: Tensor, visible: Tensor, index: float, pairing: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the directions of the electric field, and the polarization, that views observe at points.

    Returns:
        [2, P, V, 2, 3] directions of the field in the world, and of the axes perpendicular to field and ray; [P, V]
        weights; and [P, V, 2] DoLP and its noise.
    """
    limit = float(optics.diffuse_dolp_limit(index))
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
        grid = torch.stack((2 * u - 1, 2 * v - 1), dim=-1).float()[None, None]
        planes = grid_sample(_polarization_planes(view, pairing), grid, align_corners=False)[0, :, 0]
        stokes = planes[:3]
        degree = optics.dolp(stokes)
        spread = optics.dolp_noise(stokes, planes[3])
        degrees[:, column] = torch.stack((degree, spread), dim=-1)
        certain = degree > limit + 3 * spread
        good = visible[:, column] & inside & certain & (planes[4] < 1e-3) & (stokes[0] > 0.02)
        # Polarization before the reflection rotates the field by about sqrt(1 - d^2) / d times its DoLP, equally in
        # many observations. The weight is therefore the square of the inverse variance.
        weights[:, column] = good * (degree**2 / (1.05 - degree**2)) ** 2
        x_ref, up_ref = optics.lens_frame(unit(local).float())
        turn = camera.rotation.float()
        angle = optics.aolp(stokes)
        cosine = torch.cos(angle)[:, None]
        sine = _SENSES[..., None] * torch.sin(angle)[:, None]
        fields[:, :, column, 0] = (cosine * x_ref + sine * up_ref) @ turn
        fields[:, :, column, 1] = (cosine * up_ref - sine * x_ref) @ turn
    return fields, weights, degrees


def _spread(fields: Tensor, weights: Tensor) -> Tensor:
    """Return how far the fields of each point deviate from a plane, for every zero, [P, 180].

    The result is the weighted mean square of their components along the best normal. A field rotated by z is ``cos z e
    + sin z p``, so the moments of all zeros follow from three moments.
    """
    share = weights / weights.sum(dim=1, keepdim=True)
    e, p = fields.unbind(dim=2)
    moments = [torch.einsum("pv,pvi,pvj->pij", share, a, b) for a, b in ((e, e), (p, p), (e, p))]
    mixed = moments[2] + moments[2].mT
    spreads = []
    for zero in range(DEGREES):
        c = math.cos(math.radians(zero))
        s = math.sin(math.radians(zero))
        moment = c * c * moments[0] + s * s * moments[1] + s * c * mixed
        spreads.append(torch.linalg.eigvalsh(moment)[:, 0].clamp(min=0))
    return torch.stack(spreads, dim=1)


NORMALS_RECIPE = "3dgs-dr:consistent"
"""Name of the recipe of the short training that gives the normals."""
LONGEST = 160
"""Largest width or height of the training pictures in pixels, after averaging by a whole factor."""


def short_run(
    scene: Scene,
    *,
    steps: int,
    backend: Backend,
    on_step: Callable[[StepReport], None],
    refractive_index: float | None = None,
    recipe: Recipe | None = None,
    until: int = 0,
) -> TrainingState:
    """Run the short training that gives normals or angles, and return its state.

    Args:
        scene: scene at the size of the training.
        steps: number of optimizer steps.
        backend: device and rasterizer.
        on_step: callback after every step.
        refractive_index: refractive index of the surfaces. If None, that of the scene is used.
        recipe: recipe of the training. If None, ``NORMALS_RECIPE`` is used.
        until: step after which the training stops. If 0, all steps are done.
    """
    recipe = recipe or training_recipe(NORMALS_RECIPE)
    settings = resolve(TrainSettings(steps, 0, refractive_index, begin_again=False), scene, recipe)
    loop, _ = gaussian_training(TrainingContext(scene, recipe, settings, backend), None)
    while loop.state.step < (until or steps):
        on_step(loop.step())
    return loop.state


@torch.no_grad()
def trained_surface(state: TrainingState, view: View, backend: Backend) -> ViewSurface:
    """Return the surface that the trained Gaussians show in one view, on the CPU."""
    request = RenderRequest(sh_degree=0, depth=True)
    result = render(state.gaussians, view.camera, backend.rasterize, request).to("cpu")
    rays = view.camera.rays()
    normal, known = guide_normals(view.camera.to_camera(result.normal), rays, Priors.minimum_normal)
    by_depth = unit(view.camera.to_camera(depth_normals(result.depth, view.camera)))
    known = (
        known & (result.alpha > EvidenceLimits.opaque) & (dot(normal, by_depth) > EvidenceLimits.agreement)
    )
    return ViewSurface(view.camera, normal, result.depth, known)
