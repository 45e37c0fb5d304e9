"""LPIPS with a network of random weights, and FLIP against its formulas."""

import math
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
import torchmetrics.functional.image.lpips as reference
from scipy.ndimage import convolve
from skimage.color import rgb2lab, rgb2xyz, xyz2lab
from torch import nn

from polarguide.optics.color import shown
from polarguide.results.evaluation import perceptual
from polarguide.results.evaluation.perceptual import PIXELS_PER_DEGREE, flip, load_package


def picture(seed):
    return torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(seed))


def vgg16():
    """The layers of VGG-16 up to its last convolution, after Simonyan and Zisserman 2015, of random weights."""
    torch.manual_seed(0)
    layers, channels = [], 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        for width in block:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


@pytest.fixture(scope="module")
def network():
    return vgg16()


@pytest.fixture
def weights(network, monkeypatch, tmp_path):
    """A folder that is torch's cache; with the network's weights. Nothing may be downloaded."""
    monkeypatch.delenv(perceptual.FOLDER, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", None)
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    state = {f"features.{name}": values for name, values in network.state_dict().items()}
    torch.save(state | {"classifier.0.weight": torch.zeros(2)}, folder / perceptual.NETWORK)
    return folder


def test_the_same_as_torchmetrics(weights, network, monkeypatch):
    """Its own network comes from torchvision; here, ours is put in its place."""
    monkeypatch.setattr(reference, "_get_tv_model_features", lambda *_: network)
    theirs = reference._LPIPS(net="vgg", pnet_rand=True)
    for first, second in ((picture(1), picture(2)), (0.9 * picture(3), picture(3))):
        batches = (shown(each).movedim(-1, 0)[None] for each in (first, second))
        value, reason = perceptual.lpips(first, second)
        assert reason is None
        assert value == pytest.approx(float(theirs(*batches, normalize=True)), rel=1e-5)


def test_distance(weights):
    true = picture(1)
    near, reason = perceptual.lpips(true * 0.98, true)
    assert reason is None
    far, _ = perceptual.lpips(picture(2), true)
    assert perceptual.lpips(true, true) == (0.0, None)
    assert 0 < near < far
    assert perceptual.load_lpips()[0] is perceptual.load_lpips()[0]


def test_left_out_pixels_have_no_influence(weights):
    pred, true = picture(1), picture(2)
    keep = torch.ones(40, 48, dtype=torch.bool)
    keep[10:30, 10:30] = False
    value, _ = perceptual.lpips(pred, true, keep)
    pred[~keep] = torch.nan
    assert perceptual.lpips(pred, true, keep) == (value, None)
    assert perceptual.lpips(pred.nan_to_num(), true)[0] != value


def test_weights_from_a_folder(weights, monkeypatch, tmp_path):
    expected = perceptual.lpips(picture(1), picture(2))
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    shutil.move(weights / perceptual.NETWORK, folder)
    monkeypatch.setenv(perceptual.FOLDER, str(folder))
    reason = perceptual.lpips(picture(1), picture(2))[1]
    assert f"{perceptual.CHANNELS} are not in the folder {perceptual.FOLDER}" in reason
    shutil.copy(Path(reference.__file__).parent / "lpips_models" / perceptual.CHANNELS, folder)
    assert perceptual.lpips(picture(1), picture(2)) == expected


def test_without_weights_there_is_a_reason_and_nothing_is_downloaded(weights, monkeypatch):
    file = weights / perceptual.NETWORK
    file.write_bytes(file.read_bytes()[:1000])
    value, reason = perceptual.lpips(picture(1), picture(2))
    assert value is None
    assert reason.startswith(f"damaged: {perceptual.NETWORK} and ")
    file.unlink()
    value, reason = perceptual.lpips(picture(1), picture(2))
    assert value is None
    assert reason.startswith(f"not installed: its weights {perceptual.NETWORK} are missing; ")
    assert str(weights) not in reason
    file.touch()
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    assert reason != (reason := perceptual.lpips(picture(1), picture(2))[1])
    assert reason.startswith(f"not installed: its weights {perceptual.CHANNELS} are missing; ")


def test_small_picture():
    value, reason = perceptual.lpips(picture(1)[:20], picture(2)[:20])
    assert (value, reason) == (None, "the picture is smaller than 32 x 32 pixels")


needs_flip = pytest.mark.skipif(find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed")

# Andersson et al. 2020: contrast sensitivity of the three opponent channels, sums of two Gaussians; features; colors.
SENSITIVITY = ((1, 0.0047, 0, 1e-5), (1, 0.0053, 0, 1e-5), (34.1, 0.04, 13.5, 0.025))
FEATURE_WIDTH, FEATURE_POWER = 0.082, 0.5
COLOR_POWER, COLOR_SPLIT, SPLIT_VALUE = 0.7, 0.4, 0.95
WHITE = rgb2xyz(np.ones((1, 1, 3)))[0, 0]


def opponent(xyz):
    """Linearized CIELAB: the channels Yy, Cx, Cz."""
    x, y, z = np.moveaxis(xyz / WHITE, -1, 0)
    return np.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), axis=-1)


def from_opponent(channels):
    light, red, blue = np.moveaxis(channels, -1, 0)
    y = (light + 16) / 116
    return np.stack((y + red / 500, y, y - blue / 200), axis=-1) * WHITE


def eye(channels, ppd):
    seen = np.empty_like(channels)
    radius = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * ppd)
    steps = np.arange(-radius, radius + 1) / ppd
    square = steps[:, None] ** 2 + steps**2
    for channel, (a1, b1, a2, b2) in enumerate(SENSITIVITY):
        kernel = sum(
            a * math.sqrt(math.pi / b) * np.exp(-(math.pi**2) * square / b) for a, b in ((a1, b1), (a2, b2))
        )
        seen[..., channel] = convolve(channels[..., channel], kernel / kernel.sum(), mode="nearest")
    return seen


def hunted(rgb):
    """CIELAB whose chroma grows with lightness (the Hunt effect)."""
    lab = rgb.copy()
    lab[..., 1:] *= 0.01 * rgb[..., :1]
    return lab


def hyab(a, b):
    difference = a - b
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


def color_error(true, pred, ppd):
    labs = []
    for rgb in (true, pred):
        xyz = from_opponent(eye(opponent(rgb2xyz(rgb)), ppd))
        linear = np.clip(np.einsum("ij,hwj->hwi", np.linalg.inv(XYZ_FROM_RGB), xyz), 0, 1)
        labs.append(hunted(xyz2lab(np.einsum("ij,hwj->hwi", XYZ_FROM_RGB, linear))))
    green, blue = (hunted(rgb2lab(np.array([[rgb]], dtype=float))) for rgb in ((0, 1, 0), (0, 0, 1)))
    largest = float(hyab(green, blue)[0, 0]) ** COLOR_POWER
    error, knee = hyab(*labs) ** COLOR_POWER, COLOR_SPLIT * largest
    high = SPLIT_VALUE + (error - knee) / (largest - knee) * (1 - SPLIT_VALUE)
    return np.where(error < knee, SPLIT_VALUE / knee * error, high)


XYZ_FROM_RGB = rgb2xyz(np.where(np.eye(3)[None] > 0, 1.0, 0.0))[0].T


def features(rgb, ppd):
    """Strength of edges and of points in the lightness, each normalized."""
    light = (opponent(rgb2xyz(rgb))[..., 0] + 16) / 116
    sigma = 0.5 * FEATURE_WIDTH * ppd
    radius = math.ceil(3 * sigma)
    x, y = np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1))
    bell = np.exp(-(x**2 + y**2) / (2 * sigma**2))
    found = []
    for kernel in (-x * bell, (x**2 / sigma**2 - 1) * bell):
        kernel = np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), kernel / -kernel[kernel < 0].sum())
        found.append(np.hypot(*(convolve(light, k, mode="nearest") for k in (kernel, kernel.T))))
    return found


def by_the_paper(true, pred, ppd=PIXELS_PER_DEGREE):
    pairs = zip(features(true, ppd), features(pred, ppd), strict=True)
    feature = np.maximum(*(np.abs(a - b) for a, b in pairs))
    return color_error(true, pred, ppd) ** (1 - (feature / math.sqrt(2)) ** FEATURE_POWER)


def pictures():
    """Smooth pictures with an edge, linear."""
    y, x = np.mgrid[:40, :56] / 40
    true = np.stack((0.2 + 0.5 * x, 0.4 + 0.3 * y, 0.6 - 0.3 * x), axis=-1)
    pred = true * np.where(x < 0.7, 0.85, 1.1)[..., None] + 0.05 * np.sin(9 * y)[..., None]
    return torch.from_numpy(true), torch.from_numpy(pred)


@needs_flip
def test_as_the_paper_defines_it():
    true, pred = pictures()
    expected = by_the_paper(shown(true).numpy(), shown(pred).numpy())
    value, reason = flip(pred, true)
    assert reason is None
    assert 0.05 < value < 0.5
    assert value == pytest.approx(expected.mean(), rel=2e-3)


@needs_flip
def test_of_plain_colors_it_is_the_distance_of_colors_alone():
    black, white = torch.zeros(32, 32, 3), torch.ones(32, 32, 3)
    value, _ = flip(black, white)
    green, blue = (hunted(rgb2lab(np.array([[rgb]], dtype=float))) for rgb in ((0, 1, 0), (0, 0, 1)))
    largest = float(hyab(green, blue)[0, 0]) ** COLOR_POWER
    knee = COLOR_SPLIT * largest
    assert value == pytest.approx(
        SPLIT_VALUE + (100**COLOR_POWER - knee) / (largest - knee) * (1 - SPLIT_VALUE), abs=1e-4
    )
    assert flip(white, white) == (0.0, None)


@needs_flip
def test_left_out_pixels_have_no_influence_on_flip():
    true, pred = pictures()
    keep = torch.ones(40, 56, dtype=torch.bool)
    keep[10:30, 10:30] = False
    value = flip(pred, true, keep)
    assert value[0] is not None
    pred[~keep] = torch.nan
    assert flip(pred, true, keep) == value
    value, reason = flip(pred, true, torch.zeros(40, 56, dtype=torch.bool))
    assert value is None
    assert "no pixel" in reason


def test_without_the_package(monkeypatch):
    load_package.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "flip_evaluator", None)
    try:
        assert flip(*pictures()) == (None, "not installed: the package flip-evaluator")
    finally:
        load_package.cache_clear()
