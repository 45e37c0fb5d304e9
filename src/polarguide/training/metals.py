"""Which Gaussians are metals: what all views measured of each is explained twice, and the better explanation wins.

At a Gaussian, a view measures S0 and, per color, the polarization P across the rendered normal's plane of incidence.

- A dielectric's body light d is the same from everywhere, and its specular light s is free:
  ``S0 = d + s``, ``P = rho_s s - rho_d d``. Without s, ``(rho_s + rho_d) d = rho_s S0 - P`` in every view.
- A metal mirrors light that is free, but polarizes it as its reflectance r says: ``P = rho(r) S0`` in every view.

Either has one unknown per color, which all views share, and one per color and view. Compared are their residuals E
across the line of what the free light can explain, as log(E_dielectric / E_metal) over a neighborhood. That a metal
fits better counts only where no dielectric fits: a matte white body under an even sky could as well be aluminium. And a
metal's color is that of the light it mirrors times r, so that r follows the color that it shows.

In polarized light neither fits. A metal then shows light that is polarized at 45 degrees to the plane of incidence, of
which a dielectric reflects a twentieth at most, up to 60 degrees: where there is much of it, measured by the light of
the scene, and the metal is not much farther off across the plane than at 45 degrees to it, is metal, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide import optics
from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import render, splats
from polarguide.shading.metal import any_metal
from polarguide.shading.model import Light, Parameters, ShadingModel
from polarguide.training.priors import guide_normals
from polarguide.vectors import dot

# Share of the cameras' distance from the middle of the points within which metals are looked for: what is farther away
# is behind the subject in all views from the other side.
REACH = 0.5
MOST_VIEWS = 32
# A view counts if the Gaussian shows at least this share of what it shows in its best view.
LEAST_SHARE = 0.3
# Cosines of zeniths that count: head-on nothing is polarized, at grazing angles normals and reflectances are unsure.
COSINES = (0.25, 0.97)
LEAST_VIEWS = 4.0
# Pixels, over all views, from which on a Gaussian is known, and the share of its neighbors that has to be.
LEAST_SEEN, LEAST_SUPPORT = 0.3, 0.35
NEIGHBORS, NEAREST = 64, 16
# Reflectances that are tried: a level times a power of the color that is seen.
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.95)
POWERS = (0.5, 0.75, 1.0)
# Light below which nothing is told: residuals are relative to S0 and this.
DARK = 0.02
# Mean squares of relative residuals below this count as this.
LEAST_RESIDUAL = 2e-4
# Evidence from which on a neighborhood begins to be metal, and goes on where enough of the nearest are.
BEGIN, CONTINUE, STAY = 2.2, 0.4, 1.3
BEGIN_MISFIT, CONTINUE_MISFIT = 0.05, 0.02
CROWD, ALONE = 0.12, 0.2
# Evidence down to which what lies among metal joins it, and from which share of its nearest on: what mirrors something
# even could be either.
AMONG, MAJORITY = -0.7, 0.4
# Of a piece that hangs together, the share, and how many, that have to be surely metal. True ones had 0.25 to 0.56, a
# plate in polarized light 0.02 to 0.13. Neighbors hang together from this likeness of their normals on.
SURE_SHARE, FEWEST_SURE = 0.18, 10
TOUCHING = 0.2
# Share of the user's words from which on their contradictions are told.
CONTRADICTED = 0.15
# No metal reflects one color less than about 0.38 times another (gold, blue and red). A body whose colors, over those
# of the scene, differ by more than this is none.
LEAST_TINT = 0.25
# Neighbors whose brightness, or whose colors in proportion to it, differ by this factor's logarithm are of another
# material, more or less.
LIKE_BRIGHTNESS, LIKE_TINT = 0.4, 0.25
ROUNDS, FILLING = 12, 40
# Of how many views the gain of the light is taken, and where.
GAIN_VIEWS, CLEAR_SHARE, LEAST_COVERED, MOST_GAIN = 10, 0.6, 0.003, 4.0


class Limits(NamedTuple):
    """From which on a neighborhood is metal in polarized light.

    Attributes:
        oblique: what is polarized at 45 degrees, as a share of what is seen. light: of the scene's mean light.
        times: how many times its square that of the metal's misfit may be.
        ratio: evidence below which a dielectric explains more.
    """

    oblique: float
    light: float
    times: float
    ratio: float


BEGIN_OBLIQUELY, CONTINUE_OBLIQUELY = Limits(0.03, 0.08, 4.0, 0.0), Limits(0.02, 0.02, 6.0, -0.5)


class Evidence(NamedTuple):
    """What the views say of N Gaussians.

    Attributes:
        ratio: [N] log(E_dielectric / E_metal), over the neighborhood, in which those of like brightness count.
        misfit: [N] root of the mean E_dielectric of the neighborhood: how far from any dielectric.
        reflectance: [N, 3] of the metal that fits best.
        near: [N, K] int64 the neighborhoods, nearest first.
        alike: [N, K] in [0, 1], how alike neighbors are turned, and how alike their color is: others belong to
            another surface, such as the table under a pot, or are of another material, such as the tire around a wheel.
        brightness: [N] mean S0 of what is seen, over that of all that is seen.
        tint: [N] in [0, 1], what is seen in the weakest over that in the strongest color, each over the scene's mean,
            of the neighborhood: of a metal no less than its reflectances are apart.
        metal_misfit: [N] root of the mean E_metal of the neighborhood.
        oblique: [N] root of the mean square of what is polarized at 45 degrees to the plane of incidence, of the
            neighborhood, relative like the residuals.
        support: [N] share of the neighborhood that enough views show.
        said: [N, 2] weight of pixels that the user calls dielectric and metal.
    """

    ratio: Tensor
    misfit: Tensor
    reflectance: Tensor
    near: Tensor
    alike: Tensor
    brightness: Tensor
    tint: Tensor
    metal_misfit: Tensor
    oblique: Tensor
    support: Tensor
    said: Tensor


def shares(gaussians: Parameters, view: View, target: Tensor, rasterize: Rasterize) -> Tensor:
    """Sums [N, C] over the pixels of a picture [H, W, C], each by what the Gaussian has in it."""
    with torch.no_grad():
        fixed = splats(gaussians)
    features = target.new_zeros(len(fixed.means), target.shape[-1], requires_grad=True)
    with torch.enable_grad():
        (rasterize(fixed._replace(features=features), view.camera).features * target).sum().backward()
    assert features.grad is not None
    return features.grad


class Seen(NamedTuple):
    """Means over what V views show of each Gaussian: weight [V, N], S0, P, the polarization at 45 degrees to both
    [V, N, 3], cosine of the zenith [V, N].
    """

    weight: Tensor
    s0: Tensor
    across: Tensor
    oblique: Tensor
    cosine: Tensor


def _look(gaussians: Parameters, view: View, rasterize: Rasterize) -> Tensor:
    """Sums [N, 11] over a view's pixels: 1, S0, P, the polarization at 45 degrees to it and the cosine."""
    device = gaussians["means"].device
    normal = render(gaussians, view.camera, rasterize, sh_degree=0).normal
    assert normal is not None
    view = view.to(device)
    rays = view.camera.rays(device=device)
    guide, known = guide_normals(view.camera.to_camera(normal), rays)
    s0, s1, s2 = view.stokes()
    x_ref, up_ref = optics.lens_frame(rays)
    x, y = dot(guide, x_ref), dot(guide, up_ref)
    sine2 = (x * x + y * y).clamp(min=1e-6)
    cosine2, sine = ((x * x - y * y) / sine2)[..., None], (2 * x * y / sine2)[..., None]
    across, oblique = -(s1 * cosine2 + s2 * sine), s2 * cosine2 - s1 * sine
    one = torch.ones_like(x)[..., None]
    good = (known & ~(view.invalid | view.saturated))[..., None]
    target = torch.cat((one, s0, across, oblique, -dot(guide, rays)[..., None]), dim=-1) * good
    return shares(gaussians, view, target.contiguous(), rasterize)


def _seen(sums: Tensor) -> Seen:
    """Means of the sums [V, N, 11], with the weight of views that count."""
    weight = sums[..., 0]
    means = sums[..., 1:] / weight.clamp(min=1e-6)[..., None]
    cosine = means[..., 9].clamp(0, 1)
    counts = (weight > LEAST_SHARE * weight.amax(dim=0)) & (cosine > COSINES[0]) & (cosine < COSINES[1])
    return Seen(weight * counts, means[..., :3], means[..., 3:6], means[..., 6:9], cosine)


def _relative(seen: Seen) -> tuple[Tensor, Tensor]:
    """Weights [V, N, 3] of squares, and what their sums over the views are relative to [N, 3]."""
    above = seen.s0.clamp(min=0) + DARK  # the variance of light that is counted grows with the light
    weight = seen.weight[..., None] / above
    return weight, (weight * above * above).sum(dim=0).clamp(min=1e-9)


def residuals(seen: Seen, refractive_index: float) -> tuple[Tensor, Tensor, Tensor]:
    """Mean squares of the relative residuals of a dielectric and of a metal [N], and the metal's reflectance [N, 3]."""
    s0, across, cosine = seen.s0, seen.across, seen.cosine[..., None]
    sine2 = 1 - cosine * cosine
    weight, scale = _relative(seen)
    specular, diffuse = (slope * sine2 for slope in optics.dolp_slopes(cosine, refractive_index))
    seen_body, of_body = specular * s0 - across, specular + diffuse
    by_line = weight / (1 + specular * specular)
    body = (by_line * of_body * seen_body).sum(dim=0) / (by_line * of_body**2).sum(dim=0).clamp(min=1e-9)
    misfit = (by_line * (seen_body - of_body * body.clamp(min=0)) ** 2).sum(dim=0) / scale
    color = (seen.weight[..., None] * s0).sum(dim=0)
    color = (color / color.amax(dim=1, keepdim=True).clamp(min=1e-6)).clamp(min=0.05)
    best = torch.full_like(misfit[:, 0], torch.inf)
    fitted = torch.zeros_like(color)
    for power in POWERS:
        for level in LEVELS:
            reflectance = level * color**power
            degree = optics.conductor(cosine, reflectance)[1] * sine2
            off = (weight * (across - degree * s0) ** 2 / (1 + degree * degree)).sum(dim=0) / scale
            error = off.mean(dim=1)
            better = error < best
            best = torch.where(better, error, best)
            fitted = torch.where(better[:, None], reflectance, fitted)
    return misfit.mean(dim=1), best, fitted


def oblique_light(seen: Seen) -> Tensor:
    """Mean squares [N] of the polarization at 45 degrees to the plane of incidence, relative like the residuals."""
    weight, scale = _relative(seen)
    return ((weight * seen.oblique**2).sum(dim=0) / scale).mean(dim=1)


@torch.no_grad()
def evidence(
    gaussians: Parameters, views: Sequence[View], rasterize: Rasterize, refractive_index: float
) -> Evidence:
    """What views whose pictures determine the Stokes vector say of each Gaussian; see the module's text.

    Args:
        views: at least one; so many of them as ``MOST_VIEWS``, evenly, are looked at.
    """
    step = max(1, -(-len(views) // MOST_VIEWS))
    seen = _seen(torch.stack([_look(gaussians, view, rasterize) for view in views[::step]]))
    dielectric, metal, reflectance = residuals(seen, refractive_index)
    total = seen.weight.sum(dim=0)
    effective = total * total / (seen.weight**2).sum(dim=0).clamp(min=1e-9)
    known = total.clamp(max=20) * (effective > LEAST_VIEWS)
    places = gaussians["means"].detach().cpu().double().numpy()
    count = min(NEIGHBORS, len(places))
    near = (
        torch.from_numpy(cKDTree(places).query(places, k=count)[1]).view(len(places), count).to(total.device)
    )
    axes = shortest_axis_normals(
        gaussians["means"], gaussians["quaternions"], gaussians["log_scales"], total.new_zeros(3), None
    )
    alike = dot(axes[:, None], axes[near]) ** 4
    color = ((seen.weight[..., None] * seen.s0).sum(dim=0) / total.clamp(min=1e-6)[:, None]).clamp(min=0)
    mean = (color * known[:, None]).sum(dim=0) / known.sum().clamp(min=1e-6)
    tints = color / mean.clamp(min=1e-6)
    color = color + DARK
    brightness = color.mean(dim=1)
    like_color = _like_color(color, near)
    trust = (known + 1e-6)[near] * like_color

    def over_neighbors(values: Tensor) -> Tensor:
        return (values[near] * trust).sum(dim=1) / trust.sum(dim=1)

    ratio = (dielectric.clamp(min=LEAST_RESIDUAL) / metal.clamp(min=LEAST_RESIDUAL)).log()
    said = total.new_zeros(len(total), 2)
    for view in views:
        if view.materials is not None:
            kinds = view.materials.to(total.device)
            target = torch.stack((kinds == 1, kinds == 2), dim=-1).float()
            said += shares(gaussians, view, target, rasterize)
    reflectance = torch.stack([over_neighbors(r) for r in reflectance.unbind(1)], dim=1)
    tints = torch.stack([over_neighbors(t) for t in tints.unbind(1)], dim=1)
    support = (known > LEAST_SEEN).float()[near].mean(dim=1)
    return Evidence(
        over_neighbors(ratio),
        over_neighbors(dielectric).sqrt(),
        reflectance,
        near,
        alike * like_color,
        brightness * known.sum() / (brightness * known).sum().clamp(min=1e-6),
        tints.amin(dim=1) / tints.amax(dim=1).clamp(min=1e-6),
        over_neighbors(metal).sqrt(),
        over_neighbors(oblique_light(seen)).sqrt(),
        support,
        said,
    )


def _like_color(color: Tensor, near: Tensor) -> Tensor:
    """How much the neighbors [N, K] of each Gaussian look like it, in [0, 1]; of colors [N, 3] over 0."""
    brightness, logarithms = color.mean(dim=1).log(), color.log()
    tint = logarithms - logarithms.mean(dim=1, keepdim=True)
    brighter = (brightness[near] - brightness[:, None]) / LIKE_BRIGHTNESS
    tinted = (tint[near] - tint[:, None]) / LIKE_TINT
    return torch.exp(-0.5 * (brighter.square() + tinted.square().mean(dim=2)))


def decide(found: Evidence, was: Tensor, allowed: Tensor) -> Tensor:
    """Which Gaussians are metals, [N] bool.

    What is surely metal begins; what is likely joins where enough of its nearest neighbors are. What was metal before
    and still is rather plainly begins, too; the rest of it has to join again, or a metal would creep on over what lies
    beside it. Single ones are none, and neither are pieces of which little is sure: a metal is plainly one over much of
    its surface. What lies among metal joins even where a dielectric explains it a little better. What the user says of
    a Gaussian is so.

    Args:
        was: [N] bool, metal until now. allowed: [N] bool, those that may be.
    """
    told = found.said.sum(dim=1) > LEAST_SEEN
    told_metal = told & (found.said[:, 1] > found.said[:, 0])
    allowed = allowed & ~told & (found.tint > LEAST_TINT)
    able = allowed & (found.misfit > CONTINUE_MISFIT) & (found.support > LEAST_SUPPORT)
    no_dielectric = found.misfit > BEGIN_MISFIT
    surely = told_metal | (able & no_dielectric & (found.ratio > BEGIN))
    begun = surely | (able & was & (found.ratio > STAY))
    metal = _pieces(found, surely, begun, able & (found.ratio > CONTINUE))
    surely = able & no_dielectric & _obliquely(found, BEGIN_OBLIQUELY)
    likely = able & _obliquely(found, CONTINUE_OBLIQUELY)
    metal |= _pieces(found, surely, surely | (was & likely), likely)
    return told_metal | _grown(found, metal, allowed & (found.ratio > AMONG), MAJORITY, FILLING)


def _obliquely(found: Evidence, limits: Limits) -> Tensor:
    """Whether so much is polarized at 45 degrees that it tells of metal, and explains the metal's misfit."""
    much = (found.oblique > limits.oblique) & (found.oblique * found.brightness > limits.light)
    return much & (found.metal_misfit**2 < limits.times * found.oblique**2) & (found.ratio > limits.ratio)


def _pieces(found: Evidence, surely: Tensor, metal: Tensor, likely: Tensor) -> Tensor:
    """What is metal [N] where ``metal`` begins and ``likely`` joins, in pieces of which enough is sure."""
    metal = _grown(found, metal, likely, CROWD, ROUNDS)
    metal = metal & (_share_of_nearest(found, metal) > ALONE)
    touching = found.alike[:, :NEAREST] > TOUCHING
    return metal & _sure_enough(found.near[:, :NEAREST], touching, metal, surely)


def _share_of_nearest(found: Evidence, metal: Tensor) -> Tensor:
    """Share [N] of metals among the nearest of each, by how alike they are."""
    counts = found.alike[:, :NEAREST]
    return (metal[found.near[:, :NEAREST]] * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1e-6)


def _grown(found: Evidence, metal: Tensor, likely: Tensor, share: float, rounds: int) -> Tensor:
    """``metal`` [N], and what is ``likely`` and has more than this share of metals among its nearest, over and over."""
    for _ in range(rounds):
        grown = metal | (likely & (_share_of_nearest(found, metal) > share))
        if bool((grown == metal).all()):
            break
        metal = grown
    return metal


def _sure_enough(nearest: Tensor, touching: Tensor, metal: Tensor, surely: Tensor) -> Tensor:
    """Which metals [N] lie in a connected piece of them of which enough is sure."""
    near, inside, sure = nearest.cpu().numpy(), metal.cpu().numpy(), surely.cpu().numpy()
    edges = touching.cpu().numpy() & inside[:, None] & inside[near]
    rows, columns = np.nonzero(edges)
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, near[rows, columns])), shape=(len(inside),) * 2)
    pieces, piece = connected_components(graph, directed=False)
    counts = np.bincount(piece, minlength=pieces)
    certain = np.bincount(piece[sure & inside], minlength=pieces)
    enough = (certain >= FEWEST_SURE) & (certain >= SURE_SHARE * counts)
    return torch.from_numpy(enough[piece]).to(metal.device)


def contradiction(found: Evidence) -> float:
    """Share of what the user says of materials that other views contradict, in [0, 0.5]."""
    return float(found.said.amin(dim=1).sum() / found.said.sum().clamp(min=1e-6))


@torch.no_grad()
def light_gain(
    gaussians: Gaussians, light: Light, views: Sequence[View], rasterize: Rasterize, shading: ShadingModel
) -> float:
    """By how much the light should be brighter, as the first metals show it.

    Dielectrics fix the product of strength and light alone. Metals, whose reflectance is known, fix the light.

    Returns:
        The median of what they show over what is rendered of them; 1 where they are hardly seen. Not so little that
        strengths would have to exceed 1.
    """
    ratios, pixels = [], 0
    for view in views[:: max(1, len(views) // GAIN_VIEWS)]:
        shown = view.photograph().to(gaussians["means"].device).flatten(0, 1)
        metal = render(gaussians, view.camera, rasterize, shading=shading, light=light).metal
        pixels += len(shown)
        if metal is None:
            continue
        clear = (metal.share > CLEAR_SHARE) & ~(view.saturated | view.invalid).to(shown.device).flatten()[
            metal.pixels
        ]
        rendered = metal.specular[clear].mean(dim=1) / metal.share[clear]
        ratios.append(((shown[metal.pixels[clear]].mean(dim=1) + 1e-3) / (rendered + 1e-3)).log())
    found = torch.cat(ratios) if ratios else gaussians["means"].new_zeros(0)
    if len(found) < LEAST_COVERED * pixels:
        return 1.0
    body = gaussians["metalness"] == 0
    least = (
        torch.quantile(shading.strength(gaussians)[body], 0.9) if bool(body.any()) else found.new_tensor(0.1)
    )
    return float(found.median().exp().clamp(min=float(least), max=MOST_GAIN))


def metalness_share(gaussians: Parameters, camera: Camera, rasterize: Rasterize) -> Tensor | None:
    """Blended metalness [H, W]; None where no Gaussian is a metal, or none can be."""
    metalness = gaussians.get("metalness")
    if metalness is None or not any_metal(metalness):
        return None
    with torch.no_grad():
        return rasterize(splats(gaussians, metalness[:, None]), camera).features[..., 0]
