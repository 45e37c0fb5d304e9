"""What the CUDA backend does around gsplat, with gsplat's functions in plain torch; and how it fails without them."""

import importlib
import sys
import time
import types

import gsplat_stand_in
import pytest
import torch
from faults import Fault
from raster_scenes import differences, in_view, outcome, posed
from reference_rasterizer import rasterize_reference

from polarguide import raster
from polarguide.raster import ScreenStatistic, Splats, choose_backend, cuda
from polarguide.raster.cuda import load_gsplat, rasterize_cuda

TOLERANCE = 2e-5


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", gsplat_stand_in)
    gsplat_stand_in.calls.clear()


CASES = [
    (channels, statistic)
    for channels in (1, 3, 6, 7, 8, 10, 11, 31, 32)
    for statistic in (None, (), (0, 1, 2), (1, 4), (4, 1), (2,), tuple(range(channels)))
    if not statistic or max(statistic) < channels
]


@pytest.mark.parametrize(("channels", "statistic"), CASES)
def test_pictures_gradients_and_statistics_are_those_of_the_reference(
    channels: int, statistic: tuple[int, ...] | None
) -> None:
    camera = posed(23, 21)
    gaussians = in_view(camera, 40, channels, seed=channels)
    found = outcome(rasterize_cuda, gaussians, camera, statistic)
    expected = outcome(rasterize_reference, gaussians, camera, statistic, dtype=torch.float64)
    worst = differences(found, expected)
    worst.pop("radii")  # gsplat's are of another kind
    assert max(worst.values()) < TOLERANCE, worst
    assert bool((found.radii[expected.radii > 0] > 0).all())


@pytest.mark.parametrize(("channels", "blended"), [(3, [3]), (8, [3, 5]), (7, [3, 4]), (11, [3, 8])])
def test_a_statistic_costs_one_more_call_where_other_channels_are_there(
    channels: int, blended: list[int]
) -> None:
    camera = posed(16, 16)
    inputs = Splats(*(t.requires_grad_() for t in in_view(camera, 10, channels, seed=1)))
    statistic = ScreenStatistic((0, 1, 2))
    rasterize_cuda(inputs, camera, statistic=statistic).features.sum().backward()
    assert gsplat_stand_in.calls == blended
    assert statistic.gradient is not None
    with torch.no_grad():
        rasterize_cuda(inputs, camera, statistic=statistic)
    assert len(gsplat_stand_in.calls) == len(blended) + 1


@pytest.mark.parametrize("still", [(3, 4, 5), (6, 2)])
@pytest.mark.parametrize("statistic", [None, (0, 1, 2)])
def test_still_channels_as_in_the_reference(
    still: tuple[int, ...], statistic: tuple[int, ...] | None
) -> None:
    camera = posed(23, 21)
    gaussians = in_view(camera, 40, 7, seed=2)
    found = outcome(rasterize_cuda, gaussians, camera, statistic, still=still)
    expected = outcome(rasterize_reference, gaussians, camera, statistic, still=still, dtype=torch.float64)
    worst = differences(found, expected)
    worst.pop("radii")  # gsplat's are of another kind
    assert max(worst.values()) < TOLERANCE, worst


def test_a_camera_is_copied_once() -> None:
    camera, other = posed(16, 16), posed(16, 16)
    first = cuda._view(camera, torch.device("cpu"))
    assert cuda._view(camera, torch.device("cpu")) is first
    assert cuda._view(other, torch.device("cpu")) is not first


def kernels(monkeypatch: pytest.MonkeyPatch, content: object) -> None:
    """What importing gsplat's kernels gives: a value of ``_C``, or an exception."""
    real = importlib.import_module

    def fake(name: str) -> object:
        if name != "gsplat.cuda._backend":
            return real(name)
        if isinstance(content, Exception):
            raise content
        return types.SimpleNamespace(_C=content)

    monkeypatch.setattr(importlib, "import_module", fake)
    monkeypatch.setattr(cuda, "has_gsplat", lambda: True)


def test_kernels_that_are_there_are_loaded_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    kernels(monkeypatch, object())
    said: list[str] = []
    load_gsplat(said.append)
    assert said == []


def test_compiling_is_announced_while_it_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(cuda, "NOTICE_SECONDS", 0.01)
    real = importlib.import_module

    def compiles(name: str) -> object:
        if name != "gsplat.cuda._backend":
            return real(name)
        for _ in range(1000):
            if not said:
                time.sleep(0.01)
        return types.SimpleNamespace(_C=object())

    monkeypatch.setattr(importlib, "import_module", compiles)
    monkeypatch.setattr(cuda, "has_gsplat", lambda: True)
    load_gsplat(said.append)
    assert len(said) == 1
    assert "compiling" in said[0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no CUDA toolkit"),
        (RuntimeError("Error building extension 'gsplat_cuda':\nlong\nlog"), "Error building extension"),
        (OSError("libcudart.so.13: cannot open shared object file"), "libcudart"),
        (ImportError(""), "ImportError"),
    ],
)
def test_a_failed_build_is_one_message_with_the_way_out(
    monkeypatch: pytest.MonkeyPatch, content: object, message: str
) -> None:
    kernels(monkeypatch, content)
    Fault("gsplat", "CUDA", message, "--device cpu").raised_by(load_gsplat, print)


def pretend(monkeypatch: pytest.MonkeyPatch, *, gpus: int, gsplat: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    for module in (raster, cuda):
        monkeypatch.setattr(module, "has_gsplat", lambda: gsplat)
    monkeypatch.setattr(raster, "load_gsplat", lambda say: load_gsplat(say) if not gsplat else None)


def test_auto_takes_the_gpu_that_can_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, gpus=2, gsplat=True)
    assert choose_backend("auto").device == torch.device("cuda", 0)
    assert choose_backend("cpu").device == torch.device("cpu")
    pretend(monkeypatch, gpus=0, gsplat=True)
    Fault("--device cuda", "a GPU", "none that PyTorch").raised_by(choose_backend, "cuda")


def test_auto_says_why_it_leaves_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, gpus=1, gsplat=False)
    said: list[str] = []
    assert choose_backend("auto", say=said.append).device == torch.device("cpu")
    assert "gsplat" in said[0]
    Fault("--device cuda", "gsplat", "", "install").raised_by(choose_backend, "cuda")


def test_auto_is_the_cpu_without_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, gpus=0, gsplat=True)
    assert choose_backend("auto").device == torch.device("cpu")
    Fault("--device cuda", "a GPU", "0").raised_by(choose_backend, "cuda")
