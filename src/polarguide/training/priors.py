"""Polarization priors of a view, from its Stokes vectors and the normals of frozen Gaussians.

PolarGuide-GSDR (Shan et al. 2026) couples Gaussians and polarization in this way. The normals of the Gaussians resolve
the ambiguities of polarization normals and of the separation into layers. The resulting priors supervise the Gaussians
until the next refresh.

A flat mirroring surface has a single normal, which explains the polarization of a large part of a view. Light that a
dielectric or a metal mirrors is polarized across the plane of incidence. The AoLP of a pixel therefore gives a
direction perpendicular to its normal, for any mirrored light at any apparent depth. The directions of many pixels
determine the normal of the plane up to its sign. The sign follows from the camera, because the surface faces it. Both
ambiguities, of pi and of pi/2, vanish. Still water appears at the depth of the mirrored scene, and polarization is the
only cue to its surface.

The planes of incidence of a sphere also meet in one line, the ray through its center. There Fresnel's equations allow
almost no polarization, so that the measurement contradicts this normal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.capture.exposures import FOUR
from polarguide.geometry.vectors import dot, unit
from polarguide.optics.color import srgb_encode
from polarguide.training.recipe import Candidates, FlatRules, Priors
from polarguide.training.targets import ViewPriors


@dataclass(frozen=True, eq=False)
class Flat:
    """A flat surface in a view.

    Attributes:
        normal: [3] unit normal, world axes, towards the camera.
        where: [H, W] bool, True for pixels that the normal explains.
    """

    normal: Tensor
    where: Tensor

    def to(self, device: torch.device) -> Flat:
        """Return the surface on a device."""
        return Flat(self.normal.to(device), self.where.to(device))


@torch.no_grad()
def flat_surface(view: View, refractive_index: float, rules: FlatRules) -> Flat | None:
    """Find the flat surface that explains the most pixels of a view.

    Return None if no surface explains enough pixels. The pictures of the view have to determine the Stokes vector.
    Random pairs of pixels propose normals. The proposal with the most agreeing pixels is refined by least squares on
    these pixels.
    """
    luminance = optics.luminance(view.stokes())
    rays = view.camera.rays()
    degree = optics.dolp(luminance)
    good = (degree > rules.faint) & ~view.invalid & ~view.saturated
    x_ref, up_ref = optics.lens_frame(rays)
    angle = 0.5 * torch.atan2(luminance[2], luminance[1])[..., None]
    across = x_ref * angle.cos() + up_ref * angle.sin()

    pixels = good.numel()
    step = max(1, round((pixels / rules.samples) ** 0.5))
    sampled = torch.zeros_like(good)
    sampled[::step, ::step] = good[::step, ::step]
    e = across[sampled]
    d = rays[sampled]
    dolp = degree[sampled]
    fewest = rules.least * pixels / step**2
    if len(e) < max(2.0, fewest):
        return None
    pairs = torch.randint(len(e), (2, rules.tries), generator=torch.Generator().manual_seed(0))
    proposed = torch.linalg.cross(e[pairs[0]], e[pairs[1]])
    proposed = unit(proposed[proposed.norm(dim=-1) > rules.apart])
    if not len(proposed):
        return None
    proposed = torch.cat((proposed, -proposed))
    fits = _agrees(proposed @ e.T, -(proposed @ d.T), dolp, refractive_index, rules)
    best = fits.sum(dim=1).argmax()
    normal = proposed[best]
    inside = fits[best]
    for _ in range(3):
        _, vectors = torch.linalg.eigh(e[inside].T @ e[inside])
        normal = vectors[:, 0] * torch.sign(vectors[:, 0] @ normal)
        inside = _agrees(e @ normal, -(d @ normal), dolp, refractive_index, rules)
    if float(inside.sum()) < fewest:
        return None
    everywhere = normal.expand_as(rays)
    where = good & _agrees(dot(across, everywhere), -dot(rays, everywhere), degree, refractive_index, rules)
    around = torch.nn.functional.avg_pool2d(where[None].float(), rules.window, 1, rules.window // 2)[0]
    return Flat(view.camera.to_world(normal), where & (around > rules.most))


def _agrees(off: Tensor, cosine: Tensor, dolp: Tensor, refractive_index: float, rules: FlatRules) -> Tensor:
    """Return a mask of pixels that agree with normals.

    Args:
        off: cosine between the normal and the direction across the plane of incidence of the pixel.
        cosine: cosine between the normal and the direction to the camera.
        dolp: DoLP of the pixel.
        refractive_index: refractive index of the surface.
        rules: tolerances.
    """
    allowed = (
        optics.specular_dolp(cosine.clamp(0, 1).acos(), refractive_index) * rules.slack[0] + rules.slack[1]
    )
    return (off.abs() < rules.close) & (cosine > rules.grazing) & (dolp < allowed)


def flat_surfaces(views: Iterable[View], refractive_index: float, rules: FlatRules) -> dict[str, Flat]:
    """Find flat surfaces that appear with similar normals in enough views, and return them by view.

    Each returned surface has the mean normal of the similar surfaces. Views that do not determine the Stokes vector are
    skipped.
    """
    surfaces = dict[str, Flat]()
    determined = 0
    for view in views:
        if view.is_determined:
            determined += 1
            if (flat := flat_surface(view, refractive_index, rules)) is not None:
                surfaces[view.name] = flat
    if not surfaces:
        return {}
    normals = torch.stack([flat.normal for flat in surfaces.values()])
    sizes = torch.stack([flat.where.sum() for flat in surfaces.values()]).to(normals)
    alike = normals @ normals.T > torch.cos(torch.deg2rad(normals.new_tensor(rules.alike)))
    enough = max(rules.fewest, rules.share * determined)
    agreed = {}
    for (name, flat), others in zip(surfaces.items(), alike, strict=True):
        if int(others.sum()) >= enough:
            agreed[name] = replace(flat, normal=unit((normals * (others * sizes)[:, None]).sum(dim=0)))
    return agreed


class Unguided(NamedTuple):
    """Part of a view's priors that depends on the pictures alone.

    It does not depend on the Gaussians, so it is computed once and reused at all refreshes. The last four attributes
    have values only if the settings request normals from color differences, and None otherwise.

    Attributes:
        usable: [H, W] bool, True for pixels whose polarization exceeds the threshold and its noise.
        degree: [H, W] DoLP. It has no bias by noise if the settings test it against the noise.
        zenith, azimuth: [H, W] angles in radians of the normals from color differences.
        certainty: [H, W] weight of these normals, in [0, 1]; 0 where color differences determine no normal.
        colorful: [H, W] 0 for a gray body, 1 for a colored body, and values between them.
    """

    usable: Tensor
    degree: Tensor
    zenith: Tensor | None = None
    azimuth: Tensor | None = None
    certainty: Tensor | None = None
    colorful: Tensor | None = None


@torch.no_grad()
def unguided(view: View, settings: Priors, refractive_index: float) -> Unguided:
    """Compute the part of a view's priors that needs no Gaussians.

    Args:
        view: the capture; the computation runs on its device.
        settings: settings of the priors.
        refractive_index: refractive index of all surfaces.
    """
    stokes = view.stokes()
    noise: Tensor | float = 0.0
    if settings.snr and view.exposures == FOUR:  # only redundant pictures allow an estimate of the noise
        noise = optics.intensity_noise(view.intensities().mean(dim=-1))
    luminance = optics.luminance(stokes)
    usable = optics.polarization_mask(
        luminance,
        threshold=settings.threshold,
        invalid=view.invalid,
        noise_sigma=noise,
        snr=settings.snr,
        saturated=view.saturated,
    )
    degree = debiased_dolp(luminance, noise)
    if not settings.chromatic:
        return Unguided(usable, degree)
    good = ~(view.invalid | view.saturated)
    return Unguided(usable, degree, *_chromatic_angles(stokes, refractive_index, good, settings))


def debiased_dolp(luminance: Tensor, noise: Tensor | float) -> Tensor:
    """Return the DoLP [H, W] without the bias of noise.

    Args:
        luminance: [3, H, W] Stokes vectors.
        noise: [H, W] standard deviation of one of the four intensities. 0 means no noise.
    """
    if not isinstance(noise, Tensor):
        return optics.dolp(luminance)
    return optics.polarization_uncertainty(luminance, (noise * noise).expand(4, *noise.shape)).debiased


def guide_normals(normal: Tensor, rays: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Convert blended normals to unit normals that face the camera.

    Returns a tuple of the unit normals [H, W, 3] and a mask [H, W] of the pixels with a reliable normal.

    Args:
        normal: [H, W, 3] blended normals. A normal that faces away from the camera is turned until it is perpendicular
            to the ray.
        rays: [H, W, 3] unit directions from the camera.
        least: length above which a blended normal is reliable.
    """
    reliable = dot(normal, normal) > least**2
    facing = unit(normal)
    overshoot = dot(facing, rays)[..., None].clamp(min=0)
    return unit(facing - overshoot * 1.001 * rays), reliable


@torch.no_grad()
def view_priors(
    view: View,
    normal: Tensor,
    settings: Priors,
    refractive_index: float | Tensor,
    precomputed: Unguided | None = None,
    metal: Tensor | None = None,
    flat: Flat | None = None,
) -> ViewPriors:
    """Compute the priors of one view.

    Args:
        view: the capture; its pictures have to determine the Stokes vector.
        normal: [H, W, 3] normals rendered from the frozen Gaussians, world axes, any length. The computation runs on
            the device of this tensor.
        settings: candidates, separation and other settings of the priors.
        refractive_index: refractive index of all surfaces, or [H, W] of each pixel.
        precomputed: result of ``unguided`` for the view. With None it is computed here, and the refractive index must
            be a number.
        metal: [H, W] share of metals, to which the rules for dielectrics do not apply. None means that there are no
            metals.
        flat: a flat surface. Where its normal is far from the rendered normals, it replaces them and the normals from
            color differences.
    """
    view, rays = view.to(normal.device), view.camera.rays(device=normal.device)
    if precomputed is None:
        assert not isinstance(refractive_index, Tensor)
        precomputed = unguided(view, settings, refractive_index)
    stokes = view.stokes()
    luminance = optics.luminance(stokes)
    guide = _guide(view, normal, flat, rays, settings)
    nearest_to = guide.normal
    by_color = _by_color(precomputed, guide, settings, rays)
    if by_color is not None:
        nearest_to = torch.where(by_color[1][..., None] > 0, by_color[0], guide.normal)
    candidates = _candidates(settings.candidates, luminance, rays, refractive_index)
    normals = candidates if isinstance(candidates, Tensor) else candidates.normals
    chosen = optics.disambiguate(candidates, nearest_to, rays, azimuth_weight=settings.azimuth_weight).normal
    layers = _separated(stokes, guide, settings, refractive_index, rays)
    conditioned = layers.conditioned & ~view.saturated
    counts = precomputed.usable if settings.live else precomputed.usable & guide.shown
    weight = (precomputed.degree / settings.full_dolp).clamp(max=1) * counts
    chromatic, chromatic_weight = (chosen, torch.zeros_like(weight)) if by_color is None else by_color
    weight = torch.maximum(weight, chromatic_weight)
    reliable = (~(view.invalid | view.saturated)).float()
    if metal is not None:
        body, predicted = _without_metal(metal, luminance, guide.normal, rays, settings.metal_share)
        conditioned = conditioned * body
        chromatic_weight = chromatic_weight * body
        weight = weight * predicted
        reliable = reliable * predicted
    return ViewPriors(
        specular=srgb_encode((layers.specular / 2).clamp(0, 1)),
        diffuse=srgb_encode((layers.diffuse / 2).clamp(0, 1)),
        separated=conditioned * (~view.invalid).float(),
        normal=view.camera.to_world(chosen),
        plane=view.camera.to_world(
            _plane(chosen, by_color, precomputed.degree < settings.chromatic_plane_dolp, rays)
        ),
        weight=weight,
        chromatic=view.camera.to_world(chromatic),
        chromatic_weight=chromatic_weight,
        camera=view.camera,
        stokes=stokes,
        stokes_weight=stokes_weight(stokes, reliable),
        surface=surface_weight(stokes, weight, settings.bright),
        candidates=view.camera.to_world(normals) if settings.live else None,
        azimuth_share=settings.azimuth_share,
        chromatic_share=settings.chromatic_share,
    )


def stokes_weight(stokes: Tensor, reliable: Tensor) -> Tensor:
    """Return the weight [H, W] of S1 and S2, which is one over the square root of S0.

    The variance of photon noise is proportional to S0.

    Args:
        stokes: [3, H, W, 3] measured Stokes vectors.
        reliable: [H, W] 1 where the measurement is reliable, 0 elsewhere.
    """
    return reliable * (stokes[0].mean(dim=-1) + 0.01).rsqrt()


def surface_weight(stokes: Tensor, weight: Tensor, bright: float) -> Tensor:
    """Return the weight [H, W] of the agreement of normals and depth, in [0, 1].

    Args:
        stokes: [3, H, W, 3] measured Stokes vectors.
        weight: [H, W] weight of the polarization normal.
        bright: S0/2 above which the agreement has full weight. With 0, it has the weight of the polarization normal.
    """
    if not bright:
        return weight
    radiance = optics.luminance(stokes)[0] / 2
    return torch.maximum(weight, (radiance / bright).clamp(0, 1))


def _plane(chosen: Tensor, by_color: tuple[Tensor, Tensor] | None, faint: Tensor, rays: Tensor) -> Tensor:
    """Return normals [H, W, 3] of the planes of incidence, camera axes.

    Args:
        chosen: [H, W, 3] chosen candidates.
        by_color: see ``_by_color``.
        faint: [H, W] bool, True for nearly unpolarized pixels.
        rays: [H, W, 3] unit directions from the camera.
    """
    plane = unit(torch.linalg.cross(rays, chosen))
    if by_color is None:
        return plane
    # Nearly unpolarized light has no reliable AoLP, but the slope among its colors may have one.
    better = (by_color[1] > 0) & faint
    return torch.where(better[..., None], unit(torch.linalg.cross(rays, by_color[0])), plane)


def _without_metal(
    metal: Tensor, luminance: Tensor, normal: Tensor, rays: Tensor, shares: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Return two weights of the pixels of a view that contains metals.

    Returns a tuple of two tensors [H, W]. The first is a weight for terms that hold for dielectrics only. The second is
    a weight for terms that predict both materials.

    Args:
        metal: [H, W] share of metals.
        luminance: [3, H, W] Stokes vectors.
        normal, rays: [H, W, 3] camera axes.
        shares: two metal shares. At the first, a pixel counts as a dielectric, and at the second as a metal.
    """
    none, whole = shares
    body = 1 - ((metal - none) / (whole - none)).clamp(0, 1)
    # Light from a metal that is polarized in the plane of incidence was polarized before the reflection. The model does
    # not predict it.
    return body, 1 - (1 - body) * (_across(luminance, normal, rays) < 0)


class _Guide(NamedTuple):
    """Normals of the guide in camera axes.

    Attributes:
        normal: [H, W, 3] normals.
        shown: [H, W] bool, True for pixels with a known normal.
        on_plane: [H, W, 3] normals of the flat surface.
        astray: [H, W] bool, True for pixels where ``on_plane`` replaces the normals of the Gaussians.
    """

    normal: Tensor
    shown: Tensor
    on_plane: Tensor
    astray: Tensor


def _guide(view: View, normal: Tensor, flat: Flat | None, rays: Tensor, settings: Priors) -> _Guide:
    guide, reliable = guide_normals(view.camera.to_camera(normal), rays, settings.minimum_normal)
    if flat is None:
        return _Guide(guide, reliable, guide, torch.zeros_like(reliable))
    on_plane = view.camera.to_camera(flat.normal).expand_as(guide)
    astray = flat.where & ~(reliable & (dot(guide, on_plane) > math.cos(math.radians(settings.astray))))
    return _Guide(torch.where(astray[..., None], on_plane, guide), reliable | flat.where, on_plane, astray)


def _by_color(
    precomputed: Unguided, guide: _Guide, settings: Priors, rays: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Return normals [H, W, 3] from color differences or of a flat surface, and their weights [H, W].

    Return None if the settings request no normals from color differences.
    """
    _, _, zenith, azimuth, certainty, colorful = precomputed
    if zenith is None or azimuth is None or certainty is None or colorful is None:
        return None
    chromatic = facing(zenith, azimuth, guide.normal, rays)
    weight = certainty * guide.shown
    if settings.chromatic_within is not None:
        nearness = _within(chromatic, guide.normal, *settings.chromatic_within)
        weight = weight * torch.maximum(nearness, colorful)
    chromatic = torch.where(guide.astray[..., None], guide.on_plane, chromatic)
    return chromatic, torch.maximum(weight, guide.astray.to(weight))


def _separated(
    stokes: Tensor, guide: _Guide, settings: Priors, refractive_index: float | Tensor, rays: Tensor
) -> optics.Separation:
    """Separate specular and diffuse light by the method that the recipe specifies.

    In the exact method, ``conditioned`` is False at pixels without a known normal.
    """
    if settings.separation == "paper":
        zenith = optics.diffuse_zenith(optics.dolp(optics.luminance(stokes)), refractive_index)
        return optics.paper_separation(stokes, zenith, refractive_index)
    layers = optics.exact_separation(stokes, guide.normal, rays, refractive_index)
    return layers._replace(conditioned=layers.conditioned & guide.shown)


def _across(luminance: Tensor, normal: Tensor, rays: Tensor) -> Tensor:
    """Return the polarization [H, W] across the plane of incidence times ``sin^2(zenith)``.

    The value is negative for light that is polarized in the plane of incidence.

    Args:
        luminance: [3, H, W] Stokes vectors.
        normal, rays: [H, W, 3] camera axes.
    """
    x_ref, up_ref = optics.lens_frame(rays)
    x = dot(normal, x_ref)
    y = dot(normal, up_ref)
    return -(luminance[1] * (x * x - y * y) + luminance[2] * (2 * x * y))


def _within(normal: Tensor, guide: Tensor, full: float, none: float) -> Tensor:
    """Return a weight [H, W] that falls with the angle between two unit normals.

    It is 1 up to ``full`` degrees, falls linearly, and is 0 from ``none`` degrees on.
    """
    angle = torch.linalg.cross(normal, guide).norm(dim=-1).atan2(dot(normal, guide)).rad2deg()
    return ((none - angle) / (none - full)).clamp(0, 1)


def _candidates(
    kind: Candidates, luminance: Tensor, rays: Tensor, refractive_index: float | Tensor
) -> optics.Candidates | optics.PhysicalCandidates | Tensor:
    """Return the candidate normals [H, W, K, 3] of a recipe in camera axes, or a record with these normals."""
    if kind == "physical":
        return optics.physical_candidates(luminance, rays, refractive_index)
    paper = optics.paper_candidates(luminance, rays, refractive_index)
    if kind == "paper":
        return paper
    quarters = [paper.azimuth + turn * torch.pi / 2 for turn in range(4)]
    return torch.stack(
        [optics.normal_from_angles(paper.zenith, azimuth, rays) for azimuth in quarters], dim=-2
    )


def facing(zenith: Tensor, azimuth: Tensor, guide: Tensor, rays: Tensor) -> Tensor:
    """Return the normals [H, W, 3] of an azimuth that is known up to half a turn.

    An azimuth and its opposite give two normals. The normal nearer to the guide is returned.

    Args:
        zenith, azimuth: [H, W] radians.
        guide: [H, W, 3] guide normals, camera axes.
        rays: [H, W, 3] unit directions from the camera.
    """
    normal = optics.normal_from_angles(zenith, azimuth, rays)
    mirrored = optics.normal_from_angles(zenith, azimuth + torch.pi, rays)
    return torch.where((dot(normal, guide) >= dot(mirrored, guide))[..., None], normal, mirrored)


def facing_chromatic(
    stokes: Tensor,
    guide: Tensor,
    rays: Tensor,
    refractive_index: float,
    good: Tensor,
    settings: Priors,
) -> tuple[Tensor, Tensor]:
    """Estimate normals from the polarization of color differences, and their weights.

    Color differences leave two opposite azimuths. The one nearer to the guide is used.

    Args:
        stokes: [3, H, W, 3] Stokes vectors.
        guide: [H, W, 3] guide normals, camera axes.
        rays: [H, W, 3] unit directions from the camera.
        refractive_index: refractive index of all surfaces.
        good: [H, W] bool, True for pixels with a valid measurement.
        settings: settings of the priors.

    Returns:
        A tuple of the unit normals [H, W, 3] in camera axes and their weights [H, W] in [0, 1]. The weight is 0 where
        color differences determine no normal.
    """
    zenith, azimuth, weight, _ = _chromatic_angles(stokes, refractive_index, good, settings)
    return facing(zenith, azimuth, guide, rays), weight


def _chromatic_angles(
    stokes: Tensor, refractive_index: float, good: Tensor, settings: Priors
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return zenith, azimuth and weight of the normals from color differences, and the colorfulness of the body.

    All four tensors are [H, W]. The angles are in radians. The weight and the colorfulness are in [0, 1].
    """
    chromatic = optics.chromatic_normals(stokes, refractive_index)
    gray, color = settings.gray
    return (
        chromatic.zenith,
        chromatic.azimuth,
        (chromatic.certainty / settings.full_certainty).clamp(max=1) * (chromatic.decided & good),
        ((chromatic.contrast - gray) / (color - gray)).clamp(0, 1),
    )
