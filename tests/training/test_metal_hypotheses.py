"""Likelihoods of metals and dielectrics against slow references in float64, and their prior of error variances."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from metal_balls import gaussians_of_the_ball, views_of
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.capture.exposures import Exposure
from polarguide.raster.cpu import rasterize_cpu
from polarguide.training.metals.hypotheses import (
    NOISE,
    ROUGH,
    TURN,
    DielectricTerms,
    SceneLight,
    Setting,
    VariancePrior,
    dielectric_fit,
    dielectric_terms,
    log_ratio,
    metal_fit,
    scene_light,
    variance_prior,
)
from polarguide.training.metals.observations import (
    ViewSamples,
    samples_of,
    stokes_noise,
    valid_radiance,
    view_sums,
)
from polarguide.training.metals.search import MetalEvidence, neighbors_of, of_views
from polarguide.training.recipe import MetalRules, MetalViews

RULES, LIMITS = MetalRules(), MetalViews()
SETTING = Setting(refractive_index=1.5, light=0.5, dark=0.02)
VIEWS = 9
SURFACES = 4
ALL_OTHERS = torch.tensor([[k for k in range(SURFACES) if k != place] for place in range(SURFACES)])


def turning_samples(seed: int) -> ViewSamples:
    """Views of dielectrics that show different normals, below a light that changes with the normal, with errors."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(VIEWS, SURFACES, *shape, generator=generator).double()

    normal = torch.nn.functional.normalize(uniform(3) - 0.3, dim=-1)
    cosine = 0.3 + 0.6 * uniform()
    diffuse = 0.3 * (1 + 0.5 * normal[..., 2:]).expand(-1, -1, 3)
    specular = 0.2 * uniform(3)
    sine2 = 1 - cosine[..., None] ** 2
    over, under = (slope * sine2 for slope in optics.dolp_slopes(cosine[..., None]))
    noise = 0.01 * torch.randn(VIEWS, SURFACES, 3, generator=generator).double()
    return ViewSamples(
        weight=0.2 + uniform(),
        s0=diffuse + specular,
        across=over * specular - under * diffuse + noise,
        oblique=torch.zeros(VIEWS, SURFACES, 3).double(),
        noise=torch.zeros(VIEWS, SURFACES, 3).double(),
        cosine=cosine,
        normal=normal,
    )


def log_density(values: Tensor, design: Tensor, precision: Tensor) -> float:
    """Logarithm of a Gaussian density with independent errors and coefficients of unit variance, up to a constant."""
    covariance = torch.diag(1 / precision) + design @ design.T
    return float(-0.5 * (torch.logdet(covariance) + values @ torch.linalg.solve(covariance, values)))


def expected_gain(samples: ViewSamples, noise: Tensor) -> float:
    """Gain of a common gradient over none, as the ratio of two densities with full covariances, mean over colors."""
    above = samples.s0 + SETTING.dark
    weight = samples.weight[..., None] / above
    weight = weight / (weight * above**2).sum(dim=0)
    sine2 = 1 - samples.cosine[..., None] ** 2
    over, under = (slope * sine2 for slope in optics.dolp_slopes(samples.cosine[..., None]))
    best = []  # of each surface: error, excess, line, weight
    for place in range(SURFACES):
        tried = []
        for left in ROUGH:
            rough = left * over[:, place]
            line = (rough + under[:, place]).expand(-1, 3)
            excess = rough * samples.s0[:, place] - samples.across[:, place]
            weights = weight[:, place] / (1 + rough**2)
            light = (weights * line * excess).sum(dim=0) / (weights * line**2).sum(dim=0)
            error = float((weights * (excess - line * light) ** 2).sum(dim=0).mean())
            tried.append((error, excess, line, weights, light))
        best.append(min(tried, key=lambda values: values[0]))
    gain = 0.0
    for color in range(3):
        values = torch.cat([excess[:, color] for _, excess, *_ in best])
        precision = torch.cat([fit[3][:, color] / noise[k] for k, fit in enumerate(best)])
        flat = torch.block_diag(*[1e3 * fit[2][:, color, None] for fit in best])  # the light has no prior
        turns = [
            TURN * fit[4][color] * fit[2][:, color, None] * samples.normal[:, k] for k, fit in enumerate(best)
        ]
        design = torch.cat((flat, torch.cat(turns)), dim=1)
        gain += log_density(values, design, precision) - log_density(values, flat, precision)
    return gain / 3


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_a_gradient_that_neighbors_share_is_integrated_out(noise: float) -> None:
    """The gain over constant diffuse light is that of two Gaussian densities, if all surfaces are neighbors."""
    samples = turning_samples(0)
    noises = noise * torch.tensor([1.0, 2.0, 0.5, 3.0]).double()
    terms = dielectric_terms(samples, SETTING)
    fit = dielectric_fit(terms, noises, ALL_OTHERS)
    gain = ((terms.error() - fit.error) / (2 * noises) - fit.freedom).sum()
    assert float(gain) == pytest.approx(expected_gain(samples, noises), rel=1e-3, abs=1e-3)


def test_views_of_one_normal_leave_the_diffuse_light_constant() -> None:
    samples = turning_samples(1)
    samples = samples._replace(normal=samples.normal[:1].expand(VIEWS, SURFACES, 3))
    terms = dielectric_terms(samples, SETTING)
    fit = dielectric_fit(terms, torch.full((SURFACES,), 1e-4).double(), ALL_OTHERS)
    torch.testing.assert_close(fit.error, terms.error())
    assert float(fit.freedom.abs().max()) < 1e-9


def test_light_that_changes_with_the_normal_does_not_look_like_metal() -> None:
    """Several sides of a thin dielectric are visible; with constant diffuse light, its error is large."""
    samples = turning_samples(2)
    terms = dielectric_terms(samples, SETTING)
    fit = dielectric_fit(terms, torch.full((SURFACES,), 1e-5).double(), ALL_OTHERS)
    assert float((fit.error / terms.error()).max()) < 0.8


@pytest.mark.parametrize(("scale", "weight"), [(4e-4, 2.0), (1e-3, 6.0), (2e-3, 40.0)])
def test_the_prior_of_error_variances_is_estimated_from_samples(scale: float, weight: float) -> None:
    random = np.random.default_rng(3)
    observations = random.integers(8, 30, 20_000)
    variances = scale * weight / random.chisquare(weight, 20_000)
    samples = variances * random.chisquare(observations) / observations
    prior = variance_prior(torch.from_numpy(samples), torch.from_numpy(observations))
    assert prior.scale == pytest.approx(scale, rel=0.1)
    assert prior.weight == pytest.approx(weight, rel=0.15)


def test_the_variance_of_a_surface_is_integrated_out() -> None:
    """The ratio is that of two integrals over the variance, of the prior and the likelihood of all observations."""
    prior = VariancePrior(scale=4e-4, weight=3.0)
    count, errors = 5.0, (2e-3, 3e-4)
    logarithms = torch.linspace(math.log(1e-7), math.log(1e3), 20_000).double()
    variance = logarithms.exp()
    # The density of the prior in the logarithm of the variance.
    density = variance ** (-prior.weight / 2) * torch.exp(-prior.weight * prior.scale / (2 * variance))
    integrals = [
        float((density * variance ** (-count / 2) * torch.exp(-count * error / (2 * variance))).sum())
        for error in errors
    ]
    ratio = prior.ratio(*(torch.tensor([value]) for value in (count, *errors)))
    assert float(ratio) == pytest.approx(math.log(integrals[1] / integrals[0]), rel=1e-4)


def test_equal_variances_give_a_strong_prior() -> None:
    random = np.random.default_rng(4)
    samples = 1e-3 * random.chisquare(10, 5000) / 10
    prior = variance_prior(torch.from_numpy(samples), torch.full((5000,), 10.0))
    assert prior.weight > 200
    assert prior.scale == pytest.approx(1e-3, rel=0.02)


def test_errors_below_the_noise_of_a_camera_count_as_this_noise() -> None:
    prior = variance_prior(torch.full((100,), 1e-9), torch.full((100,), 200.0))
    assert prior.scale == pytest.approx(NOISE, rel=0.05)


def ratio_of(dielectric: Tensor, metal: Tensor, views: Tensor) -> Tensor:
    """Log likelihood ratio [N] of surfaces that show one normal in all views."""
    count = len(metal)
    zeros = torch.zeros(count)
    terms = DielectricTerms(dielectric, torch.zeros(count, 3, 3, 3), torch.zeros(count, 3, 3), zeros, zeros)
    none = torch.zeros(count, 0, dtype=torch.int64)
    return log_ratio(metal, terms, views, none)


def test_large_errors_of_other_surfaces_do_not_hide_a_metal() -> None:
    """Surfaces with wrong normals, with correct normals, and a metal with five views."""
    dielectric = torch.tensor([1.4e-3] * 500 + [2e-4] * 300 + [1.5e-3])
    metal = torch.tensor([2e-3] * 500 + [8e-4] * 300 + [2e-4])
    ratio = ratio_of(dielectric, metal, torch.full((801,), 5.0))
    assert float(ratio[-1]) > 10 * RULES.prior
    assert float(ratio[:-1].max()) < 0


def test_each_gaussian_gets_the_normals_of_its_pixels() -> None:
    """The normals of a ball are the directions of its Gaussians from the center."""
    ball = gaussians_of_the_ball()
    view = views_of("gray", 0.0)[0]
    sums = view_sums(ball, view, rasterize_cpu, LIMITS.least_normal)
    samples = samples_of([sums], slice(None), LIMITS)
    visible = samples.weight[0] > 1
    assert int(visible.sum()) > 50
    cosines = (samples.normal[0] * ball["means"]).sum(dim=-1)[visible]
    assert float(cosines.min()) > 0.95


def test_polarization_by_noise_is_no_evidence() -> None:
    """A metal explains all oblique polarization. If this is noise, the errors are those without it."""
    clean = turning_samples(0)
    generator = torch.Generator().manual_seed(1)
    noise = 0.05 * torch.randn(VIEWS, SURFACES, 3, generator=generator).double()
    noisy = clean._replace(oblique=noise, noise=noise)
    unknown = noisy._replace(noise=torch.zeros_like(noise))
    expected, measured, wrong = (metal_fit(samples, SETTING).error for samples in (clean, noisy, unknown))
    torch.testing.assert_close(measured, expected)
    assert bool((wrong < expected).all())
    errors = (dielectric_terms(samples, SETTING).error() for samples in (clean, noisy))
    torch.testing.assert_close(*errors)
    mirrored = clean._replace(oblique=noise + 0.2, noise=noise)
    assert bool((metal_fit(mirrored, SETTING).error < expected).all())


@pytest.mark.parametrize("angles", [(0, 45, 90, 135), (0, 30, 60, 90, 120, 150), (10, 40, 100, 130, 170)])
def test_redundant_pictures_determine_the_noise_of_the_stokes_vector(angles: tuple[int, ...]) -> None:
    four = views_of("gray", 0.0)[0]
    stokes = four.stokes()
    generator = torch.Generator().manual_seed(2)

    def view(noise: float) -> View:
        pictures = torch.stack([optics.intensity(stokes, math.radians(angle)) for angle in angles])
        pictures = 0.2 + 0.5 * pictures + noise * torch.randn(pictures.shape, generator=generator)
        exposures = tuple(Exposure(float(angle)) for angle in angles)
        return replace(four, pictures=(65535 * pictures).round().to(four.codes.dtype), exposures=exposures)

    assert float(stokes_noise(view(0.0)).abs().max()) < 1e-4
    clean, noisy = view(0.0), view(0.02)
    differences = (noisy.stokes() - clean.stokes())[1:]
    assert float(stokes_noise(noisy).std()) == pytest.approx(float(differences.std()), rel=0.05)


def test_three_pictures_do_not_determine_the_noise() -> None:
    view = views_of("gray", 0.0)[0]
    three = replace(view, pictures=view.codes[:3], exposures=view.exposures[:3])
    torch.testing.assert_close(stokes_noise(three), three.stokes()[0])


def test_surfaces_in_too_few_views_give_no_evidence() -> None:
    views = torch.tensor([0.0, 0.3, 0.0])
    assert not bool(ratio_of(torch.ones(3), 0.1 * torch.ones(3), views).any())


def test_the_light_of_a_scene_is_the_distribution_of_all_its_pixels() -> None:
    generator = torch.Generator().manual_seed(3)
    pictures = [torch.rand(count, 3, generator=generator) for count in (40, 7)]
    light = scene_light(pictures, dark=0.02)
    logarithms = np.log(
        np.concatenate([picture.double().numpy().mean(axis=1) for picture in pictures]) + 0.02
    )
    assert light.mean == pytest.approx(logarithms.mean(), rel=1e-6)
    assert light.spread == pytest.approx(logarithms.std(), rel=1e-5)
    even = scene_light([torch.full((5, 3), 0.5)], dark=0.0)
    assert 0 < even.spread < 0.05


def test_a_metal_in_front_of_dark_light_costs_the_square_of_its_distance() -> None:
    mean, spread = math.log(0.2), 0.6
    light = SceneLight(mean, spread, dark=0.0)
    reflectance = torch.tensor([[0.5, 0.5, 0.5], [0.9, 0.5, 0.1], [0.5, 0.5, 0.5]], dtype=torch.float64)
    mirrored = torch.tensor([-2.0, -1.0, 3.0]).double()  # standard deviations
    s0 = 0.5 * torch.exp(mean + spread * mirrored)[:, None].expand(-1, 3)
    changes = torch.exp(torch.tensor([-0.3, 0.0, 0.3]).double())
    views = len(changes)
    samples = ViewSamples(
        weight=torch.ones(views, 3).double(),
        s0=changes[:, None, None] * s0,
        across=torch.zeros(views, 3, 3).double(),
        oblique=torch.zeros(views, 3, 3).double(),
        noise=torch.zeros(views, 3, 3).double(),
        cosine=torch.full((views, 3), 0.7).double(),
        normal=torch.zeros(views, 3, 3).double(),
    )
    assert light.cost(samples, reflectance).tolist() == pytest.approx([2.0, 0.5, 0.0], abs=1e-9)


def test_radiance_is_that_of_valid_pixels() -> None:
    view = views_of("gold")[0]
    invalid = torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)
    invalid[:5] = True
    view = replace(view, invalid=invalid)
    valid = ~(invalid | view.saturated)
    torch.testing.assert_close(valid_radiance(view), view.stokes()[0][valid], atol=1e-4, rtol=0)


def test_dark_light_reduces_evidence_by_at_most_that_of_one_gaussian() -> None:
    ball = gaussians_of_the_ball()
    looks = [view_sums(ball, view, rasterize_cpu, LIMITS.least_normal) for view in views_of("gold")]
    labels = torch.zeros(len(ball["means"]))
    neighbors = neighbors_of(ball)

    def measured(mean: float) -> MetalEvidence:
        return of_views(looks, SceneLight(mean, 1.0, LIMITS.dark), labels, neighbors, 1.5, RULES, LIMITS)

    bright, gray, dark = (measured(mean) for mean in (-20.0, 0.0, 20.0))
    seen = bright.views > 0.5
    lost = [((bright.ratio - other.ratio) * bright.views)[seen] for other in (gray, dark)]
    assert float(lost[0].max()) > 0
    assert float(lost[0].max()) <= RULES.trust + 1e-3
    torch.testing.assert_close(lost[1], torch.full_like(lost[1], RULES.trust), atol=1e-3, rtol=0)
