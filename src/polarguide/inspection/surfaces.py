"""Evidence from surface normals: specular light is polarized across the plane of incidence, diffuse light in it.

The normals come from a short training on the photographs alone, which no order of the four pictures changes. The
AoLP agrees with their azimuth modulo a quarter turn; which quarter it is, only pixels decide that must be specular,
because their degree of polarization exceeds what diffuse light has at their zenith.
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
from polarguide.inspection.clusters import cells, cluster_sums
from polarguide.inspection.likelihood import DEGREES, Evidence
from polarguide.inspection.orders import PAIRINGS, SENSES

SOURCE = "normals of a short training"
SAMPLES = 400
"""Pixels of a view that are looked at, far enough apart."""
ZENITH_MARGIN = math.radians(15.0)
"""How far a rendered zenith may be off for a pixel to count as one that must be specular."""
LEAST_ZENITH = math.radians(15.0)
LEAST_DOLP = 0.03
FEWEST = 500
LEAST_INLIERS, LARGEST_ERROR, LEAST_CONCENTRATION = 0.5, math.radians(10.0), 0.25
"""When normals are good enough: share of the pixels that agree, error of the normals there, and length of the mean of
``exp(4 i (AoLP - azimuth))``, which is 1 for perfect agreement modulo a quarter turn and 0 for none."""
_SPECULAR = 0.95
_NORMAL_ERRORS = tuple(math.radians(angle) for angle in (3.0, 6.0, 10.0, 16.0))
_INLIERS = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97)


@dataclass(frozen=True, eq=False)
class Surface:
    """What is known of the surface in one view.

    Attributes:
        camera: at the size of the following.
        normal: [H, W, 3] unit, camera axes, facing the camera. depth: [H, W]. known: [H, W] bool, where both are good.
    """

    camera: Camera
    normal: Tensor
    depth: Tensor
    known: Tensor


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels with a normal and a polarization, all [N] but for ``place`` [N, 3] (world).

    Attributes:
        aolp, dolp: measured. azimuth, zenith: of the normal. noise: standard deviation of the DoLP.
    """

    aolp: Tensor
    dolp: Tensor
    noise: Tensor
    azimuth: Tensor
    zenith: Tensor
    place: Tensor

    def must_be_specular(self, index: float) -> Tensor:
        """[N] bool: polarized more than diffuse light can be at this zenith."""
        most = optics.diffuse_dolp((self.zenith + ZENITH_MARGIN).clamp(max=math.pi / 2), index)
        return self.dolp > most + 2 * self.noise


def surface_pixels(pairs: Iterable[tuple[InspectedView, Surface]], pairing: int = 0, seed: int = 0) -> Pixels:
    """Pixels of all views that have a good normal and certain polarization; at most 400 a view.

    Args:
        pairs: views and their surfaces, which may be smaller pictures.
        pairing: which pictures are perpendicular, a position in ``PAIRINGS``.
        seed: of the choice of pixels.
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
        place = surface.camera.to_world(rays / rays[..., 2:] * surface.depth[..., None])
        place = place + surface.camera.center.float()
        rows = (optics.aolp(stokes), degree, spread, optics.azimuth(surface.normal, rays), zenith)
        flat = torch.stack([*(row.flatten() for row in rows), *place.reshape(-1, 3).unbind(-1)])
        found.append(flat[:, chosen])
    rows_found = torch.cat(found, dim=1) if found else torch.zeros(8, 0)
    aolp, dolp, noise_of, azimuth, zenith_of = rows_found[:5].unbind(0)
    return Pixels(aolp, dolp, noise_of, azimuth, zenith_of, rows_found[5:].T)


def surface_evidence(pixels: Pixels, index: float) -> Evidence:
    """Score all zeros and both senses by the normals.

    A pixel's doubled angle between AoLP and azimuth follows a mixture: a von Mises lobe about the perpendicular, one
    about the parallel, and a floor. Both lobes weigh the same, except that a pixel that must be specular has nearly
    all in the first. The width follows from the error of the normals over the sine of the zenith and the noise of the
    AoLP; that error and the floor are fitted where they explain most.
    """
    count = len(pixels.aolp)
    if count < FEWEST:
        note = f"Only {count} pixels have a good normal and certain polarization; {FEWEST} are needed."
        return Evidence(SOURCE, torch.zeros(1, len(SENSES), DEGREES), count, False, note)
    must = pixels.must_be_specular(index)
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
        f"{count} pixels, {int(must.sum())} of which must be specular; the AoLP of {inliers:.0%} agrees with the "
        f"normals, whose error is about {math.degrees(error):.0f}° (agreement modulo 90°: {coherent:.2f} of 1)."
    )
    usable = inliers >= LEAST_INLIERS and error <= LARGEST_ERROR and coherent >= LEAST_CONCENTRATION
    return Evidence(SOURCE, cluster_sums(values, cells(pixels.place)), count, usable, note)


def _concentration(pixels: Pixels) -> float:
    """How well AoLP and azimuth agree modulo a quarter turn, for the better sense and the best zero, in [0, 1]."""
    lengths = []
    for sense in SENSES:
        angle = 4 * (sense * pixels.aolp - pixels.azimuth)
        lengths.append(float(torch.hypot(torch.cos(angle).mean(), torch.sin(angle).mean())))
    return max(lengths)


def _log_likelihood(pixels: Pixels, must: Tensor, zeros: Tensor, error: float, inliers: float) -> Tensor:
    """[N, 2, Z] log-density of the pixels' angles for both senses and zeros [Z] in degrees."""
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
