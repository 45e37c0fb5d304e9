"""LPIPS: what it says without its network, and the loading code with a network of random weights."""

import importlib.machinery
import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch
import torchmetrics.image.lpip  # noqa: F401  (before the stand-in below can be mistaken for the real torchvision)
from torch import nn

from polarguide.evaluation import lpips


@pytest.fixture(autouse=True)
def fresh():
    lpips.load_metric.cache_clear()
    yield
    lpips.load_metric.cache_clear()


def picture(seed):
    return torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(seed))


def vgg16(weights=None):
    """The layers of VGG-16 up to its last convolution, after Simonyan and Zisserman 2015."""
    assert weights is not None
    torch.manual_seed(0)
    layers, channels = [], 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        for width in block:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2))
    return SimpleNamespace(features=nn.Sequential(*layers))


@pytest.fixture
def torchvision(monkeypatch, tmp_path):
    """A stand-in for torchvision whose weights are "there" once their file is; nothing may be downloaded."""
    package, models = ModuleType("torchvision"), ModuleType("torchvision.models")
    package.__spec__ = importlib.machinery.ModuleSpec("torchvision", None)
    models.VGG16_Weights = SimpleNamespace(DEFAULT=SimpleNamespace(url="https://example.org/vgg16-0.pth"))
    models.vgg16 = vgg16
    package.models = models
    monkeypatch.setitem(sys.modules, "torchvision", package)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    monkeypatch.setattr("torchmetrics.functional.image.lpips._TORCHVISION_AVAILABLE", True)
    monkeypatch.setattr("torchmetrics.image.lpip._TORCHVISION_AVAILABLE", True)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", None)
    (tmp_path / "checkpoints").mkdir()
    return tmp_path / "checkpoints" / "vgg16-0.pth"


def test_without_torchvision(monkeypatch):
    monkeypatch.setattr(lpips, "find_spec", lambda name: None)
    assert lpips.lpips(picture(1), picture(2)) == (
        None,
        "torchvision is not installed (the extra lpips has it)",
    )


def test_without_weights_nothing_is_downloaded(torchvision):
    value, reason = lpips.lpips(picture(1), picture(2))
    assert value is None
    assert "vgg16-0.pth are not in torch's hub cache" in reason
    assert lpips.FETCH_COMMAND in reason


def test_broken_torchvision(torchvision):
    del sys.modules["torchvision.models"].VGG16_Weights
    value, reason = lpips.lpips(picture(1), picture(2))
    assert value is None
    assert reason.startswith("torchvision cannot be imported (ImportError: ")


def test_small_picture():
    value, reason = lpips.lpips(picture(1)[:20], picture(2)[:20])
    assert (value, reason) == (None, "the picture is smaller than 32 x 32 pixels")


def test_distance(torchvision):
    torchvision.touch()
    true = picture(1)
    near, reason = lpips.lpips(true * 0.98, true)
    assert reason is None
    far, _ = lpips.lpips(picture(2), true)
    assert lpips.lpips(true, true) == (0.0, None)
    assert 0 < near < far
    assert lpips.load_metric()[0] is lpips.load_metric()[0]


def test_left_out_pixels_have_no_influence(torchvision):
    torchvision.touch()
    pred, true = picture(1), picture(2)
    keep = torch.ones(40, 48, dtype=torch.bool)
    keep[10:30, 10:30] = False
    value, _ = lpips.lpips(pred, true, keep)
    pred[~keep] = torch.nan
    assert lpips.lpips(pred, true, keep) == (value, None)
    assert lpips.lpips(pred.nan_to_num(), true)[0] != value
