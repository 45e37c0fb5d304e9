"""Evidence on the angles from surface normals.

Specular light is polarized perpendicular to the plane of incidence, diffuse light parallel to it. The normals come from
a short training on the photographs alone, which do not depend on the order of the four pictures. The AoLP agrees with
their azimuth modulo 90 degrees; the multiple of 90 degrees follows from certainly specular pixels, whose DoLP exceeds
that of diffuse light at their zenith.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from polarguide import optics
from polarguide.camera import Camera
from polarguide.inspection.capture import InspectedView
from polarguide.inspection.likelihood import DEGREES, Evidence, spatial_cells, sum_by_cluster
from polarguide.inspection.orders import PAIRINGS, SENSES

SOURCE = "normals of a short training"
SAMPLES = 400
"""Largest number of pixels that are sampled in a view."""
ZENITH_MARGIN = math.radians(15.0)
"""Error of a rendered zenith up to which a pixel still counts as certainly specular."""
LEAST_ZENITH = math.radians(15.0)
LEAST_DOLP = 0.03
FEWEST = 500
LEAST_INLIERS, LARGEST_ERROR, LEAST_CONCENTRATION = 0.5, math.radians(10.0), 0.25
"""Limits for usable normals: share of pixels that agree, error of the normals there, and length of the mean of
``exp(4 i (AoLP - azimuth))``, which is 1 for perfect agreement modulo 90 degrees and 0 for none."""
_SPECULAR = 0.95
_NORMAL_ERRORS = tuple(math.radians(angle) for angle in (3.0, 6.0, 10.0, 16.0))
_INLIERS = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97)


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that one view sees.

    Attributes:
        camera: at the size of the maps.
        normal: unit normals in camera axes that face the camera, [H, W, 3]. depth: camera z, [H, W].
        known: whether normal and depth are reliable, [H, W] bool.
    """

    camera: Camera
    normal: Tensor
    depth: Tensor
    known: Tensor


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Pixels with a normal and a measured polarization.

    Attributes:
        aolp, dolp: measured, [N]. noise: standard deviation of the DoLP, [N].
        azimuth, zenith: angles of the normal in radians, [N]. position: in the world, [N, 3].
    """

    aolp: Tensor
    dolp: Tensor
    noise: Tensor
    azimuth: Tensor
    zenith: Tensor
    position: Tensor

    def certainly_specular(self, index: float) -> Tensor:
        """Whether the DoLP exceeds that of diffuse light at this zenith, [N] bool."""
        most = optics.diffuse_dolp((self.zenith + ZENITH_MARGIN).clamp(max=math.pi / 2), index)
        return self.dolp > most + 2 * self.noise


def sample_surfaces(
    pairs: Iterable[tuple[InspectedView, Surface]], pairing: int = 0, seed: int = 0
) -> SurfaceSamples:
    """Sample pixels with a reliable normal and significant polarization, at most 400 per view.

    Args:
        pairs: views and their surfaces, whose maps may be smaller than the pictures.
        pairing: the pairs of perpendicular pictures, an index into ``PAIRINGS``.
        seed: of the random sampling.
    """
    order = [PAIRINGS[pairing].index(angle) for angle in optics.ANGLES]
    generator = torch.Generator().manual_seed(seed)
    found: list[Tensor] = []
    for view, surface in pairs:
        size = surface.known.shape
        gray = view.intensities().mean(dim=-1)[order]
        noise = optics.intensity_noise(gray)
        planes = torch.cat((optics.stokes(gray), noise[None], (~view.usable).float()[None]))
        planes = interpolate(planes[None], size=size, mode="area")[0]
        stokes, degree = planes[:3], optics.dolp(planes[:3])
        spread = optics.dolp_noise(stokes, planes[3])
        rays = surface.camera.rays()
        zenith = optics.zenith(surface.normal, rays)
        good = surface.known & (planes[4] < 1e-3) & (stokes[0] > 0.01) & (zenith > LEAST_ZENITH)
        good &= (degree > LEAST_DOLP) & (degree > 3 * spread)
        chosen = good.flatten().nonzero()[:, 0]
        chosen = chosen[torch.randperm(len(chosen), generator=generator)[:SAMPLES]]
        position = surface.camera.to_world(rays / rays[..., 2:] * surface.depth[..., None])
        position = position + surface.camera.center.float()
        rows = (optics.aolp(stokes), degree, spread, optics.azimuth(surface.normal, rays), zenith)
        flat = torch.stack([*(row.flatten() for row in rows), *position.reshape(-1, 3).unbind(-1)])
        found.append(flat[:, chosen])
    rows_found = torch.cat(found, dim=1) if found else torch.zeros(8, 0)
    aolp, dolp, noise_of, azimuth, zenith_of = rows_found[:5].unbind(0)
    return SurfaceSamples(aolp, dolp, noise_of, azimuth, zenith_of, rows_found[5:].T)


def normal_evidence(pixels: SurfaceSamples, index: float) -> Evidence:
    """Log-likelihoods of all zeros and both senses, given the normals.

    Twice a pixel's angle between AoLP and azimuth follows a mixture: a von Mises distribution about the perpendicular,
    one about the parallel, and a uniform one. The first two have equal weights; for certainly specular pixels the first
    has nearly all. Their width follows from the error of the normals over the sine of the zenith and from the noise of
    the AoLP; that error and the uniform share are fitted by maximum likelihood.
    """
    count = len(pixels.aolp)
    if count < FEWEST:
        note = (
            f"Only {count} pixels have a reliable normal and significant polarization; {FEWEST} are needed."
        )
        return Evidence(SOURCE, torch.zeros(1, len(SENSES), DEGREES), count, False, note)
    must = pixels.certainly_specular(index)
    coarse = torch.arange(0, DEGREES, 4)
    fits = [
        (float(_log_likelihood(pixels, must, coarse, error, inliers).sum(dim=0).max()), error, inliers)
        for error in _NORMAL_ERRORS
        for inliers in _INLIERS
    ]
    _, error, inliers = max(fits)
    values = _log_likelihood(pixels, must, torch.arange(DEGREES), error, inliers)
    coherent = _concentration(pixels)
    note = (
        f"{count} pixels, {int(must.sum())} of which are certainly specular; the AoLP of {inliers:.0%} agrees with the "
        f"normals, whose error is about {math.degrees(error):.0f}° (agreement modulo 90°: {coherent:.2f} of 1)."
    )
    usable = inliers >= LEAST_INLIERS and error <= LARGEST_ERROR and coherent >= LEAST_CONCENTRATION
    return Evidence(SOURCE, sum_by_cluster(values, spatial_cells(pixels.position)), count, usable, note)


def _concentration(pixels: SurfaceSamples) -> float:
    """Agreement of AoLP and azimuth modulo 90 degrees, for the better sense and the best zero, in [0, 1]."""
    lengths = []
    for sense in SENSES:
        angle = 4 * (sense * pixels.aolp - pixels.azimuth)
        lengths.append(float(torch.hypot(torch.cos(angle).mean(), torch.sin(angle).mean())))
    return max(lengths)


def _log_likelihood(
    pixels: SurfaceSamples, must: Tensor, zeros: Tensor, error: float, inliers: float
) -> Tensor:
    """Log-density of the pixels' angles for both senses and zeros [Z] in degrees, [N, 2, Z]."""
    aolp_noise = pixels.noise / (2 * pixels.dolp)
    variance = (error / torch.sin(pixels.zenith)) ** 2 + aolp_noise**2
    concentration = (1 / (4 * variance)).clamp(max=200.0)[:, None]
    height = 1 / (math.pi * torch.special.i0e(concentration))
    across = torch.where(must, _SPECULAR, 0.5)[:, None]
    turn = torch.deg2rad(2 * zeros.float())[None]
    found = []
    for sense in SENSES:
        cosine = torch.cos(2 * (sense * pixels.aolp - pixels.azimuth)[:, None] + turn)
        lobes = across * torch.exp(-concentration * (1 + cosine))
        lobes += (1 - across) * torch.exp(-concentration * (1 - cosine))
        found.append(torch.log((1 - inliers) / math.pi + inliers * height * lobes))
    return torch.stack(found, dim=1)
