"""Likelihoods of two hypotheses on a surface, dielectric and metal, from its measurements in many views.

At a Gaussian, a view measures S0 and two components of polarization for each color. P is the polarization across the
plane of incidence of the rendered normal, and U is the polarization at 45 degrees to this plane. ``rho`` are Fresnel's
degrees of polarization.

- The specular light s of a dielectric is unknown in each view: ``S0 = d + s``, ``P = k rho_s s - rho_d d``. Roughness
  reduces the specular polarization by a factor k in ``ROUGH``. The diffuse light d is the same in all views that show
  the same normal. Views of a thin or strongly curved surface show different normals n, so that d is linear in n.
- A metal mirrors unknown light and polarizes it according to its reflectance r: ``P = rho(r) S0``. Its color is the
  color of the mirrored light times r, so r is derived from the observed color.

Unpolarized light has no U. Polarized light changes P about as much as U. A metal preserves at most the share
``conductor_oblique_share`` of U (aluminum 0.98 at 45 degrees and 0.91 at 60; copper and gold 0.57 at 60 and 0.1 at 70).
A dielectric preserves at most ``sqrt(Rs Rp)`` times the light of the scene. Under each hypothesis, the explained part
of U reduces the error in P, and the rest of U is added as an error. Noise also causes U. It explains nothing and is no
error, so both parts lose the variance of the noise, which four angles determine (``ViewSamples.noise``). With three
angles, U is not used. Without this, the U of textured or noisy pictures would be evidence for metals, which explain
more of U than dielectrics.

**Brightness.** A metal mirrors light of the scene, so that observed color over reflectance has the brightness of the
scene. The logarithm of its brightness is normal, with the mean and the variance of all pixels of the pictures. A metal
in front of much darker light is unlikely, such as black rubber, whose weak gloss resembles that of a rough metal. A
metal in front of brighter light is not, because lamps may be outside of the pictures.

**Diffuse light.** With the mean normal ``n'`` of all views, the diffuse light is ``d (1 + h (n - n'))``. The relative
gradient h belongs to the illumination, so that a Gaussian and its neighbors share it. Its prior is Gaussian with the
standard deviation ``TURN``. h is integrated out: its best value leaves the error, and the share of each Gaussian in
half the logarithm of prior over posterior variance is evidence against the dielectric.

**Variance.** The errors E are mean squares of d = 2 n observations relative to the light: P and U in n views. Their
variance differs between surfaces, because it includes the errors of the rendered normals. Its prior is a scaled inverse
chi-square distribution with scale ``s^2`` and weight ``d0``, both estimated from all surfaces of the scene. With the
variance integrated out, the log likelihood ratio is ``(d0 + d)/2 log((d0 s^2 + d E_dielectric) / (d0 s^2 + d
E_metal))`` (Smyth 2004, "Linear models and empirical Bayes methods", Statistical Applications in Genetics 3).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.special import digamma, polygamma
from torch import Tensor

from polarguide import optics
from polarguide.optics.fresnel import reflectances_from_cosine
from polarguide.training.metals.observations import ViewSamples

ROUGH = (1.0, 0.85, 0.7, 0.55)
"""Tested shares of the specular polarization that remain on a rough dielectric."""
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.95)
"""Levels of the tested reflectances. A tested reflectance is a level times a power of the observed color."""
POWERS = (0.5, 0.75, 1.0)
"""Powers of the observed color in the tested reflectances."""
TURN = 0.44
"""Standard deviation of the relative gradient of diffuse light, per radian. Below a uniform sky, the diffuse light is
proportional to ``1 + n_z``. This value is the root mean square of each component of its relative gradient along the
surface, over all normals that face up."""
UNKNOWNS = 2
"""Number of unknowns of each hypothesis. As many views are needed to determine the unknowns, and give no evidence."""
NOISE = 1e-4
"""Mean square of the noise of a camera relative to the light. Smaller errors count as this error in the prior."""
LEAST_VARIANCE = 1e-3
"""Least variance of logarithms: of error variances and of radiance. For error variances, it limits the weight of the
prior to 2,000 observations."""


class Setting(NamedTuple):
    """Values that all surfaces of a scene share.

    Attributes:
        refractive_index: refractive index of dielectrics.
        light: mean radiance of the scene, S0.
        dark: radiance that is added to the denominator of relative errors.
    """

    refractive_index: float
    light: float
    dark: float


class SceneLight(NamedTuple):
    """Distribution of the logarithm of the radiance in all pixels of a scene's pictures.

    Attributes:
        mean: mean of ``log(S0 + dark)``; S0 is the mean over the colors.
        spread: its standard deviation.
        dark: radiance that is added before the logarithm.
    """

    mean: float
    spread: float
    dark: float

    def cost(self, samples: ViewSamples, reflectance: Tensor) -> Tensor:
        """Return the cost [N] of metals with reflectance [N, 3] in front of too dark light, in nats per view."""
        logarithms = log_radiance(samples.s0, self.dark)
        observed = (samples.weight * logarithms).sum(dim=0) / samples.weight.sum(dim=0).clamp(min=1e-6)
        mirrored = observed - reflectance.mean(dim=-1).log()
        return 0.5 * ((self.mean - mirrored) / self.spread).clamp(min=0) ** 2


def log_radiance(s0: Tensor, dark: float) -> Tensor:
    """Return the logarithm of radiance [..., 3], mean over the colors, after ``dark`` is added."""
    return (s0.mean(dim=-1).clamp(min=0) + dark).log()


def scene_light(pictures: Iterable[Tensor], dark: float) -> SceneLight:
    """Measure the distribution of the radiance S0 over pixels.

    Args:
        pictures: radiance S0 of the valid pixels of each picture, [P, 3].
        dark: radiance that is added before the logarithm.
    """
    moments = torch.zeros(3, dtype=torch.float64)
    for s0 in pictures:
        logarithms = log_radiance(s0, dark).double().cpu()
        moments += torch.stack([logarithms**power for power in range(3)]).sum(dim=1)
    mean, square = (float(moment / moments[0].clamp(min=1)) for moment in moments[1:])
    return SceneLight(mean, math.sqrt(max(square - mean * mean, LEAST_VARIANCE)), dark)


class MetalFit(NamedTuple):
    """The metal that fits each of N Gaussians best.

    Attributes:
        error: [N] mean squared error relative to the light.
        reflectance: [N, 3] its reflectance.
    """

    error: Tensor
    reflectance: Tensor


class DielectricFit(NamedTuple):
    """The dielectric that fits each of N Gaussians best.

    Attributes:
        error: [N] mean squared error relative to the light.
        freedom: [N] share in half the logarithm of prior over posterior variance of the gradient, in nats.
    """

    error: Tensor
    freedom: Tensor


class DielectricTerms(NamedTuple):
    """Error of the dielectric hypothesis on N Gaussians, as a quadratic function of the relative gradient h.

    With the gradient in units of its standard deviation, the error of a color is its ``constant`` part ``- 2 pull h + h
    moments h``.

    Attributes:
        constant: [N] error of diffuse light that does not change with the normal, mean over the colors.
        moments: [N, 3, 3, 3] quadratic terms of each color.
        pull: [N, 3, 3] linear terms of each color.
        excused: [N] part of U that the hypothesis explains. It is subtracted from the error, which remains positive.
        beyond: [N] rest of U, which is added to the error.
    """

    constant: Tensor
    moments: Tensor
    pull: Tensor
    excused: Tensor
    beyond: Tensor

    def error(self, changes: Tensor | float = 0.0) -> Tensor:
        """Return the mean squared error [N], for given changes [N] of the constant part."""
        return ((self.constant + changes).clamp(min=0) - self.excused).clamp(min=0) + self.beyond


class _Weights:
    """Weights of squared errors, which make them relative to the light."""

    def __init__(self, samples: ViewSamples, dark: float) -> None:
        above = samples.s0.clamp(min=0) + dark  # the variance of photon counts grows with the light
        weight = samples.weight[..., None] / above
        self.values = weight / (weight * above * above).sum(dim=0).clamp(min=1e-9)

    def mean(self, squares: Tensor) -> Tensor:
        """Return the mean [N] of squares [V, N, 3] over views and colors."""
        return (self.values * squares).sum(dim=0).mean(dim=1)


def _explained(samples: ViewSamples, largest: Tensor, weights: _Weights) -> tuple[Tensor, Tensor]:
    """Return the part [N] of U, up to ``largest``, that a hypothesis explains, and the rest [N], both beyond noise."""
    noise = weights.mean(samples.noise**2)
    beyond = weights.mean((samples.oblique.abs() - largest).clamp(min=0) ** 2)
    return (weights.mean(samples.oblique**2) - beyond - noise).clamp(min=0), (beyond - noise).clamp(min=0)


def metal_fit(samples: ViewSamples, setting: Setting) -> MetalFit:
    """Fit the metal hypothesis: the best of the tested reflectances."""
    weights = _Weights(samples, setting.dark)
    cosine = samples.cosine[..., None]
    color = (samples.weight[..., None] * samples.s0).sum(dim=0)
    color = (color / color.amax(dim=1, keepdim=True).clamp(min=1e-6)).clamp(min=0.05)
    found = []
    tried = [level * color**power for power in POWERS for level in LEVELS]
    for reflectance in tried:
        n, k = optics.conductor_index(reflectance)
        degree = optics.conductor_dolp_slope(cosine, n, k) * (1 - cosine * cosine)
        error = weights.mean((samples.across - degree * samples.s0) ** 2 / (1 + degree * degree))
        largest = optics.conductor_oblique_share(cosine, n, k).abs() * samples.s0.clamp(min=0)
        excused, beyond = _explained(samples, largest, weights)
        found.append((error - excused).clamp(min=0) + beyond)
    error, chosen = torch.stack(found).min(dim=0)
    return MetalFit(error, torch.stack(tried)[chosen, torch.arange(len(chosen), device=chosen.device)])


def dielectric_terms(samples: ViewSamples, setting: Setting) -> DielectricTerms:
    """Return the error of the dielectric hypothesis for the roughness that fits best, with diffuse light from views."""
    weights = _Weights(samples, setting.dark)
    cosine = samples.cosine[..., None]
    slopes = optics.dolp_slopes(cosine, setting.refractive_index)
    specular, diffuse = (slope * (1 - cosine * cosine) for slope in slopes)
    terms = []
    for left in ROUGH:
        over = left * specular
        line = over + diffuse
        excess = over * samples.s0 - samples.across
        terms.append(_line_terms(samples.normal, line, excess, weights.values / (1 + over * over)))
    constant, moments, pull = (torch.stack(values) for values in zip(*terms, strict=True))
    chosen = constant.argmin(dim=0), torch.arange(constant.shape[1], device=constant.device)
    s, p = reflectances_from_cosine(cosine, setting.refractive_index)
    explained = _explained(samples, (s * p).sqrt() * setting.light, weights)
    return DielectricTerms(constant[chosen], moments[chosen], pull[chosen], *explained)


def _line_terms(
    normal: Tensor, line: Tensor, excess: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the constant, quadratic and linear terms of the error ``weight (excess - line d (1 + h (n - n')))^2``.

    The normal ``n'`` is the mean with which the best light d does not depend on h.

    Args:
        normal: [V, N, 3] normals n.
        line: [V, N, 1] error of a unit of diffuse light.
        excess: [V, N, 3] error without diffuse light.
        weight: [V, N, 3] weights of the squared errors.
    """
    along = weight * line**2
    total = along.sum(dim=0).clamp(min=1e-9)
    light = ((weight * line * excess).sum(dim=0) / total).clamp(min=0)
    rest = excess - line * light
    middle = torch.einsum("vnc,vni->nci", along, normal) / total[..., None]
    turns = normal[:, :, None, :] - middle
    spread = TURN * light[..., None]
    moments = torch.einsum("vnc,vnci,vncj->ncij", along, turns, turns) * spread[..., None] ** 2
    pull = torch.einsum("vnc,vnci->nci", weight * line * rest, turns) * spread
    return (weight * rest**2).sum(dim=0).mean(dim=1), moments, pull


def dielectric_fit(terms: DielectricTerms, noise: Tensor, neighbors: Tensor) -> DielectricFit:
    """Fit the gradient of diffuse light to each Gaussian and its neighbors, by least squares with the prior.

    The three colors count as one observation, like their errors.

    Args:
        terms: error of each Gaussian.
        noise: [N] error variance of each surface, over its number of observations.
        neighbors: [N, K] indices of the neighbors.
    """
    precision = terms.moments / noise[:, None, None, None]
    pull = terms.pull / noise[:, None, None]
    shared_precision = precision + torch.eye(3).to(precision)
    shared_pull = pull.clone()
    for column in neighbors.unbind(dim=1):
        shared_precision += precision[column]
        shared_pull += pull[column]
    sharing = 1 + neighbors.shape[1]
    gradient = torch.linalg.solve(shared_precision, shared_pull[..., None])[..., 0]
    bent = (torch.einsum("ncij,ncj->nci", terms.moments, gradient) - 2 * terms.pull) * gradient
    unlikely = noise * gradient.square().sum(dim=-1).mean(dim=-1) / sharing
    freedom = 0.5 * torch.logdet(shared_precision).mean(dim=-1) / sharing
    return DielectricFit(terms.error(bent.sum(dim=-1).mean(dim=-1) + unlikely), freedom)


class VariancePrior(NamedTuple):
    """Scaled inverse chi-square distribution of the error variances of the surfaces of a scene.

    Attributes:
        scale: typical variance.
        weight: degrees of freedom, as the number of observations that the prior is worth. It is small if the variances
            of surfaces differ much.
    """

    scale: float
    weight: float

    def squares(self, observations: Tensor, errors: Tensor) -> Tensor:
        """Return the sum of squares [N] of observations with mean squared errors, and of those of the prior."""
        return self.weight * self.scale + observations * errors

    def noise(self, observations: Tensor, errors: Tensor) -> Tensor:
        """Return the error variance [N] of each surface, over its number of observations."""
        variance = self.squares(observations, errors) / (self.weight + observations)
        return variance / observations

    def ratio(self, observations: Tensor, dielectric: Tensor, metal: Tensor) -> Tensor:
        """Return the log likelihood ratio [N] of metal and dielectric, from their mean squared errors."""
        sums = [self.squares(observations, errors) for errors in (dielectric, metal)]
        return 0.5 * (self.weight + observations) * (sums[0] / sums[1]).log()


def variance_prior(errors: Tensor, observations: Tensor) -> VariancePrior:
    """Estimate the prior of the error variance from the logarithms of all errors.

    The mean and the variance of the logarithms determine both parameters (Smyth 2004, Sec. 6.2).

    Args:
        errors: [N] mean squared errors. Errors below ``NOISE`` count as ``NOISE``.
        observations: [N] number of observations of each error, at least 2.
    """
    half = 0.5 * observations.double().cpu().numpy()
    logarithms = errors.double().clamp(min=NOISE).cpu().numpy()
    logarithms = np.log(logarithms) - digamma(half) + np.log(half)
    variance = max(float(logarithms.var() - polygamma(1, half).mean()), LEAST_VARIANCE)
    weight = 2 * brentq(lambda value: polygamma(1, value) - variance, 1e-6, 1e6)
    scale = math.exp(float(logarithms.mean()) + digamma(weight / 2) - math.log(weight / 2))
    return VariancePrior(scale, weight)


def log_ratio(metal: Tensor, terms: DielectricTerms, views: Tensor, neighbors: Tensor) -> Tensor:
    """Return the log likelihood ratio [N] of metal and dielectric.

    It is 0 in scenes without a surface that has at least one independent view.

    Args:
        metal: [N] error of the metal hypothesis.
        terms: error of the dielectric hypothesis.
        views: [N] number of independent views, beyond those that determine the unknowns.
        neighbors: [N, K] indices of the neighbors.
    """
    sampled = views >= 1
    if not bool(sampled.any()):
        return torch.zeros_like(views)
    observations = 2 * views.clamp(min=1e-6)
    smaller = torch.minimum(terms.error(), metal)
    prior = variance_prior(smaller[sampled], observations[sampled])
    noise = prior.noise(observations, smaller)
    dielectric = dielectric_fit(terms, noise, neighbors)
    return prior.ratio(observations, dielectric.error, metal) + dielectric.freedom
