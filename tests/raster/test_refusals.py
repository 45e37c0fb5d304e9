"""What a rasterizer refuses, and how it says so."""

from __future__ import annotations

import math
import re

import pytest
import torch
from raster_scenes import looking_ahead, repeated, round_gaussian

from polarguide.core.errors import PolarguideError
from polarguide.raster import Rasterize, ScreenStatistic, Splats, choose_backend, rasterize_reference
from polarguide.raster.cpu import rasterize_cpu

BOTH = pytest.mark.parametrize("rasterize", [rasterize_cpu, rasterize_reference], ids=["cpu", "reference"])


@BOTH
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", Splats._fields)
def test_what_is_not_finite_is_refused_with_its_index(rasterize: Rasterize, name: str, value: float) -> None:
    camera = looking_ahead(8, 8)
    for index in (0, 3, 5):
        gaussians = repeated(round_gaussian(1.0, 0.5), 6)
        broken = getattr(gaussians, name).clone()
        broken.view(6, -1)[index, -1] = value
        with pytest.raises(PolarguideError, match=re.escape(f"rasterize({name})")) as error:
            rasterize(gaussians._replace(**{name: broken}), camera)
        assert error.value.found == f"NaN or infinity in Gaussian {index}"


@BOTH
@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (6, 2)),
        ("means", ()),
        ("means", (5, 3)),
        ("rotations", (6, 3)),
        ("rotations", (5, 4)),
        ("scales", (6,)),
        ("scales", (7, 3)),
        ("opacities", (6, 1)),
        ("opacities", (1,)),
        ("features", (6,)),
        ("features", (5, 3)),
        ("features", (6, 3, 1)),
    ],
)
def test_wrong_shapes_are_refused(rasterize: Rasterize, name: str, shape: tuple[int, ...]) -> None:
    gaussians = repeated(round_gaussian(1.0, 0.5), 6)
    with pytest.raises(PolarguideError, match=r"expected shape .* found"):
        rasterize(gaussians._replace(**{name: torch.ones(shape)}), looking_ahead(8, 8))


@BOTH
@pytest.mark.parametrize("channels", [0, 33, 100])
def test_channels_beyond_the_interface_are_refused(rasterize: Rasterize, channels: int) -> None:
    gaussians = round_gaussian(1.0, 0.5)._replace(features=torch.ones(1, channels))
    with pytest.raises(PolarguideError, match=f"1 to 32 channels, found {channels}"):
        rasterize(gaussians, looking_ahead(8, 8))


@BOTH
@pytest.mark.parametrize("channels", [(2,), (0, -1), (1, 1)])
def test_statistic_over_channels_that_do_not_exist_is_refused(
    rasterize: Rasterize, channels: tuple[int, ...]
) -> None:
    with pytest.raises(PolarguideError, match="statistic"):
        rasterize(round_gaussian(1.0, 0.5), looking_ahead(8, 8), statistic=ScreenStatistic(channels))


@BOTH
@pytest.mark.parametrize("channels", [(2,), (0, -1), (1, 1)])
def test_still_channels_that_do_not_exist_are_refused(
    rasterize: Rasterize, channels: tuple[int, ...]
) -> None:
    with pytest.raises(PolarguideError, match="still"):
        rasterize(round_gaussian(1.0, 0.5), looking_ahead(8, 8), still=channels)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.int64])
def test_native_backend_refuses_other_number_types(dtype: torch.dtype) -> None:
    gaussians = round_gaussian(1.0, 0.5)
    for name in Splats._fields:
        with pytest.raises(PolarguideError, match=re.escape(f"rasterize({name}): expected float32")):
            rasterize_cpu(
                gaussians._replace(**{name: getattr(gaussians, name).to(dtype)}), looking_ahead(8, 8)
            )


def test_cuda_is_refused_with_a_remedy() -> None:
    with pytest.raises(PolarguideError, match="--device cpu"):
        choose_backend("cuda")
