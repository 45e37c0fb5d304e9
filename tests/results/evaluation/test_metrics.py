"""Metrics against independent packages, known values, and masks that must be honoured."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import (
    peak_signal_noise_ratio as torchmetrics_psnr,
)
from torchmetrics.functional.image import (
    structural_similarity_index_measure as torchmetrics_ssim,
)

from polarguide.results.evaluation import metrics


def similarity(pred, true, keep=None):
    return float(metrics.ssim(pred, true, keep))


def layer_psnr(*inputs, **options):
    return metrics.decibels(float(metrics.layer_error(*inputs, **options)))


def noise(seed, height=40, width=56):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def stripes(height=64, width=48):
    """Sharp edges, flat areas and values that clip."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack(
        ((x // 7) % 2 * 1.2, (y // 5) % 3 * 0.3, torch.full_like(x, 0.001, dtype=torch.float32)), -1
    )


def pairs():
    structured = stripes()
    blurred = torch.nn.functional.avg_pool2d(structured.movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1)
    return {
        "noise": (noise(1), noise(2)),
        "nearly equal": (noise(3), noise(3) + 0.01 * noise(4)),
        "stripes": (blurred, structured),
        "dark": (noise(5) * 0.004, noise(6) * 0.004),
    }


@pytest.mark.parametrize(
    ("linear", "encoded"),
    [
        (0.0, 0.0),
        (0.0031308, 0.04044994),
        (0.18, 0.46135613),
        (0.5, 0.73535698),
        (1.0, 1.0),
        (1.7, 1.0),
        (-2.0, 0.0),
    ],
)
def test_shown_is_the_srgb_transfer(linear, encoded):
    assert float(metrics.shown(torch.tensor(linear, dtype=torch.float64))) == pytest.approx(encoded, abs=1e-7)


def test_shown_has_a_finite_gradient_at_black():
    dark = torch.zeros(3, requires_grad=True)
    metrics.shown(dark).sum().backward()
    assert torch.allclose(dark.grad, torch.full((3,), 12.92))


each_pair = pytest.mark.parametrize(("pred", "true"), pairs().values(), ids=pairs())


@each_pair
def test_psnr_agrees_with_other_packages(pred, true):
    a, b = metrics.shown(pred.double()), metrics.shown(true.double())
    value = metrics.psnr(pred, true)
    assert value == pytest.approx(peak_signal_noise_ratio(b.numpy(), a.numpy(), data_range=1), abs=1e-6)
    assert value == pytest.approx(float(torchmetrics_psnr(a, b, data_range=1.0)), abs=1e-5)


@each_pair
def test_ssim_agrees_with_scikit_image(pred, true):
    theirs = structural_similarity(
        metrics.shown(true.double()).numpy(),
        metrics.shown(pred.double()).numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=-1,
    )
    assert similarity(pred, true) == pytest.approx(theirs, abs=1e-6)


@each_pair
def test_ssim_agrees_with_torchmetrics_inside(pred, true):
    a, b = (metrics.shown(p.double()).movedim(-1, 0)[None] for p in (pred, true))
    _, everywhere = torchmetrics_ssim(a, b, sigma=1.5, data_range=1.0, return_full_image=True)
    # It also averages the windows that reach over the border, filled with a mirror image.
    inside = float(everywhere[..., 5:-5, 5:-5].mean())
    assert similarity(pred, true) == pytest.approx(inside, abs=1e-6)


def test_equal_pictures():
    picture = noise(7)
    assert metrics.psnr(picture, picture) == math.inf
    assert similarity(picture, picture) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("metric", [metrics.psnr, similarity])
def test_left_out_pixels_have_no_influence(metric):
    pred, true = pairs()["stripes"]
    keep = torch.ones(true.shape[:2], dtype=torch.bool)
    keep[20:30, 5:17] = False
    broken_pred, broken_true = pred.clone(), true.clone()
    broken_pred[~keep] = math.nan
    broken_true[~keep] = 1 - broken_true[~keep]
    value = metric(pred, true, keep)
    assert math.isfinite(value)
    assert metric(broken_pred, broken_true, keep) == value
    assert value != metric(pred, true)


def test_psnr_over_a_mask_is_psnr_of_its_pixels():
    pred, true = noise(8), noise(9)
    keep = torch.zeros(true.shape[:2], dtype=torch.bool)
    keep[3:20, 10:30] = True
    assert metrics.psnr(pred, true, keep) == pytest.approx(metrics.psnr(pred[3:20, 10:30], true[3:20, 10:30]))


def test_keeping_everything_is_no_mask():
    pred, true = noise(10), noise(11)
    keep = torch.ones(true.shape[:2], dtype=torch.bool)
    assert similarity(pred, true, keep) == similarity(pred, true)
    assert metrics.psnr(pred, true, keep) == metrics.psnr(pred, true)


def test_ssim_beside_a_masked_half_is_not_darkened_by_it():
    true = noise(12)
    pred = true.clone()
    pred[:, 28:] = 0
    keep = torch.zeros(true.shape[:2], dtype=torch.bool)
    keep[:, :28] = True
    assert similarity(pred, true, keep) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "metric", [metrics.psnr, metrics.ssim, metrics.normal_mae_deg, metrics.normal_within_11]
)
def test_nothing_kept_is_nan(metric):
    assert math.isnan(metric(noise(1), noise(2), torch.zeros(40, 56, dtype=torch.bool)))


@pytest.mark.parametrize(
    ("metric", "given", "what"),
    [
        (metrics.psnr, (noise(1), noise(1)[:, 1:]), r"\[40, 56, 3\] and \[40, 55, 3\]"),
        (metrics.ssim, (noise(1), noise(1), torch.ones(40, 56)), r"keep: .*\[40, 56\]"),
        (metrics.ssim, (noise(1)[:10], noise(1)[:10]), "56 x 10"),
        (metrics.normal_angles_deg, (noise(1), noise(1)[1:]), "normals: "),
    ],
)
def test_shapes_that_do_not_fit_are_refused(metric, given, what):
    with pytest.raises(ValueError, match=what):
        metric(*given)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 11.24, 45.0, 90.0, 179.9999999, 180.0])
def test_normal_angles_are_exact_at_both_ends(degrees):
    true = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turn = np.deg2rad(degrees)
    pred = torch.tensor([np.sin(turn), 0.0, np.cos(turn)]) * 3.7
    assert float(metrics.normal_angles_deg(pred, true)) == pytest.approx(degrees, abs=1e-9)


def test_missing_normals():
    axis = torch.tensor([0.0, 1.0, 0.0])
    for nothing in (torch.zeros(3), torch.full((3,), math.nan)):
        assert float(metrics.normal_angles_deg(nothing, axis)) == 90
    assert math.isnan(metrics.normal_angles_deg(axis, torch.zeros(3)))


def test_normal_scores_over_a_mask():
    true = torch.zeros(2, 3, 3)
    true[..., 2] = 1
    true[1, 2] = 0  # no surface there
    angles = torch.tensor([[0.0, 10.0, 20.0], [11.0, 80.0, 5.0]]).deg2rad()
    pred = torch.stack((torch.sin(angles), torch.zeros_like(angles), torch.cos(angles)), -1)
    keep = torch.tensor([[True, True, True], [True, False, True]])
    assert float(metrics.normal_mae_deg(pred, true, keep)) == pytest.approx(41 / 4, abs=1e-4)
    assert metrics.normal_within_11(pred, true, keep) == 0.75
    assert float(metrics.normal_within_11(pred, true)) == pytest.approx(0.6)


def test_layer_psnr_compares_with_half_the_lobe():
    lobe, keep = noise(13), torch.ones(40, 56, dtype=torch.bool)
    assert layer_psnr(lobe / 2, lobe, keep) == math.inf
    assert layer_psnr(lobe * 0.45, lobe, keep) == pytest.approx(metrics.psnr(lobe * 0.45, lobe / 2))


def test_aligned_layer_forgives_one_factor_per_channel_and_no_more():
    lobe, keep = noise(14), torch.ones(40, 56, dtype=torch.bool)
    keep[:, :9] = False
    tinted = lobe * torch.tensor([0.2, 1.3, 0.7])
    tinted[:, :9] = 5.0  # outside the mask: must not move the factor
    assert layer_psnr(tinted, lobe, keep, aligned=True) > 120
    assert layer_psnr(tinted + 0.1, lobe, keep, aligned=True) < 40
    assert layer_psnr(tinted, lobe, keep) < 20
    black = torch.zeros_like(lobe)
    assert layer_psnr(black, lobe, None, aligned=True) == layer_psnr(black, lobe, None)


def test_alignment_minimizes_the_linear_error():
    pred, lobe = noise(15) * 0.5, noise(16) * 0.5
    flat_pred, half = pred.flatten(0, 1).double(), lobe.flatten(0, 1).double() / 2
    scales = [
        np.linalg.lstsq(flat_pred[:, [c]].numpy(), half[:, c].numpy(), rcond=None)[0][0] for c in range(3)
    ]
    expected = metrics.psnr(pred.double() * torch.tensor(np.array(scales)), lobe / 2)
    assert layer_psnr(pred, lobe, None, aligned=True) == pytest.approx(expected, abs=1e-9)


def test_reflective_mask():
    s0 = torch.tensor([[[1.0, 1.0, 1.0]] * 4])
    specular = torch.tensor([[[0.9, 0.1, 0.0], [0.8, 0.0, 0.0], [0.4, 0.4, 0.4], [0.0, 0.0, 0.0]]])
    mask = torch.tensor([[True, True, False, True]])
    # The share is one of sums over channels: 1.0 of 3 is enough, 0.8 of 3 (all of it in red) is not.
    assert metrics.reflective_mask(specular, s0, mask).tolist() == [[True, False, False, False]]
