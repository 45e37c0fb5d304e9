"""Flat mirroring surfaces: large parts of a view whose polarization one normal explains.

Light that a dielectric or a metal mirrors is polarized across the plane of incidence. The AoLP of a pixel therefore
gives a direction perpendicular to its normal, for any mirrored light at any apparent depth. All pixels of a plane have
one normal, and the directions of many pixels determine it up to its sign, which follows from the camera. Neither the
ambiguity of pi nor that of pi/2 remains. Still water, which shows the depth of the mirrored scene, has no other cue.

The planes of incidence of a sphere also meet in one line, the ray through its center. There Fresnel's equations allow
almost no polarization, so that the measurement contradicts this normal.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.geometry.vectors import dot, unit
from polarguide.training.rules import FlatRules


@dataclass(frozen=True, eq=False)
class Flat:
    """A flat surface in a view.

    Attributes:
        normal: [3] unit, world axes, towards the camera.
        where: [H, W] bool, the pixels that it explains.
    """

    normal: Tensor
    where: Tensor

    def to(self, device: torch.device) -> Flat:
        """Return the surface on a device."""
        return Flat(self.normal.to(device), self.where.to(device))


@torch.no_grad()
def flat_surface(view: View, refractive_index: float, rules: FlatRules) -> Flat | None:
    """Find the flat surface that explains most of a view; None: no surface explains enough.

    The pictures of the view have to determine the Stokes vector. Random pairs of pixels propose normals. The proposal
    with the most agreeing pixels is refined on these by least squares.
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
    some = torch.zeros_like(good)
    some[::step, ::step] = good[::step, ::step]
    e = across[some]
    d = rays[some]
    dolp = degree[some]
    least = rules.least * pixels / step**2
    if len(e) < max(2.0, least):
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
    if float(inside.sum()) < least:
        return None
    everywhere = normal.expand_as(rays)
    where = good & _agrees(dot(across, everywhere), -dot(rays, everywhere), degree, refractive_index, rules)
    around = torch.nn.functional.avg_pool2d(where[None].float(), rules.window, 1, rules.window // 2)[0]
    return Flat(view.camera.to_world(normal), where & (around > rules.most))


def _agrees(off: Tensor, cosine: Tensor, dolp: Tensor, refractive_index: float, rules: FlatRules) -> Tensor:
    """Return a mask of pixels that agree with normals.

    Args:
        off: cosine between the normal and the direction of the pixel.
        cosine: cosine between the normal and the reversed ray.
        dolp: DoLP of the pixel.
        refractive_index: refractive index of the surface.
        rules: tolerances.
    """
    allowed = (
        optics.specular_dolp(cosine.clamp(0, 1).acos(), refractive_index) * rules.slack[0] + rules.slack[1]
    )
    return (off.abs() < rules.close) & (cosine > rules.grazing) & (dolp < allowed)


def flat_surfaces(views: Iterable[View], refractive_index: float, rules: FlatRules) -> dict[str, Flat]:
    """Find flat surfaces with similar normals in enough views; return them by view, with the mean normal.

    Views that do not determine the Stokes vector are left out.
    """
    surfaces = dict[str, Flat]()
    determined = 0
    for view in views:  # one by one, as they come
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
